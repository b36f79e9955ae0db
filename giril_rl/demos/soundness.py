"""Are a demonstration's transitions complete, finite, of the right shapes and aligned?

The paper's released loader paired states with the wrong actions and crossed episodes. Each check
here refuses one such fault before anything is learned from it.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError

_FLAGS: list[NestedKey] = [("next", "done"), ("next", "terminated"), ("next", "truncated")]
_KEYS: list[NestedKey] = [
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    *_FLAGS,
    "episode",
    "step",
]


def check_transitions(data: TensorDict, *, may_cut_last: bool, actions: bool = True) -> None:
    """Refuses transitions with a fault that would teach something wrong.

    Args:
        data: as :class:`~giril_rl.demos.Demonstration` describes; not changed.
        may_cut_last: whether the last episode may stop without an end.
        actions: whether there are actions, or states alone.

    Raises:
        UserError: naming the first fault found and where it is.
    """
    _check_tensors(data, _KEYS if actions else [key for key in _KEYS if key != "action"])
    _check_episodes(data, may_cut_last=may_cut_last)


def fault(sentence: str) -> UserError:
    """The refusal of a demonstration."""
    return UserError(f"the demonstration {sentence}")


def first_true(where: Tensor) -> int:
    """Index along the first dimension of the first true element of ``where``."""
    rows = where.flatten(1).any(1) if where.ndim > 1 else where
    return int(rows.nonzero()[0, 0])


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def _check_tensors(data: TensorDict, keys: list[NestedKey]) -> None:
    found = set(data.keys(include_nested=True, leaves_only=True))
    if "action" in found and "action" not in keys:
        raise fault("has actions and a card that says that it has none: mend the card.")
    for key in keys:
        if key not in found:
            raise fault(f"has no {_name(key)!r}: record it with giril_rl.")
    if data.ndim != 1 or data.shape[0] == 0:
        raise fault(
            f"is empty or not flat (shape {list(data.shape)}): it needs [N] transitions, N > 0."
        )
    if data.shape[0] == 1:
        raise fault("has only one transition: at least 2 are needed.")
    for key in keys:
        _check_tensor(_name(key), data.get(key), data.shape[0])
    if data["observation"].shape != data["next", "observation"].shape:
        raise fault("has observations and next observations of different shapes: record it anew.")
    differs = data["next", "done"] != (data["next", "terminated"] | data["next", "truncated"])
    if differs.any():
        raise fault(
            f"has done at index {first_true(differs)} that is not terminated or truncated: record "
            "it anew."
        )


def _check_tensor(name: str, value: Tensor, length: int) -> None:
    dtype, sizes = torch.float32, ["n"]
    if name in ("episode", "step") or (name == "action" and value.ndim == 1):
        dtype, sizes = torch.int64, []
    elif name == "next.reward":
        sizes = ["1"]
    elif name in map(_name, _FLAGS):
        dtype, sizes = torch.bool, ["1"]
    elif value.dtype == torch.uint8 and name != "action":
        dtype, sizes = torch.uint8, ["c", "h", "w"]  # Stacked frames.
    shape = list(value.shape)
    fits = len(shape) == 1 + len(sizes) and shape[0] == length
    if value.dtype != dtype or not fits or (sizes == ["1"] and shape[1] != 1):
        wanted = f"[{', '.join([str(length), *sizes])}]"
        raise fault(f"has {name} of {value.dtype} and shape {shape}: it must be {dtype} {wanted}.")
    if value.is_floating_point() and not value.isfinite().all():
        index = first_true(~value.isfinite())
        raise fault(f"has NaN or infinity in {name} at index {index}: mend or record it anew.")


def _check_episodes(data: TensorDict, *, may_cut_last: bool) -> None:
    episode, step = data["episode"], data["step"]
    jump = episode.diff(prepend=episode.new_tensor([-1]))
    fresh = jump == 1
    wrong = (jump != 0) & ~fresh
    wrong[0] = episode[0] != 0
    if wrong.any():
        index = first_true(wrong)
        raise fault(
            f"has episode {int(episode[index])} out of order at index {index}: "
            "episodes must be numbered 0, 1, 2, ... without gaps."
        )
    wrong = step != torch.where(fresh, 0, step.roll(1) + 1)
    if wrong.any():
        index = first_true(wrong)
        raise fault(
            f"has step {int(step[index])} of episode {int(episode[index])} out of order at index "
            f"{index}: steps must be numbered 0, 1, 2, ... without gaps."
        )
    done = data["next", "done"].reshape(-1)
    last = torch.cat([fresh[1:], torch.ones(1, dtype=torch.bool)])
    if (done & ~last).any():
        index = first_true(done & ~last)
        raise fault(
            f"goes on after done at index {index}, in the middle of episode {int(episode[index])}: "
            "start a new episode there."
        )
    cut = last & ~done
    if may_cut_last:
        cut[-1] = False
    if cut.any():
        index = first_true(cut)
        raise fault(
            f"has an episode {int(episode[index])} that stops at index {index} without done: "
            "its end is lost; mark it truncated if the episode ended there, or record it anew."
        )
    moved = _differ(data["next", "observation"][:-1], data["observation"][1:]) & ~last[:-1]
    if moved.any():
        index = first_true(moved)
        raise fault(
            f"is misaligned: next.observation[{index}] is not observation[{index + 1}] within "
            f"episode {int(episode[index])}, so actions may not belong to their states or an end "
            "is not marked; mend or record it anew."
        )


def _differ(left: Tensor, right: Tensor, rows: int = 1024) -> Tensor:
    """Which rows differ, bool [N]; compared in parts, as a game's images may fill the memory."""
    parts = [
        (a != b).flatten(1).any(1) for a, b in zip(left.split(rows), right.split(rows), strict=True)
    ]
    return torch.cat(parts)
