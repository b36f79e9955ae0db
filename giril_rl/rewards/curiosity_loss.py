"""Training CDIL's reward model: the intrinsic curiosity module's objective on a demonstration."""

from __future__ import annotations

from typing import Literal, get_args

from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.rewards.curiosity import CuriosityReward
from giril_rl.rewards.generative_loss import action_term
from giril_rl.rewards.transition_loss import Reduction, TransitionLoss
from giril_rl.rewards.transitions import check_transitions

FeatureTraining = Literal["inverse", "both", "none"]


class CuriosityRewardLoss(TransitionLoss):
    """``L_I + L_F`` of the paper's appendix on CDIL, to be minimised.

    - ``loss_inverse``: how far the action that the inverse model reads from ``phi(s)`` and
      ``phi(s')`` is from the expert's, by :func:`~giril_rl.rewards.action_term`: cross-entropy for
      discrete actions, mean squared error for continuous ones.
    - ``loss_forward``: :func:`~giril_rl.rewards.curiosity.feature_error` of the forward model.

    Inverse and forward model are always trained. The paper does not say which loss trains phi:

    - ``"inverse"``: ``L_I`` alone, as features are "learned with a self-supervised inverse
      dynamics model". ``L_F`` sees phi as fixed and has ``theta_F`` only.
    - ``"both"``: the sum's gradient, if phi counts as part of ``theta_I`` in the joint objective.
      ``L_F`` then pulls the features together, since shrunken ones are easily predicted.
    - ``"none"``: phi keeps its random weights, as in the authors' released code.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        features: what trains phi.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for an unknown ``features`` or ``reduction``.

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
        self.features: FeatureTraining = features

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the two terms."""
        return ["loss_inverse", "loss_forward"]

    def terms(
        self, observation: Tensor, action: Tensor, following: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The two terms, from which phi learns as ``features`` says."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action, following)
        phi = reward.features(reward.scaler(observation))
        next_phi = reward.features(reward.scaler(following))
        if self.features == "none":
            phi, next_phi = phi.detach(), next_phi.detach()
        inverse = action_term(reward.invert(phi, next_phi), reward.actions.target(action))
        if self.features == "inverse":
            phi, next_phi = phi.detach(), next_phi.detach()
        return inverse, reward.forward_error(phi, reward.actions(action), next_phi)
