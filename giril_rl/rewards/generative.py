"""GIRIL's reward: how badly a conditional VAE of the demonstration foresees a transition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.joined import JoinedSequential
from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.networks.pixels import PixelEncoder, PixelPrior
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.action_table import ActionTable
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.chunks import per_transition
from giril_rl.rewards.equations import blend_action, reconstruction_error
from giril_rl.rewards.factored import factored_error
from giril_rl.rewards.keys import REWARD_KEYS, TRANSITION_KEYS, check_keys
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.scaler import ObservationScaler, ScalingRule
from giril_rl.rewards.transitions import check_output, check_transitions, read
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded

Prior = Literal["standard", "conditional"]


class GenerativeReward(Pretrained, TensorDictModuleBase):
    """Eq. 2: ``r = lambda * ||decoder(beta * a + (1 - beta) * a_hat, s) - s'||^2``.

    States are compared after the scaler; if the scaler clamps to [-1, 1], so is the prediction.
    ``a_hat`` is softmax(z) for discrete actions and z for continuous ones, z sampled from
    ``q(z | s, s')``. With ``beta=1`` the encoder takes no part and the reward is deterministic.
    With ``beta<1`` the noise comes from a generator of the module's own, whose state is saved with
    the module; a batch and the same transitions step by step then agree in distribution only.

    Reads observation ``(*batch, d)`` or, of uint8, ``(*batch, channels, 84, 84)``, action and next
    observation, writes one reward per transition, ``(*batch, 1)``, without averaging. For frames at
    ``beta=1`` the decoder runs once for each discrete action rather than once for each transition,
    see :func:`~giril_rl.rewards.factored_error`; the numbers are the same to 1e-5. It runs for each
    transition if decoder, scaler or action encoder is a subclass with a ``forward`` of its own.
    Train it with :class:`~giril_rl.rewards.GenerativeRewardLoss`, after
    ``reward.scaler.fit(observations)``.

    Args:
        encoder: called with s and s', gives ``2 * latent`` numbers, mean and log-variance of z.
        decoder: called with the action's code and s, gives the predicted next observation.
        scaler: applied to both observations.
        actions: turns actions into codes of the latent's size.
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
        super().__init__()
        if not 0 < beta <= 1:
            raise UserError(f"beta={beta} is outside (0, 1]: give a value such as 1.0.")
        check_keys(
            "a generative reward", ("observation", "action", "next observation"), in_keys, out_keys
        )
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        self.encoder = encoder
        self.decoder = decoder
        self.prior_network = prior_network
        self.scaler = scaler
        self.actions = actions
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> GenerativeReward:
        """The paper's bodies for vector observations, initialised from ``seed`` alone.

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
            seed: seed of weights and noise. The global random state is neither read nor changed.
            in_keys: keys of observation, action and next observation.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for a beta outside (0, 1], or an unknown prior, rule or kind of action.
        """
        if prior not in get_args(Prior):
            raise UserError(f"prior={prior!r} is unknown: choose standard or conditional.")
        actions = ActionEncoder(action_spec)
        d, k = observation_dim, actions.size
        with seeded(seed):
            encoder = JoinedSequential(*mlp(2 * d, 2 * k, hidden))
            decoder = JoinedSequential(*mlp(k + d, d, hidden))
            prior_network = mlp(d, 2 * k, hidden) if prior == "conditional" else None
        return cls(
            encoder,
            decoder,
            scaler=ObservationScaler(d, rule=normalise, clamp=clamp),
            actions=actions,
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> GenerativeReward:
        """The paper's bodies for stacks of 84x84 frames (Table 2), initialised from ``seed`` alone.

        Args:
            action_spec: the environment's action spec; z has its size.
            channels: frames in an observation.
            beta: see :meth:`for_vectors`, as for all others.
            scale: lambda.
            prior: ``"standard"`` or ``"conditional"``.
            clamp: compare predictions clamped to [-1, 1].
            seed: seed of weights and noise.
            in_keys: keys of observation, action and next observation.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for a beta outside (0, 1], or an unknown prior or kind of action.
        """
        if prior not in get_args(Prior):
            raise UserError(f"prior={prior!r} is unknown: choose standard or conditional.")
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            encoder = PixelEncoder(actions.size, channels)
            decoder = PixelDecoder(actions.size, channels)
            prior_network = PixelPrior(actions.size, channels) if prior == "conditional" else None
        return cls(
            encoder,
            decoder,
            scaler=PixelScaler(clamp=clamp),
            actions=actions,
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

    def decode(self, action_code: Tensor, observation: Tensor) -> Tensor:
        """The predicted next observation, scaled but not clamped, for a scaled observation."""
        predicted = self.decoder(action_code, observation)
        check_output("the decoder", predicted, observation.shape)
        return predicted

    def predict(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        """What the reward compares with s': the predicted next observation, scaled and clamped.

        It is clamped only where the scaler clamps. With ``beta<1`` it depends on s' and on noise,
        which is drawn as for the reward.

        Args:
            observation: s, as the environment shows it.
            action: the action.
            following: s', as the environment shows it.

        Examples:
            >>> from torchrl.data import Categorical
            >>> reward = GenerativeReward.for_pixels(Categorical(3))
            >>> black = torch.zeros(2, 4, 84, 84, dtype=torch.uint8)
            >>> reward.predict(black, torch.tensor([0, 2]), black).shape
            torch.Size([2, 4, 84, 84])
        """
        check_transitions(self.scaler, self.actions, observation, action, following)
        return self._predict(self.scaler(observation), action, self.scaler(following))

    def prior(self, observation: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """Mean and log-variance of ``p(z | s)`` for a scaled observation; None, None if N(0, I)."""
        if self.prior_network is None:
            return None, None
        mu, logvar = self.prior_network(observation).chunk(2, -1)
        return mu, logvar

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        transitions = observation, action, following = read(tensordict, self.in_keys)
        check_transitions(self.scaler, self.actions, observation, action, following)
        if not self._is_factored(observation, following):
            error = per_transition(self._error, transitions, self.scaler.event_dims)
        elif self.beta < 1 or not self._is_one_hot():
            error = per_transition(self._coded_error, transitions, self.scaler.event_dims)
        else:
            table, weight = self._table(cast(PixelDecoder, self.decoder))
            index = self.actions.target(action)
            clamp = self.scaler.clamp
            error = factored_error(table, weight, index, observation, following, clamp=clamp)
        return tensordict.set(self.out_keys[0], self.scale * error.unsqueeze(-1))

    def _error(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        observation, following = self.scaler(observation), self.scaler(following)
        predicted = self._predict(observation, action, following)
        return reconstruction_error(predicted, following, self.scaler.event_dims)

    def _coded_error(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        """The same where each transition has a code of its own, by the decoder's two parts."""
        decoder, batch = cast(PixelDecoder, self.decoder), observation.shape[:-3]
        code = self._code(self.scaler(observation), action, self.scaler(following))
        return factored_error(
            decoder.code_part(code.reshape(-1, code.shape[-1])),
            decoder.state_weight,
            torch.arange(batch.numel(), device=code.device).reshape(batch),
            observation,
            following,
            clamp=self.scaler.clamp,
        )

    def _predict(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        predicted = self.decode(self._code(observation, action, following), observation)
        return predicted.clamp(-1.0, 1.0) if self.scaler.clamp else predicted

    def _code(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        code = self.actions(action)
        if self.beta < 1:
            code = blend_action(code, self._encoded_action(observation, following), self.beta)
        return code

    def _is_factored(self, observation: Tensor, following: Tensor) -> bool:
        """Whether the decoder's two parts can be computed apart: exact, but without gradient."""
        return (
            _computes_as(self.decoder, PixelDecoder)
            and _computes_as(self.scaler, PixelScaler)
            and observation.dtype == following.dtype == torch.uint8
            and not torch.is_grad_enabled()
        )

    def _is_one_hot(self) -> bool:
        """Whether there are only as many codes as actions."""
        return self.actions.discrete and _computes_as(self.actions, ActionEncoder)

    def _encoded_action(self, observation: Tensor, following: Tensor) -> Tensor:
        mu, logvar = self.encode(observation, following)
        # Drawn on the CPU, so that a seed means the same on every device.
        noise = torch.randn(mu.shape, generator=self._generator, dtype=mu.dtype).to(mu.device)
        z = mu + (0.5 * logvar).exp() * noise
        return z.softmax(-1) if self.actions.discrete else z

    def get_extra_state(self) -> Tensor:
        """The noise generator's state, uint8."""
        return self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restores the noise generator."""
        self._generator.set_state(state.cpu())


def _computes_as(module: nn.Module, kind: type[nn.Module]) -> bool:
    """Whether a module computes what ``kind`` does; a subclass may compute something else."""
    return getattr(module.forward, "__func__", None) is kind.forward
