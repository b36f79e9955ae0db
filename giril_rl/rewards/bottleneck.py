"""VAIL: GAIL's discriminator behind an information bottleneck (Peng et al. 2019, arXiv 1810.00821).

:class:`BottleneckReward` judges a pair by a latent z of it. :class:`BottleneckLoss` bounds the
information in z, by :func:`~giril_rl.rewards.adversarial.dual_step`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import knob
from giril_rl.errors import UserError
from giril_rl.networks.pixels import SIDE, PixelBottleneck
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import (
    DiscriminatorScaling,
    RewardForm,
    discriminator_scaler,
    dual_step,
)
from giril_rl.rewards.discriminator import (
    AdversarialConfig,
    DiscriminatorLoss,
    DiscriminatorReward,
    Sets,
)
from giril_rl.rewards.generative import gaussian_kl
from giril_rl.rewards.method import PINK, Method, register
from giril_rl.rewards.scaler import PixelScaler
from giril_rl.rewards.transitions import PAIR_KEYS, REWARD_KEYS, check_output, reward_for
from giril_rl.runs.pretrained import remembered
from giril_rl.runs.randomness import seeded


@dataclass
class BottleneckConfig(AdversarialConfig):
    """VAIL's discriminator with its information bottleneck."""

    penalty: float = knob(0.0, "weight of the gradient penalty; 0 leaves it out", low=0)
    information: float = knob(0.5, "I_c, nats through the bottleneck (paper: 0.5)", low=0)
    latent: int = knob(8, "size of the bottleneck's code", low=1)
    beta_start: float = knob(0.0, "first weight of the constraint", low=0)
    beta_step: float = knob(1e-2, "dual step on that weight for each nat too many", low=0)


class BottleneckReward(DiscriminatorReward):
    """A discriminator of a latent z of the pair; ``E(z | s, a)`` is a diagonal Gaussian.

    Training samples z and bounds its KL to N(0, I). The reward uses the mean of z. Train it with
    :class:`~giril_rl.rewards.BottleneckLoss`.

    Args:
        encoder: called with s and the encoded action, returns ``2 * latent`` numbers, mean and
            log-variance of z.
        head: maps z to one number, the logit of "this is the expert's".
        **kwargs: those of :class:`~giril_rl.rewards.DiscriminatorReward`.

    Examples:
        >>> from torchrl.data import Categorical
        >>> reward = BottleneckReward.for_vectors(2, Categorical(3), normalise="raw", latent=4)
        >>> mu, logvar = reward.encode(torch.zeros(7, 2), torch.zeros(7, 3))
        >>> mu.shape, logvar.shape
        (torch.Size([7, 4]), torch.Size([7, 4]))
    """

    def __init__(self, encoder: nn.Module, head: nn.Module, **kwargs: Any) -> None:
        super().__init__(encoder, **kwargs)
        self.head = head

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        form: RewardForm = "positive",
        normalise: DiscriminatorScaling = "standardise",
        clamp: float | None = 10.0,
        absorbing: bool = False,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        latent: int = 8,
    ) -> BottleneckReward:
        """The paper's encoder for vector observations, and a linear head on z.

        Arguments are those of :meth:`DiscriminatorReward.for_vectors`, and ``latent``, the size
        of z.
        """
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            encoder = mlp(observation_dim + actions.size + absorbing, 2 * latent, hidden)
            head = nn.Linear(latent, 1)
        return cls(
            encoder,
            head,
            scaler=discriminator_scaler(observation_dim, normalise, clamp),
            actions=actions,
            form=form,
            absorbing=(observation_dim,) if absorbing else None,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    @classmethod
    @remembered
    def for_pixels(
        cls,
        action_spec: TensorSpec,
        *,
        channels: int = 4,
        form: RewardForm = "positive",
        absorbing: bool = False,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        latent: int = 8,
    ) -> BottleneckReward:
        """The paper's encoder for ``channels`` frames of 84x84; see `for_vectors`."""
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            encoder = PixelBottleneck(actions.size + absorbing, latent, channels)
            head = nn.Linear(latent, 1)
        return cls(
            encoder,
            head,
            scaler=PixelScaler(),
            actions=actions,
            form=form,
            absorbing=(channels, SIDE, SIDE) if absorbing else None,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def encode(self, observation: Tensor, encoding: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of z for a scaled observation and an encoded action."""
        mu, logvar = self.network(observation, encoding).chunk(2, -1)
        return mu, logvar

    def judge(self, z: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of a latent ``(*batch, latent)``."""
        logit = self.head(z)
        check_output("the bottleneck's head", logit, (*z.shape[:-1], 1))
        return logit.squeeze(-1)

    def logit(self, observation: Tensor, encoding: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of the mean of z."""
        return self.judge(self.encode(observation, encoding)[0])


class BottleneckLoss(DiscriminatorLoss):
    """:class:`~giril_rl.rewards.DiscriminatorLoss` on sampled z, plus ``loss_bottleneck``.

    ``loss_bottleneck = beta * (KL - I_c)``. KL is that of ``E(z | s, a)`` to N(0, I), in nats,
    summed over z's dimensions and averaged over the expert's and the policy's pairs, both sets
    weighing the same (Peng et al.: over their equal mixture). Call :meth:`update_beta` after each
    gradient step. ``kl`` is logged besides. Noise comes from the global generator.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        information: the constraint I_c on the mean KL, in nats.
        beta_step: the dual step on beta.
        beta: its first value; beta is a buffer, saved with the module.
        penalty: weight of the gradient penalty, taken at the mean of z; 0 leaves it out.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for a negative number.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> reward = BottleneckReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> pairs = lambda n: {"observation": torch.zeros(n, 2), "action": torch.zeros(n).long()}
        >>> loss = BottleneckLoss(reward, information=0.5, beta_step=0.1)
        >>> out = loss(TensorDict({"expert": pairs(50), "policy": pairs(256)}))
        >>> loss.update_beta(torch.tensor(2.5))
        >>> sorted(out.keys())[2:5], loss.beta
        (['kl', 'loss_bottleneck', 'loss_expert'], tensor(0.2000))
    """

    beta: Tensor
    reward: BottleneckReward

    def __init__(
        self,
        reward: BottleneckReward,
        *,
        information: float = 0.5,
        beta_step: float = 1e-2,
        beta: float = 0.0,
        penalty: float = 0.0,
        functional: bool = False,
    ) -> None:
        super().__init__(reward, penalty=penalty, functional=functional)
        numbers = {"information": information, "beta_step": beta_step, "beta": beta}
        for name, value in numbers.items():
            if not value >= 0:
                raise UserError(f"{name}={value} is negative: give a number of 0 or more.")
        self.information = information
        self.beta_step = beta_step
        self.register_buffer("beta", torch.tensor(float(beta)))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the terms to be added, ``loss_*``, and of what is logged."""
        return ["loss_bottleneck", *super().out_keys]

    @property
    def log_keys(self) -> list[str]:
        """Names of what is logged."""
        return [*super().log_keys, "kl"]

    @torch.no_grad()
    def update_beta(self, kl: Tensor) -> None:
        """The dual step, in place, for the mean KL that :meth:`forward` returned."""
        self.beta.copy_(dual_step(self.beta, kl, self.information, self.beta_step))

    def after_step(self, log: Mapping[str, Tensor]) -> None:
        """The dual step on beta."""
        self.update_beta(log["kl"])

    def logged_state(self) -> dict[str, float]:
        """Beta."""
        return {"beta": self.beta.item()}

    def _judge(
        self, observation: Tensor, encoding: Tensor, sets: Sets
    ) -> tuple[Tensor, dict[str, Tensor]]:
        mu, logvar = self.reward.encode(observation, encoding)
        z = mu + (0.5 * logvar).exp() * torch.randn_like(mu)
        expert, policy = sets.means(gaussian_kl(mu, logvar))
        kl = (expert + policy) / 2
        bottleneck = self.beta * (kl - self.information)
        return self.reward.judge(z), {"loss_bottleneck": bottleneck, "kl": kl.detach()}


def bottleneck_reward(
    settings: BottleneckConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> BottleneckReward:
    """VAIL's reward; arguments as :func:`~giril_rl.rewards.discriminator_reward` has them."""
    settings = replace(settings, absorbing=bool(settings.absorbing))
    shared, own = "form absorbing use_actions latent", "hidden normalise clamp"
    return reward_for(
        env, BottleneckReward, settings, pairs, seed=seed, of_all=shared, of_vectors=own
    )


def bottleneck_loss(reward: BottleneckReward, settings: BottleneckConfig) -> BottleneckLoss:
    """VAIL's loss, as its settings have it.

    Examples:
        >>> from torchrl.data import Categorical
        >>> reward = BottleneckReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> bottleneck_loss(reward, BottleneckConfig(beta_start=0.5)).beta
        tensor(0.5000)
    """
    return BottleneckLoss(
        reward,
        information=settings.information,
        beta_step=settings.beta_step,
        beta=settings.beta_start,
        penalty=settings.penalty,
    )


register(
    Method(
        "vail",
        "VAIL",
        PINK,
        trained="beside",
        settings=BottleneckConfig,
        build=bottleneck_reward,
        loss=bottleneck_loss,
        rank=3,
    )
)
