import csv

from giril_rl.runs.curve import loss_points, write_losses

ROWS = [
    {"phase": "bc", "step": 100, "bc/fitted/loss": 0.5, "bc/held_out/loss": 0.75},
    {"phase": "bc", "step": 200, "bc/fitted/loss": 0.25, "bc/held_out/loss": None},
    {"phase": "fit", "step": 300, "fit/fitted/kl": 1.0},
]


def test_points_are_the_rows_with_a_loss():
    assert loss_points(ROWS) == [(100, 0.5, 0.75), (200, 0.25, None)]
    assert loss_points([]) == []
    assert loss_points([{"phase": "x", "step": 1, "x/fitted/loss": 2.0}], "x") == [(1, 2.0, None)]


def test_table_and_picture(tmp_path):
    table, picture = write_losses(
        tmp_path, ROWS, recipe="bc", task="pole", seed=3, final_return=12.5
    )
    with table.open() as file:
        assert list(csv.reader(file)) == [
            ["step", "fitted", "held_out"],
            ["100", "0.5", "0.75"],
            ["200", "0.25", ""],
        ]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_run_without_held_out_pairs_has_one_line(tmp_path):
    rows = [{"step": 10, "bc/fitted/loss": 1.0}]
    write_losses(tmp_path, rows, recipe="bc", task="pole", seed=0, final_return=0.0)
    assert (tmp_path / "curve.csv").read_text() == "step,fitted,held_out\n10,1.0,\n"
