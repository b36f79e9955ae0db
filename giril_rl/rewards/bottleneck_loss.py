"""Training VAIL's discriminator: as little information through the bottleneck as allowed."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.rewards.adversarial import dual_step
from giril_rl.rewards.bottleneck import BottleneckReward
from giril_rl.rewards.discriminator_loss import DiscriminatorLoss
from giril_rl.rewards.generative_loss import gaussian_kl


class BottleneckLoss(DiscriminatorLoss):
    """:class:`~giril_rl.rewards.DiscriminatorLoss` on sampled codes, plus ``loss_bottleneck``.

    ``loss_bottleneck = beta * (KL - I_c)``, KL that of ``E(z | s, a)`` to N(0, I), in nats, summed
    over z's dimensions and averaged over pairs of the expert and of the policy, both sets weighing
    the same (Peng et al. 2019: over the equal mixture of the two). Call :meth:`update_beta` after
    each gradient step. ``kl`` is logged besides. Noise comes from the global generator.

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
        for name, value in {
            "information": information,
            "beta_step": beta_step,
            "beta": beta,
        }.items():
            if not value >= 0:
                raise UserError(f"{name}={value} is negative: give a number of 0 or more.")
        self.information = information
        self.beta_step = beta_step
        self.register_buffer("beta", torch.tensor(float(beta)))

    @property
    def out_keys(self) -> list:
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
        self, observation: Tensor, code: Tensor, experts: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        mu, logvar = self.reward.encode(observation, code)
        z = mu + (0.5 * logvar).exp() * torch.randn_like(mu)
        divergence = gaussian_kl(mu, logvar)
        kl = (divergence[:experts].mean() + divergence[experts:].mean()) / 2
        bottleneck = self.beta * (kl - self.information)
        return self.reward.judge(z), {"loss_bottleneck": bottleneck, "kl": kl.detach()}
