"""A run of MLflow that ends when ours does."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXPERIMENT = "giril_rl"
IDENTITY = "giril_rl.run"
"""The tag by which a run that continues is found again."""


class MLflowRun:
    """Writes measurements to one run of MLflow, of which a process may have several at a time.

    TorchRL's logger keeps its run in MLflow's global state, in which a second one is refused, and
    writes into a folder of files, which MLflow gave up in version 3.10. This one has a SQLite file,
    or the server that ``MLFLOW_TRACKING_URI`` names.

    Args:
        place: the folder of the SQLite file and of artifacts.
        name: the run's name in the experiment ``giril_rl``.
        identity: tells this run from all others; the one that has it continues.
    """

    def __init__(self, place: Path, name: str, identity: str) -> None:
        from mlflow import MlflowClient

        logging.getLogger("alembic").setLevel(logging.WARNING)  # A line for each table it makes.
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
        """Write one row."""
        from mlflow.entities import Metric

        now = int(1000 * time.time())
        row = [Metric(key, float(value), now, step) for key, value in values.items()]
        self._client.log_batch(self._id, metrics=row)

    def end(self, status: str) -> None:
        """Say how it ended: FINISHED, FAILED or KILLED."""
        self._client.set_terminated(self._id, status)
