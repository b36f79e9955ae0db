"""GAIL: a discriminator's logit of how much a pair looks like the expert's (Ho and Ermon 2016).

:class:`DiscriminatorReward` makes a reward of it, :class:`DiscriminatorLoss` trains it. Labels,
forms of the reward and all that VAIL and AIRL have too are in :mod:`giril_rl.rewards.adversarial`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.networks.normalise import running_statistics
from giril_rl.networks.pixels import SIDE, PixelDiscriminator
from giril_rl.networks.vectors import mlp
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import (
    AdversarialLoss,
    AdversarialReward,
    DiscriminatorConfig,
    DiscriminatorScaling,
    RewardForm,
    adversarial_reward,
    discriminator_loss,
    discriminator_scaler,
    gradient_penalty,
    interpolated,
    with_absorbing,
)
from giril_rl.rewards.method import GREEN, Method, register
from giril_rl.rewards.scaler import PixelScaler
from giril_rl.rewards.transitions import (
    PAIR_KEYS,
    REWARD_KEYS,
    TERMINATED,
    check_actions,
    check_output,
    read,
    reward_for,
    with_action,
)
from giril_rl.runs.pretrained import remembered
from giril_rl.runs.randomness import seeded


@dataclass
class AdversarialConfig(DiscriminatorConfig):
    """GAIL's discriminator, its training and the reward made of it."""

    form: str = knob(
        "positive",
        "reward of D = P(expert): positive -log(1-D), negative log D, log_ratio, reversed -log D",
        choices=("positive", "negative", "log_ratio", "reversed"),
    )
    use_actions: bool = knob(True, USE_ACTIONS)
    absorbing: bool | None = knob(
        None, "a failure leads to an absorbing state, which is rewarded too; null: with SAC alone"
    )

    def check(self, prefix: str, run: object) -> None:
        """Refuses two rules for what follows a failure."""
        if self.absorbing and getattr(run, "termination", "ends") == "bootstrap":
            raise UserError(
                f"{prefix}absorbing=true says what follows a failure, and termination=bootstrap "
                "that its last state's value does: leave one of them out."
            )

    def settled(self, run: object) -> Self:
        """These settings with ``absorbing`` as the run's learner needs it, where it is null.

        Args:
            run: the run's settings, of which the learner and what follows a failure are read.

        Examples:
            >>> from giril_rl.config.schema import RewardRunConfig
            >>> AdversarialConfig().settled(RewardRunConfig()).absorbing
            False
        """
        if self.absorbing is not None:
            return self
        off_policy = getattr(run, "algorithm", "ppo") != "ppo"
        ends = getattr(run, "termination", "ends") == "ends"
        return replace(self, absorbing=off_policy and ends)


class DiscriminatorReward(AdversarialReward):
    """A reward made of a discriminator's logit, see :func:`~giril_rl.rewards.adversarial_reward`.

    Reads observation ``(*batch, d)``, or frames, and action; the next observation plays no role (Ho
    and Ermon 2016, and the paper). Writes one reward per transition, ``(*batch, 1)``. Train it with
    :class:`~giril_rl.rewards.DiscriminatorLoss`.

    Args:
        network: called with s and the encoded action, returns one number, the logit of "this is the
            expert's".
        scaler: applied to the observation. If it has ``event_dims``, the dimensions of one
            observation, as this package's do, the actions' shape is checked against the
            observations'.
        actions: encodes actions.
        form: the reward's form.
        absorbing: the shape of one scaled observation, where absorbing states are judged too;
            ``network`` then gets one more entry of the encoding. None judges none.
        in_keys: keys of observation and action.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for an unknown form or a wrong number of keys, or entries that are missing or of
            a wrong shape.

    Examples:
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
        absorbing: Sequence[int] | None = None,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        adversarial_reward(torch.zeros(1), form)  # Refuses an unknown form before it is needed.
        roles = "observation", "action"
        super().__init__("a discriminator's reward", roles, in_keys, out_keys, actions=actions)
        self.network = network
        self.scaler = scaler
        self.form: RewardForm = form
        self.absorbing = None if absorbing is None else tuple(absorbing)

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
        absorbing: bool = False,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DiscriminatorReward:
        """The paper's network for vector observations, initialised from ``seed`` alone.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            hidden: hidden layers (tanh).
            form: the reward's form.
            normalise: the observation's rule, see :func:`discriminator_scaler`.
            clamp: bound on each scaled observation; None has none.
            absorbing: whether absorbing states are judged too.
            use_actions: False reads observations alone, see :class:`ActionEncoder`.
            seed: seed of the weights. The global random state stays as it is.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown form, rule or kind of action.
        """
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            network = mlp(observation_dim + actions.size + absorbing, 1, hidden)
        return cls(
            network,
            scaler=discriminator_scaler(observation_dim, normalise, clamp),
            actions=actions,
            form=form,
            absorbing=(observation_dim,) if absorbing else None,
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
        absorbing: bool = False,
        use_actions: bool = True,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = PAIR_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> DiscriminatorReward:
        """The paper's network for ``channels`` frames of 84x84; see `for_vectors`."""
        actions = ActionEncoder(action_spec, use_actions=use_actions)
        with seeded(seed):
            network = PixelDiscriminator(actions.size + absorbing, channels=channels)
        return cls(
            network,
            scaler=PixelScaler(),
            actions=actions,
            form=form,
            absorbing=(channels, SIDE, SIDE) if absorbing else None,
            in_keys=in_keys,
            out_keys=out_keys,
        )

    def inputs(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The scaled observation and the encoded action, whose shapes are checked.

        Where absorbing states are judged, a last entry of the encoding is 0: not absorbing.
        """
        if (event_dims := getattr(self.scaler, "event_dims", None)) is not None:
            check_actions(self.actions, action, observation, event_dims)
        encoding = self.actions(action)
        if self.absorbing is not None:
            encoding = F.pad(encoding, (0, 1))
        return self.scaler(observation), encoding

    def absorbing_inputs(self) -> tuple[Tensor, Tensor]:
        """The absorbing pair, a batch of one: all zeros, and a last entry of 1 in the encoding."""
        if self.absorbing is None:
            raise UserError(
                "this reward judges no absorbing states: build it with absorbing=True, "
                "reward.absorbing=true of a recipe."
            )
        device = next(self.network.parameters()).device
        observation = torch.zeros(1, *self.absorbing, device=device)
        encoding = torch.zeros(1, self.actions.size, device=device)
        return observation, F.pad(encoding, (0, 1), value=1.0)

    @torch.no_grad()
    def absorbing_reward(self) -> Tensor:
        """The reward of each step in the absorbing state, a scalar.

        Raises:
            UserError: if the reward was built without absorbing states.

        Examples:
            >>> from torchrl.data import Categorical
            >>> spec = Categorical(3)
            >>> DiscriminatorReward.for_vectors(2, spec, absorbing=True).absorbing_reward().shape
            torch.Size([])
        """
        inputs = self.absorbing_inputs()
        with running_statistics(self):
            logit = self.logit(*inputs)
        return adversarial_reward(logit, self.form).squeeze(0)

    def logit(self, observation: Tensor, encoding: Tensor) -> Tensor:
        """The logit ``(*batch,)`` of a scaled observation and an encoded action."""
        logit = self.network(observation, encoding)
        check_output("the discriminator", logit, (*encoding.shape[:-1], 1))
        return logit.squeeze(-1)

    def check(self, *transitions: Tensor) -> None:
        """Nothing here: :meth:`inputs` checks for the loss as well."""

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each pair."""
        return adversarial_reward(self.logit(*self.inputs(*transitions)), self.form)


class DiscriminatorLoss(AdversarialLoss):
    """GAIL's binary cross-entropy on logits, with an optional gradient penalty.

    - ``loss_expert`` and ``loss_policy``: the two terms of
      :func:`~giril_rl.rewards.discriminator_loss`.
    - ``loss_penalty``, where the weight is not 0: :func:`~giril_rl.rewards.gradient_penalty` of the
      logit at points between the two sets' scaled observations and encoded actions, discrete ones
      included. One uniform weight per pair, from the global generator.

    Their sum is to be minimised. ``accuracy_expert`` and ``accuracy_policy`` are logged besides.

    Where the reward judges absorbing states, each set has ``("next", "terminated")`` too, whose
    mean is its number of absorbing pairs for each ordinary one. They count in both terms, by
    :func:`~giril_rl.rewards.adversarial.with_absorbing`, and the penalty has two more points: one
    between the absorbing pair and the policy's first, one between the expert's and it.

    The two sets are usually under ``"expert"`` and ``"policy"``, each of any leading shape. Their
    shapes may differ; the TensorDict that holds both then has no batch dimension. Without penalty
    and for equal sizes the loss is that of TorchRL's ``GAILLoss``, which expects probabilities.

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

        Observations are raw, ``(*n, d)`` of the expert and ``(*m, d)`` of the policy. Actions are
        as the environment takes them.
        """

        expert_observation: NestedKey = ("expert", "observation")
        expert_action: NestedKey = ("expert", "action")
        policy_observation: NestedKey = ("policy", "observation")
        policy_action: NestedKey = ("policy", "action")
        expert_terminated: NestedKey = ("expert", "next", "terminated")
        policy_terminated: NestedKey = ("policy", "next", "terminated")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    reward: DiscriminatorReward

    def __init__(
        self, reward: DiscriminatorReward, *, penalty: float = 0.0, functional: bool = False
    ) -> None:
        super().__init__(reward, penalty=penalty, functional=functional)
        entries = dict(zip(("observation", "action"), reward.in_keys, strict=False))
        if reward.absorbing is not None:
            entries["terminated"] = TERMINATED
        keys = {
            f"{side}_{entry}": (side, *(key if isinstance(key, tuple) else (key,)))
            for side in ("expert", "policy")
            for entry, key in entries.items()
        }
        self._entries = list(keys)
        self.set_keys(**keys)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of the expert's set, then of the policy's: observation, action, perhaps the end."""
        return [getattr(self.tensor_keys, entry) for entry in self._entries]

    @property
    def transition_keys(self) -> list[NestedKey]:
        """What is read of a set of transitions, by its keys in a batch."""
        ends = [] if self.reward.absorbing is None else [TERMINATED]
        return [*self.reward.in_keys, *ends]

    def _terms(self, tensordict: TensorDictBase) -> TensorDictBase:
        entries = read(tensordict, self.in_keys)
        half = len(entries) // 2
        read_of = len(self.reward.in_keys)
        expert, policy = (
            _flat(name, *self.reward.inputs(*with_action(self.reward, pairs[:read_of])))
            for name, pairs in (("expert", entries[:half]), ("policy", entries[half:]))
        )
        sets = Sets(len(expert[0]), len(policy[0]))
        parts = [expert, policy]
        if self.reward.absorbing is not None:
            parts.append(self.reward.absorbing_inputs())
            rates = (entries[half - 1].float().mean(), entries[-1].float().mean())
            sets = sets._replace(rates=rates)
        # One pass for both sets.
        observation, encoding = (torch.cat(rows) for rows in zip(*parts, strict=True))
        logit, out = self._judge(observation, encoding, sets)
        logits = sets.ordinary(logit)
        out["loss_expert"], out["loss_policy"] = discriminator_loss(*logits)
        if sets.rates is not None:
            ends = discriminator_loss(logit[-1:], logit[-1:])
            for name, end, rate in zip(("expert", "policy"), ends, sets.rates, strict=True):
                out[f"loss_{name}"] = with_absorbing(out[f"loss_{name}"], end, rate)
        if self.penalty:
            if sets.rates is not None:
                expert = _joined(parts[2], expert)
                policy = _joined(policy, parts[2])
            weight = torch.rand(max(len(expert[0]), len(policy[0])), device=logit.device)
            points = [interpolated(e, p, weight) for e, p in zip(expert, policy, strict=True)]
            # With the batch's own statistics each sample's gradient would depend on all samples.
            with running_statistics(self.reward):
                out["loss_penalty"] = self.penalty * gradient_penalty(self.reward.logit, points)
        out["accuracy_expert"] = (logits[0] > 0).to(logit.dtype).mean()
        out["accuracy_policy"] = (logits[1] < 0).to(logit.dtype).mean()
        return TensorDict({str(key): out[str(key)] for key in self.out_keys})

    def _judge(
        self, observation: Tensor, encoding: Tensor, sets: Sets
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The logit of each row, and what else the loss has."""
        return self.reward.logit(observation, encoding), {}


class Sets(NamedTuple):
    """Which rows of a batch are whose: first the expert's, then the policy's, then the absorbing.

    Attributes:
        experts: number of the expert's rows.
        policies: number of the policy's.
        rates: absorbing pairs for each ordinary one of the expert and of the policy; None where
            there is no absorbing row.
    """

    experts: int
    policies: int
    rates: tuple[Tensor, Tensor] | None = None

    def ordinary(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """The expert's rows and the policy's."""
        return values[: self.experts], values[self.experts : self.experts + self.policies]

    def means(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Means over the expert's pairs and over the policy's, the absorbing ones included."""
        expert, policy = (rows.mean() for rows in self.ordinary(values))
        if self.rates is None:
            return expert, policy
        absorbing = values[-1]
        rates = self.rates
        return with_absorbing(expert, absorbing, rates[0]), with_absorbing(
            policy, absorbing, rates[1]
        )


def _joined(*sets: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    observation, encoding = (torch.cat(rows) for rows in zip(*sets, strict=True))
    return observation, encoding


def _flat(name: str, observation: Tensor, encoding: Tensor) -> tuple[Tensor, Tensor]:
    """A set's scaled observations and encoded actions, ``(n, ...)``."""
    dims = encoding.ndim - 1
    if dims != 1:
        observation = observation.reshape(-1, *observation.shape[dims:])
        encoding = encoding.reshape(encoding.shape[:-1].numel(), encoding.shape[-1])
    if not len(encoding):
        raise UserError(f"the {name}'s set has no pairs: give at least one.")
    return observation, encoding


def discriminator_reward(
    settings: AdversarialConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> DiscriminatorReward:
    """GAIL's reward, untrained, its scaler fitted to ``pairs`` unless it follows the policy.

    Args:
        settings: its settings; those of its training are the learner's.
        env: the environment, for its specs.
        pairs: the demonstrated transitions to learn from.
        seed: seed of the weights. The global random state stays as it is.
    """
    settings = replace(settings, absorbing=bool(settings.absorbing))
    shared, own = "form absorbing use_actions", "hidden normalise clamp"
    return reward_for(
        env, DiscriminatorReward, settings, pairs, seed=seed, of_all=shared, of_vectors=own
    )


register(
    Method(
        "gail",
        "GAIL",
        GREEN,
        trained="beside",
        settings=AdversarialConfig,
        build=discriminator_reward,
        loss=lambda reward, settings: DiscriminatorLoss(reward, penalty=settings.penalty),
        rank=2,
    )
)
