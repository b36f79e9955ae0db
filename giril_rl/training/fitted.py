"""The demonstration that a finished run learned from; nothing is made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from giril_rl.configs import DemoConfig, ExpertConfig, RunConfig, TaskConfig
from giril_rl.demos import Demonstration
from giril_rl.naming import config_hash
from giril_rl.training.expert import demonstration_place, expert_settings
from giril_rl.training.finished import read_config, read_part, read_result


def find_demonstration(folder: Path) -> Demonstration | None:
    """The demonstration of a finished run where it is still there; none is recorded for want of it.

    It is looked for in the run's ``root`` and, for runs that were moved or copied since, in each
    folder above the run's.

    Args:
        folder: the run's folder.

    Returns:
        The demonstration, or None if it is gone, or is another one than at the time of the run.

    Raises:
        UserError: if it is there and damaged.
    """
    config, result = read_config(folder), read_result(folder)
    demo = read_part(folder, config, "demo", DemoConfig)
    for place in _places(folder, config, demo):
        if (place / "card.json").is_file():
            found = Demonstration.load(place)
            return found if len(found) == result.get("demo_transitions") else None
    return None


def _places(folder: Path, config: dict[str, Any], demo: DemoConfig) -> list[Path]:
    if demo.path is not None:
        return [Path(demo.path)]
    task = read_part(folder, config, "task", TaskConfig)
    expert = read_part(folder, config, "expert", ExpertConfig)
    if expert.path is None:
        made_by = config_hash(expert_settings(RunConfig(task=task), expert))
    elif (Path(expert.path) / "result.json").is_file():
        made_by = str(read_result(Path(expert.path))["config_hash"])
    else:
        return []
    roots = [Path(config.get("root", "runs")), *folder.resolve().parents]
    return [root / demonstration_place(task, demo, made_by) for root in roots]
