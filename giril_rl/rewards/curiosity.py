"""CDIL's reward: the intrinsic curiosity module (ICM) fitted to a demonstration."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from giril_rl.networks.joined import JoinedSequential
from giril_rl.networks.pixels import ForwardModel, InverseModel, PixelFeatures
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.chunks import per_transition
from giril_rl.rewards.keys import REWARD_KEYS, TRANSITION_KEYS, check_keys
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.scaler import ObservationScaler, ScalingRule
from giril_rl.rewards.transitions import check_output, check_transitions, read
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded


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


class CuriosityReward(Pretrained, TensorDictModuleBase):
    """ICM: ``r = lambda * ||forward(phi(s), a) - phi(s')||^2``, the error in feature space.

    Features are those of observations after the scaler. The inverse model, which reads the action
    back from ``phi(s)`` and ``phi(s')``, takes no part in the reward: it is what the features are
    learned by. The reward is deterministic.

    Reads observation ``(*batch, d)``, action and next observation, writes one reward per
    transition, ``(*batch, 1)``, without averaging. Train it with
    :class:`~giril_rl.rewards.CuriosityRewardLoss`, after ``reward.scaler.fit(observations)``.

    Args:
        features: phi, maps a scaled observation to its features.
        inverse_model: called with ``phi(s)`` and ``phi(s')``, gives the action's logits or code.
        forward_model: called with ``phi(s)`` and the action's code, predicts ``phi(s')``.
        scaler: applied to both observations.
        actions: turns actions into codes.
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
        inverse_model: nn.Module,
        forward_model: nn.Module,
        *,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder,
        scale: float = 1.0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        check_keys(
            "a curiosity reward", ("observation", "action", "next observation"), in_keys, out_keys
        )
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        self.features = features
        self.inverse_model = inverse_model
        self.forward_model = forward_model
        self.scaler = scaler
        self.actions = actions
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> CuriosityReward:
        """The paper's bodies for vector observations, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: layers of phi, each with tanh after it, so that features lie in (-1, 1); with
                none, the features are the scaled observation itself.
            model_hidden: hidden layers (tanh) of the inverse and the forward model.
            scale: lambda.
            normalise: the scaler's rule.
            clamp: clamp the scaled observations to [-1, 1].
            seed: seed of the weights. The global random state is neither read nor changed.
            in_keys: keys of observation, action and next observation.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for an unknown rule or kind of action.
        """
        actions = ActionEncoder(action_spec)
        size = hidden[-1] if hidden else observation_dim
        with seeded(seed):
            features: nn.Module = nn.Identity()
            if hidden:
                features = nn.Sequential(*mlp(observation_dim, size, hidden[:-1]), nn.Tanh())
            inverse_model = JoinedSequential(*mlp(2 * size, actions.size, model_hidden))
            forward_model = JoinedSequential(*mlp(size + actions.size, size, model_hidden))
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
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> CuriosityReward:
        """The paper's bodies for stacks of 84x84 frames (Table 2), initialised from ``seed`` alone.

        Batch normalisation makes the reward depend on its batch while the module is in training
        mode; :class:`~giril_rl.transforms.IntrinsicReward` calls it in eval mode.

        Args:
            action_spec: the environment's action spec.
            channels: frames in an observation.
            scale: see :meth:`for_vectors`, as for all others.
            seed: seed of the weights.
            in_keys: keys of observation, action and next observation.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for an unknown kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            features = PixelFeatures(channels)
            inverse_model, forward_model = InverseModel(actions.size), ForwardModel(actions.size)
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
        """``a_hat``: logits of a discrete action, the code of a continuous one."""
        return self.inverse_model(features, next_features)

    def predict(self, features: Tensor, action_code: Tensor) -> Tensor:
        """``phi_hat(s')`` from ``phi(s)`` and the action's code."""
        return self.forward_model(features, action_code)

    def forward_error(self, features: Tensor, action_code: Tensor, next_features: Tensor) -> Tensor:
        """:func:`feature_error` of :meth:`predict`, whose shape is checked."""
        predicted = self.predict(features, action_code)
        check_output("the forward model", predicted, next_features.shape)
        return feature_error(predicted, next_features)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        transitions = read(tensordict, self.in_keys)
        check_transitions(self.scaler, self.actions, *transitions)
        error = per_transition(self._error, transitions, self.scaler.event_dims)
        return tensordict.set(self.out_keys[0], self.scale * error.unsqueeze(-1))

    def _error(self, observation: Tensor, action: Tensor, following: Tensor) -> Tensor:
        features = self.features(self.scaler(observation))
        next_features = self.features(self.scaler(following))
        return self.forward_error(features, self.actions(action), next_features)
