"""Is a demonstration sound, and is it one of this task?"""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data import TensorSpec

from giril_rl.config.schema import TaskConfig, split_id
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.soundness import fault, first_true
from giril_rl.envs import spaces_of
from giril_rl.errors import UserError


def check_demonstration(
    demo: Demonstration,
    observation_dim: int | Sequence[int] | None = None,
    action_spec: TensorSpec | None = None,
) -> None:
    """Refuses a demonstration with a fault that would teach something wrong.

    Args:
        demo: what to check; not changed.
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
    demo.check()
    if observation_dim is not None:
        _check_shape(list(demo.transitions["observation"].shape[1:]), observation_dim)
    if action_spec is not None and demo.has_actions:
        _check_actions(demo.transitions["action"], action_spec)


def check_for_task(demo: Demonstration, task: TaskConfig) -> None:
    """:func:`check_demonstration` with the spaces of ``task``."""
    check_demonstration(demo, *spaces_of(task))


def check_whole_episode(demo: Demonstration, what: str) -> None:
    """Refuses a demonstration that is one cut episode.

    Args:
        demo: the demonstration, as much of it as is used.
        what: what needs a whole episode, for the message.

    Raises:
        UserError: if no episode has an end.
    """
    if not demo.transitions["next", "done"].any():
        raise fault(
            f"has no whole episode and {what} needs one: its {len(demo):,} transitions are the "
            "beginning of one. Use more of it (demo.first), or a longer one (demo.length)."
        )


def check_environment(demo: Demonstration, task: TaskConfig) -> None:
    """Refuses a demonstration whose card names another environment.

    All Atari games have the same observations, and many have as many actions, with other meanings.
    Other versions of the same environment pass.

    Raises:
        UserError: naming both environments.
    """
    recorded = demo.card.get("env_id")
    if isinstance(recorded, str) and _unversioned(recorded) != _unversioned(task.env_id):
        raise UserError(
            f"the demonstration is of {recorded} and not of {task.env_id}: use one of this task, "
            "or, if the two are one environment, take env_id out of its card.json."
        )


def _unversioned(env_id: str) -> str:
    return re.sub(r"-v\d+$", "", split_id(env_id)[1])


def _check_shape(found: list[int], wanted: int | Sequence[int]) -> None:
    wanted = [wanted] if isinstance(wanted, int) else list(wanted)
    if found == wanted:
        return
    if len(found) == len(wanted) == 1:
        difference = f"{found[0]} numbers in an observation and the task has {wanted[0]}"
    else:
        difference = f"observations of shape {found} and the task of shape {wanted}"
    raise fault(f"has {difference}: use a demonstration of this task.")


def _check_actions(action: Tensor, spec: TensorSpec) -> None:
    discrete = not spec.dtype.is_floating_point
    if discrete != (action.dtype == torch.int64):
        kinds = ("discrete", "continuous") if discrete else ("continuous", "discrete")
        raise fault(f"has {kinds[1]} actions and the task {kinds[0]} ones: use another one.")
    if discrete:
        low, high = torch.tensor(0), torch.tensor(spec.space.n - 1)
    else:
        if action.shape[-1] != spec.shape[-1]:
            raise fault(
                f"has {action.shape[-1]} numbers in an action and the task has {spec.shape[-1]}: "
                "use a demonstration of this task."
            )
        if not hasattr(spec.space, "low"):
            return
        low, high = (
            bound.cpu().reshape(-1, action.shape[-1])[0]
            for bound in (spec.space.low, spec.space.high)
        )
    outside = (action < low) | (action > high)
    if outside.any():
        index = first_true(outside)
        raise fault(
            f"has the action {action[index].tolist()} at index {index}, outside "
            f"[{low.tolist()}, {high.tolist()}]: record actions as executed."
        )
