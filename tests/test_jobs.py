"""One configuration has one folder, however it was asked for."""

import pytest

from giril_rl.config.jobs import Jobs
from giril_rl.config.recipe_config import config_class
from giril_rl.config.recipe_files import copy, find
from giril_rl.runs.identity import out_folder

JOBS = Jobs()


def folder(*texts, recipe="giril"):
    found = find(recipe)
    job = JOBS.job(found, config_class(found), texts)
    return out_folder(found.name, job.config, job.changes).as_posix()


@pytest.mark.parametrize(
    ("texts", "name"),
    [
        (["profile=released"], "default"),
        (["task=inverted_pendulum", "ppo.lr=3e-4", "fit.steps=50000"], "default"),
        (["task.steps=300000", "steps=300000", "demo.path=shipped"], "default"),
        (
            ["eval.episodes=3", "ppo.checkpoint_every=7", "fit.log_every=9", "imports=[a]"],
            "default",
        ),
        (["task.env_id=InvertedPendulumBulletEnv-v0", "task=inverted_pendulum"], "default"),
        (["profile=paper", "batch_mean=false"], "profile=paper"),
        (["batch_mean=true", "profile=paper"], "batch_mean=true,profile=paper"),
        (["batch_mean=False", "profile=released"], "batch_mean=false"),
        (["task.steps=70000", "steps=70000"], "task.steps=70000"),
        (["steps=300000", "task.steps=70000"], "steps=300000,task.steps=70000"),
        (["ppo.lr=1e-3"], "ppo.lr=0.001"),
        (["ppo={lr:0.0010,clip:0.1}"], "ppo.lr=0.001"),
        (["ppo.lr=1"], "ppo.lr=1.0"),
        (
            ["ppo.hidden=[ 8, 8 ]", "demo.deterministic=no"],
            "demo.deterministic=false,ppo.hidden=8,8",
        ),
        (["fit.steps=${steps}", "steps=50000"], "steps=50000"),
        (["fit.steps=${steps}"], "fit.steps=300000"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_folder_is_named_by_what_differs(texts, name):
    expected = f"runs/giril/inverted_pendulum/{name}/seed0"
    assert folder(*texts) == expected
    if len(texts) > 1:
        assert folder(*reversed(texts), "seed=0") == expected


def test_an_atari_tasks_own_values_are_its_defaults():
    assert folder("task=breakout", "ppo.num_envs=8") == "runs/giril/breakout/default/seed0"
    assert folder("task=breakout", "ppo.num_envs=16") == "runs/giril/breakout/ppo.num_envs=16/seed0"
    assert folder("task.env_id=ALE/Pong-v5", "ppo.num_envs=8") == folder("task.env_id=ALE/Pong-v5")


def test_a_recipe_may_leave_a_value_to_the_command_line(tmp_path):
    file, settings = copy(find("giril"), tmp_path / "mine.py")
    settings.write_text(settings.read_text().replace("${task.steps}", "???"))
    texts = ["steps=2000", "profile=released"]
    name = "runs/mine/inverted_pendulum/steps=2000/seed0"
    assert folder(*texts, recipe=str(file)) == name


def test_a_seed_that_another_setting_follows_is_composed_with_it(tmp_path):
    file, settings = copy(find("giril"), tmp_path / "mine.py")
    settings.write_text(settings.read_text() + "expert: {seed: '${seed}'}\n")
    recipe = find(str(file))
    job = JOBS.job(recipe, config_class(recipe), ["seed=7"])
    assert (job.config.seed, job.config.expert.seed) == (7, 7)


def test_the_words_kept_make_the_same_configuration():
    recipe = find("giril")
    schema = config_class(recipe)
    job = JOBS.job(recipe, schema, ["logger=null", "profile=paper", "seed=3", "batch_mean=false"])
    assert job.words == ("logger=null", "profile=paper", "seed=3")
    assert JOBS.job(recipe, schema, job.words).config == job.config
