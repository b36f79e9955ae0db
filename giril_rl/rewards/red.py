"""RED: random expert distillation, a reward for staying where the demonstration has been.

``r = exp(-sigma * ||f(s, a) - g(s, a)||^2)`` (Wang et al., ICML 2019): a network f is trained to
predict a random network g on the demonstration, and predicts it badly elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.optimize import brentq
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.networks.pixels import FEATURES, PixelFeatures
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.fitting import TransitionLoss
from giril_rl.rewards.method import RED, Method, register
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.transitions import (
    PAIR_KEYS,
    REWARD_KEYS,
    TransitionReward,
    check_transitions,
    per_transition,
    reward_for,
    with_action,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded


@dataclass
class DistillationConfig:
    """RED's two networks and the reward made of them."""

    sigma: float | None = knob(
        None, "sharpness; null takes the one of `demo_reward`", low=0, low_open=True
    )
    demo_reward: float = knob(
        0.9,
        "mean reward that sigma gives the demonstration",
        low=0,
        high=1,
        low_open=True,
        high_open=True,
    )
    normalise: str = knob(
        "standardise",
        "observation rule of the reward model",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: bool = knob(True, "clamp observations to [-1, 1], those of normalise=raw too")
    hidden: list[int] = knob([100, 100], "hidden layers of both networks (tanh)", low=1)
    features: int = knob(100, "size of both networks' output", low=1)
    use_actions: bool = knob(True, USE_ACTIONS)
    seed: int | None = knob(None, "seed of the reward model; null takes the run's seed", low=0)


def distillation_error(predicted: Tensor, target: Tensor) -> Tensor:
    """``||f - g||^2``, summed over the last dimension: the loss, and what the reward falls with.

    Examples:
        >>> distillation_error(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 1.0]]))
        tensor([2.])
    """
    return (predicted - target).square().sum(-1)


def distillation_reward(predicted: Tensor, target: Tensor, sigma: Tensor | float) -> Tensor:
    """``exp(-sigma * ||f - g||^2)``, summed over the last dimension (Wang et al., 2019).

    Args:
        predicted: the trained network's output f, ``(*batch, features)``.
        target: the random network's output g, of the same shape.
        sigma: sharpness, above 0.

    Examples:
        >>> f, g = torch.tensor([[1.0, 0.0], [1.0, 2.0]]), torch.tensor([[1.0, 0.0], [0.0, 1.0]])
        >>> distillation_reward(f, g, 0.5)
        tensor([1.0000, 0.3679])
    """
    return (-sigma * distillation_error(predicted, target)).exp()


class DistillationReward(Pretrained, TransitionReward):
    """RED's reward, in (0, 1], of observation and action.

    Train it with :class:`DistillationLoss`, after ``reward.scaler.fit(observations)``, then choose
    sigma with :meth:`calibrate`.

    Args:
        predictor: f, called with scaled observations and encoded actions.
        target: g, of the same kind; it keeps its random weights.
        scaler: applied to observations.
        actions: encodes actions.
        sigma: sharpness.
        in_keys: keys of observation and action.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or entries that are missing or of a wrong shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = DistillationReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> reward(batch)["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    sigma: Tensor

    def __init__(
        self,
        predictor: nn.Module,
        target: nn.Module,
        *,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder,
        sigma: float = 1.0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        roles = "observation", "action"
        super().__init__("a distillation reward", roles, in_keys, out_keys, actions=actions)
        self.predictor = predictor
        self.target = target.requires_grad_(False)
        self.scaler = scaler
        self.register_buffer("sigma", torch.tensor(float(sigma)))

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        features: int = 100,
        sigma: float = 1.0,
        normalise: ScalingRule = "standardise",
        clamp: bool = True,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DistillationReward:
        """Two multilayer perceptrons, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: hidden layers (tanh) of both networks.
            features: size of their output.
            sigma: sharpness.
            normalise: the scaler's rule.
            clamp: clamp the scaled observations to [-1, 1].
            use_actions: False reads observations alone, see :class:`ActionEncoder`.
            seed: seed of the weights. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown rule or kind of action.
        """
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            predictor = mlp(observation_dim + actions.size, features, hidden)
            target = mlp(observation_dim + actions.size, features, hidden)
        return cls(
            predictor,
            target,
            scaler=ObservationScaler(observation_dim, rule=normalise, clamp=clamp),
            actions=actions,
            sigma=sigma,
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
        features: int = 100,
        sigma: float = 1.0,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DistillationReward:
        """ICM's convolutions and a linear layer for ``channels`` frames; see `for_vectors`."""
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            predictor = _PixelNetwork(channels, actions.size, features)
            target = _PixelNetwork(channels, actions.size, features)
        return cls(
            predictor,
            target,
            scaler=PixelScaler(),
            actions=actions,
            sigma=sigma,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def outputs(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """``f(s, a)`` and ``g(s, a)``, each ``(*batch, features)``."""
        inputs = self.scaler(observation), self.actions(action)
        return self.predictor(*inputs), self.target(*inputs)

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each transition."""
        return distillation_reward(*self.outputs(*transitions), self.sigma)

    @torch.no_grad()
    def calibrate(self, pairs: TensorDictBase, demo_reward: float = 0.9) -> None:
        """Chooses sigma so that the mean reward of ``pairs`` is ``demo_reward``.

        Args:
            pairs: transitions, batch ``(n,)``; the demonstration's.
            demo_reward: their mean reward, in (0, 1).

        Raises:
            UserError: if f predicts g without error on too many of ``pairs``, or ``demo_reward`` is
                outside (0, 1).

        Examples:
            >>> from tensordict import TensorDict
            >>> from torchrl.data import Bounded
            >>> reward = DistillationReward.for_vectors(2, Bounded(-1, 1, shape=(1,)))
            >>> s, a = torch.randn(9, 2), torch.zeros(9, 1)
            >>> _ = reward.scaler.fit(s)
            >>> pairs = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [9])
            >>> reward.calibrate(pairs, demo_reward=0.8)
            >>> reward(pairs)["next", "intrinsic_reward"].mean().detach()
            tensor(0.8000)
        """
        if not 0 < demo_reward < 1:
            raise UserError(f"demo_reward={demo_reward} is outside (0, 1): give one such as 0.9.")
        device = self.sigma.device
        entries = with_action(self, tuple(pairs.get(key).to(device) for key in self.in_keys))
        error = per_transition(
            lambda *pair: distillation_error(*self.outputs(*pair)),
            entries,
            self.scaler.event_dims,
        ).double()

        def excess(log_sigma: float) -> float:
            return (-math.exp(log_sigma) * error).exp().mean().item() - demo_reward

        try:
            self.sigma.fill_(math.exp(brentq(excess, -60, 60)))
        except ValueError:  # No sigma in 1e-26 to 1e26.
            raise UserError(
                f"no sigma gives the demonstration a mean reward of {demo_reward}, for RED's "
                "network predicts too much of it without any error: set reward.sigma."
            ) from None


class _PixelNetwork(nn.Module):
    def __init__(self, channels: int, actions: int, features: int) -> None:
        super().__init__()
        self.body = PixelFeatures(channels)
        self.head = nn.Linear(FEATURES + actions, features)

    def forward(self, observation: Tensor, encoding: Tensor) -> Tensor:
        return self.head(torch.cat([self.body(observation), encoding], -1))


class DistillationLoss(TransitionLoss):
    """``||f(s, a) - g(s, a)||^2``, the error of f on the demonstration (Wang et al., 2019).

    Args:
        reward: the module to train; g's parameters are not trained.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = DistillationReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> list(DistillationLoss(reward)(batch).keys())
        ['loss_distillation']
    """

    reward: DistillationReward

    @property
    def out_keys(self) -> list[NestedKey]:
        """The name of the term."""
        return ["loss_distillation"]

    def terms(self, observation: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """The squared error of each transition."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action)
        return (distillation_error(*reward.outputs(observation, action)),)


def red_reward(
    settings: DistillationConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> DistillationReward:
    """RED's reward, untrained, its scaler fitted to ``pairs``.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of the weights. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> red_reward(DistillationConfig(), GymEnv("CartPole-v1"), pairs, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    settings = replace(settings, sigma=settings.sigma or 1.0)  # Until it is calibrated.
    shared, own = "features sigma use_actions", "hidden normalise clamp"
    return reward_for(
        env, DistillationReward, settings, pairs, seed=seed, of_all=shared, of_vectors=own
    )


register(
    Method(
        "red",
        "RED",
        RED,
        settings=DistillationConfig,
        build=red_reward,
        loss=lambda reward, settings: DistillationLoss(reward),
    )
)
