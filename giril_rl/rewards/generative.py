"""GIRIL: the prediction error of a conditional VAE trained on the demonstration.

Equation 2, the reward: :func:`blend_action` and :func:`reconstruction_error`, put together in
:class:`GenerativeReward`. Equation 1, the training: :func:`reconstruction_error`,
:func:`gaussian_kl` and :func:`action_term`, put together in :class:`GenerativeRewardLoss`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.networks.pixels import PixelEncoder, PixelPrior
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.factored import (
    ActionTable,
    coded_error,
    computes_as,
    factored_error,
    is_factored,
)
from giril_rl.rewards.fitting import Reduction, TransitionLoss
from giril_rl.rewards.method import BLUE, Method, register
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.transitions import (
    REWARD_KEYS,
    TRANSITION_KEYS,
    TransitionReward,
    check_output,
    check_transitions,
    reads_actions,
    reward_for,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded

Prior = Literal["standard", "conditional"]


@dataclass
class GenerativeConfig:
    """GIRIL's conditional VAE and the reward made of it."""

    beta: float = knob(
        1.0,
        "weight of the true action against the encoded one, in (0, 1]",
        low=0,
        high=1,
        low_open=True,
    )
    alpha: float | None = knob(
        None, "weight of the action term; null: 1 for Box, 100 for Discrete", low=0
    )
    scale: float = knob(1.0, "lambda, the weight of the squared error", low=0, low_open=True)
    prior: str = knob(
        "standard",
        "latent prior: standard N(0, I) or conditional p(z | s)",
        choices=("standard", "conditional"),
    )
    normalise: str = knob(
        "standardise",
        "observation rule of the reward model",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: bool = knob(True, "clamp observations to [-1, 1], those of normalise=raw too")
    hidden: list[int] = knob([100, 100], "hidden layers of encoder and decoder (tanh)", low=1)
    use_actions: bool = knob(True, USE_ACTIONS)
    seed: int | None = knob(None, "seed of the reward model; null takes the run's seed", low=0)

    def check(self, prefix: str, run: object) -> None:
        """Refuses weights of an action that is not read."""
        for name, unset in (("beta", 1.0), ("alpha", None)):
            value = getattr(self, name)
            if not self.use_actions and value != unset:
                raise UserError(
                    f"{prefix}{name}={value} is a weight of the action, which "
                    f"{prefix}use_actions=false leaves out: leave {prefix}{name} out."
                )


def reconstruction_error(predicted: Tensor, target: Tensor, dims: int = 1) -> Tensor:
    """``||s_hat - s'||^2`` of each observation (paper, eq. 2, without lambda).

    Times lambda it is also ``-log p(s' | z, s)`` up to a constant (eq. 1's first term).

    Args:
        predicted: s_hat, ``(*batch, *observation)``.
        target: s', of the same shape.
        dims: dimensions of one observation, the last ones: 1 for a vector, 3 for frames.

    Examples:
        >>> reconstruction_error(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))
        tensor([5.])
    """
    return (predicted - target).square().flatten(-dims).sum(-1)


def blend_action(action: Tensor, encoded: Tensor, beta: float) -> Tensor:
    """``beta * a + (1 - beta) * a_hat``, the decoder's input in the reward (paper, eq. 2).

    Examples:
        >>> blend_action(torch.tensor([1.0, 0.0]), torch.tensor([0.5, 0.5]), 0.5)
        tensor([0.7500, 0.2500])
    """
    return beta * action + (1 - beta) * encoded


def gaussian_kl(
    mu_q: Tensor, logvar_q: Tensor, mu_p: Tensor | None = None, logvar_p: Tensor | None = None
) -> Tensor:
    """``KL(q || p)`` of diagonal Gaussians, summed over the last dimension (eq. 1's second term).

    Args:
        mu_q: mean of q, ``(*batch, latent)``.
        logvar_q: log-variance of q.
        mu_p: mean of p; None means 0.
        logvar_p: log-variance of p; None means 0.

    Examples:
        >>> gaussian_kl(torch.tensor([[2.0, 0.0]]), torch.zeros(1, 2))
        tensor([2.])
    """
    difference = mu_q if mu_p is None else mu_q - mu_p
    if logvar_p is None:
        terms = logvar_q.exp() + difference.square() - 1 - logvar_q
    else:
        log_ratio = logvar_q - logvar_p
        terms = log_ratio.exp() + difference.square() * (-logvar_p).exp() - 1 - log_ratio
    return 0.5 * terms.sum(-1)


def action_term(z: Tensor, action: Tensor) -> Tensor:
    """Error of the encoded action against the expert's (eq. 1's third term), ``(*batch,)``.

    The KL to a one-hot expert policy is infinite. The paper's appendix and released code use
    cross-entropy for discrete actions and the mean squared error for continuous ones.

    Args:
        z: latent ``(*batch, latent)``.
        action: class indices ``(*batch,)``, for which z holds logits, or encoded continuous
            actions ``(*batch, latent)``.

    Examples:
        >>> action_term(torch.zeros(1, 4), torch.tensor([2])).exp()
        tensor([4.])
        >>> action_term(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 2.0]]))
        tensor([2.5000])
    """
    if action.is_floating_point():
        return (z - action).square().mean(-1)
    return -F.log_softmax(z, -1).gather(-1, action.unsqueeze(-1)).squeeze(-1)


class GenerativeReward(Pretrained, TransitionReward):
    """Eq. 2: ``r = lambda * ||decoder(beta * a + (1 - beta) * a_hat, s) - s'||^2``.

    States are compared after the scaler. If the scaler clamps to [-1, 1], so is the prediction.
    ``a_hat`` is softmax(z) for discrete actions and z for continuous ones, z sampled from
    ``q(z | s, s')``. With ``beta=1`` the encoder plays no role and the reward is deterministic.
    With ``beta<1`` the noise comes from the module's own generator, whose state is saved with the
    module. A batch and the same transitions step by step then agree in distribution only.

    With ``use_actions=False`` z is a latent of the transition that no action supervises, and takes
    ``a_hat``'s place: the limit ``beta -> 0`` of eq. 2, after eq. 1 without its third term. Beta
    has no effect, and the noise is drawn as with ``beta<1``.

    Reads observation ``(*batch, d)`` or, of uint8, ``(*batch, channels, 84, 84)``, action and next
    observation. Writes one reward per transition, ``(*batch, 1)``. Train it with
    :class:`~giril_rl.rewards.GenerativeRewardLoss`, after ``reward.scaler.fit(observations)``.

    For frames, without gradient, :func:`~giril_rl.rewards.factored_error` replaces the decoder,
    equal to 1e-5, unless decoder or scaler is a subclass with a ``forward`` of its own.

    Args:
        encoder: called with s and s', returns ``2 * latent`` numbers, mean and log-variance of z.
        decoder: called with the encoded action and s, returns the predicted next observation.
        scaler: applied to both observations.
        actions: encodes actions as vectors of the latent's size.
        prior_network: maps s to mean and log-variance of ``p(z | s)``; None means N(0, I).
        beta: weight of the true action, in (0, 1].
        scale: lambda.
        seed: seed of the noise.
        in_keys: keys of observation, action and next observation.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for a beta outside (0, 1], or entries that are missing or of a wrong shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> reward(batch)["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        encoder: nn.Module,
        decoder: nn.Module,
        *,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder,
        prior_network: nn.Module | None = None,
        beta: float = 1.0,
        scale: float = 1.0,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        if not 0 < beta <= 1:
            raise UserError(f"beta={beta} is outside (0, 1]: give a value such as 1.0.")
        roles = "observation", "action", "next observation"
        super().__init__("a generative reward", roles, in_keys, out_keys, actions=actions)
        self.encoder = encoder
        self.decoder = decoder
        self.prior_network = prior_network
        self.scaler = scaler
        self.beta = beta
        self.scale = scale
        self._generator = torch.Generator().manual_seed(seed)
        self._table = ActionTable()

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        beta: float = 1.0,
        scale: float = 1.0,
        prior: Prior = "standard",
        normalise: ScalingRule = "standardise",
        clamp: bool = True,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> GenerativeReward:
        """The paper's networks for vector observations, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec; z has its size.
            hidden: hidden layers (tanh) of encoder, decoder and conditional prior.
            beta: weight of the true action, in (0, 1].
            scale: lambda.
            prior: ``"standard"`` for N(0, I), as the released code has it, or ``"conditional"``
                for the p(z | s) of eq. 1.
            normalise: the scaler's rule.
            clamp: compare states clamped to [-1, 1].
            use_actions: False reads observations alone, see the class.
            seed: seed of weights and noise. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for a beta outside (0, 1], or an unknown prior, rule or kind of action.
        """
        conditional = _is_conditional(prior)
        d, k = observation_dim, ActionEncoder(action_spec).size
        with seeded(seed):
            encoder, decoder = mlp(2 * d, 2 * k, hidden), mlp(k + d, d, hidden)
            prior_network = mlp(d, 2 * k, hidden) if conditional else None
        return cls(
            encoder,
            decoder,
            scaler=ObservationScaler(d, rule=normalise, clamp=clamp),
            actions=ActionEncoder(action_spec, use_actions=use_actions),
            prior_network=prior_network,
            beta=beta,
            scale=scale,
            seed=seed,
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
        beta: float = 1.0,
        scale: float = 1.0,
        prior: Prior = "standard",
        clamp: bool = True,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> GenerativeReward:
        """The paper's networks for ``channels`` frames of 84x84 (Table 2); see `for_vectors`."""
        conditional, k = _is_conditional(prior), ActionEncoder(action_spec).size
        with seeded(seed):
            encoder, decoder = PixelEncoder(k, channels), PixelDecoder(k, channels)
            prior_network = PixelPrior(k, channels) if conditional else None
        return cls(
            encoder,
            decoder,
            scaler=PixelScaler(clamp=clamp),
            actions=ActionEncoder(action_spec, use_actions=use_actions),
            prior_network=prior_network,
            beta=beta,
            scale=scale,
            seed=seed,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def encode(self, observation: Tensor, next_observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of ``q(z | s, s')``, for scaled observations."""
        mu, logvar = self.encoder(observation, next_observation).chunk(2, -1)
        return mu, logvar

    def decode(self, encoding: Tensor, observation: Tensor) -> Tensor:
        """The predicted next observation for a scaled one; scaled but not clamped."""
        predicted = self.decoder(encoding, observation)
        check_output("the decoder", predicted, observation.shape)
        return predicted

    def prior(self, observation: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Mean and log-variance of ``p(z | s)`` for a scaled observation; None, None if N(0, I)."""
        if self.prior_network is None:
            return None, None
        mu, logvar = self.prior_network(observation).chunk(2, -1)
        return mu, logvar

    def predict(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        """The predicted next observation as the reward compares it with s', scaled and clamped.

        It is clamped only if the scaler clamps. With ``beta<1`` it depends on s' and draws noise.

        Args:
            observation: s, as the environment gives it.
            action: the action.
            next_observation: s', as the environment gives it.

        Examples:
            >>> from torchrl.data import Categorical
            >>> reward = GenerativeReward.for_pixels(Categorical(3))
            >>> black = torch.zeros(2, 4, 84, 84, dtype=torch.uint8)
            >>> reward.predict(black, torch.tensor([0, 2]), black).shape
            torch.Size([2, 4, 84, 84])
        """
        check_transitions(self.scaler, self.actions, observation, action, next_observation)
        return self._predict(self.scaler(observation), action, self.scaler(next_observation))

    def values(self, *transitions: Tensor) -> Tensor:
        """Eq. 2 of each transition ``(*batch,)``."""
        observation, action, next_observation = transitions
        factored = is_factored(self.decoder, self.scaler, observation, next_observation)
        if not factored or self.beta < 1 or not self._is_one_hot():
            return self.scale * super().values(*transitions)
        # There are only as many images as actions, and the decoder runs once for each.
        parts = *self._table(cast(PixelDecoder, self.decoder)), self.actions.target(action)
        clamp = self.scaler.clamp
        return self.scale * factored_error(*parts, observation, next_observation, clamp=clamp)

    def value(self, *transitions: Tensor) -> Tensor:
        """``||s_hat - s'||^2``, by the decoder's two parts where that is possible."""
        observation, action, next_observation = transitions
        s, s_next = self.scaler(observation), self.scaler(next_observation)
        if not is_factored(self.decoder, self.scaler, observation, next_observation):
            predicted = self._predict(s, action, s_next)
            return reconstruction_error(predicted, s_next, self.scaler.event_dims)
        encoding = self._blended(s, action, s_next)
        states = observation, next_observation
        return coded_error(
            cast(PixelDecoder, self.decoder), encoding, *states, clamp=self.scaler.clamp
        )

    def _is_one_hot(self) -> bool:
        return self.actions.discrete and computes_as(self.actions, ActionEncoder)

    def _predict(self, s: Tensor, action: Tensor, s_next: Tensor) -> Tensor:
        predicted = self.decode(self._blended(s, action, s_next), s)
        return predicted.clamp(-1.0, 1.0) if self.scaler.clamp else predicted

    def _blended(self, s: Tensor, action: Tensor, s_next: Tensor) -> Tensor:
        encoding = self.actions(action)
        if self.beta == 1 and self.actions.use_actions:
            return encoding
        mu, logvar = self.encode(s, s_next)
        # Drawn on the CPU, so that a seed means the same on every device.
        noise = torch.randn(mu.shape, generator=self._generator, dtype=mu.dtype).to(mu.device)
        z = mu + (0.5 * logvar).exp() * noise
        if not self.actions.use_actions:
            return z
        return blend_action(encoding, z.softmax(-1) if self.actions.discrete else z, self.beta)

    def get_extra_state(self) -> Tensor:
        """The noise generator's state, uint8."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restores the noise generator."""
        self._generator.set_state(state.cpu())


def _is_conditional(prior: str) -> bool:
    if prior not in get_args(Prior):
        raise UserError(f"prior={prior!r} is unknown: choose standard or conditional.")
    return prior == "conditional"


class GenerativeRewardLoss(TransitionLoss):
    """The negative of eq. 1, in its three terms, whose sum is to be minimised.

    - ``loss_reconstruction``: lambda * :func:`reconstruction_error` of ``decoder(z, s)``. The
      decoder gets z itself, as the paper has it in training, rather than softmax(z). z is
      sampled by reparameterisation, with noise from the global generator.
    - ``loss_kl``: :func:`gaussian_kl` of ``q(z | s, s')`` to N(0, I), or to the conditional prior.
    - ``loss_action``: alpha times :func:`action_term`.

    Terms are summed over features, then reduced over the batch. Observations are scaled by the
    reward's scaler. The prediction is not clamped, as clamping would cut its gradient.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        alpha: weight of the action term; None means 1 for continuous and 100 for discrete actions.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for an unknown reduction or a negative alpha.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> loss = GenerativeRewardLoss(reward)
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> sorted(loss(batch).keys())
        ['loss_action', 'loss_kl', 'loss_reconstruction']
    """

    reward: GenerativeReward

    def __init__(
        self,
        reward: GenerativeReward,
        *,
        alpha: float | None = None,
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        super().__init__(reward, reduction=reduction, functional=functional)
        if alpha is None:
            alpha = 100.0 if reward.actions.discrete else 1.0
        if not alpha >= 0:
            raise UserError(f"alpha={alpha} is negative: give a weight of 0 or more.")
        self.alpha = alpha

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the three terms, the last where actions are read."""
        return ["loss_reconstruction", "loss_kl", "loss_action"][: 2 + reads_actions(self.reward)]

    def terms(
        self, observation: Tensor, action: Tensor, next_observation: Tensor
    ) -> tuple[Tensor, ...]:
        """The terms, for one sample of z."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action, next_observation)
        s, s_next = reward.scaler(observation), reward.scaler(next_observation)
        mu, logvar = reward.encode(s, s_next)
        z = mu + (0.5 * logvar).exp() * torch.randn_like(mu)
        error = reconstruction_error(reward.decode(z, s), s_next, reward.scaler.event_dims)
        terms = reward.scale * error, gaussian_kl(mu, logvar, *reward.prior(s))
        if not reads_actions(reward):
            return terms
        return *terms, self.alpha * action_term(z, reward.actions.target(action))


def generative_reward(
    settings: GenerativeConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> GenerativeReward:
    """GIRIL's reward, untrained, its scaler fitted to ``pairs``.

    Args:
        settings: its settings; ``alpha`` is the loss's and ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of weights and noise. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> generative_reward(GenerativeConfig(), GymEnv("CartPole-v1"), pairs, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    every, own = "beta scale prior clamp use_actions", "hidden normalise"
    return reward_for(
        env, GenerativeReward, settings, pairs, seed=seed, of_all=every, of_vectors=own
    )


register(
    Method(
        "giril",
        "GIRIL",
        BLUE,
        settings=GenerativeConfig,
        build=generative_reward,
        loss=lambda reward, settings: GenerativeRewardLoss(reward, alpha=settings.alpha),
        rank=0,
    )
)
