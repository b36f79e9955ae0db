"""Pictures of a made-up Atari run, what is said where a file is missing, and predictions."""

import re
import shutil
import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical

from giril_rl.cli.command_line import main
from giril_rl.config.schema import DemoConfig, ExpertConfig, PPOConfig, RunConfig
from giril_rl.demos import record_demonstration
from giril_rl.envs import gym_factory, make_env
from giril_rl.experiments.report.pictures import draw_predictions, is_generative, predict
from giril_rl.experiments.report.reading import read_runs
from giril_rl.experiments.report.tables import panels_of
from giril_rl.rewards import GenerativeConfig, GenerativeReward
from giril_rl.runs.finished import read_config, read_part, read_result, read_settings
from giril_rl.runs.identity import config_hash
from giril_rl.training import make_agent
from giril_rl.training.demonstrations import demonstration_place
from giril_rl.training.experts import expert_settings

WORDS = ("task=breakout", "task.max_episode_steps=20")


@pytest.fixture
def run(made):
    """``run(recipe, *words)``: the folder of a run with policy and reward model."""
    pytest.importorskip("ale_py")

    def write(recipe, *words):
        folder = made(recipe, *WORDS, *words, score=1.0, demo_transitions=18)
        config = read_config(folder)
        env = make_env(read_settings(folder)[0], 1, seed=0)
        make_agent(env, PPOConfig(), seed=0).save_pretrained(folder / "policy")
        beta = read_part(folder, config, "reward", GenerativeConfig).beta
        reward = GenerativeReward.for_pixels(env.action_spec, beta=beta)
        reward.save_pretrained(folder / "reward")
        return folder

    return write


def record(root, folder):
    """Records what the run in ``folder`` asks for, where recipes do."""
    config = read_config(folder)
    task, _ = read_settings(folder)
    demo, expert = (
        read_part(folder, config, name, kind)
        for name, kind in (("demo", DemoConfig), ("expert", ExpertConfig))
    )
    cfg = RunConfig(task=task, seed=config["seed"])
    made_by = config_hash(expert_settings(cfg, expert))
    recorded = record_demonstration(
        gym_factory(task), lambda seen: seen.new_zeros(1).long(), seed=0, episodes=1, lives="first"
    )
    assert len(recorded) == read_result(folder)["demo_transitions"]
    recorded.save(root / demonstration_place(cfg, demo, made_by))


def report(made, capsys):
    out = made.root.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    assert main(["report", str(made.root), "--out", str(out)]) == 0
    capsys.readouterr()
    pictures = {path.name: path.read_bytes() for path in out.glob("*.png")}
    section = (out / "report.md").read_text().partition(": pictures\n")[2]
    return section, {k: v for k, v in pictures.items() if k.startswith(("predictions", "reward"))}


def test_the_lowest_seed_of_a_row_has_two_pictures(run, made, capsys):
    record(made.root, run("giril", "seed=1", "demo.path=null"))
    run("giril", "seed=2", "demo.path=null")
    made("cdil", *WORDS, score=1.0)
    section, pictures = report(made, capsys)
    name = "breakout-task.max_episode_steps=20-giril-released-demo.path=null-49999872-seed1.png"
    assert sorted(pictures) == [f"predictions-{name}", f"reward-{name}"]
    assert re.findall(r"\]\((.*?)\)", section) == sorted(pictures)
    assert all(content.startswith(b"\x89PNG") for content in pictures.values())
    about = (
        r"^GIRIL \(released\), seed 1, 49,999,872 steps `demo.path=null`: `giril/.*,seed=1,.*`; "
    )
    assert re.search(about + r"a whole game of \d+ steps, seed 1000[0-4]\.$", section, re.M)
    assert "not in the folder" not in section
    assert report(made, capsys) == (section, pictures)


def test_without_its_demonstration_a_run_shows_its_policy(run, made, capsys):
    run("giril", "reward.beta=0.9", "demo.path=null")
    section, pictures = report(made, capsys)
    assert len(pictures) == 2
    assert (
        "Its demonstration is not in the folder reported on, so all transitions are the policy's."
        in section
    )
    assert not (made.root / "demos").exists() and not (made.root / "expert").exists()


def test_what_is_missing_is_said_in_one_sentence(run, made, capsys, monkeypatch):
    shutil.rmtree(run("giril", "reward.beta=0.7") / "reward")
    shutil.rmtree(run("giril", "reward.beta=0.8") / "policy")
    text, pictures = report(made, capsys)
    place = f"giril/breakout/{','.join(WORDS)},reward.beta="
    assert not pictures
    assert text.strip().splitlines() == [
        f"No pictures of `{place}0.7`: its reward holds no saved module (card.json and "
        "model.safetensors): check the path.",
        "",
        f"No pictures of `{place}0.8`: it holds no trained policy: run it to its end first.",
    ]
    run("giril", "reward.beta=0.9")
    monkeypatch.setitem(sys.modules, "ale_py", None)
    text, _ = report(made, capsys)
    (line,) = [line for line in text.splitlines() if "0.9" in line]
    reason = 'this task needs ale_py, which is not installed: pip install "giril-rl[atari]".'
    assert line == f"No pictures of `{place}0.9`: {reason}"


def test_vectors_have_no_pictures(made, capsys):
    made("giril", score=1.0)
    section, pictures = report(made, capsys)
    assert not section and not pictures


def test_of_recipes_of_ones_own_those_with_a_generative_model_have_pictures(run, made):
    for recipe in ("giril", "cdil"):
        folder = run("giril") if recipe == "giril" else made(recipe, *WORDS, score=1.0)
        config = folder / "config.yaml"
        config.write_text(config.read_text().replace(f"recipe: {recipe}", f"recipe: my_{recipe}"))
    (panel,) = panels_of(read_runs(made.root)[0])
    assert {row.method: is_generative(row) for row in panel.rows} == {
        "my_cdil": False,
        "my_giril": True,
    }


NAMES = ["NOOP", "FIRE", "DOWNRIGHTFIRE"]


def shown(beta, scale=1.0, clamp=True, title="policy"):
    model = GenerativeReward.for_pixels(Categorical(3), beta=beta, scale=scale, clamp=clamp).eval()
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (2, 3, 4, 84, 84), generator=generator).to(torch.uint8)
    data = TensorDict(
        {
            "observation": frames[0],
            "action": torch.tensor([2, 0, 1]),
            "next": TensorDict({"observation": frames[1]}, [3]),
            "done": torch.zeros(3, 1),
        },
        [3],
    )
    labels = ["game 1\nstep 1,234\nnot trained on", "step 2", "step 3"]
    found = predict(model, data, title=title, labels=labels, actions=NAMES)
    return found, data


@pytest.mark.parametrize(("beta", "scale", "clamp"), [(1, 1.0, True), (0.7, 3.0, False)])
def test_the_reward_is_that_of_the_prediction_that_is_shown(beta, scale, clamp):
    found, data = shown(beta, scale, clamp)
    assert found.actions == ["DOWNRIGHTFIRE", "NOOP", "FIRE"]
    assert np.array_equal(found.observation, data["observation"][:, -1].numpy())
    fresh = GenerativeReward.for_pixels(Categorical(3), beta=beta, clamp=clamp).eval()
    with torch.no_grad():
        predicted = fresh.predict(data["observation"], data["action"], data["next", "observation"])
    following = data["next", "observation"].float() / 127.5 - 1
    errors = (predicted - following).square().sum((1, 2, 3))
    assert np.allclose(found.rewards, scale * errors.numpy(), rtol=1e-5)
    last = (predicted - following).square()[:, -1].numpy()
    assert np.allclose(found.errors, last, atol=1e-5)


def test_no_two_texts_overlap(drawn, tmp_path):
    groups = [shown(1, title="demonstration")[0], shown(1, scale=1e-6)[0]]
    draw_predictions(groups, "a title", tmp_path / "picture.png")
    (figure,) = drawn
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    images = [axes for axes in figure.axes if axes.images]
    assert len(images) == 4 * 6
    places = [axes.get_window_extent() for axes in images]
    places += [text.get_window_extent() for text in figure.texts]
    for number, place in enumerate(places):
        assert figure.bbox.x0 <= place.x0 and place.x1 <= figure.bbox.x1
        assert not any(place.overlaps(other) for other in places[:number])
    limits = {axes.images[0].get_clim() for axes in images[3::4]}
    assert len(limits) == 1  # One scale of the error for all rows.
    assert [t.get_text() for t in figure.texts if t.get_text().startswith("reward")][3:]
