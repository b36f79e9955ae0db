"""PPO's and SAC's runs side by side: rows, names, tables, curves."""

import csv
import json

import pytest
import yaml

from giril_rl.cli.command_line import main
from giril_rl.experiments.report.captions import caption
from giril_rl.experiments.report.learners import learner_and_reward
from giril_rl.experiments.report.reading import read_runs
from giril_rl.experiments.report.tables import panels_of, tables_of
from giril_rl.experiments.report.text import overall, table_markdown

SAC = "algorithm=sac"
PPO = "algorithm=ppo"
PAPER = "profile=paper"


def panel(made):
    (found,) = panels_of(read_runs(made.root)[0])
    return found


def results(made):
    return tables_of(panel(made))[0]


def lines(made):
    return {line.row.name: line for line in results(made).lines}


def report(made, capsys):
    out = made.root.parent / "out"
    assert main(["report", str(made.root), "--out", str(out)]) == 0
    capsys.readouterr()
    return out


def rewrite(path, change):
    """Change a run's ``config.yaml`` or ``result.json`` in place."""
    read, write = (json.loads, json.dumps) if path.suffix == ".json" else (yaml.safe_load,) * 2
    write = json.dumps if path.suffix == ".json" else yaml.safe_dump
    values = read(path.read_text())
    change(values)
    path.write_text(write(values))


def test_each_algorithm_has_a_row_beside_the_other_of_the_recipes_own_settings(made):
    for seed in (0, 1):
        made("pwil", f"seed={seed}", score=720.0)
        made("pwil", f"seed={seed}", PPO, score=-990.0)
        made("giril", f"seed={seed}", PAPER, score=10.0)
        made("giril", f"seed={seed}", PAPER, SAC, score=20.0)
    made("giril", score=30.0)
    made("bc", score=40.0)
    made("control", SAC, score=50.0)
    made("control", score=60.0)
    made("control", "reward=random", score=70.0)
    made("expert", "stop_early=false", score=80.0)
    made("expert", "stop_early=false", SAC, score=90.0)
    made("expert", score=100.0)
    table = results(made)
    assert [(line.row.name, line.row.algorithm, line.row.changes) for line in table.lines] == [
        ("expert (PPO)", "ppo", ()),
        ("PPO on the true reward", "ppo", ()),
        ("SAC on the true reward", "sac", ()),
        ("GIRIL (released, PPO)", "ppo", ()),
        ("GIRIL (paper, PPO)", "ppo", ()),
        ("GIRIL (paper, SAC)", "sac", ()),
        ("BC", None, ()),
        ("PWIL (PPO)", "ppo", ()),
        ("PWIL (SAC)", "sac", ()),
        ("control: constant (PPO)", "ppo", ()),
        ("control: constant (SAC)", "sac", ()),
        ("control: random", None, ()),
    ]
    assert len(tables_of(panel(made))) == 1
    # The paper's figures are PPO's.
    papers = {line.row.name: line.paper is not None for line in table.lines}
    assert papers["GIRIL (paper, PPO)"] and not papers["GIRIL (paper, SAC)"]


def test_without_sac_nothing_tells_the_algorithm(made, capsys):
    made("pwil", PPO, score=1.0)
    made("giril", score=2.0)
    made("expert", "stop_early=false", score=3.0)
    out = report(made, capsys)
    assert set(lines(made)) == {"PWIL", "GIRIL (released)", "PPO on the true reward"}
    text = (out / "report.md").read_text()
    assert "SAC" not in text and "emonstration [95%]" not in text and "(PPO)" not in text
    for name in ("results.csv", "runs.csv"):
        columns = next(csv.reader((out / name).open()))
        assert "algorithm" not in columns and "score_over_demo" not in columns


def test_settings_of_the_algorithm_that_does_not_run_are_no_difference(made):
    made("giril", score=1.0)
    idle = made("giril", "seed=1", score=2.0)
    rewrite(idle / "config.yaml", lambda config: config["sac"].update(lr=0.5, buffer_size=7))
    made("pwil", score=3.0)
    idle = made("pwil", "seed=1", score=4.0)
    rewrite(idle / "config.yaml", lambda config: config["ppo"].update(lr=0.5))
    found = panel(made)
    assert {(row.name, row.settings): row.seeds for row in found.rows} == {
        ("GIRIL (released, PPO)", ""): [0, 1],
        ("PWIL (SAC)", ""): [0, 1],
    }


def test_other_settings_are_other_settings_with_either_algorithm(made):
    made("giril", score=1.0)
    made("giril", SAC, score=2.0)
    made("giril", SAC, "sac.updates=1", score=3.0)
    made("giril", "ppo.clip=0.2", score=4.0)
    made("giril", SAC, "reward.beta=0.9", score=5.0)
    first, beta, other = tables_of(panel(made))
    assert [line.row.scores for line in first.lines] == [[1.0], [2.0]]
    assert [(line.row.name, line.value, line.row.scores) for line in beta.lines] == [
        ("GIRIL (released, SAC)", "β = 1.0", [2.0]),
        ("GIRIL (released, SAC)", "β = 0.9", [5.0]),
    ]
    assert [(line.row.name, line.value) for line in other.lines] == [
        ("GIRIL (released, PPO)", "the recipe's own"),
        ("GIRIL (released, PPO)", "ppo.clip=0.2"),
        ("GIRIL (released, SAC)", "the recipe's own"),
        ("GIRIL (released, SAC)", "sac.updates=1.0"),
    ]


def test_a_random_policy_and_cloning_have_no_algorithm(made):
    made("pwil", score=1.0)
    made("control", "reward=random", SAC, score=2.0)
    made("control", "reward=random", "seed=1", score=3.0)
    made("bc", score=4.0)
    found = {row.name: (row.algorithm, row.seeds) for row in panel(made).rows}
    assert found["control: random"] == (None, [0, 1])
    assert found["BC"] == (None, [0])


def test_a_constant_has_no_demonstration_for_the_replay(made):
    made("control", SAC, score=1.0)
    made("control", SAC, "seed=1", "sac.demonstration=none", score=2.0)
    (row,) = panel(made).rows
    assert row.seeds == [0, 1]


def test_results_that_do_not_tell_their_algorithm_have_that_of_their_settings(made):
    older = [made("giril", score=1.0), made("bc", score=3.0)]
    folders = [*older, made("pwil", score=2.0)]
    before = [run.algorithm for run in read_runs(made.root)[0]]
    for folder in folders:
        rewrite(folder / "result.json", lambda result: result.pop("algorithm"))
    for folder in older:  # Of before there was SAC.
        rewrite(folder / "config.yaml", lambda config: [config.pop("algorithm"), config.pop("sac")])
    runs = {run.method: run.algorithm for run in read_runs(made.root)[0]}
    assert runs == {"giril": "ppo", "bc": None, "pwil": "sac"}
    assert sorted(before, key=str) == sorted(runs.values(), key=str)
    assert all(not row.changes for row in panel(made).rows)


def test_a_run_older_than_a_setting_has_the_value_that_it_behaved_by(made):
    made("pwil", score=800.0)
    folder = made("pwil", "seed=1", score=200.0)
    rewrite(folder / "config.yaml", lambda config: config["sac"].pop("time_aware_critic"))
    made("giril", SAC, score=1.0)
    folder = made("giril", SAC, "seed=1", score=2.0)
    rewrite(folder / "config.yaml", lambda config: config["sac"].pop("time_aware_critic"))
    found = {(row.method, row.settings): row.scores for row in panel(made).rows}
    assert found == {
        ("giril", ""): [1.0, 2.0],
        ("pwil", ""): [800.0],
        ("pwil", "sac.time_aware_critic=false"): [200.0],
    }


def test_an_unfinished_run_tells_how_far_it_came(made, capsys):
    made("giril", score=1.0)
    made("pwil", "steps=1000")
    text = (report(made, capsys) / "report.md").read_text()
    assert "| unfinished | 1,000 of 1,000 |" in text


def test_sacs_score_is_that_of_its_most_likely_action(made, capsys):
    made("pwil", score=10.0, mode=7.0)  # Which of SAC is what its samples score.
    made("giril", score=20.0, mode=17.0)
    assert {name: line.row.modes for name, line in lines(made).items()} == {
        "PWIL (SAC)": [10.0],
        "GIRIL (released, PPO)": [17.0],
    }
    out = report(made, capsys)
    assert "; one that SAC trained takes its mean action." in (out / "report.md").read_text()
    rows = {row["method"]: row for row in csv.DictReader((out / "runs.csv").open())}
    assert {name: row["mode_return_mean"] for name, row in rows.items()} == {
        "pwil": "10.0",
        "giril": "17.0",
    }


@pytest.mark.parametrize(("better", "name"), [(SAC, "SAC"), (PPO, "PPO")])
def test_the_best_control_is_of_either_algorithm(made, better, name):
    for algorithm in (SAC, PPO):
        made("control", algorithm, score=500.0 if algorithm == better else 100.0)
        made("control", algorithm, "reward=copy", score=200.0)
        made("control", algorithm, "steps=900000", score=999.0)
        made("pwil", algorithm, score=400.0)
    for line in results(made).lines:
        if line.row.method == "pwil":
            estimate, best = line.improvement
            assert (best.name, estimate.value) == (f"control: constant ({name})", 0.0)


def test_scores_over_demonstrations_by_hand(made, capsys):
    for seed, (score, demonstration) in enumerate(((400.0, 800.0), (900.0, 1000.0))):
        made("pwil", f"seed={seed}", score=score, demo_return_mean=demonstration)
        made("control", SAC, f"seed={seed}", score=100.0)  # Over the demonstration of its seed.
    made("red", SAC, score=400.0, demo_return_mean=800.0)
    made("red", SAC, "seed=1", score=-1.0, demo_return_mean=1000.0)
    made("gail", SAC, score=400.0, demo_return_mean=-800.0, seeds={"expert": 9})
    made("vail", SAC, score=400.0, demo_return_mean=None)
    made("expert", score=500.0)
    found = {name: line.over_demonstration for name, line in lines(made).items()}
    assert found["PWIL (SAC)"] == pytest.approx((0.7, 0.5, 0.9))
    assert found["control: constant (SAC)"].value == pytest.approx((100 / 800 + 100 / 1000) / 2)
    for name in ("RED (SAC)", "GAIL (SAC)", "VAIL (SAC)", "expert (PPO)"):
        assert found[name] is None
    assert "Over demonstration: the score divided by " in caption(results(made))
    assert "| 0.70 [0.50, 0.90] |" in table_markdown(results(made))
    out = report(made, capsys)
    rows = {row["method"]: row for row in csv.DictReader((out / "results.csv").open())}
    pwil = rows["PWIL (SAC)"]
    assert (pwil["algorithm"], pwil["each_seed_over_demonstration"]) == ("sac", "0.5 0.9")
    assert float(pwil["over_demonstration"]) == pytest.approx(0.7)
    assert rows["RED (SAC)"]["over_demonstration"] == ""
    each = {(row["method"], row["seed"]): row for row in csv.DictReader((out / "runs.csv").open())}
    assert (each["pwil", "1"]["algorithm"], each["pwil", "1"]["score_over_demo"]) == ("sac", "0.9")
    assert each["red", "0"]["score_over_demo"] == "0.5"
    assert each["red", "1"]["score_over_demo"] == each["gail", "0"]["score_over_demo"] == ""


def test_where_no_row_has_a_ratio_there_is_no_column(made):
    made("pwil", score=-1.0)
    made("giril", score=-2.0)
    assert "over demonstration" not in table_markdown(results(made))
    assert "Over demonstration" not in caption(results(made))


def test_learner_and_reward(made, capsys):
    for algorithm, scores in ((PPO, (-990.0, 20.0, 300.0, 7.0)), (SAC, (720.0, 30.0, 850.0, 8.0))):
        pwil, giril, true, constant = scores
        for seed in (0, 1):
            made("pwil", algorithm, f"seed={seed}", score=pwil + seed)
        made("giril", algorithm, PAPER, score=giril)
        made("expert", algorithm, "stop_early=false", "steps=300000", score=true)
        made("control", algorithm, score=constant)
    made("control", PPO, "reward=copy", score=9.0)
    made("red", SAC, score=999.0)  # With one algorithm alone.
    made("gail", PPO, score=999.0)
    made("gail", SAC, "steps=1000000", score=999.0)  # At another budget.
    made("expert", score=1000.0)
    text = (report(made, capsys) / "report.md").read_text()
    heading = "### inverted_pendulum: learner and reward\n"
    assert text.count("learner and reward") == 1
    section = text.partition(heading)[2].partition("\n#")[0].strip().splitlines()
    assert section == [
        "Mean scores of the same rewards with either learner after 300,000 environment steps, "
        "1 to 2 seeds, with 95% intervals: compare rows to see what the reward does, and columns "
        "to see what the learner does.",
        "",
        "| reward | PPO | SAC |",
        "| --- | --- | --- |",
        "| the true reward | 300.0 | 850.0 |",
        "| GIRIL (paper) | 20.0 | 30.0 |",
        "| PWIL | -989.5 [-990.0, -989.0] | **720.5 [720.0, 721.0]** |",
        "| best control | 9.0: copy | 8.0: constant |",
    ]


def test_learner_and_reward_with_settings_that_differ_from_the_recipes_own(made):
    """Each beside its own twin, and none of a tuned algorithm."""
    for algorithm, tuned, pwil, giril in (
        (PPO, "ppo.lr=0.002", -990.0, 20.0),
        (SAC, "sac.lr=0.002", 700.0, 30.0),
    ):
        made("pwil", algorithm, score=pwil)
        made("pwil", algorithm, tuned, score=999.0)
        made("giril", algorithm, PAPER, "demo.subsample=1", score=giril)
        made("giril", algorithm, PAPER, f"demo.subsample={3 if algorithm == SAC else 2}", score=0.0)
    made("bc", "demo.subsample=2", score=1.0)
    assert learner_and_reward(panel(made)).splitlines()[-4:] == [
        "| reward | PPO | SAC |",
        "| --- | --- | --- |",
        "| GIRIL (paper), demo.subsample=1 | 20.0 | 30.0 |",
        "| PWIL | -990.0 | **700.0** |",
    ]


def test_one_method_with_both_algorithms_makes_no_table_of_learners(made):
    for algorithm in (PPO, SAC):
        made("pwil", algorithm, score=1.0)
        made("expert", algorithm, "stop_early=false", "steps=300000", score=2.0)
        made("control", algorithm, score=3.0)
    assert learner_and_reward(panel(made)) == ""
    made("giril", PPO, PAPER, score=1.0)
    made("giril", SAC, score=1.0)  # Of another profile.
    assert learner_and_reward(panel(made)) == ""


def test_over_all_tasks_each_algorithm_is_a_method(made):
    for task in ("inverted_pendulum", "inverted_double_pendulum"):
        words = (f"task={task}", "steps=1000")
        made("control", *words, "reward=random", score=0.0)
        made("pwil", *words, PPO, score=90.0)
        made("pwil", *words, SAC, score=450.0)
    made("giril", "task=inverted_pendulum", "steps=1000", score=9.0)
    text = overall(panels_of(read_runs(made.root)[0]))
    assert "| PWIL (PPO) | 1 | 0.10 | 0.10 |" in text
    assert "| **PWIL (SAC)** | 1 | **0.50** | 0.50 |" in text
    assert "Not on every task, and so not here: GIRIL (released, PPO)." in text


MANY = ("giril", "cdil", "gail", "vail", "airl", "ilde", "mmd", "nearest", "red", "dril")
CONTROLS = ("constant", "untrained_giril", "copy", "noise", "entropy_bonus", "random")


def looks(axes):
    return {
        line.get_label().partition(", n = ")[0]: (line.get_color(), line.is_dashed())
        for line in axes.get_lines()
        if ", n = " in line.get_label()
    }


def test_many_methods_are_drawn_in_parts_and_told_apart(made, drawn, capsys):
    for recipe in MANY:
        made(recipe, SAC, score=1.0)
    made("pwil", SAC, score=1.0)
    made("pwil", PPO, score=1.0)
    for reward in CONTROLS:
        made("control", SAC, f"reward={reward}", score=1.0)
    out = report(made, capsys)
    names = ["curves-inverted_pendulum.png", "curves-inverted_pendulum-controls.png"]
    text = (out / "report.md").read_text()
    assert all(f"]({name})" in text and (out / name).exists() for name in names)
    methods, controls = [figure for figure in drawn if figure.axes[0].get_ylabel()]
    parts = [axes for axes in methods.axes if axes.get_title()]
    assert [axes.get_title() for axes in parts] == ["methods, 1 of 2", "methods, 2 of 2"]
    assert [axes.get_title() for axes in controls.axes] == ["controls"]
    for axes in (*parts, *controls.axes):
        found = looks(axes)
        assert 4 <= len(found) <= 8 and len(set(map(str, found.values()))) == len(found)
    assert sum(len(looks(axes)) for axes in parts) == len(MANY) + 2
    (pwil,) = [looks(axes) for axes in parts if "PWIL (SAC)" in looks(axes)]
    (sac, is_dashed), (ppo, is_dotted) = pwil["PWIL (SAC)"], pwil["PWIL (PPO)"]
    assert sac == ppo and is_dotted and not is_dashed


def test_few_rows_with_sac_are_one_picture_of_methods_and_controls(made, drawn, capsys):
    made("airl", SAC, score=1.0)
    made("sinkhorn", SAC, score=1.0)  # Of the same colour in the registry.
    made("control", SAC, score=1.0)
    report(made, capsys)
    (figure,) = drawn
    assert [axes.get_title() for axes in figure.axes] == ["methods", "controls"]
    colours = [colour for colour, _ in looks(figure.axes[0]).values()]
    assert len(set(colours)) == 2
