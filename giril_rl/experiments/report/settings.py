"""In what a run's settings differ from its recipe's own, and which of that makes it another row."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any

from giril_rl.config.knobs import flat
from giril_rl.errors import UserError
from giril_rl.experiments.report.runs import RunRecord
from giril_rl.experiments.report.style import TRUE_REWARD, is_own
from giril_rl.runs.naming import NO_EFFECT

WITHOUT_PROFILE = frozenset(
    {"expert", TRUE_REWARD, "gail", "vail", "bc", "control:random", "control:held_action"}
)
"""Methods that never average rewards over environments, so that both profiles are one run."""
_OF_REWARDS = ("fit.", "demo.", "expert.", "giril.", "icm.")
_NOT_READ: dict[str, tuple[str, ...]] = {
    "control:constant": _OF_REWARDS,
    "control:copy": ("fit.", "icm."),
    "control:untrained_giril": ("fit.", "icm."),
    "control:untrained_icm": ("fit.", "giril."),
    "control:random": (*_OF_REWARDS, "ppo.", "scaling."),
    "control:held_action": (*_OF_REWARDS, "ppo.", "scaling."),
}
"""Settings that a control has and does not use, by how their keys begin."""
# What rows and panels are told apart by, and not by a change of settings.
_IDENTITY = NO_EFFECT | {"recipe", "seed", "steps", "task.name", "task.steps"}
_IDENTITY |= {"profile", "batch_mean"}
Changes = tuple[tuple[str, str], ...]
"""``(key, value as text)`` of the settings that are not the recipe's own, by key."""


@cache
def _defaults(recipe: str, task: str, env_id: str) -> dict[str, Any] | None:
    """A shipped recipe's own settings on a task, flat; None where there is no such recipe.

    A run that somebody sent may name any file, which is not to be run.
    """
    from giril_rl.config.compose import resolved
    from giril_rl.config.recipes import config_class, shipped

    try:
        found = {each.name: each for each in shipped()}[recipe]
        config = resolved(found, config_class(found), [_task_word(task, env_id)])[0]
    except (UserError, KeyError):
        return None
    return flat(json.loads(json.dumps(asdict(config))))


@cache
def _task_word(task: str, env_id: str) -> str:
    from giril_rl.config.compose import groups
    from giril_rl.config.recipes import find

    known = task in groups(find("control"))["task"][0]
    return f"task={task}" if known else f"task.env_id={env_id}"


def task_word(run: RunRecord) -> str:
    """How a run's task is named on the command line."""
    return _task_word(str(run.config["task.name"]), str(run.config.get("task.env_id")))


def text_of(value: Any) -> str:
    """A setting as it is written on the command line.

    Examples:
        >>> text_of(None), text_of(True), text_of([64, 64]), text_of(0.5)
        ('null', 'true', '[64,64]', '0.5')
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value).replace(" ", "") if isinstance(value, list) else str(value)


def changes_of(runs: Sequence[RunRecord]) -> dict[str, Changes]:
    """For each run's name, the settings that differ from what its recipe has for its task.

    A run of a recipe that is not shipped is compared with what most runs of that recipe have. A
    key that a run was made without, before it existed, is no difference.
    """
    usual = _usual(runs)
    found = {}
    for run in runs:
        task, env_id = str(run.config["task.name"]), str(run.config.get("task.env_id"))
        base = _defaults(run.recipe, task, env_id) or usual[run.recipe, task]
        differing = {
            key: text_of(value)
            for key, value in run.config.items()
            if key not in _IDENTITY
            and _reads(run, key)
            and not (key in base and base[key] == value)
        }
        # Asking for another player or recording is asking for none that is shipped.
        if differing.get("demo.path") == "null" and any(map(_of_players, differing)):
            del differing["demo.path"]
        found[run.name] = tuple(sorted(differing.items()))
    return found


def _of_players(key: str) -> bool:
    recorded = key.startswith("demo.") and key not in ("demo.path", "demo.subsample")
    return recorded or key.startswith("expert.")


def _reads(run: RunRecord, key: str) -> bool:
    """Whether a setting tells the run from others of its method.

    What stops early is called otherwise, and a control's reward is a part of its name.
    """
    method = method_of(run)
    if key == "stop_early":
        return method != TRUE_REWARD
    if key == "reward":
        return run.recipe != "control"
    return not key.startswith(_NOT_READ.get(method, ()))


def profile_of(run: RunRecord) -> str | None:
    """``released`` if rewards were averaged over environments, else ``paper``.

    None for what averages nothing in either profile: the shipped recipes that are known for it, and
    runs whose result says so.
    """
    no_difference = (run.result or {}).get("profile", "unknown") is None
    if no_difference or method_of(run) in WITHOUT_PROFILE:
        return None
    averaged = run.config.get("batch_mean", run.config.get("profile") == "released")
    return "released" if averaged else "paper"


def method_of(run: RunRecord) -> str:
    """The run's method; an expert that takes its whole budget is one to compare with."""
    whole = run.method == "expert" and run.config.get("stop_early") is False
    return TRUE_REWARD if whole else run.method


def _usual(runs: Iterable[RunRecord]) -> dict[tuple[str, str], dict[str, Any]]:
    values: dict[tuple[str, str], dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        for key, value in run.config.items():
            values[run.recipe, str(run.config["task.name"])][key].append(value)
    return {
        place: {key: max(each, key=each.count) for key, each in found.items()}
        for place, found in values.items()
    }


def split_task(changes: Changes) -> tuple[Changes, Changes]:
    """The changes that make the task another one, and the others.

    How long an expert is trained is none of the task's.

    Examples:
        >>> split_task((("ppo.lr", "0.1"), ("task.horizon", "fixed"), ("termination", "bootstrap")))
        ((('task.horizon', 'fixed'), ('termination', 'bootstrap')), (('ppo.lr', '0.1'),))
    """
    of_task = tuple(
        (key, value)
        for key, value in changes
        if key == "termination" or (key.startswith("task.") and not key.startswith("task.expert_"))
    )
    return of_task, tuple(c for c in changes if c not in of_task)


def shared_changes(
    runs: Sequence[RunRecord], changes: Mapping[str, Changes], keep: frozenset[str]
) -> Changes:
    """Changes that all runs of one task have in common: the study's own settings, no row's.

    A key counts where runs of at least two methods have it and all that have it agree. What a
    recipe of the user's own has usually is no change of it, and agrees as well.

    Args:
        runs: runs of one task.
        changes: of each run, by its name.
        keep: keys that a table is about; they always make rows.
    """
    candidates = {change for run in runs for change in changes[run.name] if change[0] not in keep}
    found = []
    for change in sorted(candidates):
        having = [
            run
            for run in runs
            if change[0] in run.config and _reads(run, change[0]) and method_of(run) != "expert"
        ]
        methods = {method_of(run) for run in having}
        agree = (
            change in changes[run.name]
            or (is_own(run.method) and text_of(run.config[change[0]]) == change[1])
            for run in having
        )
        if len(methods) > 1 and all(agree):
            found.append(change)
    return tuple(found)
