"""Episodes across collected batches: their true returns, their steps held back, their time."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from giril_rl.rewards.trajectory import steps_before


class EpisodeTracker(nn.Module):
    """Follows undiscounted true returns across batches, whole batches at a time.

    Where a batch has ``("next", "scored")`` (see :class:`giril_rl.envs.FixedHorizonEnv`), only
    those steps count, so that returns and lengths are those of the task's own episodes: one for
    each horizon, from its beginning to the first failure.

    Where it has ``("next", "game_over")`` (see :class:`giril_rl.envs.AtariEnv`), an episode is a
    whole game, whatever ends one for the learner.

    Args:
        num_envs: environments in a batch.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> tracker = EpisodeTracker(1)
        >>> reward = torch.tensor([[[1.0], [2.0], [4.0]]])
        >>> done = torch.tensor([[[False], [True], [False]]])
        >>> batch = TensorDict({"next": {"reward": reward, "done": done}}, [1, 3])
        >>> tracker(batch)
        (tensor([3.], dtype=torch.float64), tensor([2]))
        >>> tracker(batch)[0]
        tensor([7.], dtype=torch.float64)
    """

    running_return: Tensor
    running_length: Tensor

    def __init__(self, num_envs: int) -> None:
        super().__init__()
        self.register_buffer("running_return", torch.zeros(num_envs, dtype=torch.float64))
        self.register_buffer("running_length", torch.zeros(num_envs, dtype=torch.int64))

    @torch.no_grad()
    def forward(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Takes a batch ``(num_envs, time)``; gives returns and lengths of episodes ended in it."""
        reward = batch.get(("next", "reward")).squeeze(-1).double()
        over = batch.get(("next", "game_over"), None)
        done = (batch.get(("next", "done")) if over is None else over).squeeze(-1)
        scored = batch.get(("next", "scored"), None)
        if scored is None:
            time = torch.arange(1, done.shape[1] + 1).expand_as(done)
        else:
            scored = scored.squeeze(-1)
            reward = torch.where(scored, reward, 0.0)
            time = scored.cumsum(1)
        total = torch.cat([-self.running_return.unsqueeze(1), reward.cumsum(1)], 1)
        clock = torch.cat([-self.running_length.unsqueeze(1), time], 1)
        end = torch.cat([torch.ones_like(done[:, :1]), done], 1)
        # Ends of one environment follow each other in row order, so that an episode's return is
        # the difference of neighbouring totals; the first of each row has no predecessor.
        rows = end.nonzero()[:, 0]
        first = torch.ones_like(rows, dtype=torch.bool)
        first[1:] = rows[1:] != rows[:-1]
        returns = total[end].diff(prepend=total.new_zeros(1))[~first]
        lengths = clock[end].diff(prepend=clock.new_zeros(1))[~first]
        last = first.roll(-1)
        self.running_return.copy_(total[:, -1] - total[end][last])
        self.running_length.copy_(clock[:, -1] - clock[end][last])
        return returns, lengths


class _Continuity:
    """Tells which environments do not go on from where the last batch left them."""

    def __init__(self) -> None:
        self.onward: Tensor | None = None

    def moved(self, batch: TensorDictBase) -> Tensor:
        """A mask ``(num_envs,)`` for a batch ``(num_envs, time)``, the next one."""
        first = batch.get("observation")[:, 0]
        before = first if self.onward is None else self.onward
        onward = batch.get(("next", "following_observation"), None)
        onward = batch.get(("next", "observation")) if onward is None else onward
        self.onward = onward[:, -1].clone()
        return (first != before).flatten(1).any(1)


class EpisodeClock:
    """Counts the steps of running episodes across batches.

    Where an environment does not go on from where it was, an episode begins.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> states = torch.arange(4.0).reshape(1, 4, 1)
        >>> done = torch.tensor([[False, True, False, False]]).unsqueeze(-1)
        >>> after = {"observation": states + 1, "done": done}
        >>> batch = TensorDict({"observation": states, "next": after}, [1, 4])
        >>> EpisodeClock()(batch)
        tensor([[0, 1, 0, 1]])
    """

    def __init__(self) -> None:
        self._continuity = _Continuity()
        self._before = torch.zeros(0, dtype=torch.int64)

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """The steps ``(num_envs, time)`` before each one of its episode."""
        done = batch.get(("next", "done")).squeeze(-1)
        if not len(self._before):
            self._before = torch.zeros(len(done), dtype=torch.int64, device=done.device)
        moved = self._continuity.moved(batch)
        steps = steps_before(done, self._before.masked_fill(moved, 0))
        self._before = (steps[:, -1] + 1).masked_fill(done[:, -1], 0)
        return steps

    def state_dict(self) -> dict[str, Any]:
        """What the next batch's steps depend on."""
        return {"before": self._before, "onward": self._continuity.onward}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self._before, self._continuity.onward = state["before"], state["onward"]


class HeldEpisodes:
    """Holds back the steps of running episodes until their episode ends.

    Rewards that are known only then, such as Sinkhorn's, are computed of whole episodes.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> def batch(states, ends):
        ...     states = torch.tensor(states)
        ...     after = {"observation": states + 1, "done": torch.tensor(ends).unsqueeze(-1)}
        ...     return TensorDict({"observation": states, "next": after}, states.shape[:2])
        >>> held = HeldEpisodes()
        >>> held.add(batch([[[0.0], [1.0]]], [[False, False]]))
        []
        >>> [whole] = held.add(batch([[[2.0], [7.0]]], [[True, False]]))
        >>> whole["observation"].flatten()
        tensor([0., 1., 2.])
    """

    def __init__(self) -> None:
        self._held: TensorDictBase | None = None
        self._begins: list[int] = []
        self._continuity = _Continuity()

    def add(self, batch: TensorDictBase) -> list[TensorDictBase]:
        """Takes a batch ``(num_envs, time)``; gives the episodes that end in it, ``(1, length)``.

        Where an environment does not go on from where it was, its running episode is dropped.
        """
        before = 0 if self._held is None else self._held.shape[1]
        moved = self._continuity.moved(batch)
        if self._held is None:
            self._held, self._begins = batch, [0] * batch.shape[0]
        else:
            for index in moved.nonzero().flatten().tolist():
                self._begins[index] = before
            self._held = torch.cat([self._held, batch], 1)
        episodes = []
        for index, step in batch.get(("next", "done")).squeeze(-1).nonzero().tolist():
            end = before + step + 1
            episodes.append(self._held[index : index + 1, self._begins[index] : end])
            self._begins[index] = end
        first = min(self._begins)
        self._held = self._held[:, first:]
        self._begins = [begin - first for begin in self._begins]
        return episodes

    def state_dict(self) -> dict[str, Any]:
        """The running episodes."""
        if self._held is None:
            return {}
        columns = dict(self._held.flatten_keys(".").items())
        return {
            "begins": self._begins,
            "columns": columns,
            "shape": list(self._held.shape),
            "onward": self._continuity.onward,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        if not state:
            self._held, self._begins, self._continuity.onward = None, [], None
            return
        self._held = TensorDict(state["columns"], state["shape"]).unflatten_keys(".")
        self._begins, self._continuity.onward = list(state["begins"]), state["onward"]
