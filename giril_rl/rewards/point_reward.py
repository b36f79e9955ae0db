"""Rewards of the distances between a transition and the demonstrated ones.

They share how a transition becomes a point: scaler, bound, frames, actions and next state are
settings, for the methods' sources leave them open. Rewards of whole episodes follow PWIL's authors
instead, see :class:`~giril_rl.rewards.points.Atoms`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.errors import UserError
from giril_rl.networks.pixels import FEATURES, PixelFeatures
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule, check_finite
from giril_rl.rewards.transitions import (
    PIXELS_AT_ONCE,
    REWARD_KEYS,
    TRANSITION_KEYS,
    TransitionReward,
    check_actions,
    check_states,
    observation_shape,
    read,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded, stream_seed

ROLES = ("observation", "action", "next observation")
USE_NEXT = "read the next state as well"
CLAMP = "bound on each scaled observation; null has none"


class PointReward(Pretrained, TransitionReward):
    """A reward of the distances between a transition and the demonstration's.

    A transition is a point: its state, its action, its next state, one after the other, of which
    settings leave some out.

    - A state of a vector task is scaled by the ``scaler``. Of frames it is random features (ICM's
      convolutions, untrained), each divided by its standard deviation on the demonstration.
    - A Box action is encoded by :class:`ActionEncoder`, then divided by its standard deviation on
      the demonstration. A discrete one is one-hot: two actions are as far from each other as two
      standardised numbers are on average, a squared distance of 2.
    - All is divided by the square root of the number of dimensions, of which a discrete action is
      one. So a distance is a root mean square over dimensions, comparable between tasks: two
      independent draws from a demonstration are the square root of 2 apart, whatever the task. With
      ``normalise="raw"`` nothing is divided.

    A subclass implements :meth:`of_points`. Nothing is trained: :meth:`remember` takes the
    demonstration, ``atoms`` transitions of it.

    Args:
        what: the reward's name in messages.
        scaler: applied to observations.
        actions: encodes actions; None leaves them out.
        atoms: transitions of the demonstration.
        use_next: read the next observation as well.
        features: of frames, maps scaled observations ``(n, ...)`` to ``(n, d)``; None for vectors.
        in_keys: keys of observation, action and next observation; those not used are left out.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, entries that are missing or of a wrong shape, or use
            before :meth:`remember`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> class MeanDistance(PointReward):
        ...     def __init__(self, **points):
        ...         super().__init__("a mean distance", **points)
        ...     def of_points(self, points, atoms):
        ...         return -torch.cdist(points, atoms).mean(-1)
        >>> reward = MeanDistance.for_vectors(1, Categorical(2), atoms=2, use_actions=False)
        >>> reward.remember(TensorDict({"observation": torch.tensor([[0.0], [2.0]])}, [2]))
        >>> batch = TensorDict({"observation": torch.tensor([[0.0], [4.0]])}, [2])
        >>> reward(batch)["next", "intrinsic_reward"].tolist()
        [[-1.0], [-3.0]]
    """

    atoms: Tensor
    filled: Tensor
    action_scale: Tensor
    feature_scale: Tensor
    scaler: Any
    actions: Any

    def __init__(
        self,
        what: str,
        scaler: ObservationScaler | PixelScaler,
        actions: ActionEncoder | None,
        *,
        atoms: int,
        use_next: bool = False,
        features: nn.Module | None = None,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__(what, ROLES, in_keys, out_keys)
        used = True, actions is not None, use_next
        self.in_keys = [key for key, needed in zip(in_keys, used, strict=True) if needed]
        self.what, self.scaler, self.actions, self.use_next = what, scaler, actions, use_next
        self.features = None if features is None else features.requires_grad_(False).eval()
        self.state_size = _size(scaler)
        self.action_size = 0 if actions is None else actions.size
        self.raw_size = self.state_size * (1 + use_next) + self.action_size
        self.register_buffer("atoms", torch.zeros(atoms, self.raw_size))
        self.register_buffer("filled", torch.tensor(False))
        self.register_buffer("action_scale", torch.ones(self.action_size))
        self.register_buffer("feature_scale", torch.ones(self.state_size * (features is not None)))
        # Reading a buffer's value waits for the device, so it is read only until it is true.
        self._known_filled = False

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec,
        *,
        atoms: int,
        normalise: ScalingRule = "standardise",
        clamp: float | None = 10.0,
        use_actions: bool = True,
        use_next: bool = False,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        **settings: Any,
    ) -> Any:
        """For vector observations.

        Args:
            observation_dim: size of the observation.
            action_spec: the environment's action spec.
            atoms: transitions of the demonstration.
            normalise: the scaler's rule.
            clamp: bound on each scaled observation; None has none.
            use_actions: False leaves actions out.
            use_next: read the next observation as well.
            seed: has no effect, for nothing is random.
            in_keys: see the class.
            out_keys: see the class.
            **settings: the subclass's own.

        Raises:
            UserError: for an unknown rule or kind of action.
        """
        limit = {"clamp": False} if clamp is None else {"limit": clamp}
        return cls(
            scaler=ObservationScaler(observation_dim, rule=normalise, **limit),
            actions=ActionEncoder(action_spec) if use_actions else None,
            atoms=atoms,
            use_next=use_next,
            in_keys=in_keys,
            out_keys=out_keys,
            **settings,
        )

    @classmethod
    @remembered
    def for_pixels(
        cls,
        action_spec: TensorSpec,
        *,
        atoms: int,
        channels: int = 4,
        use_actions: bool = True,
        use_next: bool = False,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = TRANSITION_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
        **settings: Any,
    ) -> Any:
        """For ``channels`` frames, by random features drawn from ``seed``; see `for_vectors`."""
        with seeded(seed):
            features = PixelFeatures(channels)
        return cls(
            scaler=PixelScaler(),
            actions=ActionEncoder(action_spec) if use_actions else None,
            atoms=atoms,
            use_next=use_next,
            features=features,
            in_keys=in_keys,
            out_keys=out_keys,
            **settings,
        )

    def train(self, mode: bool = True) -> Any:
        """Sets the mode of all but the features, whose batch normalisation must not learn."""
        super().train(mode)
        if self.features is not None:
            self.features.eval()
        return self

    @torch.no_grad()
    def remember(self, demonstration: TensorDictBase) -> None:
        """Takes the demonstration ``(n,)``: its transitions and their scale.

        Raises:
            UserError: for another number of transitions than ``atoms``, or entries that are
                missing, not finite or of a wrong shape.
        """
        entries = read(demonstration, self.in_keys)
        if len(demonstration) != len(self.atoms):
            raise UserError(
                f"{len(demonstration)} demonstrated transitions where {self.what} was made for "
                f"{len(self.atoms)}: make it with atoms={len(demonstration)}."
            )
        self.check(*entries)
        for key, entry in zip(self.in_keys, entries, strict=True):
            check_finite(str(key), entry)
        self.scaler.fit(entries[0])
        self.atoms.copy_(self.raw(*(entry.to(self.atoms.device) for entry in entries)))
        states, actions, _ = self.split(self.atoms)
        if self.features is not None:
            self.feature_scale.copy_(inverse_std(states))
        elif self.actions is not None and not self.actions.discrete and self.scaler.rule != "raw":
            self.action_scale.copy_(inverse_std(actions))
        self.filled.fill_(True)
        self._known_filled = True
        self.prepare(self.points(self.atoms))

    def prepare(self, atoms: Tensor) -> None:
        """Called with the demonstration's points ``(n, d)`` once they are there."""

    def check(self, *transitions: Tensor) -> None:
        """Refuses entries of a wrong shape or encoding."""
        entries = iter(transitions)
        observation = next(entries)
        if self.actions is not None:
            check_actions(self.actions, next(entries), observation, self.scaler.event_dims)
        if self.use_next:
            check_states(observation, next(entries))

    def split(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """State, action and next state of what :meth:`raw` made."""
        sizes = self.state_size, self.action_size, self.state_size * self.use_next
        return raw.split(sizes, -1)

    @torch.no_grad()
    def raw(self, *transitions: Tensor) -> Tensor:
        """What is kept of transitions ``(*batch, raw_size)``, before it is scaled."""
        if self.features is not None and transitions[0].ndim == 4:
            parts = zip(*(x.split(PIXELS_AT_ONCE) for x in transitions), strict=True)
            return torch.cat([self._raw(*part) for part in parts])
        return self._raw(*transitions)

    def _raw(self, *transitions: Tensor) -> Tensor:
        entries = iter(transitions)
        parts = [self._state(next(entries))]
        if self.actions is not None:
            parts.append(self.actions(next(entries)))
        if self.use_next:
            parts.append(self._state(next(entries)))
        return torch.cat(parts, -1)

    def _state(self, observation: Tensor) -> Tensor:
        if self.features is None:
            return observation.to(self.atoms.dtype)
        return self.features(self.scaler(observation))

    def points(self, raw: Tensor) -> Tensor:
        """The points ``(*batch, d)`` of what :meth:`raw` made."""
        state, action, following = self.split(raw)
        parts = [self._scaled(state), action * self.action_scale]
        if self.use_next:
            parts.append(self._scaled(following))
        points = torch.cat(parts, -1)
        if self.features is None and self.scaler.rule == "raw":
            return points
        of_action = 0 if self.actions is None else 1 if self.actions.discrete else self.action_size
        return points / math.sqrt(self.state_size * (1 + self.use_next) + of_action)

    def _scaled(self, state: Tensor) -> Tensor:
        return self.scaler(state) if self.features is None else state * self.feature_scale

    def value(self, *transitions: Tensor) -> Tensor:
        """The reward of each transition."""
        if not self._known_filled:
            if not bool(self.filled):
                raise UserError(
                    f"{self.what} has no demonstration yet: call reward.remember(pairs) first."
                )
            self._known_filled = True
        return self.of_points(self.points(self.raw(*transitions)), self.points(self.atoms))

    def of_points(self, points: Tensor, atoms: Tensor) -> Tensor:
        """The rewards ``(*batch,)`` of points ``(*batch, d)`` beside the demonstration's."""
        raise NotImplementedError


def _size(scaler: ObservationScaler | PixelScaler) -> int:
    return FEATURES if isinstance(scaler, PixelScaler) else len(scaler.offset)


def inverse_std(values: Tensor) -> Tensor:
    """One over the (population) standard deviation of each column, 1 where it is constant."""
    std = values.double().std(0, unbiased=False)
    constant = std <= 1e-6 * values.double().abs().amax(0)
    return torch.where(constant, 1.0, std).reciprocal().to(values.dtype)


def point_reward_for(
    kind: Any, settings: Any, env: EnvBase, pairs: TensorDictBase, *, seed: int, own: str
) -> Any:
    """A :class:`PointReward` for an environment, which remembers ``pairs``.

    Args:
        kind: its class.
        settings: with ``use_actions``, ``use_next``, ``normalise`` and ``clamp``.
        env: the environment, for its specs.
        pairs: the demonstrated transitions.
        seed: seed of the features of frames.
        own: names of the settings of ``kind`` itself.
    """
    frames, size = observation_shape(env)
    arguments = {name: getattr(settings, name) for name in f"use_actions use_next {own}".split()}
    arguments |= {"seed": stream_seed("reward", seed), "atoms": len(pairs)}
    if frames:
        reward = kind.for_pixels(env.action_spec, channels=frames, **arguments)
    else:
        scaling = {"normalise": settings.normalise, "clamp": settings.clamp}
        reward = kind.for_vectors(size, env.action_spec, **arguments, **scaling)
    reward.remember(pairs)
    return reward
