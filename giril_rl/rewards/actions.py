"""Encodes actions as real vectors."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import affine_map, single_action_spec


class ActionEncoder(nn.Module):
    """Encodes an environment's actions as vectors of shape ``(*batch, size)``.

    - Discrete, integers ``(*batch,)``: one-hot, as floats. One-hot actions: as floats.
    - Box ``(*batch, size)``: clamped to the bounds, as the simulator does before it acts, then
      mapped affinely from the bounds to [-1, 1]. A dimension without two finite bounds keeps its
      unit.
    - With ``use_actions=False``: nothing, a vector of size 0, so that a network reads states alone.

    Args:
        spec: TorchRL's action spec, with or without the environment's batch dimensions, or a
            Composite of nothing else.
        use_actions: False encodes empty actions ``(*batch, 0)``, see :meth:`nothing`, as they are.

    Raises:
        UserError: for an unsupported spec, or actions that do not fit it. Only dtype and shape are
            checked, so that the encoder can be recorded as a graph.

    Examples:
        >>> from torchrl.data import Bounded
        >>> ActionEncoder(Categorical(3))(torch.tensor([2, 0])).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        >>> ActionEncoder(Bounded(0.0, 4.0, shape=(1,)))(torch.tensor([[3.0], [9.0]])).tolist()
        [[0.5], [1.0]]
        >>> states = ActionEncoder(Categorical(3), use_actions=False)
        >>> states(states.nothing(torch.zeros(7, 2))).shape
        torch.Size([7, 0])
    """

    low: Tensor
    high: Tensor
    offset: Tensor
    scale: Tensor

    def __init__(self, spec: TensorSpec, *, use_actions: bool = True) -> None:
        super().__init__()
        spec = single_action_spec(spec)
        self.use_actions = use_actions
        self.discrete = use_actions and isinstance(spec, (Categorical, OneHot))
        self.one_hot = use_actions and isinstance(spec, OneHot)
        if not use_actions:
            self.size = 0
            return
        self.size = int(spec.space.n if self.discrete else spec.shape[-1])
        if self.discrete:
            return
        low, high, offset, half_range = affine_map(spec)
        buffers = {"low": low, "high": high, "offset": offset, "scale": 1 / half_range}
        for name, value in buffers.items():
            self.register_buffer(name, value.to(torch.get_default_dtype()))

    @property
    def kind(self) -> str:
        """What the actions are, in a word or two."""
        if not self.use_actions:
            return "empty actions"
        if self.one_hot:
            return "one-hot vectors"
        return "integers" if self.discrete else "vectors"

    @property
    def event(self) -> tuple[int, ...]:
        """The shape of one action."""
        return () if self.discrete and not self.one_hot else (self.size,)

    def nothing(self, observation: Tensor, event_dims: int = 1) -> Tensor:
        """Empty actions ``(*batch, 0)`` for observations of ``event_dims`` dimensions each."""
        batch = observation.shape[: observation.ndim - event_dims]
        return torch.empty(*batch, 0, device=observation.device)

    def batch(self, action: Tensor) -> torch.Size:
        """The leading shape of actions.

        Raises:
            UserError: for another dtype or width than the spec's.

        Examples:
            >>> ActionEncoder(OneHot(3)).batch(torch.tensor([2, 0]))
            Traceback (most recent call last):
            giril_rl.errors.UserError: actions are torch.int64 of shape (2,): the reward reads
            one-hot vectors of shape (*batch, 3). Give those, or build it with these actions' own
            spec.
        """
        if self.event:
            fits = action.shape[-1:] == self.event
        else:
            fits = not action.is_floating_point()
        if not fits:
            shape = f"(*batch, {self.size})" if self.event else "(*batch,)"
            raise UserError(
                f"actions are {action.dtype} of shape {tuple(action.shape)}: the reward reads "
                f"{self.kind} of shape {shape}. Give those, or build it with these actions' own "
                "spec."
            )
        return action.shape[: action.ndim - len(self.event)]

    def check_values(self, action: Tensor) -> None:
        """Refuses values of the right shape that are no action. It reads values: call it once.

        Raises:
            UserError: for integers outside the spec, or vectors that are not one-hot.

        Examples:
            >>> ActionEncoder(Categorical(3)).check_values(torch.tensor([0, 3]))
            Traceback (most recent call last):
            giril_rl.errors.UserError: the demonstration's action at index [1] is 3: the reward's
            action spec has integers from 0 to 2.
        """
        if not self.discrete:
            return
        if self.one_hot:
            wrong = (action != 0).sum(-1) != 1
            wrong |= (action == 1).sum(-1) != 1
            needed = f"one-hot vectors of {self.size} numbers"
        else:
            wrong = (action < 0) | (action >= self.size)
            needed = f"integers from 0 to {self.size - 1}"
        if wrong.any():
            index = wrong.nonzero()[0].tolist()
            raise UserError(
                f"the demonstration's action at index {index} is {action[tuple(index)].tolist()}: "
                f"the reward's action spec has {needed}."
            )

    def forward(self, action: Tensor) -> Tensor:
        """The encoded actions ``(*batch, size)``."""
        self.batch(action)
        if not self.use_actions:
            return action
        if self.one_hot:
            return action.to(torch.get_default_dtype())
        if self.discrete:
            # F.one_hot reads the values, so it cannot be recorded as a graph.
            zeros = torch.zeros(*action.shape, self.size, device=action.device)
            return zeros.scatter(-1, action.long().unsqueeze(-1), 1.0)
        clamped = torch.clamp(action.to(self.low.dtype), self.low, self.high)
        return (clamped - self.offset) * self.scale

    def target(self, action: Tensor) -> Tensor:
        """What a model that predicts the action is fitted to: class indices, or the encoding."""
        if self.discrete and not self.one_hot:
            self.batch(action)
            return action.long()
        encoding = self(action)
        return encoding.argmax(-1) if self.one_hot else encoding

    def extra_repr(self) -> str:
        """Shows kind and size when printed."""
        kind = "discrete" if self.discrete else "box" if self.use_actions else "unused"
        return f"{kind}, size={self.size}"
