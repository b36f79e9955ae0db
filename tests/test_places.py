from pathlib import Path

import pytest

from giril_rl.errors import UserError
from giril_rl.files.disk import check_place


def test_a_drive_that_is_not_there_is_refused(monkeypatch):
    """Windows has many roots, and not all of them are there."""
    monkeypatch.setattr(Path, "exists", lambda path: False)
    with pytest.raises(
        UserError, match=r"cannot be written \(there is no /\): choose another out="
    ):
        check_place(Path("/data/run"), "out=")
