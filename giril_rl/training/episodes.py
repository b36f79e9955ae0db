"""True returns and lengths of the episodes that end inside collected batches."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


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
