"""Rewards that learn beside SAC, and SQIL: from their command to their result, in a few steps."""

import json
import math

import pytest

from giril_rl.cli.command_line import main
from giril_rl.runs.metrics import read_metrics

TINY = [
    "algorithm=sac",
    "sac.num_envs=2",
    "sac.rollout=16",
    "sac.batch=16",
    "sac.hidden=[8]",
    "sac.random_steps=32",
    "sac.log_every=32",
    "steps=256",
    "eval.episodes=1",
    "expert.steps=2000",
    "demo.length=100",
    "demo.subsample=2",
    "logger=null",
    "task.env_id=CartPole-v1",
]
QUICK = ("sqil",)
"""The others are slow tests, and CI runs every recipe besides."""
RECIPES = {
    "gail": ["reward.hidden=[8]"],
    "vail": ["reward.hidden=[8]", "reward.form=negative"],
    "airl": ["reward.hidden=[8]"],
    "ilde": ["fit.steps=5", "gail.hidden=[8]"],
    "sqil": [],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def run(recipe, out, root, *more):
    words = [*TINY, *RECIPES[recipe], f"out={out}", f"root={root}", *more]
    if "algorithm=ppo" in more:
        words = [word for word in words if not word.startswith("sac.")]
    return main(["run", recipe, *{word.split("=")[0]: word for word in words}.values()])


@pytest.mark.parametrize(
    "recipe", [r if r in QUICK else pytest.param(r, marks=pytest.mark.slow) for r in RECIPES]
)
def test_a_recipe_leaves_a_whole_result(recipe, root, tmp_path):
    assert run(recipe, tmp_path / "run", root) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["method"] == recipe and math.isfinite(result["return_mean"])
    ratio = result["return_mean"] / result["demo_return_mean"]
    assert (result["algorithm"], result["score_over_demo"]) == ("sac", ratio)
    rows = [
        row for row in read_metrics(tmp_path / "run" / "metrics.jsonl") if row["phase"] == "sac"
    ]
    assert rows[-1]["step"] == 256
    assert math.isfinite(rows[-1]["sac/loss_qvalue"])
    assert ("discriminator/loss_policy" in rows[-1]) == (recipe != "sqil")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("algorithm=ppo", "SQIL pays for transitions in a replay buffer, which PPO has not"),
        ("sac.demonstration=none", "leave sac.demonstration=half"),
        ("scaling.enabled=true", "leave scaling.enabled=false"),
    ],
)
def test_sqil_refuses_what_leaves_nothing_of_it(change, sentence, root, tmp_path, capsys):
    assert run("sqil", tmp_path / "run", root, change) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_each_term_of_ilde_can_be_switched_off(root, tmp_path):
    off = {
        "imitation": "reward.imitation=none",
        "curiosity": "reward.curiosity_weight=0",
        "bonus": "reward.bonus_weight=0",
    }
    for name in off:
        others = [word for term, word in off.items() if term != name]
        assert run("ilde", tmp_path / name, root, *others) == 0
        rows = read_metrics(tmp_path / name / "metrics.jsonl")
        assert any(row["phase"] == "fit" for row in rows) == (name == "curiosity")
        trained = any("discriminator/loss_policy" in row for row in rows)
        assert trained == (name == "imitation")
    assert run("ilde", tmp_path / "none", root, *off.values()) == 2


@pytest.mark.parametrize("algorithm", ["sac", "ppo"])
def test_ilde_takes_pwils_reward(algorithm, root, tmp_path):
    ppo = ["ppo.num_envs=2", "ppo.rollout=64", "ppo.minibatch=64", "ppo.epochs=1"]
    more = [f"algorithm={algorithm}", "reward.imitation=pwil"] + ppo * (algorithm == "ppo")
    assert run("ilde", tmp_path / "run", root, *more) == 0
    row = read_metrics(tmp_path / "run" / "metrics.jsonl")[-1]
    assert "discriminator/loss_policy" not in row
    assert row[f"{algorithm}/reward_mean"] > 0
