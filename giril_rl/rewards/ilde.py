"""ILDE: imitation with double exploration (Zhao, Yu, Bossens, Tsang and Gu, ICLR 2025).

``r = r_imitation + lambda * GIRIL's error + eta * b``, arXiv 2506.20307: likeness to the
demonstration, curiosity about what departs from it, and a state-entropy bonus b.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase

from giril_rl.config.schema import FitConfig, RewardRunConfig, knob
from giril_rl.errors import UserError
from giril_rl.rewards.bottleneck import BottleneckConfig, bottleneck_loss, bottleneck_reward
from giril_rl.rewards.controls import AffineReward
from giril_rl.rewards.discriminator import (
    AdversarialConfig,
    DiscriminatorLoss,
    discriminator_reward,
)
from giril_rl.rewards.entropy_bonus import EntropyBonusConfig, entropy_bonus
from giril_rl.rewards.generative import GenerativeConfig, generative_reward
from giril_rl.rewards.method import RED, Method, register
from giril_rl.rewards.pwil import PWILConfig, pwil_reward
from giril_rl.rewards.transitions import REWARD_KEYS


@dataclass
class ILDEConfig:
    """What ILDE adds up. A term of weight 0 is neither trained nor computed."""

    imitation: str = knob(
        "gail",
        "r_imitation: of a discriminator, gail or vail, or PWIL's coupling",
        choices=("gail", "vail", "pwil", "none"),
    )
    imitation_weight: float = knob(1.0, "weight of r_imitation", low=0)
    curiosity_weight: float = knob(
        0.1, "lambda, weight of GIRIL's error over its mean on the demonstration", low=0
    )
    bonus_weight: float = knob(0.1, "eta, weight of the state-entropy bonus", low=0)
    seed: int | None = knob(None, "seed of all its models; null takes the run's seed", low=0)

    @property
    def imitates(self) -> bool:
        """Whether there is an imitation reward."""
        return self.imitation != "none" and self.imitation_weight > 0

    @property
    def along_time(self) -> bool:
        """Whether it is PWIL's, which is computed once, in order of time."""
        return self.imitates and self.imitation == "pwil"

    @property
    def discriminates(self) -> bool:
        """Whether it is a discriminator's, which is trained beside the policy."""
        return self.imitates and self.imitation != "pwil"

    @property
    def moving(self) -> bool:
        """Whether the sum is computed anew for each minibatch of a replay buffer."""
        return self.discriminates or (self.bonus_weight > 0 and not self.along_time)

    def check(self, prefix: str, run: object) -> None:
        """Refuses a sum of nothing."""
        if not (self.imitates or self.curiosity_weight > 0 or self.bonus_weight > 0):
            raise UserError(
                f"all of {prefix}imitation_weight, {prefix}curiosity_weight and "
                f"{prefix}bonus_weight are off: give one of them a weight."
            )


@dataclass
class Coupling(PWILConfig):
    """PWIL's settings, which are read only where PWIL is the imitation reward."""

    def check(self, prefix: str, run: Any) -> None:
        """Refuses what PWIL does."""
        if run.reward.along_time:
            super().check(prefix, run)


@dataclass
class ILDERunConfig(RewardRunConfig):
    """The settings of a run; those of a term that is switched off are not read."""

    reward: ILDEConfig = field(default_factory=ILDEConfig)
    gail: AdversarialConfig = field(default_factory=AdversarialConfig)
    vail: BottleneckConfig = field(default_factory=BottleneckConfig)
    giril: GenerativeConfig = field(default_factory=GenerativeConfig)
    pwil: Coupling = field(default_factory=Coupling)
    bonus: EntropyBonusConfig = field(default_factory=EntropyBonusConfig)
    fit: FitConfig = field(default_factory=FitConfig)

    @property
    def discriminator(self) -> AdversarialConfig:
        """Settings of the chosen discriminator, as the learner needs them."""
        return (self.vail if self.reward.imitation == "vail" else self.gail).settled(self)


class Term(NamedTuple):
    """One reward of a sum.

    Attributes:
        weight: its factor.
        module: a reward module that writes one key, shape ``(*batch, 1)``.
    """

    weight: float
    module: TensorDictModuleBase


class SummedReward(TensorDictModuleBase):
    """The weighted sum of reward modules, ``(*batch, 1)``.

    Args:
        terms: the rewards by name.

    Raises:
        UserError: if there are none, or a module writes several keys.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.rewards import ConstantReward
        >>> terms = {"a": Term(1.0, ConstantReward(3.0)), "b": Term(0.5, ConstantReward(4.0))}
        >>> batch = SummedReward(terms)(TensorDict(batch_size=[2]))
        >>> batch["next", "intrinsic_reward"].flatten()
        tensor([5., 5.])
    """

    terms: Any

    def __init__(self, terms: Mapping[str, Term]) -> None:
        super().__init__()
        if not terms:
            raise UserError("no terms to add up: give at least one reward module.")
        for name, (_, module) in terms.items():
            if len(module.out_keys) != 1:
                raise UserError(
                    f"the reward module {name!r} writes {list(module.out_keys)}: give one that "
                    "writes one key."
                )
        self.weights = {name: term.weight for name, term in terms.items()}
        self.terms = nn.ModuleDict({name: term.module for name, term in terms.items()})
        # Beside the modules, whose keys are no attributes of nn.Module.
        self._keys = {name: (t.module.in_keys, t.module.out_keys[0]) for name, t in terms.items()}
        keys = [key for in_keys, _ in self._keys.values() for key in in_keys]
        self.in_keys: list[NestedKey] = list(dict.fromkeys(keys))
        self.out_keys: list[NestedKey] = list(REWARD_KEYS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the sum."""
        total: Tensor | None = None
        for name, module in self.terms.items():
            in_keys, out_key = self._keys[name]
            term = self.weights[name] * module(tensordict.select(*in_keys)).get(out_key)
            total = term if total is None else total + term
        return tensordict.set(self.out_keys[0], total)


class InMinibatches(TensorDictModuleBase):
    """Computes a reward of a batch for each minibatch of a flat batch by itself.

    An off-policy learner draws the minibatches of several gradient steps at once. A batch with more
    than one dimension, such as the one that was collected, stays whole.

    Args:
        module: the reward, which depends on the batch that it is computed with.
        size: transitions in a minibatch.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.rewards.entropy_bonus import EntropyBonus
        >>> from giril_rl.rewards import ObservationScaler
        >>> bonus = EntropyBonus(ObservationScaler(1, rule="raw", clamp=False), k=1)
        >>> s = torch.tensor([[0.0], [1.0], [1.0], [1.0]])
        >>> batch = TensorDict({"next": {"observation": s}}, [4])
        >>> InMinibatches(bonus, size=2)(batch)["next", "intrinsic_reward"].exp().flatten()
        tensor([2., 2., 1., 1.])
    """

    def __init__(self, module: TensorDictModuleBase, size: int) -> None:
        super().__init__()
        self.module, self.size = module, size
        self.in_keys: list[NestedKey] = list(module.in_keys)
        self.out_keys: list[NestedKey] = list(module.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the reward."""
        if tensordict.ndim != 1:
            return self.module(tensordict)
        parts = tensordict.select(*self.in_keys).split(self.size)
        computed = [self.module(part).get(self.out_keys[0]) for part in parts]
        return tensordict.set(self.out_keys[0], torch.cat(computed))


class RelativeReward(AffineReward):
    """A reward over its mean on the demonstration, which :meth:`calibrate` measures.

    Args:
        module: the reward; its ``in_keys`` and only out_key are this module's too.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.rewards import ConstantReward
        >>> reward = RelativeReward(ConstantReward(4.0))
        >>> reward.calibrate(TensorDict(batch_size=[2]))
        >>> reward(TensorDict(batch_size=[1]))["next", "intrinsic_reward"].item()
        1.0
    """

    def __init__(self, module: TensorDictModuleBase) -> None:
        super().__init__(module)

    @torch.no_grad()
    def calibrate(self, pairs: TensorDictBase) -> None:
        """Divides by the mean reward of the demonstrated transitions ``pairs``."""
        batch = pairs.select(*self.in_keys).to(self.scale.device)
        mean = self.module(batch).get(self.out_keys[0]).double().mean().item()
        self.scale.fill_(1 / mean)


def ilde_reward(
    cfg: ILDERunConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> SummedReward:
    """ILDE's reward, untrained, of the terms ``"imitation"``, ``"curiosity"`` and ``"bonus"``.

    Curiosity is a :class:`RelativeReward` of GIRIL's: fit the latter, then calibrate the former.

    Args:
        cfg: the run's settings.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of all models. The global random state stays as it is.
    """
    weights, terms = cfg.reward, {}
    if weights.imitates:
        imitation: TensorDictModuleBase
        if weights.along_time:
            imitation = pwil_reward(cfg.pwil, env, pairs, seed=seed)
        elif isinstance(cfg.discriminator, BottleneckConfig):
            imitation = bottleneck_reward(cfg.discriminator, env, pairs, seed=seed)
        else:
            imitation = discriminator_reward(cfg.discriminator, env, pairs, seed=seed)
        terms["imitation"] = Term(weights.imitation_weight, imitation)
    if weights.curiosity_weight:
        curiosity = RelativeReward(generative_reward(cfg.giril, env, pairs, seed=seed))
        terms["curiosity"] = Term(weights.curiosity_weight, curiosity)
    if weights.bonus_weight:
        bonus = InMinibatches(entropy_bonus(cfg.bonus, env, pairs, seed=seed), cfg.sac.batch)
        terms["bonus"] = Term(weights.bonus_weight, bonus)
    return SummedReward(terms)


def imitation_loss(reward: Any, settings: AdversarialConfig) -> DiscriminatorLoss:
    """The loss of the discriminator whose reward is the imitation term, GAIL's or VAIL's.

    Args:
        reward: the term.
        settings: :attr:`ILDERunConfig.discriminator`.
    """
    if isinstance(settings, BottleneckConfig):
        return bottleneck_loss(reward, settings)
    return DiscriminatorLoss(reward, penalty=settings.penalty)


register(Method("ilde", "ILDE", RED, trained="beside", settings=ILDEConfig))
