"""A loss's reward with its parameters in it, or beside it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule


def hold_reward(loss: LossModule, reward: TensorDictModuleBase, functional: bool) -> None:
    """Makes ``reward`` the loss's, with its parameters apart under ``reward_params`` or in it.

    Args:
        loss: where ``reward`` and, if functional, ``reward_params`` are set.
        reward: the module to train.
        functional: whether to keep the parameters apart.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from giril_rl.rewards import DiscriminatorLoss, DiscriminatorReward
        >>> reward = DiscriminatorReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> loss = DiscriminatorLoss(reward, functional=True)
        >>> loss.reward_params["network", "0", "weight"].shape
        torch.Size([100, 5])
    """
    if functional:
        loss.convert_to_functional(cast(Any, reward), "reward")
    else:
        loss.reward = reward


def reward_parameters(loss: LossModule) -> AbstractContextManager[Any]:
    """While it lasts, the reward computes with the loss's ``reward_params``, if it has any.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from giril_rl.rewards import DiscriminatorLoss, DiscriminatorReward
        >>> reward = DiscriminatorReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> with reward_parameters(DiscriminatorLoss(reward)) as parameters:
        ...     parameters is None
        True
    """
    return loss.reward_params.to_module(loss.reward) if loss.functional else nullcontext()
