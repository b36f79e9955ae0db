"""Every recipe on Breakout, from its command to its result, too short to learn anything."""

import json
import math

import pytest
import torch
import yaml

from giril_rl.cli.command_line import main
from giril_rl.demos import Demonstration
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.metrics import read_metrics

pytest.importorskip("ale_py")

BATCH = 2 * 64
TINY = {
    "task": "breakout",
    "task.max_episode_steps": 60,
    "steps": 2 * BATCH,
    "ppo.num_envs": 2,
    "ppo.rollout": 64,
    "ppo.minibatch": 64,
    "ppo.epochs": 1,
    "eval.episodes": 1,
    "logger": "null",
}
IMITATION = {"demo.subsample": 2}
FIT = {**IMITATION, "fit.steps": 4, "fit.batch": 4, "fit.log_every": 2}
ADVERSARIAL = {**IMITATION, "reward.updates": 1, "reward.batch": 8}
QUICK = ("giril",)
"""The others are slow tests, and CI runs every recipe besides."""
RECIPES = {
    "giril": FIT,
    "cdil": FIT,
    "gail": ADVERSARIAL,
    "vail": ADVERSARIAL,
    "bc": {**IMITATION, "steps": 0, "bc.steps": 4, "bc.batch": 4, "bc.log_every": 2},
    "control": {**IMITATION, "reward": "copy"},
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one demonstration."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def expert(root):
    """The folder of one expert for all; the one that recipes train takes half a minute."""
    result = run("expert", root / "player", root)
    assert result["method"] == "expert" and result["env_steps"] == 2 * BATCH
    return root / "player"


def run(recipe, out, root, **more):
    settings = {**TINY, **RECIPES.get(recipe, {}), "out": out, "root": root, **more}
    assert main(["run", recipe, *(f"{key}={value}" for key, value in settings.items())]) == 0
    return json.loads((out / "result.json").read_text())


@pytest.mark.parametrize(
    "recipe", [r if r in QUICK else pytest.param(r, marks=pytest.mark.slow) for r in RECIPES]
)
def test_each_recipe_leaves_a_whole_result(recipe, expert, root, tmp_path):
    result = run(recipe, tmp_path, root, **{"expert.path": expert})
    steps = 0 if recipe == "bc" else 2 * BATCH
    assert result["method"] == {"control": "control:copy"}.get(recipe, recipe)
    assert (result["task"], result["env_steps"]) == ("breakout", steps)
    for scores in (result, result["deterministic"]):
        assert len(scores["returns"]) == 1 and math.isfinite(scores["return_mean"])
        assert 20 < scores["episode_length_mean"] <= 60
        assert 5 < scores["life_length_mean"] <= scores["episode_length_mean"]
    (card,) = root.glob("demos/breakout/*/card.json")
    demo = Demonstration.load(card.parent)
    assert result["demo_transitions"] == len(demo) > 10
    assert demo.transitions["observation"].dtype == torch.uint8
    assert demo.transitions["next", "done"].sum() == 1  # One life.
    # Frames all the way: the policy's first layer looks at four of them.
    policy = load_state(tmp_path / "policy" / "model.safetensors")
    assert policy["actor.trunk.0.weight"].shape == (32, 4, 8, 8)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    numbers = [value for row in rows for key, value in row.items() if key != "phase"]
    assert all(math.isfinite(number) for number in numbers)
    fitted = {"giril": ["fit"] * 2, "cdil": ["fit"] * 2, "bc": ["bc"] * 2}.get(recipe, [])
    assert [row["phase"] for row in rows] == fitted + ["ppo"] * (steps // BATCH)
    assert all(row["ppo/reward_mean"] != 0 for row in rows if row["phase"] == "ppo")
    if recipe == "giril":  # What was saved is what was scored.
        assert main(["eval", str(tmp_path)]) == 0
        again = json.loads((tmp_path / "eval.json").read_text())
        assert again["returns"] == result["returns"]
        assert again["deterministic"] == result["deterministic"]


@pytest.mark.slow
def test_a_recipe_trains_its_expert_with_atari_s_own_settings(tmp_path):
    """8 games and 128 steps, though the recipe's own PPO has fewer."""
    result = run("giril", tmp_path / "run", tmp_path, **{"expert.steps": 1024})
    (config,) = tmp_path.glob("expert/**/config.yaml")
    settings = yaml.safe_load(config.read_text())
    assert (settings["ppo"]["num_envs"], settings["ppo"]["rollout"]) == (8, 128)
    assert settings["clip_reward"] and settings["ppo"]["clip_value"]
    expert = json.loads((config.parent / "result.json").read_text())
    assert expert["env_steps"] == 1024
    assert result["expert_return_mean"] == expert["return_mean"]
