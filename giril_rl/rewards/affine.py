"""Another reward, stretched and shifted: with a minus sign, or without its mean."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError


class AffineReward(TensorDictModuleBase):
    """``scale * r + shift``, r being what another reward module writes.

    ``scale=-1`` turns what was paid for into what is punished, the pay for staying alive included;
    ``shift=-mean`` takes that pay away and leaves the differences between transitions.

    Args:
        module: the reward; its ``in_keys`` and only out_key are this module's too.
        scale: what r is multiplied by, other than 0.
        shift: what is added.

    Raises:
        UserError: for a scale of 0, or a module with several out_keys.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.rewards import ConstantReward
        >>> batch = AffineReward(ConstantReward(2.0), -1.0, 0.5)(TensorDict(batch_size=[1]))
        >>> batch["next", "intrinsic_reward"].tolist()
        [[-1.5]]
    """

    scale: Tensor
    shift: Tensor

    def __init__(
        self, module: TensorDictModuleBase, scale: float = 1.0, shift: float = 0.0
    ) -> None:
        super().__init__()
        if len(module.out_keys) != 1:
            raise UserError(
                f"the reward module writes {list(module.out_keys)}: give one that writes one key."
            )
        if scale == 0:
            raise UserError("scale=0 leaves nothing of the reward: use ConstantReward instead.")
        self.module = module
        self.in_keys: list[NestedKey] = list(module.in_keys)
        self.out_keys: list[NestedKey] = list(module.out_keys)
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.register_buffer("shift", torch.tensor(float(shift)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        tensordict = self.module(tensordict)
        reward = tensordict.get(self.out_keys[0])
        return tensordict.set(self.out_keys[0], self.scale * reward + self.shift)

    def extra_repr(self) -> str:
        """Shows the two numbers when printed."""
        return f"scale={self.scale.item():g}, shift={self.shift.item():g}"
