"""A control that tells nothing: positive noise with the mean and variance of a learned reward."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.rewards.keys import REWARD_KEYS


class NoiseReward(TensorDictModuleBase):
    """Draws each transition's reward from a Gamma distribution of given mean and variance.

    Gamma, because a squared error is positive and skewed, and because two numbers fix it: shape
    ``mean^2 / variance``, scale ``variance / mean``. Draws are independent of everything, each
    other included, and positive. They come from a generator of the module's own, whose state is
    saved with the module; a batch and the same transitions step by step agree in distribution only.

    Args:
        mean: mean of the reward, above 0.
        variance: its variance, above 0.
        seed: seed of the noise. The global random state is neither read nor changed.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for a mean or variance that is not a number above 0.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = NoiseReward(2.0, 0.5)(TensorDict(batch_size=[10_000]))
        >>> drawn = reward["next", "intrinsic_reward"]
        >>> round(drawn.mean().item(), 1), round(drawn.var().item(), 1), bool((drawn > 0).all())
        (2.0, 0.5, True)
    """

    mean: Tensor
    variance: Tensor

    def __init__(
        self,
        mean: float,
        variance: float,
        *,
        seed: int = 0,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        for name, value in (("mean", mean), ("variance", variance)):
            if not (math.isfinite(value) and torch.tensor(value) > 0):
                raise UserError(
                    f"the noise's {name} is {value}: give a number above 0 (a reward that is the "
                    "same for every transition has no variance to match)."
                )
        self.in_keys: list[NestedKey] = []
        self.out_keys: list[NestedKey] = list(out_keys)
        self.register_buffer("mean", torch.tensor(float(mean)))
        self.register_buffer("variance", torch.tensor(float(variance)))
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes a fresh draw for each element of the batch."""
        # Drawn on the CPU, so that a seed means the same on every device.
        mean, variance = self.mean.cpu().double(), self.variance.cpu().double()
        shape = (mean.square() / variance).expand(*tensordict.batch_size, 1).contiguous()
        # torch.distributions.Gamma draws from the global generator only.
        drawn = torch._standard_gamma(shape, generator=self._generator) * (variance / mean)
        dtype = torch.get_default_dtype()
        # For a small shape many draws are smaller than the smallest float.
        drawn = drawn.clamp(min=torch.finfo(dtype).tiny).to(tensordict.device, dtype)
        return tensordict.set(self.out_keys[0], drawn)

    def get_extra_state(self) -> Tensor:
        """The noise generator's state, uint8."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restores the noise generator."""
        self._generator.set_state(state.cpu())

    def extra_repr(self) -> str:
        """Shows mean and variance when printed."""
        return f"mean={self.mean.item():g}, variance={self.variance.item():g}"
