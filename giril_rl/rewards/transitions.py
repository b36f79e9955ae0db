"""What rewards and their losses read of a batch, checked by shape before it is computed with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError

if TYPE_CHECKING:
    from giril_rl.rewards.actions import ActionEncoder
    from giril_rl.rewards.pixel_scaler import PixelScaler
    from giril_rl.rewards.scaler import ObservationScaler


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> tuple[Tensor, ...]:
    """The entries under ``keys``, in their order.

    Raises:
        UserError: if one is missing.

    Examples:
        >>> import torch
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
    following: Tensor,
) -> None:
    """:func:`check_states` and :func:`check_actions` of a reward's own parts.

    Args:
        scaler: the reward's scaler, which looks at the size of single observations itself.
        actions: the reward's action encoder.
        observation: s, as the environment gives it.
        action: the action, as the environment takes it.
        following: s', as the environment gives it.

    Raises:
        UserError: for shapes that do not belong together, or another encoding of actions.
    """
    check_states(observation, following)
    check_actions(actions, action, observation, scaler.event_dims)


def check_states(observation: Tensor, following: Tensor) -> None:
    """Refuses a next observation of another shape, which would be broadcast.

    Raises:
        UserError: if the shapes differ.

    Examples:
        >>> import torch
        >>> check_states(torch.zeros(7, 3), torch.zeros(7, 1))
        Traceback (most recent call last):
        giril_rl.errors.UserError: next observations have shape (7, 1) where observations have
        (7, 3): give both the same shape.
    """
    if following.shape != observation.shape:
        raise UserError(
            f"next observations have shape {tuple(following.shape)} where observations have "
            f"{tuple(observation.shape)}: give both the same shape."
        )


def check_actions(
    actions: ActionEncoder, action: Tensor, observation: Tensor, event_dims: int
) -> None:
    """Refuses actions that are not one for each observation, in the encoding of the action spec.

    Args:
        actions: the reward's action encoder.
        action: actions, as the environment takes them.
        observation: what they were taken at, ``(*batch, ...)``.
        event_dims: dimensions of one observation: 1 for vectors, 3 for frames.

    Raises:
        UserError: for another dtype or shape.

    Examples:
        >>> import torch
        >>> from torchrl.data import Categorical
        >>> from giril_rl.rewards import ActionEncoder
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
        output: what it gave.
        shape: what it has to give.

    Raises:
        UserError: for another shape.

    Examples:
        >>> import torch
        >>> check_output("the decoder", torch.zeros(7, 1), (7, 3))
        Traceback (most recent call last):
        giril_rl.errors.UserError: the decoder gives shape (7, 1) where (7, 3) is needed.
    """
    if output.shape != tuple(shape):
        raise UserError(f"{what} gives shape {tuple(output.shape)} where {tuple(shape)} is needed.")


def check_finite(what: str, values: Tensor) -> None:
    """Refuses NaN and infinity, and says where the first is. It looks at values, so call it once.

    Args:
        what: what the values are, for the message.
        values: of any shape and dtype.

    Raises:
        UserError: if one is not finite.

    Examples:
        >>> import torch
        >>> check_finite("observation", torch.tensor([[0.0, 1.0], [2.0, float("nan")]]))
        Traceback (most recent call last):
        giril_rl.errors.UserError: the demonstration's observation is nan at index [1, 1]: leave
        that transition out, or correct it.
    """
    if not values.is_floating_point():
        return
    finite = values.isfinite()
    if not finite.all():
        index = (~finite).nonzero()[0].tolist()
        raise UserError(
            f"the demonstration's {what} is {values[tuple(index)].item()} at index {index}: leave "
            "that transition out, or correct it."
        )
