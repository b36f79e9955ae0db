"""What adversarial rewards share: the maths on a discriminator's logit, its settings and its loss.

Labels, everywhere in this package: ``D(s, a) = sigmoid(logit)`` is the probability that the pair is
the **expert's** (label 1), and ``1 - D`` that it is the policy's (label 0). Ho and Ermon (2016)
label the other way round; ``docs/methods/gail.md`` translates.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from giril_rl.config.schema import COMPILE, knob
from giril_rl.errors import UserError
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.rewards.fitting import RewardLoss
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler
from giril_rl.rewards.transitions import TransitionReward
from giril_rl.runs.pretrained import Pretrained

DiscriminatorScaling = Literal["running", "demo_range", "standardise", "raw"]
RewardForm = Literal["positive", "negative", "log_ratio", "reversed"]


def discriminator_loss(expert: Tensor, policy: Tensor) -> tuple[Tensor, Tensor]:
    """Binary cross-entropy: the means of ``-log D`` (expert) and of ``-log(1 - D)`` (policy).

    Add them. Each set has its own mean, so that both weigh the same whatever their sizes.

    Args:
        expert: logits of the expert's pairs, any shape.
        policy: logits of the policy's pairs, any shape.

    Returns:
        The expert's and the policy's term, scalars.

    Examples:
        >>> ln3 = torch.tensor(3.0).log()  # D = 0.75
        >>> terms = discriminator_loss(ln3.reshape(1), torch.stack((ln3, -ln3)))
        >>> [round(term.exp().item(), 4) for term in terms]  # 4/3, and the root of 4 * 4/3
        [1.3333, 2.3094]
    """
    return F.softplus(-expert).mean(), F.softplus(policy).mean()


def adversarial_reward(logit: Tensor, form: RewardForm) -> Tensor:
    """The policy's reward for a pair, of the logit's shape.

    ===============  ====================  =========  ========================================
    form             with D = P(expert)    range      what it pays for besides likeness
    ===============  ====================  =========  ========================================
    ``"positive"``   ``-log(1 - D)``       (0, inf)   rewards survival: each step adds
    ``"negative"``   ``log D``             (-inf, 0)  punishes survival: each step costs
    ``"log_ratio"``  ``log D - log(1-D)``  all        neither by itself (the logit, as AIRL's)
    ``"reversed"``   ``-log D``            (0, inf)   rewards survival, and being *unlike*
    ===============  ====================  =========  ========================================

    Computed by softplus, so that no logit is too large.

    Args:
        logit: the discriminator's output.
        form: one of the four.

    Raises:
        UserError: for an unknown form.

    Examples:
        >>> logit = torch.tensor([3.0]).log()  # D = 0.75
        >>> [round(adversarial_reward(logit, form).exp().item(), 4)
        ...  for form in ("positive", "negative", "log_ratio", "reversed")]
        [4.0, 0.75, 3.0, 1.3333]
    """
    if form == "positive":
        return F.softplus(logit)
    if form == "negative":
        return -F.softplus(-logit)
    if form == "log_ratio":
        return logit
    if form == "reversed":
        return F.softplus(-logit)
    raise UserError(f"form={form!r} is unknown: choose one of {', '.join(get_args(RewardForm))}.")


def with_absorbing(mean: Tensor, absorbing: Tensor, rate: Tensor) -> Tensor:
    """A set's mean with its absorbing pairs: ``(mean + rate * absorbing) / (1 + rate)``.

    All absorbing pairs are the same one, so a set's mean over ordinary and absorbing pairs needs
    its value once (Kostrikov et al. 2019, arXiv 1809.02925, section 4.1).

    Args:
        mean: mean over the ordinary pairs.
        absorbing: the absorbing pair's value.
        rate: absorbing pairs for each ordinary one; one enters with each failure.

    Examples:
        >>> ordinary = torch.tensor([1.0, 2.0, 3.0, 6.0])  # Two of four end in a failure, worth 9.
        >>> with_absorbing(ordinary.mean(), torch.tensor(9.0), torch.tensor(0.5))
        tensor(5.)
    """
    return (mean + rate * absorbing) / (1 + rate)


def interpolated(expert: Tensor, policy: Tensor, weight: Tensor) -> Tensor:
    """Points between pairs of the two sets: ``weight * expert + (1 - weight) * policy``.

    The smaller set is repeated until it is as long as the larger.

    Args:
        expert: ``(n, *features)``.
        policy: ``(m, *features)``.
        weight: ``(max(n, m),)``, in [0, 1].

    Examples:
        >>> expert, policy = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[0.0], [10.0]])
        >>> interpolated(expert, policy, torch.tensor([1.0, 0.5, 0.5])).flatten()
        tensor([1.0000, 6.0000, 1.5000])
    """
    index = torch.arange(len(weight), device=weight.device)
    weight = weight.reshape(-1, *[1] * (expert.ndim - 1))
    return weight * expert[index % len(expert)] + (1 - weight) * policy[index % len(policy)]


def gradient_penalty(score: Callable[..., Tensor], points: Sequence[Tensor]) -> Tensor:
    """Mean of ``(‖gradient of score‖ - 1)^2`` (Gulrajani et al. 2017, arXiv 1704.00028, eq. 3).

    The norm is over the gradients with respect to all tensors in ``points`` together.

    Args:
        score: called with ``points``; one number per pair, whose shape is that of the batch.
        points: tensors ``(*batch, *features)``, such as observations and encoded actions.

    Returns:
        A scalar, differentiable with respect to the parameters of ``score``.

    Examples:
        >>> gradient_penalty(lambda s, a: 3 * s[:, 0] + 4 * a[:, 0], torch.zeros(2, 5, 1))
        tensor(16.)
    """
    with torch.enable_grad():
        leaves = [point.detach().requires_grad_() for point in points]
        scores = score(*leaves)
        gradients = torch.autograd.grad(scores.sum(), leaves, create_graph=True)
        slopes = torch.cat([g.reshape(*scores.shape, -1) for g in gradients], -1)
        norm = torch.linalg.vector_norm(slopes, dim=-1)
        return (norm - 1).square().mean()


def dual_step(beta: Tensor, kl: Tensor, limit: float, step: float) -> Tensor:
    """``max(0, beta + step * (kl - limit))`` (Peng et al. 2019, arXiv 1810.00821, section 4).

    Args:
        beta: the multiplier of the constraint ``kl <= limit``.
        kl: the constrained quantity, in nats.
        limit: the information constraint I_c, in nats.
        step: change of the multiplier for a violation of one nat.

    Examples:
        >>> dual_step(torch.tensor(0.25), torch.tensor([2.5, 0.0]), limit=0.5, step=1.0)
        tensor([2.2500, 0.0000])
    """
    return (beta + step * (kl - limit)).clamp_min(0.0)


@dataclass
class DiscriminatorConfig:
    """A discriminator of vectors or frames, and its training beside the policy."""

    lr: float = knob(1e-3, "Adam step size (paper: 1e-3)", low=0, low_open=True)
    updates: int = knob(10, "gradient steps with each batch of PPO; off-policy see `every`", low=1)
    every: int = knob(
        20, "off-policy: environment steps that `updates` gradient steps go to", low=1
    )
    batch: int = knob(250, "most pairs of expert and of policy in each gradient step", low=1)
    penalty: float = knob(1.0, "weight of the gradient penalty; 0 leaves it out", low=0)
    normalise: str = knob(
        "standardise",
        "observation rule: running statistics of the policy, or one of the demonstration",
        choices=("running", "demo_range", "standardise", "raw", "pixels"),
    )
    clamp: float | None = knob(
        10.0, "bound on normalised observations; null has none", low=0, low_open=True
    )
    hidden: list[int] = knob([100, 100], "hidden layers of the discriminator (tanh)", low=1)
    seed: int | None = knob(None, "seed of the discriminator; null takes the run's seed", low=0)
    compile: bool = knob(False, COMPILE)


class AdversarialReward(Pretrained, TransitionReward):
    """A reward made of a discriminator, which may follow the policy's observations.

    Attributes:
        absorbing: the shape of one scaled observation, where absorbing states are judged too; None
            judges none.
    """

    absorbing: tuple[int, ...] | None = None

    def fit_scaler(self, observations: Tensor) -> None:
        """Fits the scaler to the demonstration's ``(N, d)``, unless it follows the policy's."""
        if isinstance(self.scaler, (ObservationScaler, PixelScaler)):
            self.scaler.fit(observations)

    def observe(self, observations: Tensor) -> None:
        """Updates running statistics, if any, with the policy's observations ``(*batch, d)``."""
        if isinstance(self.scaler, RunningNormaliser):
            self.scaler.update(observations)


def discriminator_scaler(
    observation_dim: int, rule: DiscriminatorScaling, clamp: float | None
) -> nn.Module:
    """Scales a discriminator's observations.

    An untrained policy goes where an expert never was, tens of the demonstration's standard
    deviations away.

    Args:
        observation_dim: size of the observation's last dimension.
        rule: ``"running"`` for mean and standard deviation of all that the policy has seen so far
            (update them with each batch before the discriminator), or a rule of
            :class:`~giril_rl.rewards.ObservationScaler`, fitted to the demonstration.
        clamp: bound on the result; None has none.

    Raises:
        UserError: for an unknown rule.

    Examples:
        >>> discriminator_scaler(2, "raw", clamp=1.0)(torch.tensor([0.5, 7.0]))
        tensor([0.5000, 1.0000])
    """
    if rule not in get_args(DiscriminatorScaling):
        raise UserError(
            f"normalise={rule!r} is unknown: choose one of "
            f"{', '.join(get_args(DiscriminatorScaling))}."
        )
    if rule == "running":
        return RunningNormaliser(observation_dim, clip=float("inf") if clamp is None else clamp)
    return ObservationScaler(
        observation_dim, rule=rule, clamp=clamp is not None, limit=1.0 if clamp is None else clamp
    )


class AdversarialLoss(RewardLoss):
    """The loss of a discriminator between an expert's transitions and a policy's.

    A subclass names what it reads in ``in_keys`` and ``transition_keys``, and computes in
    ``_terms``. There is no ``reduction``: each term is a mean over its own set.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        penalty: weight of the gradient penalty; 0 leaves it out.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for a negative penalty.
    """

    reward: Any

    def __init__(
        self, reward: TensorDictModuleBase, *, penalty: float = 0.0, functional: bool = False
    ) -> None:
        if not penalty >= 0:
            raise UserError(f"penalty={penalty} is negative: give a weight of 0 or more.")
        super().__init__(reward, functional=functional)
        self.penalty = penalty

    @property
    @abstractmethod
    def transition_keys(self) -> list[NestedKey]:
        """What is read of a set of transitions, by its keys in a batch."""

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the terms to be added, ``loss_*``, and of what is logged."""
        penalty = ["loss_penalty"] if self.penalty else []
        return ["loss_expert", "loss_policy", *penalty, *self.log_keys]

    @property
    def log_keys(self) -> list[str]:
        """Names of what is logged."""
        return ["accuracy_expert", "accuracy_policy"]

    def after_step(self, log: Mapping[str, Tensor]) -> None:
        """Follows each gradient step; ``log`` has the step's :attr:`log_keys`."""

    def logged_state(self) -> dict[str, float]:
        """Numbers of the loss's own that are worth logging."""
        return {}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms and what is logged, all scalars."""
        with self.parameters_in_reward():
            return self._terms(tensordict)

    @abstractmethod
    def _terms(self, tensordict: TensorDictBase) -> TensorDictBase:
        """All :attr:`out_keys`."""
