"""Learning from preferences: the Bradley-Terry loss, and pairs of snippets of ranked episodes."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.runs.randomness import stream_seed


def preference_loss(better: Tensor, worse: Tensor) -> Tensor:
    """``-log P(better over worse)`` of two sums of rewards (Bradley and Terry; D-REX's eq. 2).

    ``P = exp(better) / (exp(better) + exp(worse))``, the logistic function of their difference.

    Examples:
        >>> preference_loss(torch.tensor([0.0, 2.0]), torch.tensor([0.0, 0.0]))
        tensor([0.6931, 0.1269])
    """
    return F.softplus(worse - better)


def snippet_rows(
    noise: Tensor,
    lengths: Tensor,
    *,
    pairs: int,
    snippet: int,
    margin: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Draws pairs of snippets, of which the less noisy one is preferred.

    Two episodes are drawn uniformly from all pairs whose noise differs by ``margin`` or more; of
    each, ``snippet`` consecutive steps from a random one on, or the whole of a shorter episode.

    Args:
        noise: of each episode, ``(episodes,)``.
        lengths: steps of each episode; the episodes' rows follow one another.
        pairs: how many.
        snippet: most steps.
        margin: least difference of noise.
        generator: what draws.

    Returns:
        Rows of the better and of the worse snippets, int64 ``(pairs, snippet)`` each; -1 fills up
        what is shorter.

    Raises:
        UserError: if no two episodes differ so much.

    Examples:
        >>> better, worse = snippet_rows(
        ...     torch.tensor([0.9, 0.1]), torch.tensor([2, 3]), pairs=1, snippet=3, margin=0.5,
        ...     generator=torch.Generator(),
        ... )
        >>> better.tolist(), worse.tolist()
        ([[2, 3, 4]], [[0, 1, -1]])
    """
    # Levels such as 0.3 - 0.0 and 0.35 - 0.05 are to differ alike.
    ranked = (noise.double().unsqueeze(0) - noise.double().unsqueeze(1) >= margin - 1e-6).nonzero()
    if not len(ranked):
        raise UserError(
            f"no two noise levels differ by {margin}: set a smaller reward.margin, or levels that "
            "are farther apart."
        )
    chosen = ranked[torch.randint(len(ranked), (pairs,), generator=generator)]
    share = torch.rand(pairs, 2, generator=generator, dtype=torch.float64)
    length = lengths[chosen]
    begin = (share * (length - snippet + 1).clamp(min=1)).long()
    first = (lengths.cumsum(0) - lengths)[chosen]
    time = torch.arange(snippet)
    rows = (first + begin).unsqueeze(-1) + time
    rows = torch.where(time < length.unsqueeze(-1), rows, -1)
    return rows[:, 0], rows[:, 1]


def snippet_pairs(
    noise: Tensor,
    lengths: Tensor,
    *,
    members: int,
    pairs: int,
    snippet: int,
    margin: float,
    seed: int,
) -> tuple[TensorDict, TensorDict]:
    """Each member's own pairs: four fifths to fit, one fifth for validation.

    Args:
        noise: of each episode, ``(episodes,)``.
        lengths: steps of each episode.
        members: of the ensemble.
        pairs: of each member.
        snippet: most steps.
        margin: least difference of noise.
        seed: of the draws.

    Returns:
        Two TensorDicts, batches ``(n,)``, with ``"better"`` and ``"worse"``, rows ``(n, members,
        snippet)`` as of :func:`snippet_rows`.

    Examples:
        >>> fitted, validation = snippet_pairs(
        ...     torch.tensor([0.0, 0.5]), torch.tensor([20, 20]), members=3, pairs=10, snippet=7,
        ...     margin=0.3, seed=0,
        ... )
        >>> fitted["better"].shape, len(validation)
        (torch.Size([8, 3, 7]), 2)
    """
    drawn = snippet_rows(
        noise,
        lengths,
        pairs=pairs * members,
        snippet=snippet,
        margin=margin,
        generator=torch.Generator().manual_seed(stream_seed("ranking", seed)),
    )
    better, worse = (rows.reshape(pairs, members, -1) for rows in drawn)
    both = TensorDict({"better": better, "worse": worse}, [pairs])
    return both[pairs // 5 :], both[: pairs // 5]
