"""The control that every learned reward has to beat: the same reward for everything."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from giril_rl.rewards.keys import REWARD_KEYS


class ConstantReward(TensorDictModuleBase):
    """Writes one constant as the reward of every transition, shape ``(*batch, 1)``.

    With a positive constant the return counts the steps survived. A task that this reward solves
    says nothing about a learned one.

    Args:
        value: the reward.
        out_keys: where it is written, one key.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = ConstantReward(2.0)(TensorDict(batch_size=[3]))
        >>> batch["next", "intrinsic_reward"].squeeze(-1).tolist()
        [2.0, 2.0, 2.0]
    """

    def __init__(
        self,
        value: float = 1.0,
        *,
        out_keys: tuple[NestedKey, ...] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        self.value = value
        self.in_keys: list[NestedKey] = []
        self.out_keys: list[NestedKey] = list(out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the constant for each element of the batch."""
        reward = torch.full((*tensordict.batch_size, 1), self.value, device=tensordict.device)
        return tensordict.set(self.out_keys[0], reward)
