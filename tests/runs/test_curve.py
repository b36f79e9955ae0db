import csv

import matplotlib.pyplot as plt

from giril_rl.runs.curve import curve_points, loss_points, write_curve, write_losses

ROWS = [
    {"phase": "fit", "step": 500, "fit/loss": 0.5},
    {"phase": "ppo", "step": 8192, "ppo/loss": 0.1, "train/return_mean": None},
    {"phase": "ppo", "step": 16384, "train/return_mean": 25.5, "train/episodes": 100},
    {"phase": "ppo", "step": 1_000_000, "train/return_mean": 9358.25, "train/episodes": 7},
]
LOSSES = [
    {"phase": "bc", "step": 100, "bc/fitted/loss": 0.5, "bc/held_out/loss": 0.75},
    {"phase": "bc", "step": 200, "bc/fitted/loss": 0.25, "bc/held_out/loss": None},
    {"phase": "fit", "step": 300, "fit/fitted/kl": 1.0},
]


def test_rows_without_a_return_are_left_out():
    assert curve_points(ROWS) == [(16384, 25.5, 100), (1_000_000, 9358.25, 7)]


def test_table_and_picture(tmp_path, monkeypatch):
    drawn = []
    from matplotlib.figure import Figure

    savefig = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *a, **k: (drawn.append(self), savefig(self, *a, **k))
    )
    open_figures = plt.get_fignums()
    table, picture = write_curve(
        tmp_path / "run",
        ROWS,
        recipe="giril",
        task="inverted_pendulum",
        seed=3,
        expert_return=9359.0,
        demo_return=9360.0,
        final_return=9000.0,
        final_std=120.0,
        final_step=1_000_000,
    )
    with open(table, newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[1] == {"step": "1000000", "return_mean": "9358.25", "episodes": "7"}
    assert picture.read_bytes().startswith(b"\x89PNG")
    (axes,) = drawn[0].axes
    assert axes.get_title() == "giril on inverted_pendulum, seed 3"
    labels = axes.get_legend_handles_labels()[1]
    assert labels == [
        "training episodes",
        "expert (9,359.0)",
        "demonstration (9,360.0)",
        "final evaluation (9,000.0)",
    ]
    assert axes.lines[0].get_xdata().tolist() == [16384, 1_000_000]
    assert "1,000,000" in [text.get_text() for text in axes.get_xticklabels()]
    assert plt.get_fignums() == open_figures


def test_run_without_episodes_still_gets_its_files(tmp_path):
    table, picture = write_curve(tmp_path, [], recipe="bc", task="t", seed=0, final_return=3.0)
    assert table.read_text() == "step,return_mean,episodes\n"
    assert picture.stat().st_size > 1000


def test_rows_without_a_loss_are_left_out():
    assert loss_points(LOSSES) == [(100, 0.5, 0.75), (200, 0.25, None)]
    assert loss_points([]) == []
    assert loss_points([{"phase": "x", "step": 1, "x/fitted/loss": 2.0}], "x") == [(1, 2.0, None)]


def test_table_and_picture_of_losses(tmp_path):
    table, picture = write_losses(
        tmp_path, LOSSES, recipe="bc", task="pole", seed=3, final_return=12.5
    )
    with table.open() as file:
        assert list(csv.reader(file)) == [
            ["step", "fitted", "held_out"],
            ["100", "0.5", "0.75"],
            ["200", "0.25", ""],
        ]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_without_validation_pairs_there_is_one_line(tmp_path):
    rows = [{"step": 10, "bc/fitted/loss": 1.0}]
    write_losses(tmp_path, rows, recipe="bc", task="pole", seed=0, final_return=0.0)
    assert (tmp_path / "curve.csv").read_text() == "step,fitted,held_out\n10,1.0,\n"
