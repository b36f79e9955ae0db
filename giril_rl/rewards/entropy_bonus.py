"""State-entropy bonus: a reward for states far from the others of the batch.

``b = log(1 + mean distance to the k nearest states of the batch)`` (APT: Liu and Abbeel 2021; ILDE:
Zhao et al. 2025, k = 12). Maximising it maximises a particle-based estimate of the entropy of the
states visited.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import knob
from giril_rl.errors import UserError
from giril_rl.networks.pixels import PixelFeatures
from giril_rl.rewards.method import GREY, Method, register
from giril_rl.rewards.points import DISTANCES_AT_ONCE, EXACT
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.transitions import (
    PIXELS_AT_ONCE,
    REWARD_KEYS,
    TransitionReward,
    reward_for,
)
from giril_rl.runs.pretrained import Pretrained, remembered
from giril_rl.runs.randomness import seeded

NEXT_STATE_KEYS: tuple[NestedKey, ...] = (("next", "observation"),)


@dataclass
class EntropyBonusConfig:
    """The state-entropy bonus."""

    k: int = knob(12, "nearest states of the batch whose distances are averaged (ILDE: 12)", low=1)
    among: int = knob(
        256, "most states that are compared with each other; a larger batch is split", low=2
    )
    normalise: str = knob(
        "standardise",
        "observation rule of the distances",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    seed: int | None = knob(
        None, "frames: seed of the random features; null takes the run's seed", low=0
    )


def knn_bonus(states: Tensor, k: int) -> Tensor:
    """``log(1 + mean distance to the k nearest)`` of each state among the others.

    A state is not its own neighbour; equal ones count with distance 0. A batch of ``k`` states or
    fewer takes all the others, and a state alone gets 0. No gradient flows.

    Args:
        states: scaled states or features, ``(n, d)``.
        k: number of neighbours, at least 1.

    Returns:
        ``(n,)``, at least 0.

    Raises:
        UserError: for k below 1 or states of another shape.

    Examples:
        >>> knn_bonus(torch.tensor([[0.0], [1.0], [4.0]]), k=2)  # log(1 + 2.5), 1 + 2, 1 + 3.5
        tensor([1.2528, 1.0986, 1.5041])
    """
    if k < 1 or states.ndim != 2:
        raise UserError(
            f"k={k} and states of shape {tuple(states.shape)}: give k of at least 1 and states "
            "of shape (n, d)."
        )
    states = states.detach()
    n = len(states)
    k = min(k, n - 1)
    if k < 1:
        return states.new_zeros(n)
    bonuses = []
    for rows in torch.arange(n, device=states.device).split(max(1, DISTANCES_AT_ONCE // n)):
        # The exact mode: the one by matrix products gives neighbours a distance that is noise.
        distance = torch.cdist(states[rows], states, compute_mode=EXACT)
        distance = distance.scatter(1, rows.unsqueeze(1), float("inf"))
        bonuses.append(distance.topk(k, largest=False, sorted=False).values.mean(1).log1p())
    return torch.cat(bonuses)


class EntropyBonus(Pretrained, TransitionReward):
    """The bonus of the next state of each transition, among the next states of the same batch.

    All transitions of one call are one batch, whatever its leading shape. The number depends on the
    batch: compute it for the batch that the policy is updated with. A single transition gets 0, so
    that it does not work step by step in an environment. A batch of more than ``among`` transitions
    is split into parts of equal size, of which each takes every so many-th transition, so that the
    number does not depend on how many minibatches are drawn at once.

    Only the scaler has to be fitted. Frames are compared by random features, which stay as they
    are: ICM's convolutions, untrained (as in RE3, Seo et al. 2021).

    Args:
        scaler: applied to observations.
        features: maps scaled observations ``(n, ...)`` to ``(n, d)``; None compares observations.
        k: number of neighbours.
        among: most states that are compared with each other.
        in_keys: key of the next observation, one.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or an observation that is missing or of a wrong size.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = EntropyBonus(ObservationScaler(1, rule="raw", clamp=False), k=2)
        >>> batch = TensorDict({"next": {"observation": torch.tensor([[0.0], [1.0], [4.0]])}}, [3])
        >>> reward(batch)["next", "intrinsic_reward"].squeeze(-1)
        tensor([1.2528, 1.0986, 1.5041])
    """

    def __init__(
        self,
        scaler: ObservationScaler | PixelScaler,
        features: nn.Module | None = None,
        *,
        k: int = 12,
        among: int = 256,
        in_keys: Sequence[NestedKey] = NEXT_STATE_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__("a state-entropy bonus", ("next observation",), in_keys, out_keys)
        self.scaler = scaler
        self.features = None if features is None else features.requires_grad_(False).eval()
        self.k, self.among = k, among

    @classmethod
    @remembered
    def for_vectors(
        cls,
        observation_dim: int,
        action_spec: TensorSpec | None = None,
        *,
        k: int = 12,
        among: int = 256,
        normalise: ScalingRule = "standardise",
        seed: int = 0,
        in_keys: Sequence[NestedKey] = NEXT_STATE_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> EntropyBonus:
        """The bonus of scaled observations, which are not clamped.

        Args:
            observation_dim: size of the observation.
            action_spec: has no effect, for actions play no role.
            k: number of neighbours.
            among: see the class.
            normalise: the scaler's rule.
            seed: has no effect, for nothing is random.
            in_keys: see the class.
            out_keys: see the class.

        Raises:
            UserError: for an unknown rule.
        """
        scaler = ObservationScaler(observation_dim, rule=normalise, clamp=False)
        return cls(scaler, k=k, among=among, in_keys=in_keys, out_keys=out_keys)

    @classmethod
    @remembered
    def for_pixels(
        cls,
        action_spec: TensorSpec | None = None,
        *,
        channels: int = 4,
        k: int = 12,
        among: int = 256,
        seed: int = 0,
        in_keys: Sequence[NestedKey] = NEXT_STATE_KEYS,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> EntropyBonus:
        """The bonus of random features of ``channels`` frames, drawn from ``seed``."""
        with seeded(seed):
            features = PixelFeatures(channels)
        return cls(PixelScaler(), features, k=k, among=among, in_keys=in_keys, out_keys=out_keys)

    def train(self, mode: bool = True) -> EntropyBonus:
        """Sets the mode of all but the features, whose batch normalisation must not learn."""
        super().train(mode)
        if self.features is not None:
            self.features.eval()
        return self

    def check(self, *transitions: Tensor) -> None:
        """The scaler checks the observation."""

    @torch.no_grad()
    def values(self, *transitions: Tensor) -> Tensor:
        """The bonus of each next observation, of all of them as one batch."""
        (observation,) = transitions
        events = self.scaler.event_dims
        batch = observation.shape[: observation.ndim - events]
        flat = observation.reshape(-1, *observation.shape[observation.ndim - events :])
        points = self.points(flat)
        parts = max(1, -(-len(points) // self.among))
        bonus = points.new_empty(len(points))
        for i in range(parts):
            bonus[i::parts] = knn_bonus(points[i::parts], self.k)
        return bonus.reshape(batch)

    def points(self, observation: Tensor) -> Tensor:
        """What distances are computed between, ``(n, d)``, for observations ``(n, ...)``."""
        if self.features is None:
            return self.scaler(observation)
        parts = observation.split(PIXELS_AT_ONCE)
        return torch.cat([self.features(self.scaler(part)) for part in parts])


def entropy_bonus(
    settings: EntropyBonusConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int = 0
) -> EntropyBonus:
    """The bonus for an environment, its scaler fitted to ``pairs``.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: transitions whose scale observations are brought to, the demonstration's.
        seed: seed of the features of frames. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> entropy_bonus(EntropyBonusConfig(), GymEnv("CartPole-v1"), pairs).scaler
        ObservationScaler(4, rule='standardise', clamp=False)
    """
    return reward_for(
        env, EntropyBonus, settings, pairs, seed=seed, of_all="k among", of_vectors="normalise"
    )


register(
    Method(
        "control:entropy_bonus",
        "control: entropy bonus",
        GREY,
        kind="control",
        trained="never",
        scope="batch",
        settings=EntropyBonusConfig,
        build=entropy_bonus,
        rank=207,
    )
)
