"""Making a task's agent, saving it and getting it back."""

from __future__ import annotations

from pathlib import Path

import torch

from giril_rl.configs import PPOConfig, TaskConfig
from giril_rl.envs import BatchedEnv, make_env
from giril_rl.errors import UserError
from giril_rl.networks.agents import Agent, agent_for
from giril_rl.training.checkpoint import load_state, save_state

POLICY_FILE = "policy.safetensors"


def make_agent(env: BatchedEnv, cfg: PPOConfig, seed: int) -> Agent:
    """An untrained agent for ``env``, initialised from ``seed`` alone.

    Examples:
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> make_agent(env, PPOConfig(), seed=0).critic(torch.zeros(1, 4)).shape
        torch.Size([1, 1])
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return agent_for(env, hidden=cfg.hidden, normalise=cfg.normalise_observations)


def save_agent(agent: Agent, folder: Path) -> None:
    """Writes ``policy.safetensors`` into a run's folder."""
    save_state(folder / POLICY_FILE, dict(agent.state_dict()))


def load_agent(folder: Path, task: TaskConfig, cfg: PPOConfig) -> Agent:
    """The agent that :func:`save_agent` wrote.

    Raises:
        UserError: if there is none, or it is another task's.
    """
    path = folder / POLICY_FILE
    if not path.exists():
        raise UserError(f"{folder} holds no trained policy: run it to its end first.")
    env = make_env(task, 1, seed=0)
    agent = make_agent(env, cfg, seed=0)
    env.close()
    try:
        agent.load_state_dict(load_state(path))
    except RuntimeError:
        raise UserError(
            f"{path} does not fit {task.name} with its settings: it belongs to another run."
        ) from None
    return agent
