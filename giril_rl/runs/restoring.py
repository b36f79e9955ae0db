"""Putting a checkpoint back into what it is a checkpoint of."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch

from giril_rl.errors import UserError

if TYPE_CHECKING:
    from giril_rl.runs.run import Run


@contextmanager
def restoring(run: Run, phase: str) -> Iterator[None]:
    """Refuses a checkpoint that is whole and belongs to something else.

    Args:
        run: the run that it lies in.
        phase: its name.

    Raises:
        UserError: in place of whatever is raised where names, sizes or types do not fit.
    """
    try:
        yield
    except torch.OutOfMemoryError:
        raise  # A RuntimeError, and no reason to delete a checkpoint.
    except (KeyError, IndexError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise UserError(
            f"{run.folder / phase}.safetensors cannot be put back ({type(error).__name__}: "
            f"{reason}): if it is a checkpoint of another run or task, delete the file to start "
            "that part again, or restore a copy."
        ) from error
