"""The demonstration that a finished run learned from; nothing is made."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from giril_rl.config.schema import DemoConfig, ExpertConfig, RunConfig, TaskConfig
from giril_rl.demos import Demonstration
from giril_rl.demos.shipped import demonstration_folder, is_shipped
from giril_rl.errors import UserError
from giril_rl.runs.finished import read_config, read_part, read_result
from giril_rl.runs.identity import config_hash
from giril_rl.training.expert import demonstration_place, expert_settings


def find_demonstration(folder: Path, within: Path) -> Demonstration | None:
    """The demonstration of a finished run where it is still there; none is recorded for want of it.

    It is looked for where the run's settings say, and, for runs that were moved or copied since and
    for settings of another current directory, in the same way in each folder from the run's up to
    ``within``. The settings of a run that somebody sent may name any file, so nothing that lies
    elsewhere is read.

    Args:
        folder: the run's folder.
        within: the folder above it outside of which nothing is read.

    Returns:
        The demonstration, or None if it is not there, or is another one than at the time of the
        run.

    Raises:
        UserError: if it is there and damaged, or the run's settings are not what a run writes.
    """
    config, result = read_config(folder), read_result(folder)
    demo = read_part(folder, config, "demo", DemoConfig)
    place: Path | None
    if demo.path is not None and is_shipped(demo.path):
        task = read_part(folder, config, "task", TaskConfig)
        place = demonstration_folder(demo.path, task, result["seed"])
    else:
        places = _places(folder, within, config, result, demo)
        place = next((path for path in places if _is_inside(path / "card.json", within)), None)
    if place is None:
        return None
    found = Demonstration.load(place)
    return found if len(found) == result.get("demo_transitions") else None


def _places(
    folder: Path, within: Path, config: dict[str, Any], result: dict[str, Any], demo: DemoConfig
) -> Iterator[Path]:
    """Where the demonstration may lie."""
    if demo.path is not None:
        yield from _readings(demo.path, folder, within)
        return
    root = config.get("root", "runs")
    if not isinstance(root, str):
        raise UserError(f"{folder / 'config.yaml'}: root={root}: text is needed.")
    task = read_part(folder, config, "task", TaskConfig)
    expert = read_part(folder, config, "expert", ExpertConfig)
    run = RunConfig(task=task, seed=result["seed"])
    made_by = None
    if expert.path is None:
        made_by = config_hash(expert_settings(run, expert))
    else:
        for place in _readings(expert.path, folder, within):
            if _is_inside(place / "result.json", within):
                made_by = str(read_result(place)["config_hash"])
                break
    if made_by is not None:
        below = demonstration_place(run, demo, made_by)
        for place in (*_readings(root, folder, within), *_above(folder, within)):
            yield place / below


def _readings(path: str, folder: Path, within: Path) -> Iterator[Path]:
    """What a path in a run's settings may mean: as it is, and below each folder above the run's."""
    yield Path(path)
    for above in _above(folder, within):
        yield above / path


def _above(folder: Path, within: Path) -> list[Path]:
    """The folders above a run's, up to and with ``within``."""
    top = within.resolve()
    return [path for path in folder.resolve().parents if path.is_relative_to(top)]


def _is_inside(file: Path, within: Path) -> bool:
    """Whether there is such a file, wherever links lead, below ``within``."""
    try:
        return file.resolve().is_relative_to(within.resolve()) and file.is_file()
    except (OSError, ValueError, RuntimeError):  # A null byte, a name too long, links in a circle.
        return False
