"""Training a discriminator to tell the expert's pairs from the policy's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from giril_rl.errors import UserError
from giril_rl.networks.batch_norm import running_statistics
from giril_rl.rewards.adversarial import discriminator_loss, gradient_penalty, interpolated
from giril_rl.rewards.discriminator import DiscriminatorReward
from giril_rl.rewards.functional import hold_reward, reward_parameters
from giril_rl.rewards.transitions import read


class DiscriminatorLoss(LossModule):
    """GAIL's binary cross-entropy on logits, with an optional gradient penalty.

    - ``loss_expert``: mean of ``-log D`` over the expert's pairs.
    - ``loss_policy``: mean of ``-log(1 - D)`` over the policy's.
    - ``loss_penalty``, where the weight is not 0: see
      :func:`~giril_rl.rewards.adversarial.gradient_penalty`, of the logit, at points between scaled
      observations and between action codes of the two sets, so that discrete actions do too. One
      uniform weight per pair, from the global generator.

    Their sum is to be minimised. ``accuracy_expert`` and ``accuracy_policy`` are logged besides.

    The two sets lie beside each other, usually under ``"expert"`` and ``"policy"``, each of any
    leading shape. Their shapes may differ; the TensorDict that holds both then has no batch
    dimension. Without penalty and for equal sizes the loss is that of TorchRL's ``GAILLoss``, which
    wants probabilities. There is no ``reduction``: each term is a mean over a set of its own.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        penalty: weight of the gradient penalty; 0 leaves it out.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for a negative penalty, or a set that is missing, empty or of a wrong shape.

    Examples:
        >>> from torchrl.data import Categorical
        >>> reward = DiscriminatorReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> pairs = lambda n: {"observation": torch.zeros(n, 2), "action": torch.zeros(n).long()}
        >>> batch = TensorDict({"expert": pairs(50), "policy": pairs(256)})
        >>> sorted(DiscriminatorLoss(reward, penalty=10.0)(batch).keys())
        ['accuracy_expert', 'accuracy_policy', 'loss_expert', 'loss_penalty', 'loss_policy']
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that :meth:`set_keys` changes; their defaults follow the reward's ``in_keys``.

        Attributes:
            expert_observation: raw observations of the expert ``(*n, d)``.
            expert_action: its actions, as the environment takes them.
            policy_observation: raw observations of the policy ``(*m, d)``.
            policy_action: its actions.
        """

        expert_observation: NestedKey = ("expert", "observation")
        expert_action: NestedKey = ("expert", "action")
        policy_observation: NestedKey = ("policy", "observation")
        policy_action: NestedKey = ("policy", "action")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    reward: DiscriminatorReward
    reward_params: TensorDictParams
    target_reward_params: TensorDictParams

    def __init__(
        self, reward: DiscriminatorReward, *, penalty: float = 0.0, functional: bool = False
    ) -> None:
        super().__init__()
        if not penalty >= 0:
            raise UserError(f"penalty={penalty} is negative: give a weight of 0 or more.")
        hold_reward(self, reward, functional)
        self._functional = functional
        self.penalty = penalty
        observation, action = (k if isinstance(k, tuple) else (k,) for k in reward.in_keys)
        self.set_keys(
            expert_observation=("expert", *observation),
            expert_action=("expert", *action),
            policy_observation=("policy", *observation),
            policy_action=("policy", *action),
        )

    @property
    def functional(self) -> bool:
        """Whether the parameters are kept apart from the module, under ``reward_params``."""
        return self._functional

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the expert's observation and action and of the policy's."""
        keys = self.tensor_keys
        expert = [keys.expert_observation, keys.expert_action]
        return [*expert, keys.policy_observation, keys.policy_action]

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
        with reward_parameters(self):
            return self._terms(tensordict)

    def _terms(self, tensordict: TensorDictBase) -> TensorDictBase:
        entries = read(tensordict, self.in_keys)
        expert = _flat("expert", *self.reward.inputs(*entries[:2]))
        policy = _flat("policy", *self.reward.inputs(*entries[2:]))
        # One pass for both sets.
        observation, code = (torch.cat(sets) for sets in zip(expert, policy, strict=True))
        logit, out = self._judge(observation, code, len(expert[0]))
        logits = logit[: len(expert[0])], logit[len(expert[0]) :]
        out["loss_expert"], out["loss_policy"] = discriminator_loss(*logits)
        if self.penalty:
            weight = torch.rand(max(len(expert[0]), len(policy[0])), device=logit.device)
            points = [interpolated(e, p, weight) for e, p in zip(expert, policy, strict=True)]
            # By a batch's own statistics each sample's slope would be all samples' together.
            with running_statistics(self.reward):
                out["loss_penalty"] = self.penalty * gradient_penalty(self.reward.logit, points)
        out["accuracy_expert"] = (logits[0] > 0).to(logit.dtype).mean()
        out["accuracy_policy"] = (logits[1] < 0).to(logit.dtype).mean()
        return TensorDict({str(key): out[str(key)] for key in self.out_keys})

    def _judge(
        self, observation: Tensor, code: Tensor, experts: int
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The logits of both sets, of which the first ``experts`` are the expert's."""
        return self.reward.logit(observation, code), {}


def _flat(name: str, observation: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
    """A set's scaled observations and action codes, ``(n, ...)``."""
    dims = code.ndim - 1
    if dims != 1:
        observation = observation.reshape(-1, *observation.shape[dims:])
        code = code.reshape(-1, code.shape[-1])
    if not len(code):
        raise UserError(f"the {name}'s set has no pairs: give at least one.")
    return observation, code
