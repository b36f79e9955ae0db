"""Which runs make a row: those that differ in their seed alone."""

import pytest
import yaml

from giril_rl.experiments.report.entries import PALETTE
from giril_rl.experiments.report.reading import read_runs
from giril_rl.experiments.report.tables import panels_of, tables_of
from giril_rl.experiments.report.text import seeds_text
from giril_rl.rewards.method import BLUE, Method, register, unregister


def panels(made):
    return panels_of(read_runs(made.root)[0])


def rows(made):
    (panel,) = panels(made)
    return {(row.name, row.settings, row.steps): row for row in panel.rows}


def tables(made):
    (panel,) = panels(made)
    return {table.name: table for table in tables_of(panel)}


def test_seeds_make_a_row_however_the_runs_were_asked_for(made):
    made("giril", "seed=1", score=30.0, mode=29.0)
    made("giril", score=10.0, mode=9.0)
    # Where the folder lies and what is logged make no difference; nor does a default spelled out.
    made("giril", "seed=2", "root=x", "logger=null", "ppo.lr=3e-4", "profile=released", score=50.0)
    (row,) = rows(made).values()
    assert (row.name, row.settings, row.steps) == ("GIRIL (released)", "", 300_000)
    assert (row.seeds, row.scores, row.modes) == ([0, 1, 2], [10, 30, 50], [9, 29, 50])
    assert row.estimates[0].value == 30.0


def test_methods_profiles_budgets_and_settings_make_rows_of_their_own(made):
    made("giril", score=1.0)
    made("giril", "profile=paper", score=2.0)
    made("giril", "steps=1000000", score=3.0)
    made("giril", "reward.prior=conditional", "ppo.clip=0.2", score=4.0)
    made("giril", "batch_mean=false", "seed=1", score=5.0)  # The paper's, by another name.
    made("control", score=6.0)
    found = {key: row.scores for key, row in rows(made).items()}
    assert found == {
        ("GIRIL (released)", "", 300_000): [1.0],
        ("GIRIL (paper)", "", 300_000): [2.0, 5.0],
        ("GIRIL (released)", "", 1_000_000): [3.0],
        ("GIRIL (released)", "ppo.clip=0.2 reward.prior=conditional", 300_000): [4.0],
        ("control: constant", "", 300_000): [6.0],
    }
    # An unknown difference has a line of its own, beside the recipe's own settings.
    lines = [(line.row.name, line.value) for line in tables(made)["other"].lines]
    assert lines == [
        ("GIRIL (released)", "the recipe's own"),
        ("GIRIL (released)", "ppo.clip=0.2 reward.prior=conditional"),
    ]


def test_a_profile_without_effect_makes_no_row_and_a_repeat_is_named(made):
    made("gail", score=1.0)
    repeat = made("gail", score=1.0, name="later", extra={"profile": "paper"})
    (panel,) = panels(made)
    (row,) = panel.rows
    assert (row.name, row.seeds) == ("GAIL", [0])
    assert [run.folder for run in panel.repeats] == [repeat]


def test_what_changes_the_task_makes_a_panel_without_the_papers_numbers(made):
    made("giril", score=1.0)
    made("giril", "task.horizon=fixed", score=2.0)
    made("giril", "termination=bootstrap", "task=inverted_double_pendulum", score=3.0)
    found = {panel.title: panel for panel in panels(made)}
    assert list(found) == [
        "inverted_double_pendulum, termination=bootstrap",
        "inverted_pendulum",
        "inverted_pendulum, task.horizon=fixed",
    ]
    papers = {
        title: [line.paper and line.paper.value for line in tables_of(panel)[0].lines]
        for title, panel in found.items()
    }
    assert list(papers.values()) == [[None], [990.2], [None]]


def test_runs_without_a_termination_join_those_that_have_one(made):
    made("giril", "termination=bootstrap", score=1.0)
    made("bc", score=2.0)
    (panel,) = panels(made)
    assert [row.name for row in panel.rows] == ["GIRIL (released)", "BC"]
    made("giril", score=1.0)
    plain, changed = panels(made)
    assert [len(each.rows) for each in (plain, changed)] == [2, 1]


def test_how_long_an_expert_trains_makes_no_other_task(made):
    made("giril", "task.expert_steps=2000000", score=1.0)
    made("giril", "task.expert_score=900", score=2.0)
    found = {row.settings.split()[-1] for row in rows(made).values()}
    assert found == {"task.expert_steps=2000000", "task.expert_score=900.0"}


def test_a_key_that_a_run_was_made_without_is_no_difference(made):
    folder = made("giril", score=1.0)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    for key in ("horizon", "after_failure", "expert_steps"):
        del config["task"][key]
    del config["termination"]
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    made("giril", "seed=1", score=2.0)
    (row,) = rows(made).values()
    assert row.seeds == [0, 1]


def test_a_key_that_the_recipe_does_not_know_is_a_difference(made):
    made("giril", score=1.0, extra={"novelty": 3})
    (row,) = rows(made).values()
    assert row.settings == "novelty=3"


def test_runs_of_an_unknown_recipe_are_compared_with_one_another(made):
    for seed, clip in ((0, 0.1), (1, 0.1), (2, 0.3)):
        made("giril", f"seed={seed}", f"ppo.clip={clip}", score=1.0, extra={"recipe": "mine"})
    found = {row.settings: row.seeds for row in rows(made).values()}
    assert found == {"": [0, 1], "ppo.clip=0.3": [2]}


def test_a_recipe_of_ones_own_is_a_method_beside_the_shipped_ones(made):
    made("giril", score=1.0)
    made("giril", "ppo.clip=0.1", score=2.0, extra={"recipe": "mine"})  # Its result says giril.
    made("bc", "eval.seed=10000", score=3.0, extra={"recipe": "GAIL"}, profile=None)
    made("gail", score=4.0)
    made("control", "reward=copy", score=5.0, extra={"recipe": "other"})
    made("control", "reward=noise", "seed=1", score=6.0, extra={"recipe": "other"})
    (panel,) = panels(made)
    assert panel.repeats == []
    assert {(row.name, row.settings): row.scores for row in panel.rows} == {
        ("GIRIL (released)", ""): [1.0],
        ("GAIL", ""): [4.0],
        ("GAIL (own)", ""): [3.0],
        ("mine (released)", ""): [2.0],
        ("other (released)", ""): [5.0],
        ("other (released)", "reward=noise"): [6.0],
    }
    table = tables(made)["results"]
    assert len(table.lines) == 5 and [line.row.scores for line in table.best] == [[5.0]]
    colours = [row.look.color for row in panel.main]
    assert len(set(colours)) == 5
    assert not set(colours[2:]) & set(PALETTE)  # Of no shipped method, in any picture.


def test_a_runs_settings_name_no_file_that_is_run(made, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "theirs.py").write_text('"""A recipe."""\nraise SystemExit("it was run")\n')
    (tmp_path / "theirs.yaml").write_text("defaults: [recipe_schema]\n")
    made("giril", score=1.0, extra={"recipe": "theirs.py"})
    assert [row.name for row in panels(made)[0].rows] == ["theirs.py (released)"]


def test_the_demonstration_follows_the_seed_and_a_given_one_is_a_row(made):
    for seed in range(3):
        made("giril", f"seed={seed}", score=1.0, demo_id=f"d{seed}", demo=f"shipped:pole/{seed}")
    made("giril", "demo.path=mine", score=2.0, demo_id="d9", demo="mine")
    made("bc", score=3.0)
    found = {(row.name, row.settings): row.seeds for row in rows(made).values()}
    assert found == {
        ("GIRIL (released)", ""): [0, 1, 2],
        ("GIRIL (released)", "demo.path=mine"): [0],
        ("BC", ""): [0],
    }


def test_controls_are_not_told_apart_by_what_they_do_not_read(made):
    made("giril", "demo.path=mine", "ppo.lr=0.1", score=1.0)
    made("bc", "demo.path=mine", "ppo.lr=0.1", score=1.0)
    made("control", "ppo.lr=0.1", score=2.0)  # A constant has no demonstration,
    made("control", "reward=random", score=3.0)  # and a random policy trains nothing.
    (panel,) = panels(made)
    assert panel.shared == (("demo.path", "mine"), ("ppo.lr", "0.1"))
    assert len(panel.main) == 4


@pytest.fixture
def registered():
    """Two more methods in the registry, of which the control has no reward."""
    zero = Method("control:zero", "zeros", "#654321", kind="control", trained="never", rank=300)
    found = [Method("mine", "Mine", "#123456"), zero]
    yield [register(method) for method in found]
    for method in found:
        unregister(method.name)


def test_the_report_learns_of_a_method_from_its_entry(made, registered):
    made("giril", score=1.0)
    made("giril", score=2.0, name="mine", extra={"recipe": "mine"}, profile=None)
    for seed, lr in ((0, "0.1"), (1, "0.2")):
        words = (f"seed={seed}", f"ppo.lr={lr}")
        made("control", *words, score=3.0, extra={"reward": "zero"}, method="control:zero")
    (panel,) = panels(made)
    assert [(row.name, row.seeds, row.is_control, row.look.color) for row in panel.rows] == [
        ("GIRIL (released)", [0], False, BLUE),
        ("Mine", [0], False, "#123456"),
        ("zeros", [0, 1], True, "#654321"),
    ]


def test_what_all_runs_share_is_the_panels_and_no_rows(made):
    made("giril", "ppo.clip=0.2", score=1.0)
    made("giril", "ppo.clip=0.2", "reward.beta=0.9", score=2.0)
    made("control", "ppo.clip=0.2", score=3.0)
    made("expert", score=4.0)
    made("gail", "ppo.clip=0.2", score=5.0, extra={"recipe": "mine"}, profile=None)
    (panel,) = panels(made)
    assert panel.shared == (("ppo.clip", "0.2"),)
    assert [(row.name, row.settings) for row in panel.rows] == [
        ("expert", ""),
        ("GIRIL (released)", ""),
        ("GIRIL (released)", "reward.beta=0.9"),
        ("mine", ""),
        ("control: constant", ""),
    ]


def test_a_whole_budget_on_the_true_reward_is_a_method_beside_the_others(made):
    made("expert", score=4.0)
    for seed in (0, 1):
        made("expert", "stop_early=false", f"seed={seed}", score=3.0 + seed)
    made("giril", score=1.0)
    made("control", score=2.0)
    (panel,) = panels(made)
    assert [(row.name, row.settings, row.seeds) for row in panel.rows] == [
        ("expert", "", [0]),
        ("PPO on the true reward", "", [0, 1]),
        ("GIRIL (released)", "", [0]),
        ("control: constant", "", [0]),
    ]
    (table,) = tables_of(panel)
    assert table.name == "results"
    assert seeds_text(panel.main) == "1 to 2 seeds"


def test_what_one_method_alone_has_is_not_shared(made):
    made("giril", "reward.prior=conditional", score=1.0)
    made("control", score=3.0)
    (panel,) = panels(made)
    assert panel.shared == ()
    assert panel.rows[0].settings == "reward.prior=conditional"


def test_how_a_model_is_fitted_is_nothing_to_controls_that_have_none(made):
    for recipe in ("giril", "cdil"):
        made(recipe, "fit.steps=7", score=1.0)
    made("control", score=2.0)
    made("control", "reward=copy", "fit.steps=9", score=3.0)
    (panel,) = panels(made)
    assert panel.shared == (("fit.steps", "7"),)
    assert len(panel.main) == 4
    made("control", "reward=noise", score=4.0)  # Which is matched to a fitted model.
    (panel,) = panels(made)
    assert panel.shared == () and len(panel.main) == 3


def test_ablations_are_recognised_by_their_keys(made):
    made("giril", score=1.0)
    made("giril", "profile=paper", score=1.5)  # Nothing is varied in this profile.
    made("giril", "reward.beta=0.9", score=2.0)
    made("giril", "reward.beta=0.99", score=3.0)
    made("giril", "scaling.enabled=false", score=4.0)
    made("giril", "demo.length=null", "demo.episodes=5", score=5.0)
    made("giril", "demo.length=null", "demo.episodes=10", score=6.0)
    made("vail", score=7.0)
    made("vail", "reward.information=0.2", score=8.0)
    made("gail", score=9.0)
    made("gail", "reward.form=negative", score=10.0)
    found = {
        name: [(line.row.name, line.value, line.row.scores[0]) for line in table.lines]
        for name, table in tables(made).items()
        if name != "results"
    }
    giril = "GIRIL (released)"
    assert found == {
        "beta": [(giril, "β = 1.0", 1.0), (giril, "β = 0.9", 2.0), (giril, "β = 0.99", 3.0)],
        "standardisation": [(giril, "standardised", 1.0), (giril, "original", 4.0)],
        "information": [("VAIL", "I_c = 0.5", 7.0), ("VAIL", "I_c = 0.2", 8.0)],
        "form": [("GAIL", "positive", 9.0), ("GAIL", "negative", 10.0)],
        "demonstrations": [
            (giril, "1,000 transitions", 1.0),
            (giril, "5 full episodes", 5.0),
            (giril, "10 full episodes", 6.0),
        ],
    }
    papers = [line.paper and line.paper.value for line in tables(made)["demonstrations"].lines]
    assert papers == [None, 1000.0, 994.4]


def test_two_things_varied_at_once_are_in_no_ablation(made):
    made("giril", "reward.beta=0.9", "scaling.enabled=false", score=1.0)
    found = tables(made)
    assert list(found) == ["other"]
    assert found["other"].lines[0].value == "reward.beta=0.9 scaling.enabled=false"


def test_the_best_control_has_the_highest_mean_at_that_budget(made):
    for seed, score in ((0, 10.0), (1, 20.0)):
        made("control", f"seed={seed}", score=score)
    made("control", "reward=copy", score=14.0)
    made("control", "reward=copy", "ppo.clip=0.2", score=90.0)  # Not its own settings.
    made("control", "reward=noise", "steps=1000000", score=80.0)
    made("control", "reward=random", "steps=1000000", score=12.0)
    for seed, score in ((0, 5.0), (1, 15.0)):
        made("giril", f"seed={seed}", score=score)
    made("giril", "steps=1000000", score=81.0)
    made("bc", score=79.0)
    (panel,) = panels(made)
    lines = {(line.row.name, line.row.steps): line for line in tables_of(panel)[0].lines}
    estimate, best = lines["GIRIL (released)", 300_000].improvement
    assert best.name == "control: constant"
    assert estimate.value == (0 + 0 + 1 + 0) / 4
    assert lines["GIRIL (released)", 1_000_000].improvement[1].name == "control: noise"
    # What takes no steps is compared with the controls of the largest budget.
    estimate, best = lines["BC", 0].improvement
    assert (best.name, estimate.value) == ("control: noise", 0.0)
    assert lines["control: constant", 300_000].improvement is None


def test_a_random_policy_alone_is_no_control_to_beat(made):
    made("control", "reward=random", score=1.0)
    made("giril", score=2.0)
    made("bc", score=3.0)
    (panel,) = panels(made)
    assert all(line.improvement is None for line in tables_of(panel)[0].lines)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["task=breakout"], "demonstration of one life"),
        (["task=breakout", "demo.lives=all"], "demonstration"),
        ([], "demonstration"),
    ],
)
def test_one_life_is_not_called_a_whole_demonstration(made, words, name):
    """Scores are of whole games, and are divided by it as in the paper."""
    made("giril", *words, score=2.0)
    made("control", *(word for word in words if "task" in word), score=1.0)
    (panel,) = panels(made)
    assert panel.demonstration == name
