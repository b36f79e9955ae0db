"""VAIL's reward: a discriminator that sees a pair only through a bottleneck."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from giril_rl.networks.joined import JoinedSequential
from giril_rl.networks.pixel_discriminators import PixelBottleneck
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import RewardForm
from giril_rl.rewards.discriminator import (
    DiscriminatorReward,
    DiscriminatorScaling,
    discriminator_scaler,
)
from giril_rl.rewards.keys import PAIR_KEYS, REWARD_KEYS
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.transitions import check_output
from giril_rl.runs.pretrained import remembered
from giril_rl.runs.randomness import seeded


class BottleneckReward(DiscriminatorReward):
    """A discriminator of a code z of the pair, ``E(z | s, a)`` a diagonal Gaussian.

    In training z is sampled and its KL to N(0, I) is bounded; the reward takes the mean of z (Peng
    et al. 2019, arXiv 1810.00821). Train it with :class:`~giril_rl.rewards.BottleneckLoss`.

    Args:
        encoder: called with s and the action's code, gives ``2 * latent`` numbers, mean and
            log-variance of z.
        head: maps z to one number, the logit of "this is the expert's".
        **kwargs: those of :class:`~giril_rl.rewards.DiscriminatorReward`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        latent: int = 8,
    ) -> BottleneckReward:
        """The paper's body for vector observations and a linear head on z.

        Args:
            observation_dim: see :meth:`DiscriminatorReward.for_vectors`, as for all others.
            action_spec: the environment's action spec.
            hidden: hidden layers (tanh) of the encoder.
            form: the reward's form.
            normalise: the observation's rule.
            clamp: bound on each scaled observation; None has none.
            seed: seed of the weights.
            in_keys: keys of observation and action.
            out_keys: where the reward is written, one key.
            latent: size of z.

        Raises:
            UserError: for an unknown form, rule or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            encoder = JoinedSequential(*mlp(observation_dim + actions.size, 2 * latent, hidden))
            head = nn.Linear(latent, 1)
        return cls(
            encoder,
            head,
            scaler=discriminator_scaler(observation_dim, normalise, clamp),
            actions=actions,
            form=form,
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        latent: int = 8,
    ) -> BottleneckReward:
        """The paper's body for stacks of 84x84 frames and a linear head on z.

        Args:
            action_spec: see :meth:`DiscriminatorReward.for_pixels`, as for all others.
            channels: frames in an observation.
            form: the reward's form.
            seed: seed of the weights.
            in_keys: keys of observation and action.
            out_keys: where the reward is written, one key.
            latent: size of z.

        Raises:
            UserError: for an unknown form or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            encoder = PixelBottleneck(actions.size, latent, channels)
            head = nn.Linear(latent, 1)
        return cls(
            encoder,
            head,
            scaler=PixelScaler(),
            actions=actions,
            form=form,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def encode(self, observation: Tensor, action_code: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of z for a scaled observation and an action's code."""
        mu, logvar = self.network(observation, action_code).chunk(2, -1)
        return mu, logvar

    def judge(self, z: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of a code ``(*batch, latent)``."""
        logit = self.head(z)
        check_output("the bottleneck's head", logit, (*z.shape[:-1], 1))
        return logit.squeeze(-1)

    def logit(self, observation: Tensor, action_code: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of the code's mean."""
        return self.judge(self.encode(observation, action_code)[0])
