"""What rewards have in common: the transitions they read, checked by shape, and their output."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from giril_rl.errors import UserError
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler
from giril_rl.runs.randomness import stream_seed

TRANSITION_KEYS: tuple[NestedKey, ...] = ("observation", "action", ("next", "observation"))
PAIR_KEYS: tuple[NestedKey, ...] = ("observation", "action")
STATE_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"))
TERMINATED: NestedKey = ("next", "terminated")
REWARD_KEYS: tuple[NestedKey, ...] = (("next", "intrinsic_reward"),)
PIXELS_AT_ONCE = 256
"""Transitions of frames that a network takes at a time."""


class TransitionReward(TensorDictModuleBase):
    """A reward that is computed from each transition alone, and written as ``(*batch, 1)``.

    A subclass implements :meth:`value`. Frames are passed to it :data:`PIXELS_AT_ONCE` at a time.

    Args:
        what: the reward's name in messages.
        roles: what the ``in_keys`` stand for, in order.
        in_keys: the keys to read.
        out_keys: the key to write, one.
        actions: encodes actions, if it reads any. With ``use_actions=False`` the action's key is
            left out of ``in_keys``, and :meth:`value` gets an empty action.

    Raises:
        UserError: for another number of keys.

    Examples:
        >>> from tensordict import TensorDict
        >>> class Speed(TransitionReward):
        ...     def value(self, observation, next_observation):
        ...         return (next_observation - observation).norm(dim=-1)
        ...     def check(self, observation, next_observation):
        ...         check_states(observation, next_observation)
        >>> reward = Speed("a speed", ("observation", "next observation"), STATE_KEYS, REWARD_KEYS)
        >>> reward.scaler = ObservationScaler(2, rule="raw")
        >>> s, s_next = torch.zeros(1, 2), torch.tensor([[3.0, 4.0]])
        >>> batch = TensorDict({"observation": s, "next": {"observation": s_next}}, [1])
        >>> reward(batch)["next", "intrinsic_reward"]
        tensor([[5.]])
    """

    scaler: Any
    actions: ActionEncoder

    def __init__(
        self,
        what: str,
        roles: Sequence[str],
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        *,
        actions: ActionEncoder | None = None,
    ) -> None:
        super().__init__()
        if len(in_keys) != len(roles) or len(out_keys) != 1:
            number = {1: "one", 2: "two", 3: "three", 4: "four"}[len(roles)]
            raise UserError(
                f"{what} has {number} in_keys ({', '.join(roles)}) and one out_key, not "
                f"{list(in_keys)} and {list(out_keys)}."
            )
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        if actions is not None:
            self.actions = actions
            if not actions.use_actions:
                del self.in_keys[roles.index("action")]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        transitions = with_action(self, read(tensordict, self.in_keys))
        self.check(*transitions)
        return tensordict.set(self.out_keys[0], self.values(*transitions).unsqueeze(-1))

    def check(self, *transitions: Tensor) -> None:
        """Refuses entries of a wrong shape or encoding, see :func:`check_transitions`."""
        check_transitions(self.scaler, self.actions, *transitions)

    def fit_scaler(self, observations: Tensor) -> None:
        """Fits the scaler to observations of the demonstration."""
        self.scaler.fit(observations)

    def values(self, *transitions: Tensor) -> Tensor:
        """The rewards ``(*batch,)`` of the entries under ``in_keys``."""
        return per_transition(self.value, transitions, getattr(self.scaler, "event_dims", 1))

    def value(self, *transitions: Tensor) -> Tensor:
        """The rewards of as many transitions as memory takes, one number for each."""
        raise NotImplementedError


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> tuple[Tensor, ...]:
    """The entries under ``keys``, in their order; refuses a batch that lacks one."""
    entries = tuple(tensordict.get(key, None) for key in keys)
    for key, entry in zip(keys, entries, strict=True):
        if entry is None:
            names = ", ".join(map(repr, keys))
            raise UserError(f"the batch has no {key!r}: give transitions with {names}.")
    return entries


def with_action(reward: Any, entries: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """What ``reward`` reads, with an empty action in second place where it reads no actions."""
    if reads_actions(reward):
        return entries
    observation, *others = entries
    dims = getattr(reward.scaler, "event_dims", 1)
    return observation, reward.actions.nothing(observation, dims), *others


def reads_actions(reward: Any) -> bool:
    """Whether a reward reads actions, which one that has no ``actions`` of ours does or not."""
    return getattr(getattr(reward, "actions", None), "use_actions", True)


def check_transitions(
    scaler: ObservationScaler | PixelScaler,
    actions: ActionEncoder,
    observation: Tensor,
    action: Tensor,
    next_observation: Tensor | None = None,
) -> None:
    """:func:`check_states` and :func:`check_actions`; the scaler checks an observation's size."""
    if next_observation is not None:
        check_states(observation, next_observation)
    check_actions(actions, action, observation, scaler.event_dims)


def check_states(observation: Tensor, next_observation: Tensor) -> None:
    """Refuses a next observation of another shape, which would be broadcast."""
    if next_observation.shape != observation.shape:
        raise UserError(
            f"next observations have shape {tuple(next_observation.shape)} where observations have "
            f"{tuple(observation.shape)}: give both the same shape."
        )


def check_actions(
    actions: ActionEncoder, action: Tensor, observation: Tensor, event_dims: int
) -> None:
    """Refuses actions that are not one for each observation, as the action spec has them.

    ``event_dims`` is the number of dimensions of one observation: 1 for vectors, 3 for frames.
    """
    batch = observation.shape[: observation.ndim - event_dims]
    if actions.batch(action) != batch:
        raise UserError(
            f"actions of shape {tuple(action.shape)} beside observations of shape "
            f"{tuple(observation.shape)}: the reward reads {actions.kind} of shape "
            f"{(*batch, *actions.event)}. Give those, or build it with these actions' own spec."
        )


def check_output(what: str, output: Tensor, shape: Sequence[int]) -> None:
    """Refuses a network's output that would be broadcast to ``shape``; ``what`` names it."""
    if output.shape != tuple(shape):
        raise UserError(f"{what} gives shape {tuple(output.shape)} where {tuple(shape)} is needed.")


def per_transition(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], event_dims: int
) -> Tensor:
    """``function(*inputs)``, of frames :data:`PIXELS_AT_ONCE` at a time to bound the memory.

    ``function`` maps tensors of any leading shape to one number for each element. The first input
    is an observation ``(*batch, ...)``, which has ``event_dims`` dimensions of its own.
    """
    batch = inputs[0].shape[: inputs[0].ndim - event_dims]
    if event_dims < 3 or batch.numel() <= PIXELS_AT_ONCE:
        return function(*inputs)
    flat = [tensor.flatten(0, len(batch) - 1) for tensor in inputs]
    parts = zip(*(tensor.split(PIXELS_AT_ONCE) for tensor in flat), strict=True)
    return torch.cat([function(*part) for part in parts]).reshape(batch)


def observation_shape(env: EnvBase) -> tuple[int, int]:
    """Frames in an observation (0 for vectors), and the size of its last dimension."""
    spec = env.observation_spec["observation"]
    return (spec.shape[-3] if spec.dtype == torch.uint8 else 0), spec.shape[-1]


def reward_for(
    env: EnvBase,
    kind: Any,
    settings: Any,
    pairs: TensorDictBase,
    *,
    seed: int,
    of_all: str,
    of_vectors: str,
) -> Any:
    """``kind.for_pixels`` or ``kind.for_vectors``, as the environment's observations need.

    Its scaler is fitted to ``pairs``.

    Args:
        env: the environment, for its specs.
        kind: the reward's class.
        settings: its settings.
        pairs: the demonstrated transitions to learn from.
        seed: the reward's seed, of which its random numbers' own seed is made.
        of_all: names of the settings that both constructors take as arguments.
        of_vectors: names of those that only ``for_vectors`` takes.
    """
    frames, size = observation_shape(env)
    arguments = {name: getattr(settings, name) for name in of_all.split()}
    arguments["seed"] = stream_seed("reward", seed)
    if frames:
        reward = kind.for_pixels(env.action_spec, channels=frames, **arguments)
    else:
        arguments |= {name: getattr(settings, name) for name in of_vectors.split()}
        reward = kind.for_vectors(size, env.action_spec, **arguments)
    reward.fit_scaler(pairs.get("observation"))
    return reward
