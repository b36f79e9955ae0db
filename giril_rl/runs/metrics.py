"""A run's measurements: one JSON object a line, as they come."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from giril_rl.errors import INTERRUPTED, UserError
from giril_rl.files.disk import name_file, write_atomically
from giril_rl.files.untrusted import parse_json

METRICS = "metrics.jsonl"
"""The file of a run's folder that has them."""
LoggerName = Literal["tensorboard", "csv", "wandb", "mlflow"]


def read_metrics(path: Path) -> list[dict[str, Any]]:
    r"""The rows of a ``metrics.jsonl``, oldest first; a line that a kill cut short is left out.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "metrics.jsonl"
        >>> _ = path.write_text('{"phase": "ppo", "step": 512, "ppo/loss": 0.5}\n{"phase": "pp')
        >>> read_metrics(path)
        [{'phase': 'ppo', 'step': 512, 'ppo/loss': 0.5}]
    """
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict) and "phase" in row and type(row.get("step")) is int:
            rows.append(row)
    return rows


class MetricsFile:
    """Appends rows to ``metrics.jsonl``; each is on disk when :meth:`write` returns.

    Examples:
        >>> import tempfile
        >>> metrics = MetricsFile(Path(tempfile.mkdtemp()) / "metrics.jsonl")
        >>> metrics.write("ppo", 512, {"ppo/loss": 0.5})
        >>> metrics.write("ppo", 1024, {"ppo/loss": float("nan")})
        >>> metrics.truncate("ppo", 512)
        >>> read_metrics(metrics.path)
        [{'phase': 'ppo', 'step': 512, 'ppo/loss': 0.5}]
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.exists() and not _ends_a_line(path):
            self._rewrite(read_metrics(path))

    def write(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Append one row. JSON has no NaN or infinity: they become null."""
        row: dict[str, Any] = {"phase": phase, "step": int(step)}
        for key, value in values.items():
            number = float(value)
            row[key] = number if math.isfinite(number) else None
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        except OSError as error:
            name_file(error, self.path)
            raise

    def truncate(self, phase: str, step: int) -> None:
        """Drop the rows of ``phase`` later than ``step``, and a line that a kill cut short."""
        if self.path.exists():
            rows = read_metrics(self.path)
            self._rewrite([r for r in rows if r.get("phase") != phase or r["step"] <= step])

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in rows))


def _ends_a_line(path: Path) -> bool:
    """Whether a file's last byte is a newline; nothing else of it is read."""
    with open(path, "rb") as file:
        file.seek(max(os.fstat(file.fileno()).st_size - 1, 0))
        return file.read() == b"\n"


def check_logger(name: str | None) -> None:
    """Refuse an unknown logger, or one whose package is missing, before any work is done.

    Raises:
        UserError: naming the choices, or what to install.

    Examples:
        >>> check_logger("paper")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: logger=paper is unknown: choose tensorboard, csv, wandb, ...
    """
    if name is None:
        return
    if name not in get_args(LoggerName):
        choices = ", ".join(get_args(LoggerName))
        raise UserError(f"logger={name} is unknown: choose {choices} or null.")
    if name != "csv" and importlib.util.find_spec(name) is None:
        raise UserError(
            f'logger={name} needs the package {name}: pip install "giril-rl[loggers]", '
            "or choose logger=csv or logger=null."
        )


def make_logger(name: LoggerName, folder: Path) -> Any:
    """What writes the measurements of one run, of which a process may have several at a time.

    TensorBoard files are in ``folder/tensorboard``, CSV files in ``folder/csv``, both of TorchRL's
    loggers; Weights & Biases and MLflow name the run after the folder. A resumed run continues the
    same run of either, which is known by the folder's path.

    Returns:
        An object with TorchRL's ``log_metrics(values, step)``, to be ended by :func:`end_logger`.
    """
    check_logger(name)
    place = folder.resolve()
    identity = f"{place.name}-{zlib.crc32(str(place).encode()):08x}"
    if name == "mlflow":
        from giril_rl.runs.mlflow_run import MLflowRun

        return MLflowRun(folder / name, folder.name, identity)
    from torchrl.record.loggers.utils import get_logger

    if name in ("tensorboard", "csv"):
        return get_logger(name, str(folder / name), "")
    wandb_kwargs = {
        "project": "giril_rl",
        "id": identity,
        "resume": "allow",
        # Else the run that is open in this process would be handed out again.
        "reinit": "create_new",
    }
    return get_logger(name, str(folder / name), folder.name, wandb_kwargs=wandb_kwargs)


def end_logger(logger: Any, error: BaseException | None = None) -> None:
    """Ends what :func:`make_logger` began.

    Args:
        logger: what it returned.
        error: why the run ended before its time, if it did.
    """
    stopped = isinstance(error, KeyboardInterrupt)
    if hasattr(logger, "end"):
        logger.end("FINISHED" if error is None else "KILLED" if stopped else "FAILED")
    elif hasattr(logger.experiment, "finish"):
        logger.experiment.finish(exit_code=0 if error is None else INTERRUPTED if stopped else 1)
    elif hasattr(logger.experiment, "close"):
        logger.experiment.close()
