"""The recipes nearest, mmd and dril and the bonus alone, with either learner; little is learned."""

import json
from unittest.mock import patch

import pytest
from short_runs import Killed, rows, weights

from giril_rl.cli.command_line import main
from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.runs.run import Run

SHORT = [
    *("steps=512", "eval.episodes=1", "logger=null", "expert.steps=2000", "demo.length=100"),
    *("demo.subsample=2", "task.env_id=CartPole-v1"),
]
LEARNERS = {
    "ppo": [
        *("ppo.num_envs=2", "ppo.rollout=64", "ppo.minibatch=64", "ppo.epochs=1"),
        *("ppo.hidden=[16,16]", "ppo.checkpoint_every=128"),
    ],
    "sac": [
        *("sac.num_envs=2", "sac.rollout=8", "sac.batch=16", "sac.hidden=[16]"),
        *("sac.random_steps=64", "sac.checkpoint_every=128", "sac.log_every=64"),
    ],
}
DRIL = ["fit.steps=20", "fit.log_every=10", "reward.hidden=[16]", "reward.bc_every=50"]
QUICK = ("mmd",)
"""The others are slow tests, and CI runs every recipe besides."""
RECIPES = {
    "nearest": [],
    "mmd": ["reward.visits=20", "reward.kept=all"],
    "dril": DRIL,
    "control": ["reward=entropy_bonus"],
}
METRICS = {"mmd": ["mmd/squared", "mmd/visits"], "dril": ["bc/loss"]}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def words(recipe, out, root, *more, algorithm="sac"):
    place = [f"out={out}", f"root={root}", f"algorithm={algorithm}"]
    known = [*SHORT, *LEARNERS[algorithm], *RECIPES[recipe], *place, *more]
    return ["run", recipe, *{word.split("=")[0]: word for word in known}.values()]


@pytest.mark.parametrize("algorithm", [pytest.param("ppo", marks=pytest.mark.slow), "sac"])
@pytest.mark.parametrize(
    "recipe", [r if r in QUICK else pytest.param(r, marks=pytest.mark.slow) for r in RECIPES]
)
def test_from_command_to_result_and_resumed_bit_for_bit(recipe, algorithm, root, tmp_path):
    assert main(words(recipe, tmp_path / "whole", root, algorithm=algorithm)) == 0
    result = json.loads((tmp_path / "whole" / "result.json").read_text())
    assert result["env_steps"] == 512
    found = [row for row in rows(tmp_path / "whole") if row["phase"] == algorithm]
    for name in METRICS.get(recipe, []):
        assert any(name in row for row in found)
    log = Run.log

    def killed(self, step, values, *, phase):
        log(self, step, values, phase=phase)
        if phase == algorithm and step >= 300:
            raise Killed

    with patch.object(Run, "log", killed):
        assert main(words(recipe, tmp_path / "killed", root, algorithm=algorithm)) == 1
    assert main(words(recipe, tmp_path / "killed", root, algorithm=algorithm)) == 0
    assert weights(tmp_path / "killed") == weights(tmp_path / "whole")
    assert rows(tmp_path / "killed") == rows(tmp_path / "whole")


@pytest.mark.parametrize("recipe", ["nearest", "mmd"])
def test_without_actions(recipe, root, tmp_path):
    more = ["reward.use_actions=false", "reward.use_next=true", "steps=128"]
    assert main(words(recipe, tmp_path / "run", root, *more)) == 0


def test_dril_without_cloning_beside_and_all_transitions(root, tmp_path):
    more = ["reward.bc_every=null", "demo.subsample=1", "steps=128"]
    assert main(words("dril", tmp_path / "run", root, *more)) == 0
    assert not any("bc/loss" in row for row in rows(tmp_path / "run"))


@pytest.mark.parametrize("recipe", ["nearest", "mmd", "dril"])
def test_the_default_is_off_policy_from_the_whole_demonstration(recipe):
    found = find(recipe)
    config, _ = resolved(found, config_class(found), [])
    assert (config.algorithm, config.demo.subsample) == ("sac", 1)
