"""Actions as the real vectors that encoder and decoder speak of."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.networks.action_bounds import affine_map, single_action_spec


class ActionEncoder(nn.Module):
    """Turns an environment's actions into action codes of shape ``(*batch, size)``.

    - Discrete, integers ``(*batch,)``: one-hot, as floats. One-hot actions: as floats.
    - Box ``(*batch, size)``: clamped to the bounds, as the simulator does before it acts, then
      mapped affinely from the bounds to [-1, 1]; a dimension without two finite bounds keeps its
      unit.

    Args:
        spec: TorchRL's action spec, with or without the environment's batch dimensions, or a
            Composite of nothing else.

    Raises:
        UserError: for a spec of another kind.

    Examples:
        >>> from torchrl.data import Bounded
        >>> ActionEncoder(Categorical(3))(torch.tensor([2, 0])).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
        >>> ActionEncoder(Bounded(0.0, 4.0, shape=(1,)))(torch.tensor([[3.0], [9.0]])).tolist()
        [[0.5], [1.0]]
    """

    low: Tensor
    high: Tensor
    offset: Tensor
    scale: Tensor

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__()
        spec = single_action_spec(spec)
        self.discrete = isinstance(spec, (Categorical, OneHot))
        self.one_hot = isinstance(spec, OneHot)
        self.size = int(spec.space.n if self.discrete else spec.shape[-1])
        if self.discrete:
            return
        low, high, offset, half_range = affine_map(spec)
        buffers = {"low": low, "high": high, "offset": offset, "scale": 1 / half_range}
        for name, value in buffers.items():
            self.register_buffer(name, value.to(torch.get_default_dtype()))

    def forward(self, action: Tensor) -> Tensor:
        """The action codes ``(*batch, size)``."""
        if self.one_hot:
            return action.to(torch.get_default_dtype())
        if self.discrete:
            # Not F.one_hot, which looks at the values and so cannot be recorded as a graph.
            zeros = torch.zeros(*action.shape, self.size, device=action.device)
            return zeros.scatter(-1, action.long().unsqueeze(-1), 1.0)
        clamped = torch.clamp(action.to(self.low.dtype), self.low, self.high)
        return (clamped - self.offset) * self.scale

    def target(self, action: Tensor) -> Tensor:
        """What the encoder's latent is fitted to: class indices if discrete, else the code."""
        if self.one_hot:
            return action.to(torch.uint8).argmax(-1)
        return action.long() if self.discrete else self(action)

    def extra_repr(self) -> str:
        """Shows kind and size when printed."""
        return f"{'discrete' if self.discrete else 'box'}, size={self.size}"
