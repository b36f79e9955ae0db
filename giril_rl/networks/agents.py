"""Which policy and value network an environment needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase

from giril_rl.networks.pixel_policy import PixelActorCritic
from giril_rl.networks.policy import ActorCritic
from giril_rl.pretrained import made_class, plain

Agent = ActorCritic | PixelActorCritic
"""PPO's policy and value network, of vectors or of pixels; both have the same methods."""


def agent_for(env: EnvBase, *, hidden: Sequence[int], normalise: bool) -> Agent:
    """An untrained agent, initialised from torch's global generator.

    Args:
        env: a batched environment; bytes as observations are taken for frames.
        hidden: hidden layers of vector networks.
        normalise: whether vectors are normalised with running statistics.

    Examples:
        >>> from giril_rl.configs import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> type(agent_for(env, hidden=(16,), normalise=True)).__name__
        'ActorCritic'
    """
    kind, needs = _needed(env)
    if kind is PixelActorCritic:
        return kind(**needs)
    return kind(**needs, hidden=hidden, normalise=normalise)


def load_agent_from(folder: Path | str) -> Agent:
    """The agent that its ``save_pretrained`` wrote, whichever of the two it is.

    Args:
        folder: the ``policy`` folder of a run, or a copy of it.

    Raises:
        UserError: as :meth:`giril_rl.pretrained.Pretrained.from_pretrained`.

    Examples:
        >>> import tempfile
        >>> folder = PixelActorCritic(4).save_pretrained(tempfile.mkdtemp())
        >>> policy = load_agent_from(folder).acting()
        >>> policy.out_keys
        ['action', 'action_log_prob', 'state_value']
    """
    kinds = {kind.__name__: kind for kind in (ActorCritic, PixelActorCritic)}
    return kinds.get(made_class(folder) or "", ActorCritic).from_pretrained(folder)


def fits(agent: Agent, env: EnvBase) -> bool:
    """Whether an agent's observations and actions are those of an environment.

    Examples:
        >>> from giril_rl.configs import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> fits(PixelActorCritic(2), env)
        False
    """
    kind, needs = _needed(env)
    made_with = agent.made_with
    return type(agent) is kind and all(
        made_with.get(name) == plain(value) for name, value in needs.items()
    )


def _needed(env: EnvBase) -> tuple[type[Any], dict[str, Any]]:
    """The class of agent for an environment, and the arguments that the environment decides."""
    observation = env.observation_spec["observation"]
    if observation.dtype == torch.uint8:
        return PixelActorCritic, {
            "actions": int(env.action_spec.space.n),
            "channels": observation.shape[-3],
        }
    return ActorCritic, {
        "observation_size": observation.shape[-1],
        "action_spec": env.action_spec,
    }
