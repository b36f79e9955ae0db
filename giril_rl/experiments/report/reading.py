"""Reads run folders: settings and results, and the state of runs without a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from giril_rl.config.families import TaskFamily, family_of
from giril_rl.config.knobs import flat
from giril_rl.errors import UserError
from giril_rl.experiments.report.entries import PLAYER, TRUE_REWARD
from giril_rl.files.untrusted import parse_json, parse_yaml, read_text
from giril_rl.runs.finished import check_run_format, read_result
from giril_rl.runs.metrics import METRICS, read_metrics


@dataclass(frozen=True)
class RunRecord:
    """A finished run.

    Attributes:
        folder: its folder.
        name: that folder relative to the folder of the report.
        config: its settings as ``{dotted key: value}``.
        result: the content of ``result.json``.
        below: the folder of the report.
    """

    folder: Path
    name: str
    config: dict[str, Any]
    result: dict[str, Any]
    below: Path

    @property
    def recipe(self) -> str:
        """The recipe's name."""
        return str(self.config["recipe"])

    @property
    def method(self) -> str:
        """The recipe's name; ``control:REWARD`` of a control.

        An expert that trains for its whole budget is a method of its own.
        """
        if self.recipe == PLAYER and self.config.get("stop_early") is False:
            return TRUE_REWARD
        if self.recipe == "control":
            return str(self.result.get("method", f"control:{self.config.get('reward')}"))
        return self.recipe

    @property
    def algorithm(self) -> str | None:
        """What trained the policy, "ppo" or "sac"; None without reinforcement learning."""
        if "algorithm" in self.result:
            return self.result["algorithm"]
        return str(self.config.get("algorithm", "ppo")) if self.result["env_steps"] else None

    @property
    def task(self) -> str:
        """The task's name."""
        return str(self.config["task.name"])

    @property
    def env_id(self) -> str:
        """The id of the task's environment."""
        return str(self.config.get("task.env_id"))

    @property
    def score(self) -> float:
        """Mean return of the policy as trained."""
        return float(self.result["return_mean"])

    @property
    def mode(self) -> float | None:
        """Mean return with the policy's most likely actions: SAC's score; None if not measured."""
        if self.result.get("sampled") is not None:
            return self.score
        mode = self.result.get("deterministic")
        return float(mode["return_mean"]) if mode else None

    @property
    def seed(self) -> int:
        """The seed of the policy's training."""
        return int(self.config["seed"])

    @property
    def steps(self) -> int:
        """The budget of environment steps."""
        return int(self.config["steps"])

    @property
    def family(self) -> TaskFamily:
        """The family of its task."""
        return family_of(self.env_id)

    @property
    def has_demonstration(self) -> bool:
        """Whether it learned from a demonstration."""
        return any(self.result.get(key) is not None for key in ("demo_transitions", "demo_id"))

    def metrics(self) -> list[dict[str, Any]]:
        """The rows of its ``metrics.jsonl``."""
        return read_metrics(self.folder / METRICS)


class Unfinished(NamedTuple):
    """A run without a result, named like a finished one.

    The state is failed, interrupted, unfinished or not finished yet; the steps are those so far and
    the budget; the reason is the last line of its log, where a study knows it.
    """

    name: str
    state: str
    steps: str
    reason: str


def read_runs(folder: Path) -> tuple[list[RunRecord], list[Unfinished]]:
    """All runs below a folder, at any depth: the finished ones and the others.

    Raises:
        UserError: if no run is finished or a result cannot be read.
    """
    finished: list[RunRecord] = []
    others: dict[str, Unfinished] = {}
    known = _standings(folder)
    for path in sorted(folder.rglob("config.yaml")):
        run, name = path.parent, path.parent.relative_to(folder).as_posix()
        config = _config(path)
        if config is None:
            others[name] = Unfinished(name, "unfinished", "", "its config.yaml cannot be read")
        elif not {"recipe", "task.name", "seed", "steps"} <= set(config):
            continue  # Another program's config.yaml.
        elif not all(type(config[key]) is int for key in ("seed", "steps")):
            others[name] = Unfinished(name, "unfinished", "", "its config.yaml is not a run's")
        elif (run / "result.json").exists():
            finished.append(RunRecord(run, name, config, read_result(run), folder))
        else:
            check_run_format(run)
            rows = [row for row in read_metrics(run / METRICS) if row["phase"] in ("ppo", "sac")]
            taken = max((row["step"] for row in rows), default=0)
            state, reason = known.pop(name, ("unfinished", ""))
            others[name] = Unfinished(name, state, f"{taken:,} of {config['steps']:,}", reason)
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


# A study that was killed leaves its runs "running".
_STATES = {
    "failed": "failed",
    "interrupted": "interrupted",
    "running": "unfinished",
    "waiting": "not finished yet",
}


def _standings(folder: Path) -> dict[str, tuple[str, str]]:
    """State and last line of the runs that studies below the folder did not finish, by folder."""
    found: dict[str, tuple[str, str]] = {}
    for path in sorted(folder.glob("**/studies/*/status.json")):
        root = path.parents[2]
        try:
            for row in parse_json(read_text(path))["runs"]:
                state = _STATES.get(row["state"])
                place = (root / row["folder"]).relative_to(folder).as_posix()
                if ".." in Path(place).parts:
                    continue  # Outside this folder.
                if state and found.get(place, ("",))[0] != "failed":
                    found[place] = (state, str(row["last_line"] or ""))
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return found
