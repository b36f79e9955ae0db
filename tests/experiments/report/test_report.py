"""The command on made-up runs: every finished run is in a table, every other one is listed."""

import csv
import json

import numpy as np
import pytest

from giril_rl.cli.command_line import main
from giril_rl.experiments.report.charts import binned_curve, row_curves
from giril_rl.experiments.report.reading import read_runs
from giril_rl.experiments.report.tables import panels_of


@pytest.fixture
def runs(made):
    for seed in range(3):
        made("giril", f"seed={seed}", score=900.0 + seed, mode=800.0)
        made("giril", f"seed={seed}", "reward.beta=0.9", score=700.0 + seed)
        made("control", f"seed={seed}", score=500.0)
        made("control", f"seed={seed}", "reward=random", score=10.0 + 10 * seed)
        made("bc", f"seed={seed}", score=300.0)
    made("giril", "task=inverted_double_pendulum", score=4000.0, demo_return_mean=9000.0)
    made("expert", score=950.0)
    return made


def report(made, capsys, code=0):
    out = made.root.parent / "out"
    assert main(["report", str(made.root), "--out", str(out)]) == code
    return out, capsys.readouterr()


def test_tables_and_pictures(runs, capsys):
    out, captured = report(runs, capsys)
    assert captured.out == f"17 finished runs in 3 tables: {out}/report.md\n"
    text = (out / "report.md").read_text()
    assert "## inverted_pendulum: results\n\n3 seeds, 300,000 environment steps." in text
    scores = "demonstration 1,000.0, of the expert 900.0 and of the random policy 20.0."
    assert f"Scores of the {scores}" in text
    missing = "Not normalised: a run of the random policy is missing; `giril run control "
    missing += f"task=inverted_double_pendulum reward=random root={runs.root}` makes one."
    assert text.count("Not normalised") == 1 and missing in text
    assert "Paper: Table 5, 10,000,000 steps, 3 seeds." in text
    line = (
        "| **GIRIL (released)** | 3 | 300,000 | **901.0 [900.0, 902.0]** | 1.00 [1.00, 1.00] "
        "| 1.00 [1.00, 1.00] | 990.2 | 900.0 901.0 902.0 |"
    )
    assert line in text
    # (300 - 20) / (900 - 20) = 0.318, and the random policy's own is 0.
    assert "| BC | 3 | 0 | 300.0 [300.0, 300.0] | 0.32 [0.32, 0.32] |" in text
    assert "| control: random | 3 | 0 | 20.0 [10.0, 30.0] | 0.00 [-0.01, 0.01] | - | - |" in text
    assert "β = 0.9 | 3 | 300,000 | 701.0" in text
    pictures = {path.name: path.read_bytes() for path in out.glob("*.png")}
    assert set(pictures) == {
        "normalised.png",
        "curves-inverted_pendulum.png",
        "curves-inverted_pendulum-beta.png",
        "curves-inverted_double_pendulum.png",
    }
    for name, content in pictures.items():
        assert content.startswith(b"\x89PNG")
        assert f"]({name})" in text


def test_csv_has_unrounded_numbers(runs, capsys):
    out, _ = report(runs, capsys)
    rows = list(csv.DictReader((out / "results.csv").open()))
    (giril,) = [
        r
        for r in rows
        if r["method"] == "GIRIL (released)" and r["steps"] == "300000" and r["table"] == "results"
    ]
    assert giril["each_seed"] == "900.0 901.0 902.0"
    assert [float(giril[key]) for key in ("mean", "iqm", "mode", "paper", "p_best_control")] == [
        901.0,
        901.0,
        800.0,
        990.2,
        1.0,
    ]
    assert (giril["seeds"], giril["n"], giril["best_control"]) == (
        "0 1 2",
        "3",
        "control: constant",
    )
    each = list(csv.DictReader((out / "runs.csv").open()))
    assert len(each) == 17
    assert {row["state"] for row in each} == {"finished"}
    (one,) = [row for row in each if row["folder"] == "giril/inverted_pendulum/seed=1"]
    assert (one["seed"], one["reward_seed"], one["return_mean"]) == ("1", "101", "901.0")


def test_all_tasks_together(made, capsys):
    # Halfway from the random policy's to the player's, whatever the signs of the two.
    for task, low, high in (
        ("inverted_pendulum", 100.0, 900.0),
        ("inverted_double_pendulum", -1200.0, -200.0),
    ):
        for seed in range(2):
            words = (f"task={task}", f"seed={seed}")
            made("giril", *words, score=(low + high) / 2, expert_return_mean=high)
            made("control", *words, "reward=random", score=low)
            if task == "inverted_pendulum":
                made("control", *words, score=500.0)
    out, _ = report(made, capsys)
    text = (out / "report.md").read_text()
    assert "| GIRIL (released) | 2 | 0.50 [0.50, 0.50] | 0.50 [0.50, 0.50] |" in text
    assert "inverted_double_pendulum (random policy -1,200.0, player -200.0, " in text
    assert "Not on every task, and so not here: control: constant." in text


def test_without_training_episodes_there_are_no_curves(made, capsys):
    made("bc", score=300.0)
    made("control", "reward=random", score=100.0)
    out, _ = report(made, capsys)
    assert [path.name for path in out.glob("*.png")] == ["normalised.png"]
    assert "| BC | 1 | 0 | 300.0 | 0.25 | 36.0 | 300.0 |" in (out / "report.md").read_text()


def test_without_a_random_policy_there_are_no_bars(made, capsys):
    made("giril", score=-5.0, demo_return_mean=-2.0)
    out, _ = report(made, capsys)
    assert not (out / "normalised.png").exists()
    text = (out / "report.md").read_text()
    assert "normalised.png" not in text and "Not normalised: " in text


def test_the_top_names_what_made_the_runs_and_their_origins_stand_beside_them(made, capsys):
    versions = {"giril_rl": "0.2.0", "torch": "2.13.0", "torchrl": "0.14.1", "pybullet": None}
    for seed in range(2):
        origin = {"demo": f"shipped:pole/{seed}", "demo_id": f"d{seed}"}
        made("giril", f"seed={seed}", score=500.0, versions=versions, processor="A B1", **origin)
    older = {**versions, "giril_rl": "0.1.0"}
    made("control", "reward=random", score=100.0, versions=older, processor="A B1")
    out, _ = report(made, capsys)
    head = (out / "report.md").read_text().splitlines()[2]
    assert head == (
        "3 finished runs, made with giril-rl 0.1.0 (1 run) and 0.2.0 (2 runs), torch 2.13.0, "
        "torchrl 0.14.1; processor: A B1."
    )
    rows = list(csv.DictReader((out / "runs.csv").open()))
    keys = ("demo", "demo_id", "expert_return_mean", "demo_return_mean", "normalised")
    assert sorted(tuple(row[key] for key in keys) for row in rows) == [
        ("", "", "", "", "0.0"),
        ("shipped:pole/0", "d0", "900.0", "1000.0", "0.5"),
        ("shipped:pole/1", "d1", "900.0", "1000.0", "0.5"),
    ]


def test_runs_without_a_result_are_listed(runs, capsys):
    runs("giril", "seed=8")
    runs("giril", "seed=9")
    broken = runs("giril", "seed=7", score=3.0)
    (broken / "config.yaml").write_text("a: [")
    folder = runs.root / "studies" / "mine"
    folder.mkdir(parents=True)
    rows = [
        ("giril/inverted_pendulum/seed=9", "failed", "RuntimeError: a | b"),
        ("giril/inverted_pendulum/seed=1", "failed", "finished since"),
        ("giril/inverted_pendulum/seed=30", "waiting", None),
    ]
    entries = [dict(zip(("folder", "state", "last_line"), row, strict=True)) for row in rows]
    (folder / "status.json").write_text(json.dumps({"runs": entries}))
    out, captured = report(runs, capsys)
    assert captured.out.startswith("17 finished runs in 3 tables, 4 without a result: ")
    text = (out / "report.md").read_text()
    place = "giril/inverted_pendulum"
    assert text.split("## Without a result")[1].strip().splitlines() == [
        "| run | state | steps | last line |",
        "| --- | --- | --- | --- |",
        f"| `{place}/seed=30` | not finished yet | - | - |",
        f"| `{place}/seed=7` | unfinished | - | its config.yaml cannot be read |",
        f"| `{place}/seed=8` | unfinished | 300,000 of 300,000 | - |",
        f"| `{place}/seed=9` | failed | 300,000 of 300,000 | RuntimeError: a \\| b |",
    ]
    states = [row["state"] for row in csv.DictReader((out / "runs.csv").open())]
    assert states.count("finished") == 17 and states.count("failed") == 1


def test_a_folder_without_finished_runs_is_refused(made, capsys):
    made("giril")
    _, captured = report(made, capsys, code=2)
    (line,) = captured.err.splitlines()
    assert line.startswith(f"giril: there is no finished run below {made.root}: ")


def test_the_same_runs_give_the_same_report(runs, capsys):
    out, _ = report(runs, capsys)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    report(runs, capsys)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_curve_weighs_episodes_and_repeats_over_gaps():
    points = [(10, 1.0, 3), (20, 5.0, 1), (90, 7.0, None)]
    curve = binned_curve(points, steps=100, bins=5)
    assert curve.tolist() == [2.0, 2.0, 2.0, 2.0, 7.0]
    assert np.isnan(binned_curve(points[2:], steps=100, bins=5)[:4]).all()


def test_curves_of_a_row(runs):
    (_, pendulum) = panels_of(read_runs(runs.root)[0])
    rows = {(row.name, row.settings): row for row in pendulum.rows}
    steps, curves = row_curves(rows["GIRIL (released)", ""], bins=4)
    assert steps.tolist() == [75_000, 150_000, 225_000, 300_000]
    assert curves.tolist() == [[s / 4, s / 2, s * 0.75, s] for s in (900.0, 901.0, 902.0)]
    assert row_curves(rows["BC", ""]) is None


def test_the_legend_covers_no_curve(runs, drawn, tmp_path):
    assert main(["report", str(runs.root), "--out", str(tmp_path / "out")]) == 0
    legends = [
        ([text.get_text() for text in legend.get_texts()], legend, axes)
        for figure in drawn
        for axes in figure.axes
        if (legend := axes.get_legend()) is not None
    ]
    assert len(legends) == 4  # Methods and controls of one task, methods of the other, beta.
    for names, legend, axes in legends:
        assert legend.get_window_extent().y1 <= axes.get_window_extent().y0
        assert any(name.startswith("demonstration (") for name in names)
    assert ["GIRIL (released), n = 3", "BC, n = 3 (final score)"] in [n[:2] for n, _, _ in legends]


def test_no_curve_is_cut_off(made, drawn, tmp_path):
    made("giril", score=1.0)
    made("giril", "reward.prior=conditional", score=1.0)
    made("giril", "reward.prior=conditional", "steps=2000000", score=1.0)
    made("control", "steps=1000000", score=1.0)
    assert main(["report", str(made.root), "--out", str(tmp_path / "out")]) == 0
    limits = [[axes.get_xlim()[1] for axes in figure.axes] for figure in drawn]
    assert limits == [[1_050_000, 1_050_000], [2_100_000]]
    labels = [text.get_text() for text in drawn[1].axes[0].get_legend().get_texts()]
    assert labels[1:3] == [
        "reward.prior=conditional, 300,000 steps, n = 1",
        "reward.prior=conditional, 2,000,000 steps, n = 1",
    ]


def test_a_value_has_one_colour_in_all_parts_of_a_picture(made, drawn, tmp_path):
    for recipe in ("giril", "gail", "bc"):
        for episodes in (1, 5):
            made(recipe, f"demo.episodes={episodes}", "demo.length=null", score=1.0)
    made("giril", score=1.0)  # A value that one part alone has.
    assert main(["report", str(made.root), "--out", str(tmp_path / "out")]) == 0
    colours = {}
    for axes in drawn[-1].axes:
        for line in axes.get_lines():
            label = line.get_label().partition(", n = ")[0]
            if "full episode" in label:
                colours.setdefault(label, []).append(line.get_color())
    assert {label: len(found) for label, found in colours.items()} == {
        "1 full episode": 3,
        "5 full episodes": 3,
    }
    assert all(len(set(found)) == 1 for found in colours.values())
    assert len({found[0] for found in colours.values()}) == 2


def test_games_have_life_length_and_speed_in_the_csv(made, capsys):
    for seed, length in ((0, 50.0), (1, 70.0)):
        made(
            "control",
            "task=breakout",
            f"seed={seed}",
            score=2.0,
            life_length_mean=length,
            steps_per_second=500.0,
        )
    out, _ = report(made, capsys)
    text = (out / "report.md").read_text()
    assert "life length |" not in text  # It is in the CSV: a table has few columns.
    rows = list(csv.DictReader((out / "results.csv").open()))
    assert [(row["life_length"], row["steps_per_second"]) for row in rows] == [("60.0", "500.0")]
