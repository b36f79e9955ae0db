"""Makes an environment's agent, loads a saved one, and checks that the two fit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from torchrl.data import Categorical
from torchrl.envs import EnvBase

from giril_rl.config.schema import PPOConfig, SACConfig, TaskConfig
from giril_rl.envs import BatchedEnv, make_env, observation_kind
from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import single_action_spec, unsupported
from giril_rl.policies.actor_critic import ActorCritic, PPOAgent
from giril_rl.policies.agent import Agent
from giril_rl.policies.pixel_actor_critic import PixelActorCritic
from giril_rl.policies.soft_actor_critic import SACAgent
from giril_rl.runs.pretrained import made_class, plain
from giril_rl.runs.randomness import Use, seeded, stream_seed

NO_FRAMES = "SAC has no networks for frames here: set algorithm=ppo."
POLICY = "policy"
"""The folder of a run that holds its policy, see :class:`giril_rl.runs.pretrained.Pretrained`."""


def agent_for(env: EnvBase, *, hidden: Sequence[int], normalise: bool) -> PPOAgent:
    """An untrained agent for an environment, initialised from torch's global generator.

    Args:
        env: a batched environment. Observations of bytes are frames.
        hidden: hidden layers of vector networks.
        normalise: whether vectors are normalised with running statistics.

    Raises:
        UserError: for an action space that no agent supports.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> type(agent_for(env, hidden=(16,), normalise=True)).__name__
        'ActorCritic'
    """
    kind, needs = _needed(env)
    if kind is PixelActorCritic:
        if isinstance(needs["actions"], Categorical):
            needs["actions"] = int(needs["actions"].space.n)
        return kind(**needs)
    return kind(**needs, hidden=hidden, normalise=normalise)


def make_agent(env: BatchedEnv, cfg: PPOConfig, seed: int, *, use: Use = "training") -> PPOAgent:
    """An untrained agent for ``env``, initialised from ``use`` and ``seed`` alone.

    Examples:
        >>> import torch
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> make_agent(env, PPOConfig(), seed=0).critic(torch.zeros(1, 4)).shape
        torch.Size([1, 1])
    """
    with seeded(stream_seed(use, seed)):
        return agent_for(env, hidden=cfg.hidden, normalise=cfg.normalise_observations)


def make_sac_agent(
    env: BatchedEnv, cfg: SACConfig, seed: int, *, use: Use = "training"
) -> SACAgent:
    """SAC's untrained agent for ``env``, initialised from ``use`` and ``seed`` alone.

    Raises:
        UserError: for frames, and actions that SAC has no form for.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> make_sac_agent(env, SACConfig(), seed=0).discrete
        True
    """
    if observation_kind(env) == "image":
        raise UserError(NO_FRAMES)
    with seeded(stream_seed(use, seed)):
        return SACAgent(
            env.observation_spec["observation"].shape[-1],
            env.action_spec,
            hidden=cfg.hidden,
            normalise=cfg.normalise_observations,
            noise=cfg.noise if cfg.entropy == "none" else None,
            precision=cfg.precision,
        )


def load_agent_from(folder: Path | str) -> Agent:
    """The agent that its ``save_pretrained`` wrote, of whichever class.

    Args:
        folder: the ``policy`` folder of a run, or a copy of it.

    Raises:
        UserError: as :meth:`giril_rl.runs.pretrained.Pretrained.from_pretrained`.

    Examples:
        >>> import tempfile
        >>> folder = PixelActorCritic(4).save_pretrained(tempfile.mkdtemp())
        >>> policy = load_agent_from(folder).acting()
        >>> policy.out_keys
        ['action', 'action_log_prob', 'state_value']
    """
    kinds: dict[str, type[Any]] = {x.__name__: x for x in (ActorCritic, PixelActorCritic, SACAgent)}
    return kinds.get(made_class(folder) or "", ActorCritic).from_pretrained(folder)


def load_agent(run: Path, task: TaskConfig) -> Agent:
    """The policy of a finished run.

    Raises:
        UserError: if there is none, or it belongs to another task.
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


def fits(agent: Agent, env: EnvBase) -> bool:
    """Whether an agent's observations and actions are those of an environment.

    Actions fit if their encoding, number and bounds do. A policy cannot see these when it acts: an
    environment that expects one-hot actions takes every integer for the first action.

    Raises:
        UserError: for an action space that no agent supports.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> fits(PixelActorCritic(2), env)
        False
        >>> from torchrl.envs import GymEnv
        >>> one_hot = GymEnv("CartPole-v1")  # TorchRL's default
        >>> fits(agent_for(env, hidden=(16,), normalise=True), one_hot)
        False
    """
    kind, needs = _needed(env)
    made_with = _made_with(agent)
    is_kind = type(agent) is kind or (kind is ActorCritic and type(agent) is SACAgent)
    return is_kind and all(made_with.get(name) == plain(value) for name, value in needs.items())


def check_actions(agent: object, env: EnvBase) -> None:
    """Refuses an agent whose actions an environment would silently take for others.

    Args:
        agent: what acts; only an :class:`~giril_rl.policies.Agent` is checked.
        env: where it acts.

    Raises:
        UserError: if encoding, number or bounds of the actions differ.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> check_actions(ActorCritic(4, Categorical(2)), GymEnv("CartPole-v1"))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: the policy was made for actions {'action_spec': 'discrete', 'n':
        2} and the environment has {'action_spec': 'one_hot', 'n': 2}: make it with the
        environment's action_spec.
    """
    if not isinstance(agent, Agent):
        return
    made_with, wanted = _made_with(agent), plain(env.action_spec)
    found = made_with.get("action_spec", made_with.get("actions"))
    if found is not None and found != wanted:
        raise UserError(
            f"the policy was made for actions {found} and the environment has {wanted}: make it "
            "with the environment's action_spec."
        )


def _made_with(agent: Agent) -> dict[str, Any]:
    made_with = agent.made_with
    if isinstance(made_with.get("actions"), int):
        made_with["actions"] = plain(Categorical(made_with["actions"]))
    return made_with


def _needed(env: EnvBase) -> tuple[type[Any], dict[str, Any]]:
    """An environment's class of agent, and the arguments that the environment determines."""
    observation = env.observation_spec["observation"]
    actions = single_action_spec(env.action_spec)
    if actions.ndim - env.batch_dims != (0 if isinstance(actions, Categorical) else 1):
        raise unsupported(actions)
    if observation_kind(env) == "image":
        return PixelActorCritic, {"actions": actions, "channels": observation.shape[-3]}
    return ActorCritic, {"observation_size": observation.shape[-1], "action_spec": actions}
