import os
from pathlib import Path

import pytest

from giril_rl.errors import UserError
from giril_rl.files.disk import check_place, csv_text, read_json, write_atomically, write_json


def test_failed_write_keeps_the_old_file_and_leaves_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_json_round_trip_and_refusals(tmp_path):
    path = tmp_path / "deep" / "a.json"
    write_json(path, {"x": 0.1})
    assert read_json(path) == {"x": 0.1}
    path.write_text("[1]")
    with pytest.raises(UserError, match="not hold a JSON object"):
        read_json(path)
    path.write_text('{"x": ')
    with pytest.raises(UserError, match="cannot be read as JSON"):
        read_json(path)


def test_csv_has_empty_cells_for_none_and_quotes_what_needs_it():
    text = csv_text(("a", "b"), [(None, 0.1 + 0.2), ('x "y", z', 1)])
    assert text == 'a,b\n,0.30000000000000004\n"x ""y"", z",1\n'


def test_a_missing_drive_is_refused(monkeypatch):
    """Windows has several roots, and not all of them exist."""
    monkeypatch.setattr(Path, "exists", lambda path: False)
    with pytest.raises(
        UserError, match=r"cannot be written \(there is no /\): choose another out="
    ):
        check_place(Path("/data/run"), "out=")
