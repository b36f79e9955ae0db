"""GAIL's reward: how much a pair looks like the expert's to a discriminator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.joined import JoinedSequential
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.pixel_discriminators import PixelDiscriminator
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import RewardForm, adversarial_reward
from giril_rl.rewards.chunks import per_transition
from giril_rl.rewards.keys import PAIR_KEYS, REWARD_KEYS, check_keys
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.scaler import ObservationScaler
from giril_rl.rewards.transitions import check_actions, check_output, read
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded

DiscriminatorScaling = Literal["running", "demo_range", "standardise", "raw"]


class DiscriminatorReward(Pretrained, TensorDictModuleBase):
    """A reward made of a discriminator's logit, see :func:`~giril_rl.rewards.adversarial_reward`.

    Reads observation ``(*batch, d)``, or frames, and action, and writes one reward per transition,
    ``(*batch, 1)``; the next observation takes no part (Ho and Ermon 2016, and the paper). Train it
    with :class:`~giril_rl.rewards.DiscriminatorLoss`.

    Args:
        network: called with s and the action's code, gives one number, the logit of "this is the
            expert's".
        scaler: applied to the observation. Where it says how many ``event_dims`` an observation
            has, as this package's do, the actions' shape is held to the observations'.
        actions: turns actions into codes.
        form: the reward's form.
        in_keys: keys of observation and action.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for an unknown form or a wrong number of keys, or entries that are missing or of
            a wrong shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> reward = DiscriminatorReward.for_vectors(2, Categorical(3), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, dtype=torch.int64)
        >>> batch = TensorDict({"observation": s, "action": a}, [4])
        >>> reward(batch)["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        scaler: nn.Module,
        actions: ActionEncoder,
        form: RewardForm = "positive",
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        adversarial_reward(torch.zeros(1), form)  # Refuses an unknown form before it is needed.
        check_keys("a discriminator's reward", ("observation", "action"), in_keys, out_keys)
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        self.network = network
        self.scaler = scaler
        self.actions = actions
        self.form: RewardForm = form

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        form: RewardForm = "positive",
        normalise: DiscriminatorScaling = "standardise",
        clamp: float | None = 10.0,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DiscriminatorReward:
        """The paper's body for vector observations, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: hidden layers (tanh).
            form: the reward's form.
            normalise: the observation's rule, see :func:`discriminator_scaler`.
            clamp: bound on each scaled observation; None has none.
            seed: seed of the weights. The global random state is neither read nor changed.
            in_keys: keys of observation and action.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for an unknown form, rule or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            network = JoinedSequential(*mlp(observation_dim + actions.size, 1, hidden))
        return cls(
            network,
            scaler=discriminator_scaler(observation_dim, normalise, clamp),
            actions=actions,
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
        form: RewardForm = "positive",
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DiscriminatorReward:
        """The paper's body for stacks of 84x84 frames, initialised from ``seed`` alone.

        Args:
            action_spec: the environment's action spec.
            channels: frames in an observation.
            form: see :meth:`for_vectors`, as for all others.
            seed: seed of the weights.
            in_keys: keys of observation and action.
            out_keys: where the reward is written, one key.

        Raises:
            UserError: for an unknown form or kind of action.
        """
        actions = ActionEncoder(action_spec)
        with seeded(seed):
            network = PixelDiscriminator(actions.size, channels=channels)
        return cls(
            network,
            scaler=PixelScaler(),
            actions=actions,
            form=form,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def fit_scaler(self, observations: Tensor) -> None:
        """Fits the scaler to the demonstration's ``(N, d)``, unless it follows the policy's."""
        if isinstance(self.scaler, (ObservationScaler, PixelScaler)):
            self.scaler.fit(observations)

    def observe(self, observations: Tensor) -> None:
        """Lets running statistics take in the policy's observations ``(*batch, d)``."""
        if isinstance(self.scaler, RunningNormaliser):
            self.scaler.update(observations)

    def inputs(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The scaled observation and the action's code, for what the environment gives."""
        if (event_dims := getattr(self.scaler, "event_dims", None)) is not None:
            check_actions(self.actions, action, observation, event_dims)
        return self.scaler(observation), self.actions(action)

    def logit(self, observation: Tensor, action_code: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of a scaled observation and an action's code."""
        logit = self.network(observation, action_code)
        check_output("the discriminator", logit, (*action_code.shape[:-1], 1))
        return logit.squeeze(-1)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        pair = read(tensordict, self.in_keys)
        reward = per_transition(self._value, pair, getattr(self.scaler, "event_dims", 1))
        return tensordict.set(self.out_keys[0], reward.unsqueeze(-1))

    def _value(self, observation: Tensor, action: Tensor) -> Tensor:
        return adversarial_reward(self.logit(*self.inputs(observation, action)), self.form)


def discriminator_scaler(
    observation_dim: int, rule: DiscriminatorScaling, clamp: float | None
) -> nn.Module:
    """What brings observations to the scale of a discriminator's input.

    A policy that knows nothing goes where an expert never was, tens of the demonstration's
    deviations away.

    Args:
        observation_dim: size of the observation's last dimension.
        rule: ``"running"`` for the mean and deviation of all that the policy has seen so far
            (update it with each batch before the discriminator), or a rule of
            :class:`~giril_rl.rewards.ObservationScaler`, fitted to the demonstration.
        clamp: bound on the result; None has none.

    Raises:
        UserError: for an unknown rule.

    Examples:
        >>> discriminator_scaler(2, "raw", clamp=1.0)(torch.tensor([0.5, 7.0]))
        tensor([0.5000, 1.0000])
    """
    if rule not in get_args(DiscriminatorScaling):
        raise UserError(
            f"normalise={rule!r} is unknown: choose one of "
            f"{', '.join(get_args(DiscriminatorScaling))}."
        )
    if rule == "running":
        return RunningNormaliser(observation_dim, clip=float("inf") if clamp is None else clamp)
    return ObservationScaler(
        observation_dim, rule=rule, clamp=clamp is not None, limit=1.0 if clamp is None else clamp
    )
