"""Recipes whose reward follows episodes: from command to result, stopped and resumed, refused."""

import json

import pytest
import torch
from short_runs import Killed, rows, stopped, weights

from giril_rl.cli.command_line import main
from giril_rl.rewards import PWILReward, SinkhornReward

TINY = (
    *("task.env_id=CartPole-v1", "steps=320", "eval.episodes=2", "logger=null"),
    *("expert.steps=2000", "demo.length=60", "sac.num_envs=2", "sac.rollout=8", "sac.batch=8"),
    *("sac.hidden=[8]", "sac.random_steps=64", "sac.log_every=16", "sac.checkpoint_every=48"),
    *("ppo.num_envs=2", "ppo.rollout=16", "ppo.minibatch=16", "ppo.epochs=1", "ppo.hidden=[8]"),
    *("ppo.checkpoint_every=96",),
)
REWARDS = {"pwil": PWILReward, "sinkhorn": SinkhornReward}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def run(recipe, out, root, *more):
    return main(["run", recipe, f"out={out}", f"root={root}", *TINY, *more])


@pytest.mark.parametrize("more", [(), ("algorithm=ppo",), ("reward.use_actions=false",)])
def test_pwil_stopped_in_mid_episode_ends_as_an_undisturbed_run(more, root, tmp_path):
    assert run("pwil", tmp_path / "whole", root, *more) == 0
    for step in (112, 208):
        with stopped(Killed, step):
            if run("pwil", tmp_path / "cut", root, *more) != 0:
                raise Killed  # The command had turned it into an exit status.
    assert run("pwil", tmp_path / "cut", root, *more) == 0
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert weights(tmp_path / "cut") == weights(tmp_path / "whole")
    reward = PWILReward.from_pretrained(tmp_path / "whole/reward")
    assert reward.horizon == 500 and len(reward.running) == 0
    assert reward.atoms.points.shape == (60, 4 if "reward.use_actions=false" in more else 6)


@pytest.mark.parametrize("recipe", REWARDS)
def test_a_recipe_leaves_a_whole_result(recipe, root, tmp_path):
    assert run(recipe, tmp_path / "run", root) == 0
    result = json.loads((tmp_path / "run/result.json").read_text())
    assert result["method"] == recipe and result["env_steps"] == 320
    assert any(row.get("sac/reward_mean") for row in rows(tmp_path / "run"))
    reward = REWARDS[recipe].from_pretrained(tmp_path / "run/reward")
    assert torch.isfinite(reward.atoms.points).all() and reward.atoms.fitted


@pytest.mark.parametrize("recipe", REWARDS)
def test_images_are_refused_before_anything_is_trained(recipe, tmp_path, capsys):
    words = ["run", recipe, "task=breakout", "algorithm=ppo", f"out={tmp_path}/run"]
    assert main(words) != 0
    assert "measures distances of vectors and this task shows images" in capsys.readouterr().err
