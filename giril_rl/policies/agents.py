"""Which policy and value network an environment needs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl.data import Categorical
from torchrl.envs import EnvBase

from giril_rl.envs import observation_kind
from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import single_action_spec, unsupported
from giril_rl.policies.pixel_policy import PixelActorCritic
from giril_rl.policies.policy import ActorCritic
from giril_rl.runs.pretrained import made_class, plain

Agent = ActorCritic | PixelActorCritic
"""PPO's policy and value network, of vectors or of pixels; both have the same methods."""


def agent_for(env: EnvBase, *, hidden: Sequence[int], normalise: bool) -> Agent:
    """An untrained agent, initialised from torch's global generator.

    Args:
        env: a batched environment; bytes as observations are taken for frames.
        hidden: hidden layers of vector networks.
        normalise: whether vectors are normalised with running statistics.

    Raises:
        UserError: for an action space of another kind than the networks have.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> from giril_rl.envs import make_env
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


def load_agent_from(folder: Path | str) -> Agent:
    """The agent that its ``save_pretrained`` wrote, whichever of the two it is.

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
    kinds = {kind.__name__: kind for kind in (ActorCritic, PixelActorCritic)}
    return kinds.get(made_class(folder) or "", ActorCritic).from_pretrained(folder)


def fits(agent: Agent, env: EnvBase) -> bool:
    """Whether an agent's observations and actions are those of an environment.

    Actions are so in encoding, number and bounds. A policy cannot see these when it acts: in an
    environment that expects one-hot actions, integers are all taken for the first action.

    Raises:
        UserError: for an action space that no agent has.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> from giril_rl.envs import make_env
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
    return type(agent) is kind and all(
        made_with.get(name) == plain(value) for name, value in needs.items()
    )


def check_actions(agent: object, env: EnvBase) -> None:
    """Refuses an agent whose actions an environment would take for others, without a word.

    Args:
        agent: what acts; only those of this package are looked at.
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
    if not isinstance(agent, (ActorCritic, PixelActorCritic)):
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
    """The class of agent for an environment, and the arguments that the environment decides."""
    observation = env.observation_spec["observation"]
    actions = single_action_spec(env.action_spec)
    if actions.ndim - env.batch_dims != (0 if isinstance(actions, Categorical) else 1):
        raise unsupported(actions)
    if observation_kind(env) == "image":
        return PixelActorCritic, {"actions": actions, "channels": observation.shape[-3]}
    return ActorCritic, {"observation_size": observation.shape[-1], "action_spec": actions}
