import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder to work in, with something beside it that nothing may touch."""
    (tmp_path / "work").mkdir()
    (tmp_path / "beside.txt").write_text("beside")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path
