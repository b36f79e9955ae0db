"""AIRL: adversarial inverse reinforcement learning (Fu et al., ICLR 2018, arXiv 1710.11248).

The discriminator is ``D = exp(f) / (exp(f) + pi(a | s))`` with ``f = g + gamma h(s') - h(s)``. So
its logit is ``f - log pi(a | s)``, and g is a reward without the shaping of the potential h.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import knob
from giril_rl.errors import UserError
from giril_rl.networks.normalise import running_statistics
from giril_rl.networks.pixels import FEATURES, PixelFeatures
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import (
    AdversarialLoss,
    AdversarialReward,
    DiscriminatorConfig,
    DiscriminatorScaling,
    discriminator_loss,
    discriminator_scaler,
    gradient_penalty,
    interpolated,
)
from giril_rl.rewards.method import SKY, Method, register
from giril_rl.rewards.scaler import PixelScaler
from giril_rl.rewards.transitions import (
    REWARD_KEYS,
    TERMINATED,
    TRANSITION_KEYS,
    check_transitions,
    read,
    reward_for,
)
from giril_rl.runs.pretrained import remembered
from giril_rl.runs.randomness import seeded

LOG_PROB: NestedKey = "policy_log_prob"
AIRL_KEYS: tuple[NestedKey, ...] = (*TRANSITION_KEYS, TERMINATED)
AIRLForm = Literal["log_ratio", "f", "g"]


@dataclass
class AIRLConfig(DiscriminatorConfig):
    """AIRL's discriminator, its training and the reward made of it."""

    form: str | None = knob(
        None,
        "reward: log_ratio f - log pi, f, or g without shaping; null: log_ratio with PPO, else f, "
        "for SAC's entropy bonus is - log pi",
        choices=("log_ratio", "f", "g"),
    )
    state_only: bool = knob(False, "g of the state alone, for other dynamics; h always is")
    gamma: float | None = knob(
        None, "discount of the shaping; null takes the learner's", low=0, high=1
    )

    def settled(self, run: object) -> AIRLConfig:
        """These settings with the learner's form and discount, where they are null.

        Args:
            run: the run's settings, of which the learner and its discount are read.

        Examples:
            >>> from giril_rl.config.schema import RewardRunConfig
            >>> settled = AIRLConfig().settled(RewardRunConfig())
            >>> settled.form, settled.gamma
            ('log_ratio', 0.99)
        """
        learner = getattr(run, "algorithm", "ppo")
        form = self.form or ("log_ratio" if learner == "ppo" else "f")
        gamma = getattr(run, learner).gamma if self.gamma is None else self.gamma
        return replace(self, form=form, gamma=gamma)


def shaped(g: Tensor, h: Tensor, h_next: Tensor, terminated: Tensor, gamma: float) -> Tensor:
    """``f = g + gamma * (1 - terminated) * h(s') - h(s)`` (Fu et al. 2018, eq. 4).

    Nothing follows a failure, so its last potential is 0. All arguments have one shape.

    Examples:
        >>> g, h, h_next = torch.ones(2), torch.tensor([2.0, 2.0]), torch.tensor([4.0, 4.0])
        >>> shaped(g, h, h_next, torch.tensor([False, True]), gamma=0.5)
        tensor([ 1., -1.])
    """
    return g + gamma * torch.where(terminated, 0.0, h_next) - h


def airl_logit(f: Tensor, log_prob: Tensor) -> Tensor:
    """The logit ``f - log pi`` of ``D = exp(f) / (exp(f) + pi)``, which is ``log D - log(1 - D)``.

    Examples:
        >>> f, pi = torch.tensor(3.0).log(), torch.tensor(0.5)  # D = 3 / 3.5
        >>> round(airl_logit(f, pi.log()).sigmoid().item() * 7, 4)
        6.0
    """
    return f - log_prob


class AIRLReward(AdversarialReward):
    """AIRL's reward of observation, action, next observation and whether the step failed.

    Args:
        g: called with the scaled observation, and with the encoded action unless ``state_only``;
            returns one number.
        h: called with a scaled observation; returns one number, the potential.
        scaler: applied to observations.
        actions: encodes actions.
        form: ``"f"``, ``"g"``, or ``"log_ratio"``, f minus the policy's log-probability, which is
            read as ``"policy_log_prob"``; see :func:`with_log_prob`.
        state_only: whether g reads no action.
        gamma: discount of the potential; the learner's own.
        in_keys: keys of observation, action, next observation and ``terminated``, ``(*batch, 1)``.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for an unknown form, or entries that are missing or of a wrong shape.

    Examples:
        >>> from torchrl.data import Categorical
        >>> reward = AIRLReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> s, a, end = torch.zeros(4, 2), torch.zeros(4).long(), torch.zeros(4, 1).bool()
        >>> batch = TensorDict(
        ...     {"observation": s, "action": a, "next": {"observation": s, "terminated": end}}, [4]
        ... )
        >>> reward(batch)["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        g: nn.Module,
        h: nn.Module,
        *,
        scaler: nn.Module,
        actions: ActionEncoder,
        form: AIRLForm = "f",
        state_only: bool = False,
        gamma: float = 0.99,
        in_keys: Sequence[NestedKey] = AIRL_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        if form not in get_args(AIRLForm):
            raise UserError(f"form={form!r} is unknown: choose one of log_ratio, f, g.")
        roles = ["observation", "action", "next observation", "terminated"]
        super().__init__("AIRL's reward", roles, in_keys, out_keys)
        self.transition_keys = list(self.in_keys)
        if form == "log_ratio":
            self.in_keys.append(LOG_PROB)
        self.g, self.h = g, h
        self.scaler = scaler
        self.actions = actions
        self.form: AIRLForm = form
        self.state_only = state_only
        self.gamma = gamma

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        form: AIRLForm = "f",
        state_only: bool = False,
        gamma: float = 0.99,
        normalise: DiscriminatorScaling = "standardise",
        clamp: float | None = 10.0,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = AIRL_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> AIRLReward:
        """Two multilayer perceptrons, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: hidden layers (tanh) of g and of h.
            form: see the class.
            state_only: see the class.
            gamma: see the class.
            normalise: the observation's rule, see
                :func:`~giril_rl.rewards.adversarial.discriminator_scaler`.
            clamp: bound on each scaled observation; None has none.
            seed: seed of the weights. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown form, rule or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            g = mlp(observation_dim + (0 if state_only else actions.size), 1, hidden)
            h = mlp(observation_dim, 1, hidden)
        return cls(
            g,
            h,
            scaler=discriminator_scaler(observation_dim, normalise, clamp),
            actions=actions,
            form=form,
            state_only=state_only,
            gamma=gamma,
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
        form: AIRLForm = "f",
        state_only: bool = False,
        gamma: float = 0.99,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = AIRL_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> AIRLReward:
        """ICM's convolutions and a linear layer for ``channels`` frames; see `for_vectors`."""
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            g = _FrameValue(channels, 0 if state_only else actions.size)
            h = _FrameValue(channels, 0)
        return cls(
            g,
            h,
            scaler=PixelScaler(),
            actions=actions,
            form=form,
            state_only=state_only,
            gamma=gamma,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def check(self, *transitions: Tensor) -> None:
        """Refuses entries of a wrong shape."""
        check_transitions(self.scaler, self.actions, *transitions[:3])
        batch = self.actions.batch(transitions[1])
        wanted = {"terminated": (transitions[3], (*batch, 1))}
        if len(transitions) > 4:
            wanted["the policy's log-probability"] = (transitions[4], tuple(batch))
        for name, (entry, shape) in wanted.items():
            if entry.shape != shape:
                raise UserError(f"{name} has shape {tuple(entry.shape)}: give {shape}.")

    def inputs(self, s: Tensor, action: Tensor, s_next: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The scaled observation, the encoded action and the scaled next observation."""
        return self.scaler(s), self.actions(action), self.scaler(s_next)

    def unshaped(self, observation: Tensor, encoding: Tensor) -> Tensor:
        """The unshaped g ``(*batch,)`` of a scaled observation and an encoded action."""
        inputs = (observation,) if self.state_only else (observation, encoding)
        return self.g(*inputs).squeeze(-1)

    def f(self, s: Tensor, encoding: Tensor, s_next: Tensor, terminated: Tensor) -> Tensor:
        """The shaped f ``(*batch,)`` of scaled observations and an encoded action."""
        h, h_next = self.h(s).squeeze(-1), self.h(s_next).squeeze(-1)
        return shaped(self.unshaped(s, encoding), h, h_next, terminated, self.gamma)

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each transition."""
        s, encoding, s_next = self.inputs(*transitions[:3])
        if self.form == "g":
            return self.unshaped(s, encoding)
        f = self.f(s, encoding, s_next, transitions[3].squeeze(-1))
        return airl_logit(f, transitions[4]) if self.form == "log_ratio" else f


class _FrameValue(nn.Module):
    """One number of scaled frames, and of ``extra`` more numbers if there are any."""

    def __init__(self, channels: int, extra: int) -> None:
        super().__init__()
        self.body = PixelFeatures(channels)
        self.head = nn.Linear(FEATURES + extra, 1)

    def forward(self, observation: Tensor, *more: Tensor) -> Tensor:
        return self.head(torch.cat([self.body(observation), *more], -1))


def with_log_prob(
    reward: AIRLReward, log_prob: Callable[[Tensor, Tensor], Tensor]
) -> AIRLReward | TensorDictSequential:
    """The reward with what it reads of the policy before it, if it reads that.

    The log-probability is the present policy's, computed whenever the reward is.

    Args:
        reward: AIRL's reward.
        log_prob: ``log_prob(observation, action)`` of an agent, ``(*batch,)``.
    """
    if LOG_PROB not in reward.in_keys:
        return reward
    entries = reward.in_keys[:2]
    return TensorDictSequential(TensorDictModule(log_prob, entries, [LOG_PROB]), reward)


class AIRLLoss(AdversarialLoss):
    """Binary cross-entropy of the logit ``f - log pi``, with an optional gradient penalty on f.

    Each set has the reward's transitions and ``"policy_log_prob"``, the present policy's, of the
    expert's actions as well. The terms and what is logged are those of
    :class:`~giril_rl.rewards.DiscriminatorLoss`.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        penalty: weight of the gradient penalty; 0, the paper's, leaves it out.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Examples:
        >>> from torchrl.data import Categorical
        >>> reward = AIRLReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> s, a, end = torch.zeros(4, 2), torch.zeros(4).long(), torch.zeros(4, 1).bool()
        >>> one = {"observation": s, "action": a, "policy_log_prob": torch.zeros(4)}
        >>> one["next"] = {"observation": s, "terminated": end}
        >>> out = AIRLLoss(reward)(TensorDict({"expert": one, "policy": one}))
        >>> sorted(out.keys())
        ['accuracy_expert', 'accuracy_policy', 'loss_expert', 'loss_policy']
    """

    reward: AIRLReward

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the expert's set, then of the policy's."""
        keys = [key if isinstance(key, tuple) else (key,) for key in self.transition_keys]
        keys.append((str(LOG_PROB),))
        return [(side, *key) for side in ("expert", "policy") for key in keys]

    @property
    def transition_keys(self) -> list[NestedKey]:
        """What is read of a set of transitions, besides the log-probability."""
        return self.reward.transition_keys

    def _terms(self, tensordict: TensorDictBase) -> TensorDictBase:
        reward = self.reward
        entries = read(tensordict, self.in_keys)
        half = len(entries) // 2
        flat: list[list[Tensor]] = []
        for side in (entries[:half], entries[half:]):
            reward.check(*side)
            dims = side[-1].ndim
            flat.append([entry.flatten(0, dims - 1) if dims != 1 else entry for entry in side])
        experts = len(flat[0][0])
        together = [torch.cat(rows) for rows in zip(*flat, strict=True)]
        inputs = reward.inputs(*together[:3])
        logit = airl_logit(reward.f(*inputs, together[3].squeeze(-1)), together[4])
        out: dict[str, Tensor] = {}
        out["loss_expert"], out["loss_policy"] = discriminator_loss(
            logit[:experts], logit[experts:]
        )
        if self.penalty:
            size = max(experts, len(logit) - experts)
            weight = torch.rand(size, device=logit.device)
            points = [interpolated(x[:experts], x[experts:], weight) for x in inputs]
            alive = torch.zeros(size, dtype=torch.bool, device=logit.device)
            with running_statistics(reward):
                slope = gradient_penalty(lambda s, a, n: reward.f(s, a, n, alive), points)
            out["loss_penalty"] = self.penalty * slope
        out["accuracy_expert"] = (logit[:experts] > 0).to(logit.dtype).mean()
        out["accuracy_policy"] = (logit[experts:] < 0).to(logit.dtype).mean()
        return TensorDict({str(key): out[str(key)] for key in self.out_keys})


def airl_reward(
    settings: AIRLConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> AIRLReward:
    """AIRL's reward, untrained, its scaler fitted to ``pairs`` unless it follows the policy.

    Args:
        settings: its settings, :meth:`AIRLConfig.settled` for a learner; null is f, of 0.99.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of the weights. The global random state stays as it is.
    """
    gamma = 0.99 if settings.gamma is None else settings.gamma
    settings = replace(settings, form=settings.form or "f", gamma=gamma)
    shared, own = "form state_only gamma", "hidden normalise clamp"
    return reward_for(env, AIRLReward, settings, pairs, seed=seed, of_all=shared, of_vectors=own)


register(
    Method(
        "airl",
        "AIRL",
        SKY,
        trained="beside",
        settings=AIRLConfig,
        build=airl_reward,
        loss=lambda reward, settings: AIRLLoss(reward, penalty=settings.penalty),
    )
)
