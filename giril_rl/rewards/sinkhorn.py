"""Sinkhorn: a reward for an episode that can be moved onto the demonstration at a small cost.

``r_i = -scale * sum_j P_ij C_ij`` (Haldar et al., CoRL 2022, "Watch and Match"): C is the cost
between the episode's steps and the demonstration's, P the transport plan of 100 Sinkhorn steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.rewards.method import SKY, Method, register
from giril_rl.rewards.points import EXACT, Atoms
from giril_rl.rewards.trajectory import TrajectoryReward, check_vectors, spaces_of
from giril_rl.rewards.transitions import REWARD_KEYS
from giril_rl.runs.pretrained import remembered

Cost = Literal["euclidean", "cosine"]
FAR = 1e50
"""The factor of a row or column beyond which a Sinkhorn step is made in the log domain."""


@dataclass
class SinkhornConfig:
    """Sinkhorn's reward."""

    cost: str = knob(
        "euclidean", "cost between standardised steps", choices=("euclidean", "cosine")
    )
    regularisation: float = knob(
        0.01, "entropic regularisation, in units of the mean cost", low=0, low_open=True
    )
    iterations: int = knob(100, "Sinkhorn steps", low=1)
    scale: float | None = knob(
        None, "factor of the reward; null takes that of `first_return`", low=0, low_open=True
    )
    first_return: float = knob(
        10.0, "what the first episode is made to lose in all", low=0, low_open=True
    )
    use_actions: bool = knob(False, USE_ACTIONS)

    def check(self, prefix: str, run: Any) -> None:
        """Refuses frames, before anything is trained."""
        check_vectors("Sinkhorn", run.task.family.observation)


def pairwise_cost(x: Tensor, y: Tensor, cost: Cost = "euclidean") -> Tensor:
    """The cost ``(L, n)`` between rows of ``x`` and ``y``: distance, or 1 less the cosine.

    Examples:
        >>> x, y = torch.tensor([[3.0, 0.0]]), torch.tensor([[0.0, 4.0], [6.0, 0.0]])
        >>> pairwise_cost(x, y), pairwise_cost(x, y, "cosine")
        (tensor([[5., 3.]]), tensor([[1., 0.]]))
    """
    if cost == "cosine":
        return 1 - F.normalize(x, dim=-1) @ F.normalize(y, dim=-1).T
    return torch.cdist(x, y, compute_mode=EXACT)


def sinkhorn_plan(cost: Tensor, regularisation: float, iterations: int = 100) -> Tensor:
    """The transport plan of Sinkhorn's algorithm between two uniform distributions.

    Rows add up to ``1 / L`` exactly; columns to ``1 / n`` as far as it has converged. The first
    step is made in the log domain, where nothing under- or overflows. The others multiply rows and
    columns of the plan so far, which is some 100 times as fast, until a factor grows too large for
    that: then comes another step in the log domain (Schmitzer 2019).

    Args:
        cost: float64 ``(L, n)``.
        regularisation: entropic regularisation, in units of the cost.
        iterations: Sinkhorn steps; each scales columns, then rows.

    Examples:
        >>> cost = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
        >>> sinkhorn_plan(cost, 0.01).round(decimals=4).tolist()
        [[0.5, 0.0], [0.0, 0.5]]
        >>> sinkhorn_plan(cost, 100.0).round(decimals=2).tolist()
        [[0.25, 0.25], [0.25, 0.25]]
    """
    rows, columns = (1 / size for size in cost.shape)
    log_kernel = -cost / regularisation
    f, g = cost.new_zeros(cost.shape[0], 1), cost.new_zeros(cost.shape[1])
    u, v = torch.ones_like(f[:, 0]), torch.ones_like(g)
    kernel = log_kernel
    for step in range(iterations):
        if not step or max(u.max(), 1 / u.min(), v.max(), 1 / v.min()) > FAR:
            f = f + u.log().unsqueeze(1)
            g = math.log(columns) - torch.logsumexp(log_kernel + f, 0)  # Takes v over as well.
            f = math.log(rows) - torch.logsumexp(log_kernel + g, 1, keepdim=True)
            kernel = (log_kernel + f + g).exp()
            u, v = torch.ones_like(u), torch.ones_like(v)
        else:
            v = columns / (u @ kernel)
            u = rows / (kernel @ v)
    return u.unsqueeze(1) * kernel * v


def sinkhorn_value(cost: Tensor, regularisation: float = 0.01, iterations: int = 100) -> Tensor:
    """``-sum_j P_ij C_ij``, each step's share of what moving the episode costs, negated.

    Args:
        cost: ``(L, n)``, between an episode's L steps and the demonstration's n.
        regularisation: in units of the mean cost.
        iterations: Sinkhorn steps.

    Examples:
        Both steps lie at the first of two demonstrated ones; half of each goes to the second:

        >>> sinkhorn_value(torch.tensor([[0.0, 3.0], [0.0, 3.0]]))
        tensor([-0.7500, -0.7500], dtype=torch.float64)
    """
    cost = cost.double()
    mean = cost.mean().item()
    plan = sinkhorn_plan(cost, regularisation * mean if mean > 0 else 1.0, iterations)
    return -(plan * cost).sum(1)


class SinkhornReward(TrajectoryReward):
    """Sinkhorn's reward, at most 0, of a whole episode.

    It is known at an episode's end: the last step is paid the episode's sum and all others 0.
    Within :meth:`~giril_rl.rewards.trajectory.TrajectoryReward.fresh_episodes`, where batches hold
    whole episodes, each step is paid its own share.

    Give it the demonstration by :meth:`fit`.

    Args:
        observation_dim: size of the observation.
        action_spec: the environment's action spec; None compares states alone.
        atoms: n, the number of the demonstration's transitions.
        cost: see :func:`pairwise_cost`.
        regularisation: entropic regularisation, in units of an episode's mean cost.
        iterations: Sinkhorn steps.
        scale: factor of the reward; None learns it from the first episode.
        first_return: then that episode's rewards add up to minus this.
        in_keys: see :class:`~giril_rl.rewards.trajectory.TrajectoryReward`.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: see there; and within ``fresh_episodes()`` before there is a scale.

    Examples:
        >>> from tensordict import TensorDict
        >>> s = torch.arange(4.0).unsqueeze(-1)
        >>> reward = SinkhornReward(1, None, atoms=3, scale=1.0)
        >>> _ = reward.fit(TensorDict({"observation": s[:3]}, [3]))
        >>> done = torch.tensor([[False], [False], [True]])
        >>> episode = {"observation": s[1:], "next": {"observation": s[1:] + 1, "done": done}}
        >>> batch = TensorDict(episode, [3]).unsqueeze(0)
        >>> reward(batch)["next", "intrinsic_reward"].flatten()
        tensor([ 0.0000,  0.0000, -1.2232])
    """

    whole_episodes: ClassVar[bool] = True
    episode_state: ClassVar[tuple[str, ...]] = (
        *TrajectoryReward.episode_state,
        "history",
        "length",
    )

    history: Tensor
    length: Tensor
    scale: Tensor

    @remembered
    def __init__(
        self,
        observation_dim: int,
        action_spec: TensorSpec | None,
        *,
        atoms: int,
        cost: Cost = "euclidean",
        regularisation: float = 0.01,
        iterations: int = 100,
        scale: float | None = None,
        first_return: float = 10.0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        demonstration = Atoms(atoms, observation_dim, action_spec)
        super().__init__("a Sinkhorn reward", demonstration, in_keys, out_keys)
        self.cost: Cost = cost
        self.regularisation, self.iterations = regularisation, iterations
        self.first_return = first_return
        # 0 until it is learned.
        self.register_buffer("scale", torch.tensor(scale or 0.0, dtype=torch.float64))
        size = demonstration.points.shape[1]
        self.register_buffer("history", torch.zeros(0, 0, size, dtype=torch.float64))
        self.register_buffer("length", torch.zeros(0, dtype=torch.int64))

    def begin(self, environments: int) -> None:
        """Forgets all steps."""
        self.history = self.history.new_zeros(environments, 0, self.history.shape[2])
        self.length = self.length.new_zeros(environments)

    def restart(self, where: Tensor) -> None:
        """Forgets the steps of the running episodes where ``where`` is true."""
        self.length = torch.where(where, 0, self.length)

    def pay(self, vectors: Tensor, ends: Tensor) -> Tensor:
        """Each step's share within ``fresh_episodes``, otherwise the sum at an episode's end."""
        if self._fresh:
            return torch.stack([self._shares(*row) for row in zip(vectors, ends, strict=True)])
        reward = vectors.new_zeros(ends.shape)
        stops = ends.any(0).nonzero().flatten().tolist()
        begin = 0
        for stop in stops:
            self._remember(vectors[:, begin : stop + 1])
            for i in ends[:, stop].nonzero().flatten().tolist():
                reward[i, stop] = self._value(self.history[i, : self.length[i]], learn=True).sum()
            self.restart(ends[:, stop])
            begin = stop + 1
        self._remember(vectors[:, begin:])
        return reward

    def _shares(self, steps: Tensor, ends: Tensor) -> Tensor:
        """Of one environment's steps ``(T, size)``, cut into episodes after ``ends``."""
        cuts = (ends.nonzero().flatten() + 1).tolist()
        episodes = [part for part in steps.tensor_split(cuts) if len(part)]
        return torch.cat([self._value(part, learn=self._learns_from_fresh) for part in episodes])

    def _remember(self, steps: Tensor) -> None:
        number, time = steps.shape[:2]
        if not time:
            return
        place = self.length.unsqueeze(1) + torch.arange(time, device=steps.device)
        most = 2 ** (int(place.max())).bit_length()
        if most > self.history.shape[1]:  # Twice as much whenever it is full.
            grown = self.history.new_zeros(number, most, self.history.shape[2])
            grown[:, : self.history.shape[1]] = self.history
            self.history = grown
        self.history[torch.arange(number, device=steps.device).unsqueeze(1), place] = steps
        self.length = self.length + time

    def _value(self, episode: Tensor, *, learn: bool) -> Tensor:
        cost = pairwise_cost(episode, self.atoms.points, self.cost)
        value = sinkhorn_value(cost, self.regularisation, self.iterations)
        if not self.scale and learn and value.any():
            self.scale = self.first_return / value.sum().abs()
        if not self.scale and value.any():
            raise UserError(
                "Sinkhorn's reward is scaled by the learner's first episode and none has ended: "
                "relabel other trajectories later, or set reward.scale."
            )
        return self.scale * value

    def extra_repr(self) -> str:
        """Shows cost, regularisation and scale when printed."""
        reg, scale = self.regularisation, self.scale.item()
        return f"cost={self.cost!r}, regularisation={reg}, scale={scale:g}"


def sinkhorn_reward(
    settings: SinkhornConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int = 0
) -> SinkhornReward:
    """Sinkhorn's reward of a demonstration.

    Args:
        settings: its settings.
        env: the environment, for its specs.
        pairs: the demonstrated transitions, batch ``(n,)``, of one episode or of several, whose
            steps are pooled.
        seed: has no effect, for nothing is random.

    Raises:
        UserError: if observations are frames.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.envs import GymEnv
        >>> pairs = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> sinkhorn_reward(SinkhornConfig(), GymEnv("CartPole-v1"), pairs).cost
        'euclidean'
    """
    more = asdict(settings)
    spaces = spaces_of("Sinkhorn", env, more.pop("use_actions"))
    return SinkhornReward(*spaces, atoms=len(pairs), **more).fit(pairs)


register(
    Method(
        "sinkhorn",
        "Sinkhorn",
        SKY,
        trained="never",
        settings=SinkhornConfig,
        build=sinkhorn_reward,
        scope="trajectory",
        frames=False,
    )
)
