from contextlib import nullcontext
from dataclasses import fields, is_dataclass, replace

import pytest

from giril_rl.config.compose import Composer, groups, resolved
from giril_rl.config.overrides import sweep
from giril_rl.config.recipes import config_class, copy, find, shipped
from giril_rl.config.schema import RunConfig, TaskConfig
from giril_rl.errors import UserError
from giril_rl.methods import methods
from giril_rl.runs.identity import config_hash, out_folder, safe, variant

GIRIL = find("giril")
CONFIG = config_class(GIRIL)


def config_of(*texts):
    return resolved(GIRIL, CONFIG, texts)[0]


def out_of(*texts):
    config, changes = resolved(GIRIL, CONFIG, texts)
    return out_folder("giril", config, changes).as_posix()


def test_result_is_the_recipes_own_dataclass():
    config = config_of("ppo.lr=1e-3", "ppo.hidden=[8,4]", "seed=3")
    assert type(config) is CONFIG
    for part in fields(config):
        assert "DictConfig" not in type(getattr(config, part.name)).__name__
    assert is_dataclass(config.ppo)
    assert (config.ppo.lr, config.ppo.hidden, config.seed) == (1e-3, [8, 4], 3)
    assert type(config.ppo.hidden) is list


@pytest.mark.parametrize(
    ("task", "env_id", "steps", "score"),
    [
        ("inverted_pendulum", "InvertedPendulumBulletEnv-v0", 300_000, 990),
        ("inverted_double_pendulum", "InvertedDoublePendulumBulletEnv-v0", 1_000_000, 9_000),
    ],
)
def test_tasks(task, env_id, steps, score):
    config = config_of(f"task={task}")
    assert config.task == TaskConfig(
        task, env_id, steps=steps, expert_score=score, demonstration="shipped"
    )
    assert config.steps == steps


def test_steps_follow_the_task_unless_given():
    assert config_of("task.steps=70000").steps == 70000
    assert config_of("steps=90000", "task=inverted_double_pendulum").steps == 90000


def test_expert_trains_for_five_million_steps():
    expert = find("expert")
    assert resolved(expert, config_class(expert), [])[0].steps == 5_000_000


@pytest.mark.parametrize("recipe", shipped(), ids=lambda recipe: recipe.name)
def test_the_task_says_how_long_an_expert_is_trained(recipe):
    config = resolved(recipe, config_class(recipe), ["task.expert_steps=700000"])[0]
    found = config.steps if recipe.name == "expert" else config.expert.steps_on(config.task)
    assert found == 700_000


@pytest.mark.parametrize(("profile", "mean"), [("released", True), ("paper", False)])
def test_profiles(profile, mean):
    config = config_of(f"profile={profile}")
    assert (config.profile, config.batch_mean) == (profile, mean)
    assert config_of(f"profile={profile}", "batch_mean=true").batch_mean is True


def test_an_environment_alone_chooses_the_gymnasium_task():
    config = config_of("task.env_id=my/Reach-v5")
    assert (config.task.name, config.task.env_id) == ("my/Reach-v5", "my/Reach-v5")
    assert config.task.expert_score is None
    kept = config_of("task=inverted_pendulum", "task.env_id=Other-v0").task
    assert (kept.name, kept.env_id) == ("inverted_pendulum", "Other-v0")


def test_atari_has_settings_of_its_own_that_lose_against_the_users():
    config = config_of("task.env_id=ALE/Pong-v5", "demo.subsample=2")
    assert (config.task.name, config.task.steps) == ("ALE/Pong-v5", 49_999_872)
    assert (config.ppo.num_envs, config.ppo.rollout, config.ppo.anneal_lr) == (8, 128, True)
    assert config.ppo.entropy_coef == 0.01 and config.ppo.clip_value
    assert (config.demo.length, config.demo.episodes, config.demo.subsample) == (None, 1, 2)
    assert config.reward.normalise == "pixels"
    vector = config_of("task=inverted_pendulum")
    assert (vector.ppo.num_envs, vector.ppo.clip_value, vector.demo.length) == (16, False, 1000)
    assert config_of("task=breakout").task.steps % (8 * 128) == 0


def test_a_recipes_own_yaml_wins_over_the_kind_of_task(tmp_path):
    file, settings = copy(find("giril"), tmp_path / "mine.py")
    settings.write_text(settings.read_text() + "ppo: {rollout: 64}\n")
    mine = find(str(file))
    config, _ = resolved(mine, config_class(mine), ["task=breakout", "steps=1024"])
    assert (config.ppo.rollout, config.ppo.num_envs) == (64, 8)


@pytest.mark.parametrize("recipe", shipped(), ids=lambda recipe: recipe.name)
def test_every_shipped_recipe_composes_with_every_choice(recipe):
    schema = config_class(recipe)
    for group, (names, default) in groups(recipe).items():
        assert default in names
        # One recipe composes with all tasks, for composing takes its time.
        few = group == "task" and recipe.name != "giril"
        for name in {default, "gymnasium", "breakout"} if few else names:
            needed = {"gymnasium": "Pendulum-v1", "atari": "ALE/Pong-v5"}
            extra = [f"task.env_id={needed[name]}"] if name in needed else []
            words = [f"{group}={name}", *extra]
            images = group == "task" and config_of(*words).task.family.observation == "image"
            with of_vectors_alone(recipe.name, images):
                resolved(recipe, schema, words)


def of_vectors_alone(recipe, images):
    """A refusal where a task of images is chosen for a recipe that has no form for it."""
    if images and recipe in methods() and not methods()[recipe].frames:
        return pytest.raises(UserError, match=r"of vectors and .* shows images")
    return nullcontext()


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        (
            ["ppo.learning_rate=1"],
            "'ppo.learning_rate' is not a key of giril; did you mean 'ppo.lr'?",
        ),
        (["lr=1"], "'lr' is not a key of giril; did you mean 'fit.lr' or 'ppo.lr' or 'sac.lr'?"),
        (["sede=1"], "'sede' is not a key of giril; did you mean 'seed'?"),
        (["taks=foo"], "'taks' is not a key of giril; did you mean 'task'?"),
        (["ppo={lrr:1}"], "'ppo.lrr' is not a key of giril; did you mean 'ppo.lr'?"),
        (["eval.zzz=1"], "'eval.zzz' is not a key of giril: eval has episodes, seed."),
        (["qqq=1"], "'qqq' is not a key of giril: see `giril run giril --help`."),
        (
            ["task=foo"],
            "task=foo: choose one of ant, atari, beam_rider, breakout, gymnasium, half_cheetah, "
            "hopper, inverted_double_pendulum, inverted_pendulum, inverted_pendulum_swingup, "
            "kung_fu_master, qbert, reacher, seaquest, space_invaders, walker2d, or give "
            "a Gymnasium id, such as task.env_id=ALE/Pong-v5.",
        ),
        (["profile=foo"], "profile=foo: choose one of paper, released."),
        (["seed=abc"], "seed=abc: a whole number is needed."),
        (["seed="], "seed=: a whole number is needed."),
        (["steps=1e5"], "steps=1e5: a whole number is needed, such as 100000."),
        (["ppo.lr=fast"], "ppo.lr=fast: a number is needed."),
        (["ppo.anneal_lr=maybe"], "ppo.anneal_lr=maybe: true or false is needed."),
        (["scaling.clip=x"], "scaling.clip=x: a number or null is needed."),
        (["ppo.hidden=3"], "ppo.hidden=3: a list of whole numbers such as [100,100] is needed."),
        (["ppo=3"], "ppo=3: ppo holds several keys; set one, such as ppo.num_envs."),
        (["seed"], "'seed' is not of the form key=value."),
        (["+new=1"], "+new=1: keys can be changed, not added or removed; write key=value."),
        (["~seed"], "~seed: keys can be changed, not added or removed; write key=value."),
        (["seed=1", "seed=2"], "seed is given twice: give it once."),
        (["seed=1,2"], "seed=1,2 gives several values: add -m to run one after another."),
        (
            ["task=gymnasium"],
            "task.env_id has no value: give one, such as task.env_id=Pendulum-v1.",
        ),
        (["reward.beta=2"], "reward.beta=2.0 must be less than or equal to 1."),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_refusals(texts, sentence):
    with pytest.raises(UserError) as refusal:
        config_of(*texts)
    assert str(refusal.value) == sentence


@pytest.mark.parametrize(
    "text", ["out=a b(", "ppo.hidden=[1,2", "seed=${ppo.foo}", "steps=${root}"]
)
def test_unreadable_values_are_refused_in_one_line(text):
    with pytest.raises(UserError) as refusal:
        config_of(text)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).endswith(".")


def test_sweep_is_the_product_of_all_values():
    assert sweep(["seed=range(0,2)", "ppo.lr=0.1,0.2", "steps=5"]) == [
        ["seed=0", "ppo.lr=0.1", "steps=5"],
        ["seed=0", "ppo.lr=0.2", "steps=5"],
        ["seed=1", "ppo.lr=0.1", "steps=5"],
        ["seed=1", "ppo.lr=0.2", "steps=5"],
    ]


@pytest.mark.parametrize("text", ["ppo.lr=interval(0,1)", "task=glob(*)"])
def test_a_sweep_without_values_is_refused(text):
    with pytest.raises(UserError, match="needs its values listed"):
        sweep([text])


@pytest.mark.parametrize(
    ("texts", "folder"),
    [
        (["seed=3", "logger=csv", "threads=2"], "runs/giril/inverted_pendulum/default/seed3"),
        (
            ["root=/data", "profile=paper", "ppo.lr=1e-3", "task=inverted_double_pendulum"],
            "/data/giril/inverted_double_pendulum/ppo.lr=0.001,profile=paper/seed0",
        ),
        (["task.env_id=Pendulum-v1"], "runs/giril/Pendulum-v1/default/seed0"),
        (
            ["task=inverted_pendulum", "task.env_id=Pendulum-v1"],
            "runs/giril/inverted_pendulum/task.env_id=Pendulum-v1/seed0",
        ),
        (["out='o/${task.name}/${seed}'", "seed=1"], "o/inverted_pendulum/1"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_out_folder(texts, folder):
    assert out_of(*texts) == folder


def test_names_are_safe_short_and_distinct():
    long = [{"a": "a=" + "x" * 100 + end} for end in "12"]
    first, second = map(variant, long)
    assert len(first) == len(second) == 80
    assert first != second
    assert variant({"a": "a=b/c"}) != variant({"a": "a=b-c"})
    assert "/" not in safe("../a b") and not safe("../a b").startswith(".")


def test_config_hash_tells_configurations_apart():
    config = config_of()
    same = replace(config, out="x", root="y", logger=None, threads=2)
    assert config_hash(same) == config_hash(config)
    assert config_hash(replace(config, seed=1)) != config_hash(config)
    assert config_hash(config_of("ppo.lr=0.1")) != config_hash(config)
    assert len(config_hash(config)) == 12
    assert set(config_hash(RunConfig())) <= set("0123456789abcdef")


@pytest.mark.parametrize("default", ["cart-0.1", "null"])
def test_a_default_may_have_a_dot_in_its_name_or_be_left_to_the_command_line(default, tmp_path):
    copy(GIRIL, tmp_path / "mine.py")
    (tmp_path / "task").mkdir()
    (tmp_path / "task/cart-0.1.yaml").write_text("name: cart\nenv_id: CartPole-v1\n")
    settings = f"defaults: [recipe_schema, {{task: {default}}}, _self_]\nsteps: 2000\n"
    (tmp_path / "mine.yaml").write_text(settings)
    texts = ["task=cart-0.1"] if default == "null" else []
    assert resolved(find(str(tmp_path / "mine.py")), CONFIG, texts)[0].task.name == "cart"


# One configuration has one folder, however it was asked for.


def composer(name):
    found = find(name)
    return Composer(found, config_class(found))


def folder(*texts, recipe="giril"):
    found = composer(recipe)
    job = found.job(texts)
    return out_folder(found.recipe.name, job.config, job.changes).as_posix()


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
    job = composer(str(file)).job(["seed=7"])
    assert (job.config.seed, job.config.expert.seed) == (7, 7)


def test_the_words_kept_make_the_same_configuration():
    giril = composer("giril")
    job = giril.job(["logger=null", "profile=paper", "seed=3", "batch_mean=false"])
    assert job.words == ("logger=null", "profile=paper", "seed=3")
    assert giril.job(job.words).config == job.config


def test_a_mapping_is_the_choice_of_its_keys_alone():
    config = config_of("task.env_id=ALE/Pong-v5", "ppo={lr:0.1}")
    assert (config.ppo.lr, config.ppo.num_envs) == (0.1, 8)
