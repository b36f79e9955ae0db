"""A study's folder: the resolved study, the state of each run, and what the runs print."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

import yaml

from giril_rl.experiments.study.plan import StudyRun
from giril_rl.experiments.study.spec import Spec
from giril_rl.files.disk import csv_text, write_atomically, write_json
from giril_rl.files.untrusted import parse_json, read_text
from giril_rl.runs.identity import config_hash, safe

MOST_BYTES = 2**20
"""The size of a log beyond which a new one is begun; a study may be started any number of times."""
_TAIL = 2**16
State = Literal["waiting", "running", "finished", "failed", "interrupted"]


@dataclass
class Standing:
    """The state of one run: a row of ``status.csv`` and an entry of ``status.json``.

    Attributes:
        label: the group's label.
        recipe: the recipe's name.
        task: the task's name.
        seed: the run's seed.
        state: of the run.
        attempts: processes that the latest command started for it.
        exit_code: of the last process; if negative, of the signal that killed it.
        seconds: the duration of the last process.
        folder: the run's folder, relative to the study's root.
        log: the log file, relative to the study's folder.
        last_line: the log's last line, where the run failed.
    """

    label: str
    recipe: str
    task: str
    seed: int
    state: State
    attempts: int
    exit_code: int | None
    seconds: float | None
    folder: str
    log: str
    last_line: str | None


class StudyFolder:
    """``root/studies/NAME``: ``study.yaml``, ``status.json``, ``status.csv`` and ``logs/``.

    Args:
        spec: the study.
        changes: what the command line changed, a part of the folder's name.
        runs: the study's runs.
    """

    def __init__(self, spec: Spec, changes: Sequence[str], runs: Sequence[StudyRun]) -> None:
        self.spec, self.changes, self.runs = spec, changes, runs
        name = safe(",".join([spec.name, *sorted(changes)]), distinct=True)
        self.path = runs[0].root / "studies" / name
        before = self._before()
        self.standings = {
            run.name: before[run.name]
            if run.finished and run.name in before
            else self._standing(run)
            for run in runs
        }

    def _before(self) -> dict[str, Standing]:
        """The finished runs that the folder knows of, with their durations."""
        try:
            rows = parse_json(read_text(self.path / "status.json"))["runs"]
            known = [Standing(**row) for row in rows]
            return {row.folder: row for row in known if row.state == "finished"}
        except (OSError, ValueError, TypeError, KeyError):
            return {}  # None yet, or of another version: only times are lost.

    def _standing(self, run: StudyRun) -> Standing:
        return Standing(
            label=run.label,
            recipe=run.recipe.name,
            task=run.config.task.name,
            seed=run.config.seed,
            state="finished" if run.finished else "waiting",
            attempts=0,
            exit_code=None,
            seconds=None,
            folder=run.name,
            log=f"logs/{run.name.replace('/', '--')}.log",
            last_line=None,
        )

    def log(self, run: StudyRun) -> Path:
        """The file of the run's output."""
        return self.path / self.standings[run.name].log

    def count(self, state: State) -> int:
        """The number of runs in that state."""
        return Counter(standing.state for standing in self.standings.values())[state]

    def write_study(self) -> None:
        """Write ``study.yaml``: the study, the command line's changes, and the runs."""
        content = {
            "name": self.spec.name,
            "title": self.spec.title,
            "changes": list(self.changes),
            "groups": [
                {"label": group.label, "recipe": list(group.recipes), **group.knobs}
                for group in self.spec.groups
            ],
            "runs": [
                {
                    "label": run.label,
                    "recipe": run.recipe.word,
                    "knobs": list(run.words),
                    "folder": run.name,
                    "config_hash": config_hash(run.config),
                }
                for run in self.runs
            ],
        }
        text = yaml.dump(content, Dumper=_Plain, sort_keys=False, allow_unicode=True, width=100)
        write_atomically(self.path / "study.yaml", text)

    def write_status(self) -> None:
        """Write ``status.json`` and ``status.csv``."""
        rows = [asdict(standing) for standing in self.standings.values()]
        states = Counter(row["state"] for row in rows)
        content = {"study": self.spec.name, "states": dict(sorted(states.items())), "runs": rows}
        write_json(self.path / "status.json", content)
        columns = [field.name for field in fields(Standing)]
        text = csv_text(columns, (row.values() for row in rows))
        write_atomically(self.path / "status.csv", text)


class _Plain(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


def begin_log(log: Path, command: list[str]) -> None:
    r"""Adds a command to a log, and renames a log that is too long to ``NAME.log.old`` first.

    Args:
        log: the file; its folder is made if need be.
        command: the words after ``giril``.

    Examples:
        >>> import tempfile
        >>> log = Path(tempfile.mkdtemp()) / "a.log"
        >>> _ = log.write_text("x" * (MOST_BYTES + 1))
        >>> begin_log(log, ["run", "bc"])
        >>> log.read_text(), sorted(path.name for path in log.parent.iterdir())
        ('\n$ giril run bc\n', ['a.log', 'a.log.old'])
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    if log.is_file() and log.stat().st_size > MOST_BYTES:
        os.replace(log, log.with_name(f"{log.name}.old"))
    with open(log, "ab") as output:
        output.write(f"\n$ giril {' '.join(command)}\n".encode())


def last_line(log: Path) -> str:
    """The last line of a log that is not blank, or an empty text."""
    try:
        with open(log, "rb") as file:
            file.seek(max(os.fstat(file.fileno()).st_size - _TAIL, 0))
            text = file.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
