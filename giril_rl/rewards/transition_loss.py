"""What the losses that fit a reward module to a demonstration's transitions have in common."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from giril_rl.errors import UserError
from giril_rl.rewards.functional import hold_reward, reward_parameters
from giril_rl.rewards.transitions import read

Reduction = Literal["mean", "sum", "none"]


class TransitionLoss(LossModule):
    """A loss in one or more terms, whose sum is to be minimised.

    A subclass names its terms in ``out_keys`` and computes them in :meth:`terms`, one number per
    transition each; here they are read from the batch and reduced.

    Args:
        reward: the module to train, which reads observation, action and next observation; its
            parameters are this loss's parameters.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: keep the parameters and buffers apart from the module, as ``reward_params``, as
            TorchRL's own losses do. By default they stay in the module, so that the names in the
            loss's ``state_dict`` are the module's, its noise generator's included.

    Raises:
        UserError: for an unknown reduction, or entries that are missing.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import GenerativeReward
        >>> class KLLoss(TransitionLoss):
        ...     out_keys = ["loss_kl"]
        ...     def terms(self, observation, action, following):
        ...         mu, logvar = self.reward.encode(observation, following)
        ...         return (0.5 * (logvar.exp() + mu.square() - 1 - logvar).sum(-1),)
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> KLLoss(reward, reduction="none")(batch)["loss_kl"].shape
        torch.Size([4])
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that :meth:`set_keys` changes; their defaults are the reward's ``in_keys``.

        Attributes:
            observation: observation ``(*batch, d)``.
            action: action, as the environment takes it.
            next_observation: the true next observation.
        """

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        next_observation: NestedKey = ("next", "observation")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    reward: TensorDictModuleBase
    reward_params: TensorDictParams
    target_reward_params: TensorDictParams

    def __init__(
        self,
        reward: TensorDictModuleBase,
        *,
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        super().__init__()
        if reduction not in get_args(Reduction):
            raise UserError(f"reduction={reduction!r} is unknown: choose mean, sum or none.")
        hold_reward(self, reward, functional)
        self._functional = functional
        self.reduction = reduction
        observation, action, following = reward.in_keys
        self.set_keys(observation=observation, action=action, next_observation=following)

    @property
    def functional(self) -> bool:
        """Whether the parameters are kept apart from the module, under ``reward_params``."""
        return self._functional

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of observation, action and next observation."""
        keys = self.tensor_keys
        return [keys.observation, keys.action, keys.next_observation]

    @property
    @abstractmethod
    def out_keys(self) -> list[NestedKey]:
        """Names of the terms, ``loss_*``."""

    @abstractmethod
    def terms(self, observation: Tensor, action: Tensor, following: Tensor) -> tuple[Tensor, ...]:
        """The terms, in the order of their names, each of the batch's shape.

        Args:
            observation: observation ``(*batch, d)``, as the environment gives it.
            action: action, as the environment takes it.
            following: the next observation ``(*batch, d)``.
        """

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms, reduced; with ``reduction="none"`` of the batch's shape."""
        with reward_parameters(self):
            terms = self.terms(*read(tensordict, self.in_keys))
        reduced = {
            name: self._reduce_loss(term, tensordict=tensordict)
            for name, term in zip(self.out_keys, terms, strict=True)
        }
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        return TensorDict._new_unsafe(reduced, torch.Size(batch_size))
