"""Recipes whose reward follows episodes: from command to result, stopped and resumed, refused."""

import json

import pytest
import torch
from short_runs import Killed, rows, stopped, weights

from giril_rl.cli.command_line import main
from giril_rl.rewards import PWILReward, SinkhornReward

TINY = (
    *("task.env_id=CartPole-v1", "steps=320", "eval.episodes=2", "logger=null"),
    *("expert.steps=2000", "demo.length=60"),
)
SAC = (
    *("sac.num_envs=2", "sac.rollout=8", "sac.batch=8", "sac.hidden=[8]", "sac.random_steps=64"),
    *("sac.log_every=16", "sac.checkpoint_every=48"),
)
PPO = (
    *("algorithm=ppo", "ppo.num_envs=2", "ppo.rollout=16", "ppo.minibatch=16", "ppo.epochs=1"),
    *("ppo.hidden=[8]", "ppo.checkpoint_every=96"),
)
REWARDS = {"pwil": PWILReward, "sinkhorn": SinkhornReward}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def run(recipe, out, root, *more):
    learner = () if "algorithm=ppo" in more else SAC
    return main(["run", recipe, f"out={out}", f"root={root}", *TINY, *learner, *more])


@pytest.mark.parametrize(
    ("recipe", "more"),
    [
        ("pwil", ()),
        pytest.param("pwil", PPO, marks=pytest.mark.slow),
        pytest.param("sinkhorn", (), marks=pytest.mark.slow),
        pytest.param("sinkhorn", PPO, marks=pytest.mark.slow),
    ],
)
def test_a_run_stopped_in_mid_episode_ends_as_an_undisturbed_one(recipe, more, root, tmp_path):
    assert run(recipe, tmp_path / "whole", root, *more) == 0
    for step in (112, 208):
        with stopped(Killed, step):
            if run(recipe, tmp_path / "cut", root, *more) != 0:
                raise Killed  # The command had turned it into an exit status.
    assert run(recipe, tmp_path / "cut", root, *more) == 0
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert weights(tmp_path / "cut") == weights(tmp_path / "whole")


def test_the_shared_reward_is_that_of_the_task_without_running_episodes(root, tmp_path):
    assert run("pwil", tmp_path / "run", root, "reward.use_actions=false") == 0
    reward = PWILReward.from_pretrained(tmp_path / "run/reward")
    assert reward.horizon == 500 and len(reward.running) == 0
    assert reward.atoms.points.shape == (60, 4)


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
