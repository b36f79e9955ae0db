"""Nearest neighbour: a reward for transitions close to a demonstrated one, with nothing to train.

``r = 1 - d^2`` with d the distance to the nearest demonstrated transition (Ciosek, ICLR 2022,
"Imitation Learning by Reinforcement Learning").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.rewards.method import PINK, Method, register
from giril_rl.rewards.point_reward import CLAMP, USE_NEXT, PointReward, point_reward_for
from giril_rl.rewards.points import EXACT, in_parts, median_distance

NearestKernel = Literal["quadratic", "gaussian"]


@dataclass
class NearestConfig:
    """The nearest neighbour's reward."""

    kernel: str = knob(
        "quadratic",
        "of the distance d to the nearest: quadratic 1 - d^2; gaussian exp(-d^2 / (2 l^2)), l the "
        "median distance within the demonstration",
        choices=("quadratic", "gaussian"),
    )
    normalise: str = knob(
        "standardise",
        "observation rule of distances; raw: the environment's units, as in Ciosek's code",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: float | None = knob(10.0, CLAMP, low=0, low_open=True)
    use_actions: bool = knob(True, USE_ACTIONS)
    use_next: bool = knob(False, USE_NEXT)
    seed: int | None = knob(
        None, "frames: seed of the random features; null takes the run's seed", low=0
    )


def nearest_distance(points: Tensor, atoms: Tensor) -> Tensor:
    """Euclidean distance of each point to the nearest atom.

    Args:
        points: ``(*batch, d)``.
        atoms: ``(n, d)``, at least one.

    Returns:
        ``(*batch,)``. Memory is bounded, whatever the two sizes.

    Examples:
        >>> nearest_distance(torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.zeros(1, 2))
        tensor([5., 1.])
    """

    def nearest(part: Tensor) -> Tensor:
        return torch.cdist(part, atoms, compute_mode=EXACT).amin(1)

    return in_parts(nearest, points, len(atoms))


def nearest_reward(distance: Tensor, kernel: NearestKernel, length: Tensor | float = 1.0) -> Tensor:
    """``1 - d^2`` (quadratic), or ``exp(-d^2 / (2 l^2))`` (gaussian); 1 at distance 0 either way.

    Args:
        distance: d, of any shape.
        kernel: which of the two.
        length: l, above 0; the quadratic one has none.

    Raises:
        UserError: for an unknown kernel.

    Examples:
        >>> nearest_reward(torch.tensor([0.0, 0.5, 2.0]), "quadratic")
        tensor([ 1.0000,  0.7500, -3.0000])
        >>> nearest_reward(torch.tensor([0.0, 2.0]), "gaussian", 1.0)  # exp(-2)
        tensor([1.0000, 0.1353])
    """
    if kernel not in get_args(NearestKernel):
        raise UserError(f"kernel={kernel!r} is unknown: choose quadratic or gaussian.")
    if kernel == "quadratic":
        return 1 - distance.square()
    return (-distance.square() / (2 * length**2)).exp()


class NearestReward(PointReward):
    """The reward of the distance to the nearest demonstrated transition.

    Args:
        kernel: see :func:`nearest_reward`.
        **points: see :class:`~giril_rl.rewards.point_reward.PointReward`.

    Raises:
        UserError: for an unknown kernel, and where the base class refuses.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = NearestReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), atoms=2)
        >>> s, a = torch.tensor([[0.0, 0.0], [2.0, 4.0]]), torch.tensor([[0.5], [-0.5]])
        >>> demonstration = TensorDict({"observation": s, "action": a}, [2])
        >>> reward.remember(demonstration)
        >>> reward(demonstration)["next", "intrinsic_reward"].squeeze(-1)
        tensor([1., 1.])
        >>> halfway = TensorDict({"observation": s.mean(0)[None], "action": torch.zeros(1, 1)}, [1])
        >>> reward(halfway)["next", "intrinsic_reward"].abs().item() < 1e-6  # 1 off in each, so 1
        True
    """

    length: Tensor

    def __init__(self, *, kernel: NearestKernel = "quadratic", **points: Any) -> None:
        nearest_reward(torch.zeros(1), kernel)  # Refuses an unknown one before it is needed.
        super().__init__("a nearest neighbour's reward", **points)
        self.kernel: NearestKernel = kernel
        self.register_buffer("length", torch.tensor(1.0))

    def prepare(self, atoms: Tensor) -> None:
        """Sets the Gaussian's length to the median distance within the demonstration."""
        self.length.copy_(median_distance(atoms))

    def of_points(self, points: Tensor, atoms: Tensor) -> Tensor:
        """The reward of each point."""
        return nearest_reward(nearest_distance(points, atoms), self.kernel, self.length)


def nearest_neighbour(
    settings: NearestConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int
) -> NearestReward:
    """The nearest neighbour's reward for an environment, which remembers ``pairs``.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions.
        seed: seed of the features of frames. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 3), "action": torch.rand(9, 1)}, [9])
        >>> nearest_neighbour(NearestConfig(), GymEnv("Pendulum-v1"), pairs, seed=0).atoms.shape
        torch.Size([9, 4])
    """
    return point_reward_for(NearestReward, settings, env, pairs, seed=seed, own="kernel")


register(
    Method(
        "nearest",
        "Nearest neighbour",
        PINK,
        trained="never",
        settings=NearestConfig,
        build=nearest_neighbour,
    )
)
