"""Loggers beside ``metrics.jsonl``: TensorBoard, CSV, Weights & Biases and MLflow."""

from __future__ import annotations

import importlib.util
import logging
import os
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

from giril_rl.errors import INTERRUPTED, UserError

LoggerName = Literal["tensorboard", "csv", "wandb", "mlflow"]
EXPERIMENT = "giril_rl"
IDENTITY = "giril_rl.run"
"""The tag that holds a run's identity."""


def check_logger(name: str | None) -> None:
    """Refuse an unknown logger, or one whose package is missing, before any work is done.

    Raises:
        UserError: with the choices, or what to install.

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
    """The logger of one run; a process may have several at a time.

    TensorBoard, CSV and Weights & Biases use TorchRL's loggers. The files are in ``folder/name``.
    Weights & Biases and MLflow name the run after the folder, and a resumed run continues there:
    the folder's path identifies it.

    Returns:
        An object with TorchRL's ``log_metrics(values, step)``; end it with :func:`end_logger`.
    """
    check_logger(name)
    place = folder.resolve()
    identity = f"{place.name}-{zlib.crc32(str(place).encode()):08x}"
    if name == "mlflow":
        return MLflowRun(folder / name, folder.name, identity)
    from torchrl.record.loggers.utils import get_logger

    if name in ("tensorboard", "csv"):
        return get_logger(name, str(folder / name), "")
    wandb_kwargs = {
        "project": "giril_rl",
        "id": identity,
        "resume": "allow",
        # Else wandb returns the run that is already open in this process.
        "reinit": "create_new",
    }
    return get_logger(name, str(folder / name), folder.name, wandb_kwargs=wandb_kwargs)


def end_logger(logger: Any, error: BaseException | None = None) -> None:
    """End a logger from :func:`make_logger`; ``error`` is why the run stopped early, if it did."""
    stopped = isinstance(error, KeyboardInterrupt)
    if hasattr(logger, "end"):
        logger.end("FINISHED" if error is None else "KILLED" if stopped else "FAILED")
    elif hasattr(logger.experiment, "finish"):
        logger.experiment.finish(exit_code=0 if error is None else INTERRUPTED if stopped else 1)
    elif hasattr(logger.experiment, "close"):
        logger.experiment.close()


class MLflowRun:
    """Logs to one run of MLflow, in a SQLite file or on the server in ``MLFLOW_TRACKING_URI``.

    TorchRL's MLflow logger does not fit: it uses MLflow's global run, so that a process can have
    only one, and MLflow's file store, which MLflow 3.10 removed.

    Args:
        place: the folder of the SQLite file and the artifacts.
        name: the run's name in the experiment ``giril_rl``.
        identity: the run's unique tag; an existing run with this tag is continued.
    """

    def __init__(self, place: Path, name: str, identity: str) -> None:
        from mlflow import MlflowClient

        logging.getLogger("alembic").setLevel(logging.WARNING)  # Else a line for each table.
        logging.getLogger("mlflow.store").setLevel(logging.WARNING)
        server = os.environ.get("MLFLOW_TRACKING_URI")
        place.mkdir(parents=True, exist_ok=True)
        self._client = MlflowClient(server or f"sqlite:///{(place / 'mlflow.db').resolve()}")
        artifacts = None if server else (place / "artifacts").resolve().as_uri()
        found = self._client.get_experiment_by_name(EXPERIMENT)
        experiment = (
            self._client.create_experiment(EXPERIMENT, artifact_location=artifacts)
            if found is None
            else found.experiment_id
        )
        before = self._client.search_runs([experiment], f"tags.`{IDENTITY}` = '{identity}'")
        if before:
            self._id = before[0].info.run_id
            self._client.update_run(self._id, status="RUNNING")
        else:
            tags = {IDENTITY: identity}
            self._id = self._client.create_run(experiment, tags=tags, run_name=name).info.run_id

    def log_metrics(self, values: Mapping[str, Any], step: int) -> None:
        """Log one row."""
        from mlflow.entities import Metric

        now = int(1000 * time.time())
        row = [Metric(key, float(value), now, step) for key, value in values.items()]
        self._client.log_batch(self._id, metrics=row)

    def end(self, status: str) -> None:
        """End the run as FINISHED, FAILED or KILLED."""
        self._client.set_terminated(self._id, status)
