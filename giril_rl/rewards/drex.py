"""D-REX: a reward learned from rankings that noise makes, which may go beyond the demonstrator.

"Better-than-Demonstrator Imitation Learning via Automatically-Ranked Demonstrations" (Brown, Goo
and Niekum, CoRL 2019): a cloned policy is played with more and more random actions
(:mod:`giril_rl.training.ranking`). A reward is fitted by which that is worse the noisier it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.networks.ensembles import EnsembleLinear, EnsembleMLP
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.fitting import RewardLoss
from giril_rl.rewards.method import PINK, Method, register
from giril_rl.rewards.preferences import preference_loss
from giril_rl.rewards.scaler import ObservationScaler, ScalingRule
from giril_rl.rewards.transitions import (
    PAIR_KEYS,
    REWARD_KEYS,
    TransitionReward,
    observation_shape,
    reward_for,
    with_action,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded

AT_ONCE = 2**14
"""Transitions that the networks take at a time, to bound the memory."""


def refuse_frames(observation: str) -> None:
    """Refuses a task that shows ``"image"`` rather than ``"vector"``."""
    if observation != "vector":
        raise UserError(
            "D-REX keeps whole episodes of vectors and this task shows images: choose a task of "
            "vectors, or another method."
        )


@dataclass
class DREXConfig:
    """D-REX's ensemble of rewards and the pairs of snippets that it is fitted to."""

    members: int = knob(3, "reward networks, whose standardised outputs are averaged", low=1)
    hidden: list[int] = knob([256, 256], "hidden layers of each (ReLU)", low=1)
    pairs: int = knob(5000, "pairs of snippets for each network, a fifth for validation", low=5)
    snippet: int = knob(50, "most steps of a snippet", low=1)
    margin: float = knob(0.3, "least difference of a pair's noise levels", low=0, low_open=True)
    l2: float = knob(0.01, "weight of the sum of squared weights in the loss", low=0)
    clip: float = knob(10.0, "bound on each network's standardised reward", low=0, low_open=True)
    normalise: str = knob(
        "standardise",
        "observation rule, of the played episodes",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: float = knob(10.0, "bound on each scaled observation", low=0, low_open=True)
    use_actions: bool = knob(False, USE_ACTIONS)
    seed: int | None = knob(
        None, "seed of clone, played episodes and networks; null takes the run's seed", low=0
    )

    def check(self, prefix: str, run: Any) -> None:
        """Refuses frames and a margin that no pair has, before anything is trained."""
        refuse_frames(run.task.family.observation)
        ranking = getattr(run, "ranking", None)  # A recipe of one's own may rank otherwise.
        widest = 1.0 if ranking is None else 1 - 1 / ranking.levels
        if self.margin > widest + 1e-6:
            raise UserError(
                f"{prefix}margin={self.margin} is more than any two of the noise levels differ: "
                f"set at most {widest:.2f}, or more ranking.levels."
            )


class DREXReward(Pretrained, TransitionReward):
    """D-REX's reward: the mean of an ensemble's outputs, each standardised over played episodes.

    Fit ``reward.scaler`` to the played observations, train it with :class:`PreferenceLoss`, then
    call :meth:`calibrate`.

    Args:
        ensemble: maps scaled observations and encoded actions, concatenated, to one number for each
            of its members.
        scaler: applied to observations.
        actions: encodes actions.
        clip: bound on each member's standardised output.
        in_keys: keys of observation and action.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or entries that are missing or of a wrong shape.

    Examples:
        >>> from torchrl.data import Bounded
        >>> reward = DREXReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> played = TensorDict({"observation": torch.randn(99, 2)}, [99])
        >>> reward.calibrate(played)
        >>> paid = reward(played)["next", "intrinsic_reward"].detach()
        >>> paid.shape, abs(paid.mean().item()) < 1e-4
        (torch.Size([99, 1]), True)
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        ensemble: EnsembleMLP,
        *,
        scaler: ObservationScaler,
        actions: ActionEncoder,
        clip: float = 10.0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        roles = "observation", "action"
        super().__init__("D-REX's reward", roles, in_keys, out_keys, actions=actions)
        self.ensemble, self.scaler, self.clip = ensemble, scaler, clip
        self.register_buffer("mean", torch.zeros(ensemble.members))
        self.register_buffer("std", torch.ones(ensemble.members))

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        members: int = 3,
        hidden: Sequence[int] = (256, 256),
        clip: float = 10.0,
        normalise: ScalingRule = "standardise",
        clamp: float = 10.0,
        use_actions: bool = False,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DREXReward:
        """An ensemble of multilayer perceptrons, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            members: networks.
            hidden: hidden layers (ReLU) of each.
            clip: see the class.
            normalise: the scaler's rule.
            clamp: bound on each scaled observation.
            use_actions: False reads observations alone, see :class:`ActionEncoder`.
            seed: seed of the weights. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown rule or kind of action.
        """
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            ensemble = EnsembleMLP(members, observation_dim + actions.size, 1, hidden)
        scaler = ObservationScaler(observation_dim, rule=normalise, limit=clamp)
        return cls(
            ensemble,
            scaler=scaler,
            actions=actions,
            clip=clip,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def inputs(self, observation: Tensor, action: Tensor) -> Tensor:
        """What the networks read, ``(*batch, size)``."""
        return torch.cat([self.scaler(observation), self.actions(action)], -1)

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each transition."""
        raw = self.ensemble(self.inputs(*transitions)).squeeze(-1).movedim(0, -1)
        return ((raw - self.mean) / self.std).clamp(-self.clip, self.clip).mean(-1)

    @torch.no_grad()
    def calibrate(self, played: TensorDictBase) -> None:
        """Standardises each member's output over the played transitions, batch ``(n,)``.

        A member that pays the same for all of them keeps its unit.
        """
        device = self.mean.device
        entries = tuple(played.get(key).to(device) for key in self.in_keys)
        parts = self.inputs(*with_action(self, entries)).split(AT_ONCE)
        raw = torch.cat([self.ensemble(part) for part in parts], 1).squeeze(-1).double()
        std = raw.std(1, unbiased=False)
        self.mean.copy_(raw.mean(1))
        self.std.copy_(torch.where(std > 1e-8, std, 1.0))


class PreferenceLoss(RewardLoss):
    """The Bradley-Terry loss of pairs of snippets, with L2 regularisation, as in D-REX's code.

    Each member learns from its own pairs. The losses of all are added up, the L2 term included.

    Args:
        reward: the module to train, its scaler fitted.
        played: transitions, batch ``(n,)``, whose rows the snippets are.
        l2: weight of the sum of squared weights.

    Examples:
        >>> from torchrl.data import Bounded
        >>> reward = DREXReward.for_vectors(
        ...     2, Bounded(-1, 1, shape=(1,)), members=1, normalise="raw"
        ... )
        >>> played = TensorDict({"observation": torch.randn(20, 2)}, [20])
        >>> rows = torch.arange(20).reshape(2, 1, 10)
        >>> out = PreferenceLoss(reward, played)(TensorDict({"better": rows, "worse": rows}, [2]))
        >>> out["loss_preference"].detach()  # Each snippet against itself: log 2
        tensor(0.6931)
    """

    reward: DREXReward
    played: Tensor

    def __init__(self, reward: DREXReward, played: TensorDictBase, *, l2: float = 0.01) -> None:
        super().__init__(reward)
        self.l2 = l2
        device = reward.mean.device
        entries = tuple(played.get(key).to(device) for key in reward.in_keys)
        with torch.no_grad():
            inputs = reward.inputs(*with_action(reward, entries))
        self.register_buffer("played", inputs, persistent=False)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the snippets' rows."""
        return ["better", "worse"]

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the terms, and the share of pairs that the members rank rightly."""
        return ["loss_preference", "loss_l2", "accuracy"]

    def sums(self, rows: Tensor) -> Tensor:
        """Each member's sum of rewards of its own snippets, ``(n, members)``.

        Args:
            rows: int64 ``(n, members, snippet)``, -1 where a snippet is over.
        """
        n, members, snippet = rows.shape
        inputs = self.played[rows.clamp(min=0).transpose(0, 1).flatten(1)]
        raw = self.reward.ensemble.separately(inputs).reshape(members, n, snippet).transpose(0, 1)
        return torch.where(rows >= 0, raw, 0.0).sum(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms, averaged over pairs and added up over members."""
        better, worse = (self.sums(tensordict.get(key)) for key in self.in_keys)
        layers = (x for x in self.reward.ensemble.layers if isinstance(x, EnsembleLinear))
        squares = torch.stack([layer.weight.square().sum() for layer in layers]).sum()
        return TensorDict(
            {
                "loss_preference": preference_loss(better, worse).mean(0).sum(),
                "loss_l2": self.l2 * squares,
                "accuracy": (better > worse).float().mean(),
            }
        )


def drex_reward(
    settings: DREXConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> DREXReward:
    """D-REX's reward, untrained, its scaler fitted to ``pairs``; fit it anew to what is played.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions.
        seed: seed of the weights. The global random state stays as it is.

    Raises:
        UserError: if observations are frames.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> drex_reward(DREXConfig(), GymEnv("CartPole-v1"), pairs, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    refuse_frames("image" if observation_shape(env)[0] else "vector")
    own = "members hidden clip normalise clamp use_actions"
    return reward_for(env, DREXReward, settings, pairs, seed=seed, of_all="", of_vectors=own)


register(
    Method(
        "drex",
        "D-REX",
        PINK,
        settings=DREXConfig,
        build=drex_reward,
        frames=False,
    )
)
