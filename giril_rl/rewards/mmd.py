"""GMMIL: a reward for going where the demonstration is and the policy is not yet.

``r(x) = mean over D of k(x, y) - mean over the own visits of k(x, y)``, the witness function of the
maximum mean discrepancy (MMD) between the two (Kim and Park, AAAI 2018, "Imitation Learning via
Kernel Mean Embedding").
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
from giril_rl.rewards.method import BLUE, Method, register
from giril_rl.rewards.point_reward import CLAMP, USE_NEXT, PointReward, point_reward_for
from giril_rl.rewards.points import in_parts, median_distance
from giril_rl.rewards.transitions import read

Kept = Literal["recent", "all"]


@dataclass
class MMDConfig:
    """GMMIL's reward and what it keeps of the policy's visits."""

    kept: str = knob(
        "recent",
        "which own visits stand for the policy's: the most recent ones, or a uniform sample of all "
        "(reservoir sampling)",
        choices=("recent", "all"),
    )
    visits: int = knob(1_000, "own visits that are kept at most", low=1)
    every: int = knob(10, "recent: keep 1 in k visits, so that visits * k steps are covered", low=1)
    normalise: str = knob(
        "standardise",
        "observation rule of distances",
        choices=("demo_range", "standardise", "raw", "pixels"),
    )
    clamp: float | None = knob(10.0, CLAMP, low=0, low_open=True)
    use_actions: bool = knob(True, USE_ACTIONS)
    use_next: bool = knob(False, USE_NEXT)
    seed: int | None = knob(
        None, "seed of the sample of visits and of frames' features; null takes the run's", low=0
    )


def kernel(points: Tensor, others: Tensor, bandwidths: Tensor) -> Tensor:
    """Sum of Gaussian kernels, ``sum over b of exp(-||x - y||^2 / b)``.

    Args:
        points: x, ``(n, d)``.
        others: y, ``(m, d)``.
        bandwidths: b, squared distances, ``(k,)``.

    Returns:
        ``(n, m)``, between 0 and k.

    Examples:
        >>> x, y = torch.tensor([[0.0, 0.0]]), torch.tensor([[0.0, 0.0], [1.0, 1.0]])
        >>> kernel(x, y, torch.tensor([1.0, 2.0]))  # exp(-2) + exp(-1)
        tensor([[2.0000, 0.5032]])
    """
    # By matrix products, about a centre near which they lose little.
    centre = others.mean(0) if len(others) else 0.0
    x, y = points - centre, others - centre
    lengths = x.square().sum(1, keepdim=True) + y.square().sum(1)
    opposite = torch.addmm(lengths, x, y.T, beta=-1, alpha=2).clamp_(max=0)  # -||x - y||^2
    return sum(((opposite / b).exp_() for b in bandwidths), torch.zeros_like(opposite))


def mean_kernel(
    points: Tensor, others: Tensor, bandwidths: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Mean of :func:`kernel` over ``others``, the kernel mean embedding at ``points``.

    Args:
        points: ``(*batch, d)``.
        others: ``(m, d)``.
        bandwidths: ``(k,)``.
        weights: of the others, ``(m,)``, adding up to 1 or all 0; None gives all the same.

    Returns:
        ``(*batch,)``. Memory is bounded, whatever the sizes.

    Examples:
        >>> y = torch.tensor([[0.0], [1.0]])
        >>> mean_kernel(torch.zeros(1, 1), y, torch.ones(1))  # (1 + exp(-1)) / 2
        tensor([0.6839])
    """

    def mean(part: Tensor) -> Tensor:
        values = kernel(part, others, bandwidths)
        return values.mean(1) if weights is None else values @ weights

    return in_parts(mean, points, len(others))


def squared_mmd(
    ours: Tensor, theirs: Tensor, bandwidths: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Squared maximum mean discrepancy of two sets, 0 where they are equal.

    The mean over all pairs, each point with itself included (the biased estimate), which is never
    below 0.

    Args:
        ours: ``(n, d)``.
        theirs: ``(m, d)``.
        bandwidths: see :func:`kernel`.
        weights: of ``theirs``, see :func:`mean_kernel`.

    Examples:
        >>> x, y = torch.zeros(1, 1), torch.ones(1, 1)
        >>> squared_mmd(x, y, torch.ones(1))  # 1 + 1 - 2 exp(-1)
        tensor(1.2642)
    """
    within, across = (
        mean_kernel(ours, x, bandwidths, w) for x, w in ((ours, None), (theirs, weights))
    )
    back = mean_kernel(theirs, theirs, bandwidths, weights)
    weighted = back.mean() if weights is None else back @ weights
    return within.mean() + weighted - 2 * across.mean()


class MMDReward(PointReward):
    """GMMIL's reward of a transition, which moves with the policy's visits.

    Tell it of each batch that the policy collects by :meth:`observe`, as
    :class:`~giril_rl.training.VisitTrainer` does. Its state holds the visits. Before any, it is
    the mean kernel with the demonstration alone.

    The two bandwidths follow Kim and Park's code: the median squared distance within the
    demonstration, and that between the demonstration and the first batch of visits. Until then the
    second is as the first.

    Args:
        visits: own visits kept at most.
        kept: "recent" ones, 1 in ``every``; or a uniform sample of "all".
        every: see ``kept``.
        **points: see :class:`~giril_rl.rewards.point_reward.PointReward`.

    Raises:
        UserError: for another ``kept``, and where the base class refuses.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = MMDReward.for_vectors(
        ...     1, Bounded(-1, 1, shape=(1,)), atoms=2, every=1, use_actions=False
        ... )
        >>> demonstration = TensorDict({"observation": torch.tensor([[0.0], [2.0]])}, [2])
        >>> reward.remember(demonstration)
        >>> paid = lambda: reward(demonstration)["next", "intrinsic_reward"].squeeze(-1)
        >>> paid()
        tensor([1.3679, 1.3679])
        >>> reward.observe(demonstration[:1])  # The first is paid less than the other from now on.
        >>> bool(paid()[0] < 0 < paid()[1])
        True
    """

    visited: Tensor
    seen: Tensor
    bandwidths: Tensor

    def __init__(
        self, *, visits: int = 1_000, kept: Kept = "recent", every: int = 10, **points: Any
    ) -> None:
        if kept not in get_args(Kept):
            raise UserError(f"kept={kept!r} is unknown: choose recent or all.")
        super().__init__("GMMIL's reward", **points)
        self.kept: Kept = kept
        self.every = every if kept == "recent" else 1
        self.register_buffer("visited", torch.zeros(visits, self.raw_size))
        self.register_buffer("seen", torch.tensor(0))
        self.register_buffer("bandwidths", torch.ones(2))

    def prepare(self, atoms: Tensor) -> None:
        """Sets the bandwidths from the demonstration."""
        self.bandwidths.fill_(median_distance(atoms).square())

    @property
    def weights(self) -> Tensor:
        """The weight of each place in ``visited``: all that are taken have the same."""
        size = len(self.visited)
        held = torch.div(self.seen + self.every - 1, self.every, rounding_mode="floor")
        taken = torch.arange(size, device=held.device) < held
        return taken / held.clamp(1, size)

    @torch.no_grad()
    def observe(self, batch: TensorDictBase, generator: torch.Generator | None = None) -> None:
        """Takes a batch ``(num_envs, time)``, or any other shape, of the policy's transitions.

        Args:
            batch: with the ``in_keys``; no reward is read.
            generator: on the CPU; draws which of all visits are kept. None draws globally.

        Raises:
            UserError: for entries that are missing or of a wrong shape.
        """
        entries = read(batch, self.in_keys)
        self.check(*entries)
        events = [self.scaler.event_dims, self.scaler.event_dims]
        if self.actions is not None:
            events.insert(1, len(self.actions.event))
        # In order of time, so that the most recent are the last, of all environments.
        flat = [_in_time(x, events[i]) for i, x in enumerate(entries)]
        raw = self.raw(*(x.to(self.visited.device) for x in flat))
        before, size = int(self.seen), len(self.visited)
        numbers = torch.arange(before, before + len(raw))
        if not before:
            between = median_distance(self.points(raw), self.points(self.atoms))
            self.bandwidths[1] = between.square()
        if self.kept == "recent":
            chosen = numbers % self.every == 0
            raw, places = raw[chosen.to(raw.device)], numbers[chosen] // self.every % size
        else:  # Algorithm R (Vitter 1985): the n-th gets a place with probability size/n.
            drawn = torch.rand(len(raw), generator=generator, dtype=torch.float64) * (numbers + 1)
            places = torch.where(numbers < size, numbers, drawn.long())
        source = _last_of_each(places, size)
        written = (source >= 0).nonzero().squeeze(1)
        self.visited[written.to(raw.device)] = raw[source[written].to(raw.device)]
        self.seen += len(numbers)

    @torch.no_grad()
    def squared_mmd(self) -> Tensor:
        """Squared MMD of the demonstration and the visits kept."""
        atoms, visited = self.points(self.atoms), self.points(self.visited)
        return squared_mmd(atoms, visited, self.bandwidths, self.weights)

    def of_points(self, points: Tensor, atoms: Tensor) -> Tensor:
        """The reward of each point."""
        own = mean_kernel(points, self.points(self.visited), self.bandwidths, self.weights)
        return mean_kernel(points, atoms, self.bandwidths) - own


def _in_time(entry: Tensor, event_dims: int) -> Tensor:
    """``(num_envs, time, ...)`` as ``(time * num_envs, ...)``; other shapes just flat."""
    dims = entry.ndim - event_dims
    if dims == 2:
        entry = entry.transpose(0, 1)
    return entry.reshape(-1, *entry.shape[dims:])


def _last_of_each(places: Tensor, size: int) -> Tensor:
    """Of each place below ``size``, the index of the last entry that names it; -1 if none does.

    Writing with repeated indices would leave open which one stays.
    """
    inside = (places < size).nonzero().squeeze(1)
    source = torch.full((size,), -1)
    return source.scatter_reduce(0, places[inside], inside, "amax")


def mmd_reward(settings: MMDConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int) -> MMDReward:
    """GMMIL's reward for an environment, which remembers ``pairs``.

    Args:
        settings: its settings; ``seed`` is the caller's to resolve.
        env: the environment, for its specs.
        pairs: the demonstrated transitions.
        seed: seed of the features of frames. The global random state stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 3), "action": torch.rand(9, 1)}, [9])
        >>> mmd_reward(MMDConfig(), GymEnv("Pendulum-v1"), pairs, seed=0).visited.shape
        torch.Size([1000, 4])
    """
    own = "visits kept every"
    return point_reward_for(MMDReward, settings, env, pairs, seed=seed, own=own)


register(
    Method(
        "mmd",
        "GMMIL",
        BLUE,
        trained="beside",
        settings=MMDConfig,
        build=mmd_reward,
    )
)
