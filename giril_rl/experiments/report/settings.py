"""How a run's settings differ from its recipe's own, and which differences make another row."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any, get_type_hints

from giril_rl.config.compose import groups, resolved
from giril_rl.config.knobs import flat
from giril_rl.config.recipes import config_class, find, shipped
from giril_rl.config.schema import AveragedRunConfig, idle_algorithm
from giril_rl.config.tasks import chooses_demonstration
from giril_rl.errors import UserError
from giril_rl.experiments.report.entries import PLAYER, TRUE_REWARD, entry, is_own
from giril_rl.experiments.report.reading import RunRecord
from giril_rl.methods import ControlRunConfig
from giril_rl.rewards.method import Method, registered
from giril_rl.runs.identity import ADDED, NO_EFFECT

# Other fields of a row or a panel hold these.
_IDENTITY = NO_EFFECT | {"recipe", "seed", "steps", "task.name", "task.steps"}
_IDENTITY |= {"profile", "batch_mean", "algorithm"}
Changes = tuple[tuple[str, str], ...]
"""``(key, value as text)`` of the settings that differ from the recipe's own, by key."""


@cache
def _defaults(recipe: str, task: str, env_id: str) -> dict[str, Any] | None:
    """A shipped recipe's own settings on a task, flat; None for any other recipe.

    The settings of somebody else's run may name any file: it must not be executed.
    """
    try:
        found = {each.name: each for each in shipped()}[recipe]
        config = resolved(found, config_class(found), [_task_word(task, env_id)])[0]
    except (UserError, KeyError):
        return None
    return flat(json.loads(json.dumps(asdict(config))))


@cache
def _never_averages() -> frozenset[str]:
    """Shipped recipes whose rewards are averaged in neither profile."""
    return frozenset(
        each.name for each in shipped() if not issubclass(config_class(each), AveragedRunConfig)
    )


@cache
def _task_word(task: str, env_id: str) -> str:
    known = task in groups(find("control"))["task"][0]
    return f"task={task}" if known else f"task.env_id={env_id}"


def task_words(run: RunRecord, recipe: str, changes: Changes) -> list[str]:
    """The overrides that give a shipped recipe a run's task with those changes that it knows."""
    known = _defaults(recipe, run.task, run.env_id) or {}
    words = [f"{key}={value}" for key, value in changes if key in known]
    return [_task_word(run.task, run.env_id), *words]


def text_of(value: Any) -> str:
    """A setting as it is written on the command line.

    Examples:
        >>> text_of(None), text_of(True), text_of([64, 64]), text_of(0.5)
        ('null', 'true', '[64,64]', '0.5')
    """
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    return str(value).replace(" ", "") if isinstance(value, list) else str(value)


def changes_of(runs: Sequence[RunRecord]) -> dict[str, Changes]:
    """For each run's name, the settings that differ from its recipe's own for that task.

    Runs of a recipe that is not shipped are compared with the settings that most of them have. A
    key that a run lacks, because it is older than the key, has the value that it behaved by, if
    that is known, and is no difference otherwise.
    """
    usual = _usual(runs)
    found = {}
    for run in runs:
        own = _defaults(run.recipe, run.task, run.env_id) or usual[run.recipe, run.task]
        base = ADDED | own
        differing = {
            key: text_of(value)
            for key, value in ({k: ADDED[k] for k in ADDED if k in own} | run.config).items()
            if key not in _IDENTITY
            and not (key in base and base[key] == value)
            and _reads(run, key)
        }
        # A request for another player or recording implies that the shipped one is not used.
        if differing.get("demo.path") == "null" and any(map(_of_players, differing)):
            del differing["demo.path"]
        found[run.name] = tuple(sorted(differing.items()))
    return found


def _usual(runs: Iterable[RunRecord]) -> dict[tuple[str, str], dict[str, Any]]:
    values: dict[tuple[str, str], dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        for key, value in run.config.items():
            values[run.recipe, run.task][key].append(value)
    return {
        place: {key: max(each, key=each.count) for key, each in found.items()}
        for place, found in values.items()
    }


def _of_players(key: str) -> bool:
    return key != "demo.path" and chooses_demonstration(key)


def _reads(run: RunRecord, key: str) -> bool:
    """Whether a setting has an effect on the run that its method's name does not tell."""
    if key == "stop_early":
        return run.method != TRUE_REWARD
    if key == "reward":
        return run.recipe != "control"
    idle = f"{idle_algorithm(run.config.get('algorithm'))}."
    return not key.startswith((idle, *_ignored(entry(run.method))))


@cache
def _ignored(about: Method) -> tuple[str, ...]:
    """How those keys of the recipe ``control`` begin that a control ignores, by its entry."""
    if about.kind != "control" or is_own(about.name):
        return ()
    of_rewards = {other.settings for other in registered().values()} - {None, about.settings}
    parts = get_type_hints(ControlRunConfig).items()
    found = [f"{name}." for name, kind in parts if kind in of_rewards]
    if about.trained != "before":
        found.append("fit.")
    if not about.demonstration:
        found += ["demo.", "expert.", "sac.demonstration"]
    if about.build is None:  # It has no reward, and so no policy to train.
        found += ["ppo.", "sac.", "scaling.", "batch_mean"]
    return tuple(found)


def profile_of(run: RunRecord) -> str | None:
    """``released`` if rewards were averaged over environments, else ``paper``.

    None if both profiles give the same run.
    """
    same = run.result.get("profile", "unknown") is None or run.recipe in _never_averages()
    if same or not _reads(run, "batch_mean"):
        return None
    averaged = run.config.get("batch_mean", run.config.get("profile") == "released")
    return "released" if averaged else "paper"


def split_task(changes: Changes) -> tuple[Changes, Changes]:
    """The changes that make the task another one, and the others.

    The training of the task's expert is not part of the task.

    Examples:
        >>> split_task((("ppo.lr", "0.1"), ("task.horizon", "fixed"), ("termination", "bootstrap")))
        ((('task.horizon', 'fixed'), ('termination', 'bootstrap')), (('ppo.lr', '0.1'),))
    """
    of_task = tuple(
        (key, value)
        for key, value in changes
        if key == "termination" or (key.startswith("task.") and not key.startswith("task.expert_"))
    )
    return of_task, tuple(change for change in changes if change not in of_task)


def shared_changes(
    runs: Sequence[RunRecord], changes: Mapping[str, Changes], keep: frozenset[str]
) -> Changes:
    """Changes that all runs of one task share: they describe the study and make no rows.

    A change counts if runs of at least two methods have its key and all of them agree. Your own
    recipe agrees if its usual value is the same. The keys in ``keep`` always make rows.
    """
    candidates = {change for run in runs for change in changes[run.name] if change[0] not in keep}
    found = []
    for key, value in sorted(candidates):
        having = [
            run for run in runs if key in run.config and _reads(run, key) and run.method != PLAYER
        ]
        agree = all(
            (key, value) in changes[run.name]
            or (is_own(run.method) and text_of(run.config[key]) == value)
            for run in having
        )
        if agree and len({run.method for run in having}) > 1:
            found.append((key, value))
    return tuple(found)
