"""Run folders read for a report: settings, result, and what became of those without one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from giril_rl.config.knobs import flat
from giril_rl.config.schema import is_atari
from giril_rl.errors import UserError
from giril_rl.files.formats import check_run_format
from giril_rl.files.untrusted import parse_json, parse_yaml, read_text
from giril_rl.runs.finished import read_result
from giril_rl.runs.metrics import METRICS, read_metrics


@dataclass(frozen=True)
class RunRecord:
    """One run's folder.

    Attributes:
        folder: the folder.
        name: the folder as seen from the folder that is reported on.
        config: its settings as ``{dotted key: value}``.
        result: what ``result.json`` holds, None for an unfinished run.
        below: the folder that is reported on.
    """

    folder: Path
    name: str
    config: dict[str, Any]
    result: dict[str, Any] | None
    below: Path

    @property
    def recipe(self) -> str:
        """The recipe's name."""
        return str(self.config["recipe"])

    @property
    def method(self) -> str:
        """The recipe's name, whatever its result says; a control's with its reward."""
        if self.recipe != "control":
            return self.recipe
        return str((self.result or {}).get("method", f"control:{self.config.get('reward')}"))

    @property
    def score(self) -> float | None:
        """Mean return of the policy as trained; None for an unfinished run."""
        return None if self.result is None else float(self.result["return_mean"])

    @property
    def seed(self) -> int:
        """The seed of the policy's training."""
        return int(self.config["seed"])

    @property
    def steps(self) -> int:
        """The budget that the run was given."""
        return int(self.config["steps"])

    @property
    def is_atari(self) -> bool:
        """Whether its task is a game of the Arcade Learning Environment."""
        return is_atari(str(self.config.get("task.env_id")))

    def metrics(self) -> list[dict[str, Any]]:
        """The rows of its ``metrics.jsonl``."""
        return read_metrics(self.folder / METRICS)


@dataclass(frozen=True)
class Unfinished:
    """A run without a result.

    Attributes:
        name: its folder as seen from the folder that is reported on.
        state: in words: failed, interrupted, unfinished, not finished yet.
        steps: environment steps on record, and the budget.
        reason: the last line of its log, where a study knows one.
    """

    name: str
    state: str
    steps: str
    reason: str


def read_runs(folder: Path) -> tuple[list[RunRecord], list[Unfinished]]:
    """All runs below a folder: the finished ones, and what is known of the others.

    Args:
        folder: where runs are, at any depth.

    Raises:
        UserError: where there is no finished run, or a result cannot be read.
    """
    finished: list[RunRecord] = []
    others: dict[str, Unfinished] = {}
    known = _standings(folder)
    for path in sorted(folder.rglob("config.yaml")):
        name = path.parent.relative_to(folder).as_posix()
        config = _config(path)
        if config is None:
            others[name] = Unfinished(name, "unfinished", "", "its config.yaml cannot be read")
            continue
        if not {"recipe", "task.name", "seed", "steps"} <= set(config):
            continue  # Another program's config.yaml.
        if not all(type(config[key]) is int for key in ("seed", "steps")):
            others[name] = Unfinished(name, "unfinished", "", "its config.yaml is not a run's")
            continue
        result = None
        if path.with_name("result.json").exists():
            result = read_result(path.parent)
        else:
            check_run_format(path.parent)
        record = RunRecord(path.parent, name, config, result, folder)
        if record.result is not None:
            finished.append(record)
        else:
            taken = max(
                (row["step"] for row in record.metrics() if row["phase"] == "ppo"), default=0
            )
            state, reason = known.pop(name, ("unfinished", ""))
            others[name] = Unfinished(name, state, f"{taken:,} of {record.steps:,}", reason)
    for name, (state, reason) in known.items():
        if not (folder / name / "result.json").exists():
            others.setdefault(name, Unfinished(name, state, "", reason))
    if not finished:
        raise UserError(
            f"there is no finished run below {folder}: a run is finished when its folder has a "
            "result.json."
        )
    return finished, [others[name] for name in sorted(others)]


def _config(path: Path) -> dict[str, Any] | None:
    try:
        config = parse_yaml(read_text(path))
    except (OSError, ValueError, yaml.YAMLError):
        return None
    return flat(config) if isinstance(config, dict) else None


# A study that was killed has left its runs "running".
_STATES = {
    "failed": "failed",
    "interrupted": "interrupted",
    "running": "unfinished",
    "waiting": "not finished yet",
}


def _standings(folder: Path) -> dict[str, tuple[str, str]]:
    """State and last line of what studies below the folder did not finish, by run folder."""
    found: dict[str, tuple[str, str]] = {}
    for path in sorted(folder.glob("**/studies/*/status.json")):
        root = path.parents[2]
        try:
            rows = parse_json(read_text(path))["runs"]
            for row in rows:
                state = _STATES.get(row["state"])
                place = (root / row["folder"]).relative_to(folder).as_posix()
                if ".." in Path(place).parts:
                    continue  # Not of this folder.
                if state and found.get(place, ("",))[0] != "failed":
                    found[place] = (state, str(row["last_line"] or ""))
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return found
