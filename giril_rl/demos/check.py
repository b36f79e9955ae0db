"""Is a demonstration what it says: aligned, whole, finite and of the right shape?

The paper's released loader paired states with the wrong actions and crossed episodes. Each of
these checks refuses one such fault before anything is learned from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError

if TYPE_CHECKING:
    from torchrl.data import TensorSpec

    from giril_rl.demos.demonstration import Demonstration

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


def check_demonstration(
    demo: Demonstration,
    observation_dim: int | Sequence[int] | None = None,
    action_spec: TensorSpec | None = None,
) -> None:
    """Refuse a demonstration with a fault that would teach something wrong.

    Args:
        demo: what to check; nothing of it is changed.
        observation_dim: numbers in an observation of the task, or its shape, such as
            ``(4, 84, 84)`` for images, if known.
        action_spec: the task's action spec (TorchRL, batched or not), if known.

    Raises:
        UserError: naming the first fault found and where it is.

    Examples:
        >>> import gymnasium
        >>> from giril_rl.demos import Demonstration, record_demonstration
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), lambda o: o.new_ones(1).long(),
        ...     episodes=1, seed=0,
        ... )
        >>> late = demo.transitions.clone()
        >>> late["observation"] = late["observation"].roll(1, 0)
        >>> check_demonstration(Demonstration(late, demo.card))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: the demonstration is misaligned: next.observation[0] ...
    """
    data = demo.transitions
    _check_tensors(data)
    _check_task(data, observation_dim, action_spec)
    _check_episodes(data, may_cut_last=demo.card.get("length") is not None)


def _fault(sentence: str) -> UserError:
    return UserError(f"the demonstration {sentence}")


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def _first(where: Tensor) -> int:
    """Index along the first dimension of the first true element of ``where``."""
    return (
        int(where.flatten(1).any(1).nonzero()[0, 0]) if where.ndim > 1 else int(where.nonzero()[0])
    )


def _check_tensors(data: TensorDict) -> None:
    found = set(data.keys(include_nested=True, leaves_only=True))
    for key in _KEYS:
        if key not in found:
            raise _fault(f"has no {_name(key)!r}: record it with giril_rl.")
    if data.ndim != 1 or data.shape[0] == 0:
        raise _fault(
            f"is empty or not flat (shape {list(data.shape)}): it needs [N] transitions, N > 0."
        )
    if data.shape[0] == 1:
        raise _fault("has only one transition: at least 2 are needed.")
    for key in _KEYS:
        _check_tensor(_name(key), data.get(key), data.shape[0])
    if data["observation"].shape != data["next", "observation"].shape:
        raise _fault("has observations and next observations of different shapes: record it anew.")
    differs = data["next", "done"] != (data["next", "terminated"] | data["next", "truncated"])
    if differs.any():
        raise _fault(
            f"has done at index {_first(differs)} that is not terminated or truncated: record it "
            "anew."
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
        raise _fault(f"has {name} of {value.dtype} and shape {shape}: it must be {dtype} {wanted}.")
    if value.is_floating_point() and not value.isfinite().all():
        index = _first(~value.isfinite())
        raise _fault(f"has NaN or infinity in {name} at index {index}: mend or record it anew.")


def _check_task(
    data: TensorDict, observation_dim: int | Sequence[int] | None, action_spec: TensorSpec | None
) -> None:
    if observation_dim is not None:
        _check_shape(list(data["observation"].shape[1:]), observation_dim)
    if action_spec is None:
        return
    action = data["action"]
    discrete = not action_spec.dtype.is_floating_point
    if discrete != (action.dtype == torch.int64):
        kinds = ("discrete", "continuous") if discrete else ("continuous", "discrete")
        raise _fault(f"has {kinds[1]} actions and the task {kinds[0]} ones: use another one.")
    if discrete:
        low, high = torch.tensor(0), torch.tensor(action_spec.space.n - 1)
    else:
        if action.shape[-1] != action_spec.shape[-1]:
            raise _fault(
                f"has {action.shape[-1]} numbers in an action and the task has "
                f"{action_spec.shape[-1]}: use a demonstration of this task."
            )
        if not hasattr(action_spec.space, "low"):
            return
        low, high = (
            bound.cpu().reshape(-1, action.shape[-1])[0]
            for bound in (action_spec.space.low, action_spec.space.high)
        )
    outside = (action < low) | (action > high)
    if outside.any():
        index = _first(outside)
        raise _fault(
            f"has the action {action[index].tolist()} at index {index}, outside "
            f"[{low.tolist()}, {high.tolist()}]: record actions as executed."
        )


def _check_shape(found: list[int], wanted: int | Sequence[int]) -> None:
    wanted = [wanted] if isinstance(wanted, int) else list(wanted)
    if found == wanted:
        return
    if len(found) == len(wanted) == 1:
        difference = f"{found[0]} numbers in an observation and the task has {wanted[0]}"
    else:
        difference = f"observations of shape {found} and the task of shape {wanted}"
    raise _fault(f"has {difference}: use a demonstration of this task.")


def _check_episodes(data: TensorDict, *, may_cut_last: bool) -> None:
    episode, step = data["episode"], data["step"]
    jump = episode.diff(prepend=episode.new_tensor([-1]))
    fresh = jump == 1
    wrong = (jump != 0) & ~fresh
    wrong[0] = episode[0] != 0
    if wrong.any():
        raise _fault(
            f"has episode {int(episode[_first(wrong)])} out of order at index {_first(wrong)}: "
            "episodes must be numbered 0, 1, 2, ... without gaps."
        )
    previous = step.roll(1)
    wrong = step != torch.where(fresh, 0, previous + 1)
    if wrong.any():
        index = _first(wrong)
        raise _fault(
            f"has step {int(step[index])} of episode {int(episode[index])} out of order at index "
            f"{index}: steps must be numbered 0, 1, 2, ... without gaps."
        )
    done = data["next", "done"].reshape(-1)
    last = torch.cat([fresh[1:], torch.ones(1, dtype=torch.bool)])
    if (done & ~last).any():
        index = _first(done & ~last)
        raise _fault(
            f"goes on after done at index {index}, in the middle of episode {int(episode[index])}: "
            "start a new episode there."
        )
    cut = last & ~done
    if may_cut_last:
        cut[-1] = False
    if cut.any():
        index = _first(cut)
        raise _fault(
            f"has an episode {int(episode[index])} that stops at index {index} without done: "
            "its end is lost; mark it truncated if the episode ended there, or record it anew."
        )
    moved = _differ(data["next", "observation"][:-1], data["observation"][1:]) & ~last[:-1]
    if moved.any():
        index = _first(moved)
        raise _fault(
            f"is misaligned: next.observation[{index}] is not observation[{index + 1}] within "
            f"episode {int(episode[index])}, so actions may not belong to their states or an end "
            "is not marked; mend or record it anew."
        )


def _differ(left: Tensor, right: Tensor, rows: int = 1024) -> Tensor:
    """Which rows differ, bool [N]; some at a time, as a game's images may fill the memory."""
    parts = [
        (a != b).flatten(1).any(1) for a, b in zip(left.split(rows), right.split(rows), strict=True)
    ]
    return torch.cat(parts)
