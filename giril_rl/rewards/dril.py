"""DRIL: +1 where an ensemble of cloned policies agrees as on the demonstration, -1 elsewhere.

"Disagreement-Regularized Imitation Learning" (Brantley, Sun and Henaff, ICLR 2020): policies cloned
from bootstrap samples of the demonstration disagree where it has not been. The learner is paid for
agreement, and cloned beside (:class:`~giril_rl.training.CloningTrainer`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import knob
from giril_rl.errors import UserError
from giril_rl.networks.ensembles import EnsembleMLP
from giril_rl.networks.pixels import FEATURES, PixelFeatures
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.disagreement import (
    BOOTSTRAP,
    Form,
    Variance,
    action_variance,
    cloning_losses,
    disagreement_reward,
    state_variance,
)
from giril_rl.rewards.fitting import Reduction, TransitionLoss
from giril_rl.rewards.method import ORANGE, Method, register
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.transitions import (
    PAIR_KEYS,
    REWARD_KEYS,
    TransitionReward,
    check_transitions,
    per_transition,
    reward_for,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded


@dataclass
class DisagreementConfig:
    """DRIL's ensemble, the reward made of it, and the cloning beside."""

    form: str = knob(
        "sign",
        "sign: +1 up to the threshold, -1 above; penalty: 0 and -1; variance: minus the variance",
        choices=("sign", "penalty", "variance"),
    )
    quantile: float = knob(
        0.98,
        "of the demonstration's variances, which is the threshold",
        low=0,
        high=1,
        low_open=True,
    )
    variance: str = knob(
        "action",
        "action: of the members' probability of the action, or of their mean action's product with "
        "it; state: of all that they would do",
        choices=("action", "state"),
    )
    members: int = knob(5, "policies in the ensemble", low=2)
    hidden: list[int] = knob([256, 256], "hidden layers of each member (ReLU)", low=1)
    normalise: str = knob(
        "standardise",
        "observation rule of the ensemble",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: float = knob(10.0, "bound on each scaled observation", low=0, low_open=True)
    bc_every: int | None = knob(
        200, "environment steps for each gradient step of cloning beside; null clones not", low=1
    )
    bc_batch: int = knob(100, "demonstrated transitions per such gradient step", low=1)
    bc_lr: float = knob(2.5e-4, "Adam step size of cloning beside", low=0, low_open=True)
    seed: int | None = knob(None, "seed of the ensemble; null takes the run's seed", low=0)


class DisagreementReward(Pretrained, TransitionReward):
    """DRIL's reward of observation and action.

    Train it with :class:`DisagreementLoss`, after ``reward.scaler.fit(observations)``, then choose
    the threshold with :meth:`calibrate`.

    Args:
        ensemble: maps scaled observations to ``(members, *batch, k)``: logits of discrete actions,
            else mean encoded actions.
        scaler: applied to observations.
        actions: encodes actions.
        variance: of what members are compared: the action's product with their output, or
            all of it.
        form: see :func:`~giril_rl.rewards.disagreement.disagreement_reward`.
        in_keys: keys of observation and action.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for an unknown form or variance, another number of keys, or entries that are
            missing or of a wrong shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = DisagreementReward.for_vectors(2, Bounded(-1, 1, shape=(1,)))
        >>> s, a = torch.randn(50, 2), torch.rand(50, 1)
        >>> batch = TensorDict({"observation": s, "action": a}, [50])
        >>> _ = reward.scaler.fit(batch["observation"])
        >>> reward.calibrate(batch, quantile=0.9)
        >>> (reward(batch)["next", "intrinsic_reward"] == 1).sum()
        tensor(45)
    """

    threshold: Tensor

    def __init__(
        self,
        ensemble: nn.Module,
        *,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder,
        variance: Variance = "action",
        form: Form = "sign",
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        disagreement_reward(torch.zeros(1), 0.0, form)  # Refuses an unknown form now.
        if variance not in get_args(Variance):
            raise UserError(f"variance={variance!r} is unknown: choose action or state.")
        super().__init__("DRIL's reward", ("observation", "action"), in_keys, out_keys)
        self.ensemble, self.scaler, self.actions = ensemble, scaler, actions
        self.variance_of: Variance = variance
        self.form: Form = form
        self.register_buffer("threshold", torch.tensor(0.0))

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        members: int = 5,
        hidden: Sequence[int] = (256, 256),
        variance: Variance = "action",
        form: Form = "sign",
        normalise: ScalingRule = "standardise",
        clamp: float = 10.0,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DisagreementReward:
        """An ensemble of multilayer perceptrons, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            members: policies.
            hidden: hidden layers (ReLU) of each.
            variance: see the class.
            form: see the class.
            normalise: the scaler's rule.
            clamp: bound on each scaled observation.
            seed: seed of the weights. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown rule or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            ensemble = EnsembleMLP(members, observation_dim, actions.size, hidden)
        scaler = ObservationScaler(observation_dim, rule=normalise, limit=clamp)
        return cls(
            ensemble,
            scaler=scaler,
            actions=actions,
            variance=variance,
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
        members: int = 5,
        hidden: Sequence[int] = (256, 256),
        variance: Variance = "action",
        form: Form = "sign",
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DisagreementReward:
        """For ``channels`` frames: the members share ICM's convolutions, as in the authors' code.

        See :meth:`for_vectors` for the arguments.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            heads = EnsembleMLP(members, FEATURES, actions.size, hidden)
            ensemble = nn.Sequential(PixelFeatures(channels), heads)
        return cls(
            ensemble,
            scaler=PixelScaler(),
            actions=actions,
            variance=variance,
            form=form,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def outputs(self, observation: Tensor) -> Tensor:
        """The members' logits or mean encoded actions, ``(members, *batch, k)``."""
        return self.ensemble(self.scaler(observation))

    def variance(self, observation: Tensor, action: Tensor) -> Tensor:
        """The members' disagreement about each transition, ``(*batch,)``."""
        members = self.outputs(observation)
        if self.actions.discrete:
            members = members.softmax(-1)
        else:  # What is beyond the bounds would be executed as the bound.
            low, high = (
                (bound - self.actions.offset) * self.actions.scale
                for bound in (self.actions.low, self.actions.high)
            )
            members = members.clamp(low, high)
        if self.variance_of == "state":
            return state_variance(members)
        return action_variance(members, self.actions(action))

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each transition."""
        return disagreement_reward(self.variance(*transitions), self.threshold, self.form)

    @torch.no_grad()
    def calibrate(self, pairs: TensorDictBase, quantile: float = 0.98) -> None:
        """Sets the threshold to a quantile of the variances of ``pairs``, one for all actions.

        Args:
            pairs: transitions, batch ``(n,)``; the demonstration's.
            quantile: in (0, 1].

        Raises:
            UserError: for a quantile outside (0, 1].
        """
        if not 0 < quantile <= 1:
            raise UserError(f"quantile={quantile} is outside (0, 1]: give one such as 0.98.")
        entries = tuple(pairs.get(key).to(self.threshold.device) for key in self.in_keys)
        variance = per_transition(self.variance, entries, self.scaler.event_dims)
        self.threshold.copy_(torch.quantile(variance.double(), quantile))


class DisagreementLoss(TransitionLoss):
    """The members' cloning losses, added up: cross-entropy, or squared error of the mean action.

    Args:
        reward: the module to train.
        bootstrap: weigh each member's losses by how often its sample has a transition, see
            :func:`~giril_rl.rewards.disagreement.bootstrapped`; False leaves different initial
            weights only.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = DisagreementReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> pairs = TensorDict({"observation": torch.zeros(4, 2), "action": torch.zeros(4, 1)}, [4])
        >>> list(DisagreementLoss(reward)(pairs).keys())
        ['loss_cloning']
    """

    reward: DisagreementReward

    def __init__(
        self,
        reward: TensorDictModuleBase,
        *,
        bootstrap: bool = False,
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        self.bootstrap = bootstrap
        super().__init__(reward, reduction=reduction, functional=functional)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of observation, action and, if there are samples, their counts."""
        return [*super().in_keys, *[BOOTSTRAP] * self.bootstrap]

    @property
    def out_keys(self) -> list[NestedKey]:
        """The name of the term."""
        return ["loss_cloning"]

    def terms(
        self, observation: Tensor, action: Tensor, counts: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """The members' losses of each transition, added up."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action)
        losses = cloning_losses(
            reward.outputs(observation), reward.actions.target(action), reward.actions.discrete
        )
        if counts is not None:
            losses = losses * counts.movedim(-1, 0)
        return (losses.sum(0),)


def dril_reward(
    settings: DisagreementConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> DisagreementReward:
    """DRIL's reward, untrained, its scaler fitted to ``pairs``.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of the weights. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> dril_reward(DisagreementConfig(), GymEnv("CartPole-v1"), pairs, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    shared, own = "members hidden variance form", "normalise clamp"
    return reward_for(
        env, DisagreementReward, settings, pairs, seed=seed, of_all=shared, of_vectors=own
    )


register(
    Method(
        "dril",
        "DRIL",
        ORANGE,
        settings=DisagreementConfig,
        build=dril_reward,
        loss=lambda reward, settings: DisagreementLoss(reward),
    )
)
