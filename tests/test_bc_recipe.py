"""The recipe `bc` from its command to its result, with settings so small that little is learned."""

import json
import math

import pytest
from short_runs import weights

from giril_rl.cli.command_line import main
from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.errors import UserError
from giril_rl.runs.metrics import read_metrics

TINY = [
    "ppo.hidden=[16,16]",
    "expert.steps=2000",
    "demo.length=100",
    "demo.subsample=4",
    "bc.steps=60",
    "bc.log_every=20",
    "eval.episodes=2",
    "logger=null",
]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration of each task."""
    return tmp_path_factory.mktemp("runs")


def run(out, root, *words):
    by_key = {word.split("=")[0]: word for word in [*TINY, f"out={out}", f"root={root}", *words]}
    assert main(["run", "bc", *by_key.values()]) == 0
    return json.loads((out / "result.json").read_text())


@pytest.mark.parametrize("task", ["task.env_id=CartPole-v1", "task=inverted_pendulum"])
def test_it_leaves_a_whole_result(task, root, tmp_path, capsys):
    result = run(tmp_path / "run", root, task)
    assert result["method"] == "bc" and result["env_steps"] == 0
    assert result["algorithm"] is None
    assert result["steps_per_second"] == 0 and result["wall_seconds"] > 0
    assert result["demo_transitions"] == 100
    assert math.isfinite(result["expert_return_mean"] + result["demo_return_mean"])
    for scores in (result, result["deterministic"]):
        assert len(scores["returns"]) == scores["episodes"] == 2
    assert f"{result['return_mean']:,.1f}" in capsys.readouterr().out
    rows = read_metrics(tmp_path / "run" / "metrics.jsonl")
    assert [row["step"] for row in rows] == [20, 40, 60]
    assert rows[-1]["bc/fitted/loss"] < rows[0]["bc/fitted/loss"]
    curve = (tmp_path / "run" / "curve.csv").read_text().splitlines()
    assert curve[0] == "step,fitted,held_out" and len(curve) == 4
    assert (tmp_path / "run" / "curve.png").stat().st_size > 1000
    # What was saved is what was scored.
    assert main(["eval", str(tmp_path / "run")]) == 0
    again = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert again["returns"] == result["returns"]
    assert again["deterministic"] == result["deterministic"]
    # A finished command does nothing again.
    before = (tmp_path / "run" / "result.json").stat().st_mtime_ns
    run(tmp_path / "run", root, task)
    assert (tmp_path / "run" / "result.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_the_horizon_changes_nothing_and_the_seed_does(root, tmp_path):
    first = run(tmp_path / "first", root)
    again = run(tmp_path / "again", root, "task.horizon=fixed")
    assert weights(tmp_path / "again") == weights(tmp_path / "first")
    assert again["returns"] == first["returns"]
    assert len(list(root.glob("expert/inverted_pendulum/*/result.json"))) == 1
    assert len(list(root.glob("demos/inverted_pendulum/*/card.json"))) == 1
    run(tmp_path / "other", root, "seed=1")
    assert weights(tmp_path / "other") != weights(tmp_path / "first")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["steps=512"],
            "steps=512: cloning takes no environment steps; leave steps=0, bc.steps is the number "
            "of gradient steps.",
        ),
        (
            ["demo.subsample=1"],
            "bc.stop=held_out needs transitions to hold out and demo.subsample=1 leaves none: set "
            "demo.subsample to at least 2, or bc.stop=fixed.",
        ),
        (["bc.stop=x"], "bc.stop=x must be 'held_out' or 'fixed'."),
        (["bc.min_std=0"], "bc.min_std=0.0 must be greater than 0."),
    ],
)
def test_refusals(words, sentence):
    recipe = find("bc")
    with pytest.raises(UserError) as refusal:
        resolved(recipe, config_class(recipe), words)
    assert str(refusal.value) == sentence


def test_all_transitions_can_be_fitted_for_a_fixed_number_of_steps():
    recipe = find("bc")
    config = resolved(recipe, config_class(recipe), ["demo.subsample=1", "bc.stop=fixed"])[0]
    assert (config.steps, config.demo.subsample) == (0, 1)
