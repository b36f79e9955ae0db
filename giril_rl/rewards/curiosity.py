"""CDIL: the error of the intrinsic curiosity module (ICM) trained on the demonstration.

The reward is :func:`feature_error` of ICM's forward model, in :class:`CuriosityReward`.
:class:`CuriosityRewardLoss` trains it by ``L_I + L_F`` (paper, appendix on CDIL).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.networks.pixels import ForwardModel, InverseModel, PixelFeatures
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.fitting import Reduction, TransitionLoss
from giril_rl.rewards.generative import action_term
from giril_rl.rewards.method import RED, Method, register
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

FeatureTraining = Literal["inverse", "both", "none"]


@dataclass
class CuriosityConfig:
    """CDIL's intrinsic curiosity module and the reward made of it."""

    features: str = knob(
        "inverse",
        "what trains the features: L_I alone, L_I + L_F, or nothing (random, as released)",
        choices=("inverse", "both", "none"),
    )
    scale: float = knob(1.0, "lambda, the weight of the squared error", low=0, low_open=True)
    normalise: str = knob(
        "standardise",
        "observation rule of the reward model",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: bool = knob(True, "clamp observations to [-1, 1], those of normalise=raw too")
    hidden: list[int] = knob([100, 100], "layers of the features (tanh); [] takes none", low=1)
    model_hidden: list[int] = knob(
        [100], "hidden layers of inverse and forward model (tanh)", low=1
    )
    use_actions: bool = knob(True, USE_ACTIONS)
    seed: int | None = knob(None, "seed of the reward model; null takes the run's seed", low=0)

    def check(self, prefix: str, run: object) -> None:
        """Refuses trained features without actions."""
        check_features(prefix, self.features, use_actions=self.use_actions)


def check_features(prefix: str, features: str, *, use_actions: bool) -> None:
    """Refuses features that would be trained to predict actions where none are read."""
    if not use_actions and features != "none":
        raise UserError(
            f"{prefix}use_actions=false leaves the inverse model, which trains the features, "
            f"nothing to predict: set {prefix}features=none, which keeps them random."
        )


def feature_error(predicted: Tensor, features: Tensor) -> Tensor:
    """``||phi_hat(s') - phi(s')||^2``, summed over the last dimension (paper, appendix on CDIL).

    It is the forward model's loss and, times lambda, the reward; there is no factor of a half.

    Args:
        predicted: the forward model's ``phi_hat(s')``, ``(*batch, features)``.
        features: ``phi(s')``, of the same shape.

    Examples:
        >>> import torch
        >>> feature_error(torch.tensor([[0.5, 1.0]]), torch.tensor([[0.5, -1.0]]))
        tensor([4.])
    """
    return (predicted - features).square().sum(-1)


class CuriosityReward(Pretrained, TransitionReward):
    """ICM: ``r = lambda * ||forward(phi(s), a) - phi(s')||^2``, the error in feature space.

    With ``use_actions=False`` there is no inverse model, and the forward model predicts ``phi(s')``
    from ``phi(s)`` alone, of random features.

    Features are those of scaled observations. The inverse model, which predicts the action from
    ``phi(s)`` and ``phi(s')``, trains the features; the reward does not use it. The reward is
    deterministic.

    Reads observation ``(*batch, d)``, or frames, action and next observation. Writes one reward per
    transition, ``(*batch, 1)``. Train it with :class:`~giril_rl.rewards.CuriosityRewardLoss`, after
    ``reward.scaler.fit(observations)``.

    Args:
        features: phi, maps a scaled observation to its features.
        inverse_model: called with ``phi(s)`` and ``phi(s')``, predicts the action: its logits if it
            is discrete, else its encoding. None where actions are not read.
        forward_model: called with ``phi(s)`` and the encoded action, predicts ``phi(s')``.
        scaler: applied to both observations.
        actions: encodes actions.
        scale: lambda.
        in_keys: keys of observation, action and next observation.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or entries that are missing or of a wrong shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = CuriosityReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> reward(batch)["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        features: nn.Module,
        inverse_model: nn.Module | None,
        forward_model: nn.Module,
        *,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder,
        scale: float = 1.0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        roles = "observation", "action", "next observation"
        super().__init__("a curiosity reward", roles, in_keys, out_keys, actions=actions)
        self.features = features
        self.inverse_model = inverse_model
        self.forward_model = forward_model
        self.scaler = scaler
        self.scale = scale

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        model_hidden: Sequence[int] = (100,),
        scale: float = 1.0,
        normalise: ScalingRule = "standardise",
        clamp: bool = True,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> CuriosityReward:
        """The paper's networks for vector observations, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: layers of phi, each followed by tanh, so that features lie in (-1, 1). With no
                layers, the features are the scaled observation itself.
            model_hidden: hidden layers (tanh) of the inverse and the forward model.
            scale: lambda.
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
        size = hidden[-1] if hidden else observation_dim
        with seeded(seed):
            features: nn.Module = nn.Identity()
            if hidden:
                features = nn.Sequential(*mlp(observation_dim, size, hidden[:-1]), nn.Tanh())
            inverse_model = mlp(2 * size, actions.size, model_hidden) if use_actions else None
            forward_model = mlp(size + actions.size, size, model_hidden)
        return cls(
            features,
            inverse_model,
            forward_model,
            scaler=ObservationScaler(observation_dim, rule=normalise, clamp=clamp),
            actions=actions,
            scale=scale,
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
        scale: float = 1.0,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> CuriosityReward:
        """The paper's networks for ``channels`` frames of 84x84 (Table 2); see `for_vectors`.

        In training mode batch normalisation makes a reward depend on its batch.
        :class:`~giril_rl.transforms.IntrinsicReward` calls the module in eval mode.
        """
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            features = PixelFeatures(channels)
            inverse_model = InverseModel(actions.size) if use_actions else None
            forward_model = ForwardModel(actions.size)
        return cls(
            features,
            inverse_model,
            forward_model,
            scaler=PixelScaler(),
            actions=actions,
            scale=scale,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def invert(self, features: Tensor, next_features: Tensor) -> Tensor:
        """``a_hat``: logits of a discrete action, the encoding of a continuous one."""
        assert self.inverse_model is not None
        return self.inverse_model(features, next_features)

    def predict(self, features: Tensor, encoding: Tensor) -> Tensor:
        """``phi_hat(s')`` from ``phi(s)`` and the encoded action."""
        return self.forward_model(features, encoding)

    def forward_error(self, features: Tensor, encoding: Tensor, next_features: Tensor) -> Tensor:
        """:func:`feature_error` of :meth:`predict`, whose shape is checked."""
        predicted = self.predict(features, encoding)
        check_output("the forward model", predicted, next_features.shape)
        return feature_error(predicted, next_features)

    def value(self, *transitions: Tensor) -> Tensor:
        """Lambda times the error of each transition."""
        observation, action, next_observation = transitions
        features = self.features(self.scaler(observation))
        next_features = self.features(self.scaler(next_observation))
        return self.scale * self.forward_error(features, self.actions(action), next_features)


class CuriosityRewardLoss(TransitionLoss):
    """``L_I + L_F`` of the paper's appendix on CDIL, to be minimised.

    - ``loss_inverse``: error of the action that the inverse model predicts from ``phi(s)`` and
      ``phi(s')``, by :func:`~giril_rl.rewards.action_term`: cross-entropy for discrete actions,
      mean squared error for continuous ones.
    - ``loss_forward``: :func:`~giril_rl.rewards.curiosity.feature_error` of the forward model.

    Inverse and forward model are always trained. The paper does not say which loss trains phi:

    - ``"inverse"``: ``L_I`` alone, as features are "learned with a self-supervised inverse
      dynamics model". ``L_F`` sees phi as fixed and has ``theta_F`` only.
    - ``"both"``: the sum's gradient, if phi counts as part of ``theta_I`` in the joint objective.
      ``L_F`` then shrinks the features, since small ones are easily predicted.
    - ``"none"``: phi keeps its random weights, as in the authors' released code.

    Of a reward that reads no actions there is ``loss_forward`` only, and ``"none"`` is all that it
    allows: ``L_F`` alone would make all features the same.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        features: what trains phi.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for an unknown ``features`` or ``reduction``, or one that needs actions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = CuriosityReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> loss = CuriosityRewardLoss(reward)
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> sorted(loss(batch).keys())
        ['loss_forward', 'loss_inverse']
    """

    reward: CuriosityReward

    def __init__(
        self,
        reward: CuriosityReward,
        *,
        features: FeatureTraining = "inverse",
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        super().__init__(reward, reduction=reduction, functional=functional)
        if features not in get_args(FeatureTraining):
            raise UserError(f"features={features!r} is unknown: choose inverse, both or none.")
        check_features("", features, use_actions=reads_actions(reward))
        self.features: FeatureTraining = features

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the two terms, or of the one that needs no actions."""
        return ["loss_inverse", "loss_forward"][not reads_actions(self.reward) :]

    def terms(
        self, observation: Tensor, action: Tensor, next_observation: Tensor
    ) -> tuple[Tensor, ...]:
        """The terms; ``features`` decides which of them train phi."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action, next_observation)
        phi = reward.features(reward.scaler(observation))
        next_phi = reward.features(reward.scaler(next_observation))
        if self.features == "none":
            phi, next_phi = phi.detach(), next_phi.detach()
        if not reads_actions(reward):
            return (reward.forward_error(phi, action, next_phi),)
        inverse = action_term(reward.invert(phi, next_phi), reward.actions.target(action))
        if self.features == "inverse":
            phi, next_phi = phi.detach(), next_phi.detach()
        return inverse, reward.forward_error(phi, reward.actions(action), next_phi)


def curiosity_reward(
    settings: CuriosityConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> CuriosityReward:
    """CDIL's reward, untrained, its scaler fitted to ``pairs``.

    Args:
        settings: its settings; ``features`` is the loss's and ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of the weights. The global random state stays as it is.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> curiosity_reward(CuriosityConfig(), GymEnv("CartPole-v1"), pairs, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    every, own = "scale use_actions", "hidden model_hidden normalise clamp"
    return reward_for(
        env, CuriosityReward, settings, pairs, seed=seed, of_all=every, of_vectors=own
    )


register(
    Method(
        "cdil",
        "CDIL",
        RED,
        settings=CuriosityConfig,
        build=curiosity_reward,
        loss=lambda reward, settings: CuriosityRewardLoss(reward, features=settings.features),
        rank=1,
    )
)
