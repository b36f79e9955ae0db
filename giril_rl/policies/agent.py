"""Making a task's agent, saving it and getting it back."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.envs import BatchedEnv, make_env
from giril_rl.errors import UserError
from giril_rl.policies.agents import Agent, agent_for, fits, load_agent_from
from giril_rl.runs.randomness import Use, seeded, stream_seed

POLICY = "policy"
"""The folder of a run that holds its policy, see :class:`giril_rl.runs.pretrained.Pretrained`."""


def make_agent(env: BatchedEnv, cfg: PPOConfig, seed: int, *, use: Use = "training") -> Agent:
    """An untrained agent for ``env``, initialised from ``use`` and ``seed`` alone.

    Examples:
        >>> import torch
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> make_agent(env, PPOConfig(), seed=0).critic(torch.zeros(1, 4)).shape
        torch.Size([1, 1])
    """
    with seeded(stream_seed(use, seed)):
        return agent_for(env, hidden=cfg.hidden, normalise=cfg.normalise_observations)


def load_agent(run: Path, task: TaskConfig) -> Agent:
    """The policy of a finished run.

    Raises:
        UserError: if there is none, or it is another task's.
    """
    folder = run / POLICY
    if not folder.is_dir():
        raise UserError(f"{run} holds no trained policy: run it to its end first.")
    agent = load_agent_from(folder)
    with closing(make_env(task, 1, seed=0)) as env:
        fitting = fits(agent, env)
    if not fitting:
        raise UserError(f"{folder} does not fit {task.name}: it belongs to another task's run.")
    return agent
