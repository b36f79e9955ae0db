"""Demonstrations: record, check, save, subsample, import and export."""

from giril_rl.config.tasks import named_task
from giril_rl.demos.check import check_demonstration
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.importing import import_demonstration
from giril_rl.demos.minari import to_minari
from giril_rl.demos.npz import to_npz
from giril_rl.demos.record import record_demonstration
from giril_rl.demos.replay import verify_by_replay
from giril_rl.demos.shipped import shipped_demonstrations
from giril_rl.demos.subsample import holdout, shortened, subsample

__all__ = [
    "Demonstration",
    "check_demonstration",
    "holdout",
    "import_demonstration",
    "named_task",
    "record_demonstration",
    "shipped_demonstrations",
    "shortened",
    "subsample",
    "to_minari",
    "to_npz",
    "verify_by_replay",
]
