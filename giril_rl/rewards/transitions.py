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

TRANSITION_KEYS: tuple[NestedKey, ...] = ("observation", "action", ("next", "observation"))
PAIR_KEYS: tuple[NestedKey, ...] = ("observation", "action")
STATE_KEYS: tuple[NestedKey, ...] = ("observation", ("next", "observation"))
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
    ) -> None:
        super().__init__()
        if len(in_keys) != len(roles) or len(out_keys) != 1:
            number = {2: "two", 3: "three"}[len(roles)]
            raise UserError(
                f"{what} has {number} in_keys ({', '.join(roles)}) and one out_key, not "
                f"{list(in_keys)} and {list(out_keys)}."
            )
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        transitions = read(tensordict, self.in_keys)
        self.check(*transitions)
        return tensordict.set(self.out_keys[0], self.values(*transitions).unsqueeze(-1))

    def check(self, *transitions: Tensor) -> None:
        """Refuses entries of a wrong shape or encoding, see :func:`check_transitions`."""
        check_transitions(self.scaler, self.actions, *transitions)

    def values(self, *transitions: Tensor) -> Tensor:
        """The rewards ``(*batch,)`` of the entries under ``in_keys``."""
        return per_transition(self.value, transitions, getattr(self.scaler, "event_dims", 1))

    def value(self, *transitions: Tensor) -> Tensor:
        """The rewards of as many transitions as memory takes, one number for each."""
        raise NotImplementedError


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> tuple[Tensor, ...]:
    """The entries under ``keys``, in their order.

    Raises:
        UserError: if one is missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> read(TensorDict({"action": torch.ones(1)}), ["action", ("next", "observation")])
        Traceback (most recent call last):
        giril_rl.errors.UserError: the batch has no ('next', 'observation'): give transitions with
        'action', ('next', 'observation').
    """
    entries = tuple(tensordict.get(key, None) for key in keys)
    for key, entry in zip(keys, entries, strict=True):
        if entry is None:
            names = ", ".join(map(repr, keys))
            raise UserError(f"the batch has no {key!r}: give transitions with {names}.")
    return entries


def check_transitions(
    scaler: ObservationScaler | PixelScaler,
    actions: ActionEncoder,
    observation: Tensor,
    action: Tensor,
    next_observation: Tensor,
) -> None:
    """:func:`check_states` and :func:`check_actions`; the scaler checks an observation's size.

    Raises:
        UserError: for shapes that do not belong together, or another encoding of actions.
    """
    check_states(observation, next_observation)
    check_actions(actions, action, observation, scaler.event_dims)


def check_states(observation: Tensor, next_observation: Tensor) -> None:
    """Refuses a next observation of another shape, which would be broadcast.

    Raises:
        UserError: if the shapes differ.

    Examples:
        >>> check_states(torch.zeros(7, 3), torch.zeros(7, 1))
        Traceback (most recent call last):
        giril_rl.errors.UserError: next observations have shape (7, 1) where observations have
        (7, 3): give both the same shape.
    """
    if next_observation.shape != observation.shape:
        raise UserError(
            f"next observations have shape {tuple(next_observation.shape)} where observations have "
            f"{tuple(observation.shape)}: give both the same shape."
        )


def check_actions(
    actions: ActionEncoder, action: Tensor, observation: Tensor, event_dims: int
) -> None:
    """Refuses actions that are not one for each observation, as the action spec has them.

    Args:
        actions: the reward's action encoder.
        action: actions, as the environment takes them.
        observation: the observations beside them, ``(*batch, ...)``.
        event_dims: dimensions of one observation: 1 for vectors, 3 for frames.

    Raises:
        UserError: for another dtype or shape.

    Examples:
        >>> from torchrl.data import Categorical
        >>> column = torch.zeros(7, 1, dtype=torch.int64)
        >>> check_actions(ActionEncoder(Categorical(3)), column, torch.zeros(7, 2), 1)
        Traceback (most recent call last):
        giril_rl.errors.UserError: actions of shape (7, 1) beside observations of shape (7, 2): the
        reward reads integers of shape (7,). Give those, or build it with these actions' own spec.
    """
    batch = observation.shape[: observation.ndim - event_dims]
    if actions.batch(action) != batch:
        raise UserError(
            f"actions of shape {tuple(action.shape)} beside observations of shape "
            f"{tuple(observation.shape)}: the reward reads {actions.kind} of shape "
            f"{(*batch, *actions.event)}. Give those, or build it with these actions' own spec."
        )


def check_output(what: str, output: Tensor, shape: Sequence[int]) -> None:
    """Refuses a network's output that would be broadcast to ``shape``.

    Args:
        what: the network, for the message.
        output: its output.
        shape: the shape needed.

    Raises:
        UserError: for another shape.

    Examples:
        >>> check_output("the decoder", torch.zeros(7, 1), (7, 3))
        Traceback (most recent call last):
        giril_rl.errors.UserError: the decoder gives shape (7, 1) where (7, 3) is needed.
    """
    if output.shape != tuple(shape):
        raise UserError(f"{what} gives shape {tuple(output.shape)} where {tuple(shape)} is needed.")


def per_transition(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], event_dims: int
) -> Tensor:
    """``function(*inputs)``, of frames :data:`PIXELS_AT_ONCE` at a time to bound the memory.

    Args:
        function: maps tensors of any leading shape to one number for each element of it.
        inputs: an observation ``(*batch, ...)`` first, then what else belongs to the transitions.
        event_dims: dimensions of one observation: 1 for vectors, 3 for frames.

    Returns:
        One number for each transition, ``(*batch,)``.

    Examples:
        >>> per_transition(lambda x: x.sum(-1), (torch.ones(2, 3, 5),), event_dims=1).shape
        torch.Size([2, 3])
    """
    batch = inputs[0].shape[: inputs[0].ndim - event_dims]
    if event_dims < 3 or batch.numel() <= PIXELS_AT_ONCE:
        return function(*inputs)
    flat = [tensor.flatten(0, len(batch) - 1) for tensor in inputs]
    parts = zip(*(tensor.split(PIXELS_AT_ONCE) for tensor in flat), strict=True)
    return torch.cat([function(*part) for part in parts]).reshape(batch)


def observation_shape(env: EnvBase) -> tuple[int, int]:
    """Frames in an observation (0 for vectors), and the size of its last dimension.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> observation_shape(GymEnv("CartPole-v1"))
        (0, 4)
    """
    spec = env.observation_spec["observation"]
    return (spec.shape[-3] if spec.dtype == torch.uint8 else 0), spec.shape[-1]
