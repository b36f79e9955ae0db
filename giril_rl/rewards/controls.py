"""Rewards that stand in for a learned one. A learned reward must beat them.

A control is registered here, and nowhere else: ``giril run control reward=NAME`` finds it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from giril_rl.errors import UserError
from giril_rl.rewards.curiosity import CuriosityConfig, curiosity_reward
from giril_rl.rewards.generative import (
    GenerativeConfig,
    GenerativeRewardLoss,
    generative_reward,
    reconstruction_error,
)
from giril_rl.rewards.method import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PINK,
    RED,
    SKY,
    Method,
    register,
)
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.transitions import (
    REWARD_KEYS,
    STATE_KEYS,
    TransitionReward,
    check_states,
    observation_shape,
)


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

    def __init__(self, value: float = 1.0, *, out_keys: Sequence[NestedKey] = REWARD_KEYS) -> None:
        super().__init__()
        self.value = value
        self.in_keys: list[NestedKey] = []
        self.out_keys: list[NestedKey] = list(out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the constant for each element of the batch."""
        reward = torch.full((*tensordict.batch_size, 1), self.value, device=tensordict.device)
        return tensordict.set(self.out_keys[0], reward)


class CopyReward(TransitionReward):
    """Eq. 2 with the copy predictor ``s_hat = s``: ``r = lambda * ||s - s'||^2``.

    It pays for the distance that the scaled (and clamped) state moves in a step. A generative model
    that has learned little more than that states change slowly pays much the same.

    Reads observation ``(*batch, d)``, or frames, and next observation. Writes one reward per
    transition, ``(*batch, 1)``. Only the scaler has to be fitted.

    Args:
        scaler: applied to both observations.
        scale: lambda.
        in_keys: keys of observation and next observation.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or entries that are missing or of a wrong shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> s, s_next = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.5, 3.0]])
        >>> batch = TensorDict({"observation": s, "next": {"observation": s_next}}, [1])
        >>> reward = CopyReward(ObservationScaler(2, rule="raw", clamp=False))
        >>> reward(batch)["next", "intrinsic_reward"].tolist()
        [[4.25]]
    """

    def __init__(
        self,
        scaler: ObservationScaler | PixelScaler,
        *,
        scale: float = 1.0,
        in_keys: Sequence[NestedKey] = STATE_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__("a copy reward", ("observation", "next observation"), in_keys, out_keys)
        self.scaler = scaler
        self.scale = scale

    def check(self, *transitions: Tensor) -> None:
        """Refuses a next observation of another shape."""
        check_states(*transitions)

    def value(self, *transitions: Tensor) -> Tensor:
        """Lambda times the squared change of each state."""
        s, s_next = map(self.scaler, transitions)
        return self.scale * reconstruction_error(s, s_next, self.scaler.event_dims)


class NoiseReward(TensorDictModuleBase):
    """Draws each transition's reward from a Gamma distribution of given mean and variance.

    A Gamma distribution is positive and skewed, as a squared error is, and two numbers fix it:
    shape ``mean^2 / variance``, scale ``variance / mean``. Draws depend on nothing, each other
    included. They come from the module's own generator, whose state is saved with the module. A
    batch and the same transitions step by step agree in distribution only.

    Args:
        mean: mean of the reward, above 0.
        variance: its variance, above 0.
        seed: seed of the noise. The global random state stays as it is.
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


class AffineReward(TensorDictModuleBase):
    """``scale * r + shift`` of another reward module's r.

    ``scale=-1`` punishes what r pays for, staying alive included. ``shift=-mean`` takes the pay for
    staying alive away and leaves the differences between transitions.

    Args:
        module: the reward; its ``in_keys`` and only out_key are this module's too.
        scale: factor of r, other than 0.
        shift: what is added.

    Raises:
        UserError: for a scale of 0, or a module with several out_keys.

    Examples:
        >>> from tensordict import TensorDict
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


def copy_reward(
    settings: GenerativeConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int = 0
) -> CopyReward:
    """The copy predictor's reward on GIRIL's scale, its scaler fitted to ``pairs``.

    Args:
        settings: GIRIL's settings.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: has no effect, for nothing is random.
    """
    frames, size = observation_shape(env)
    scaler: ObservationScaler | PixelScaler
    if frames:
        scaler = PixelScaler(clamp=settings.clamp)
    else:
        rule = cast(ScalingRule, settings.normalise)
        scaler = ObservationScaler(size, rule=rule, clamp=settings.clamp)
    return CopyReward(scaler.fit(pairs.get("observation")), scale=settings.scale)


def _control(name: str, colour: str, rank: int, **entries: Any) -> None:
    label = f"control: {name.replace('_', ' ')}"
    register(Method(f"control:{name}", label, colour, kind="control", rank=rank, **entries))


_UNTRAINED: dict[str, Any] = {
    "trained": "never",
    "settings": GenerativeConfig,
    "build": generative_reward,
}
_TRAINED = {
    **_UNTRAINED,
    "trained": "before",
    "loss": lambda reward, settings: GenerativeRewardLoss(reward, alpha=settings.alpha),
}
_control(
    "constant",
    BLACK,
    200,
    trained="never",
    demonstration=False,
    build=lambda settings, env, pairs, *, seed: ConstantReward(),
)
_control("untrained_giril", BLUE, 201, **_UNTRAINED)
_control(
    "untrained_icm",
    RED,
    202,
    trained="never",
    settings=CuriosityConfig,
    build=curiosity_reward,
)
_control("copy", GREEN, 203, trained="never", settings=GenerativeConfig, build=copy_reward)
_control(
    "noise",
    PINK,
    204,
    derive=lambda reward, moments, seed: NoiseReward(*moments(), seed=seed),
    **_TRAINED,
)
_control(
    "negated_giril",
    ORANGE,
    205,
    derive=lambda reward, moments, seed: AffineReward(reward, scale=-1.0),
    **_TRAINED,
)
_control(
    "centred_giril",
    SKY,
    206,
    derive=lambda reward, moments, seed: AffineReward(reward, shift=-moments()[0]),
    **_TRAINED,
)
