"""Tables and curves of many runs."""

import csv
import json

import numpy as np
import pytest

from giril_rl.report.curves import binned_curve
from giril_rl.report.summary import collect, interval, main


def finish(folder, *, seed, value, steps=1000, method="giril", task="t"):
    folder.mkdir(parents=True)
    result = {
        "method": method,
        "task": task,
        "seed": seed,
        "env_steps": steps,
        "return_mean": value,
        "deterministic": {"return_mean": value - 1},
    }
    (folder / "result.json").write_text(json.dumps(result))
    row = {"phase": "ppo", "step": steps, "train/return_mean": value, "train/episodes": 2.0}
    (folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")


@pytest.fixture
def runs(tmp_path):
    for seed, value in ((1, 30.0), (0, 10.0), (2, 50.0)):
        finish(tmp_path / "giril" / "t" / "default" / f"seed{seed}", seed=seed, value=value)
    finish(tmp_path / "control" / "t" / "default" / "seed0", seed=0, value=5.0, method="control")
    (tmp_path / "giril" / "t" / "default" / "seed9").mkdir()  # Not finished.
    return tmp_path


def test_runs_that_differ_in_their_seed_are_one_row(runs):
    control, giril = collect([runs])
    assert (control.run, control.seeds, control.returns) == ("control default", (0,), (5.0,))
    assert (giril.run, giril.seeds, giril.returns) == ("giril default", (0, 1, 2), (10, 30, 50))
    assert giril.cells[4] == "30.0"
    assert giril.cells[7] == "29.0"


def test_the_interval_is_that_of_the_mean():
    values = np.random.default_rng(1).normal(100, 10, 400)
    low, high = interval(list(values))
    assert low < values.mean() < high
    # 1.96 standard errors either side.
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)
    assert interval([3.0]) == (3.0, 3.0)


def test_a_curve_weighs_episodes_and_repeats_over_gaps():
    points = [(10, 1.0, 3), (20, 5.0, 1), (90, 7.0, None)]
    curve = binned_curve(points, steps=100, bins=5)
    assert curve.tolist() == [2.0, 2.0, 2.0, 2.0, 7.0]
    assert np.isnan(binned_curve(points[2:], steps=100, bins=5)[:4]).all()


def test_table_and_picture_are_written(runs, capsys):
    main([str(runs), "--csv", str(runs / "s.csv"), "--png", str(runs / "s.png")])
    printed = capsys.readouterr().out
    assert "| giril default | 1,000 | 0 1 2 | 30.0 |" in printed
    rows = list(csv.reader((runs / "s.csv").open()))
    assert rows[0][0] == "task"
    assert len(rows) == 3
    assert (runs / "s.png").read_bytes().startswith(b"\x89PNG")
