"""The score divided by the demonstration's return, also where a policy is scored anew."""

import json
import shutil
from pathlib import Path

import pytest

from giril_rl.config.schema import EvalConfig
from giril_rl.errors import UserError
from giril_rl.runs.finished import read_result
from giril_rl.training.rescore import score_anew
from giril_rl.training.result import score_over_demonstration

RUN = Path(__file__).parents[1] / "data" / "run"


@pytest.mark.parametrize(
    ("score", "demonstration", "ratio"),
    [
        (400.0, 800.0, 0.5),
        (1000.0, 800.0, 1.25),
        (0.0, 800.0, 0.0),
        (400.0, None, None),
        (400.0, 0.0, None),
        (-400.0, 800.0, None),
        (-400.0, -800.0, None),  # Twice as good, or half as good?
        (400.0, -800.0, None),
    ],
)
def test_only_where_the_quotient_says_something(score, demonstration, ratio):
    assert score_over_demonstration(score, demonstration) == ratio


def test_a_new_score_has_a_new_ratio(tmp_path):
    folder = shutil.copytree(RUN, tmp_path / "run")
    assert "score_over_demo" not in read_result(folder)  # It is older.
    score_anew(folder, EvalConfig(episodes=2, seed=3))
    result = read_result(folder)
    assert result["score_over_demo"] == result["return_mean"] / 40.0


@pytest.mark.parametrize("entry", [{"algorithm": 3}, {"score_over_demo": "much"}])
def test_an_entry_that_no_run_writes_is_refused(tmp_path, entry):
    folder = shutil.copytree(RUN, tmp_path / "run")
    result = json.loads((folder / "result.json").read_text())
    (folder / "result.json").write_text(json.dumps(result | entry))
    with pytest.raises(UserError, match=f"has no {next(iter(entry))} as a run writes it"):
        read_result(folder)
