"""Every run of a study is composed and checked before the first one starts."""

import json
import re
from pathlib import Path

import pytest

from giril_rl.cli.command_line import main
from giril_rl.config.compose import groups
from giril_rl.config.recipes import find
from giril_rl.errors import UserError
from giril_rl.experiments.study.plan import Planner
from giril_rl.experiments.study.spec import find_study, read_spec, shipped_studies
from giril_rl.runs.identity import config_hash, out_folder
from giril_rl.training.experts import expert_settings


def plan(name, *changes):
    return Planner(Path("runs")).plan(read_spec(find_study(name)), changes)


def test_runs_are_all_combinations_and_their_folders_those_of_giril_run(study):
    name = study("groups: [{label: a, recipe: fake.py, seed: [0, 1], ppo.lr: [0.1, 0.2]}]")
    runs = plan(name)
    place = "fake/inverted_pendulum"
    assert {run.name for run in runs} == {
        f"{place}/ppo.lr={lr}/seed{seed}" for lr in (0.1, 0.2) for seed in (0, 1)
    }
    assert [(run.config.ppo.lr, run.config.seed) for run in runs][:2] == [(0.1, 0), (0.2, 0)]
    for run in runs:
        assert run.folder == Path("runs") / run.name
        assert main(run.command) == 0
        assert run.finished
        assert json.loads((run.folder / "result.json").read_text())["config_hash"] == config_hash(
            run.config
        )


def test_a_knob_at_its_own_value_is_left_out_and_the_run_shared(study):
    name = study(
        """
all: {task: inverted_double_pendulum, seed: 3}
groups:
  - label: a
    recipe: fake.py
    steps: 1_000_000
    ppo.epochs: 10
    widths: [4]
    ppo.clip: [0.1, 0.2]
"""
    )
    own, other = plan(name)
    # 1M is the task's own budget; the other task's is 300,000.
    assert own.name == "fake/inverted_double_pendulum/default/seed3"
    assert own.words == ("task=inverted_double_pendulum", "seed=3")
    assert other.name == "fake/inverted_double_pendulum/ppo.clip=0.2/seed3"
    (run, _) = plan(name, "task=inverted_pendulum")
    assert run.name == "fake/inverted_pendulum/steps=1000000/seed3"


def test_a_knob_stays_where_another_one_moves_its_default(study):
    name = study("groups: [{label: a, recipe: fake.py, task.steps: 70000, steps: 300000}]")
    (run,) = plan(name)
    assert (run.config.steps, run.config.task.steps) == (300_000, 70_000)
    assert run.name == "fake/inverted_pendulum/steps=300000,task.steps=70000/seed0"


def test_the_command_line_takes_the_place_of_every_groups_own(study):
    name = study(
        "groups: [{label: a, recipe: fake.py, seed: [0, 1]}, {label: b, recipe: fake.py, how: bug}]"
    )
    runs = plan(name, "seed=5,6", "ppo.lr=0.5")
    assert [(run.label, run.config.seed, run.config.ppo.lr) for run in runs] == [
        ("a", 5, 0.5),
        ("b", 5, 0.5),
        ("a", 6, 0.5),
        ("b", 6, 0.5),
    ]


def test_a_budget_for_all_groups_leaves_cloning_alone(study):
    groups = "groups: [{label: a, recipe: giril, steps: 16000}, {label: b, recipe: bc}]"
    runs = plan(study(groups), "steps=8000")
    assert {run.recipe.name: run.config.steps for run in runs} == {"giril": 8000, "bc": 0}


def test_a_study_that_is_cut_short_has_every_row_of_the_first_seed(study):
    name = study(
        "groups: [{label: a, recipe: fake.py, seed: [0, 1]},"
        " {label: b, recipe: fake.py, how: bug, seed: [1, 0]}]"
    )
    order = [(run.config.seed, run.label) for run in plan(name)]
    assert order == [(0, "a"), (0, "b"), (1, "a"), (1, "b")]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "groups: [{label: a, recipe: fak}]",
            "mine, group 'a': 'fak' is not a recipe",
        ),
        (
            "groups: [{label: a, recipe: fake.py, ppo.learning_rate: 1}]",
            "mine, group 'a': 'ppo.learning_rate' is not a key of fake.py; did you mean 'ppo.lr'?",
        ),
        (
            "groups: [{label: a, recipe: fake.py}, {label: b, recipe: fake.py, seed: [1, x]}]",
            "mine, group 'b': seed=x: a whole number is needed.",
        ),
        (
            "groups: [{label: a, recipe: fake.py, seed: [0, -1]}]",
            "mine, group 'a': seed=-1 must be greater than or equal to 0.",
        ),
        (
            "groups: [{label: a, recipe: fake.py, ppo.clip: 0}]",
            "mine, group 'a': ppo.clip=0.0 must be greater than 0.",
        ),
        (
            "groups: [{label: a, recipe: fake.py, widths: [2, 0]}]",
            "mine, group 'a': widths[1]=0 must be greater than or equal to 1.",
        ),
        (
            "groups: [{label: a, recipe: fake.py, task: pong}]",
            "mine, group 'a': task=pong: choose one of ",
        ),
        (
            "groups: [{label: a, recipe: fake.py, out: x}]",
            "mine, group 'a': out is not a knob of a study's runs",
        ),
        (
            "groups: [{label: a, recipe: fake.py}, {label: b, recipe: fake.py, ppo.epochs: 10}]",
            "mine: groups 'a' and 'b' both ask for the run fake/inverted_pendulum/default/seed0: ",
        ),
        (
            "groups: [{label: a, recipe: fake.py, seed: [1, 1]}]",
            "mine: group 'a' asks twice for the run fake/inverted_pendulum/default/seed1: ",
        ),
    ],
)
def test_refusals(study, capsys, text, sentence):
    assert main(["study", study(text)]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith(f"giril: {sentence}")
    assert captured.out == ""
    assert not Path("runs").exists()


def test_a_finished_run_of_other_settings_is_refused(study):
    name = study("groups: [{label: a, recipe: fake.py}]")
    folder = Path("runs/fake/inverted_pendulum/default/seed0")
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps({"config_hash": "0123456789ab"}))
    with pytest.raises(UserError, match="holds a finished run with other settings"):
        plan(name)


def test_a_knob_of_some_recipes_changes_those(study):
    name = study("groups: [{label: a, recipe: fake.py}, {label: b, recipe: [giril, cdil]}]")
    first, *others = plan(name, "fit.steps=7")
    assert first.words == ()
    assert [run.config.fit.steps for run in others] == [7, 7]
    with pytest.raises(UserError, match=r"group 'a'.*fit\.stops"):
        plan(name, "fit.stops=7")


def test_the_command_lines_seed_is_the_players_too_and_its_budget_is_not(study):
    """Else the study would train one expert, and its first imitator another."""
    name = study(
        """
all: {task: [hopper, half_cheetah], seed: [0, 1]}
groups:
  - {label: player, player: true, recipe: expert}
  - {label: measure, recipe: expert, stop_early: false}
  - {label: others, recipe: [giril, bc]}
"""
    )
    for changes, tasks_and_seeds in (([], 4), (["seed=5", "steps=400000"], 2)):
        runs = plan(name, *changes)
        players = {run.folder for run in runs if run.label == "player"}
        wanted = {
            out_folder("expert", expert_settings(run.config, run.config.expert), {})
            for run in runs
            if run.label == "others"
        }
        assert players == wanted and len(wanted) == tasks_and_seeds
    measured = [run.config for run in runs if run.label == "measure"]
    assert [(config.seed, config.steps) for config in measured] == [(5, 400_000)] * 2


@pytest.mark.parametrize("text", ["player: 1", "player: [true]"])
def test_a_player_is_one_or_not(study, text):
    with pytest.raises(UserError, match=r"group 'a' has player: .*: write true or false"):
        plan(study(f"groups: [{{label: a, recipe: expert, {text}}}]"))


STUDIES = tuple(shipped_studies())
GAMES = ("atari", "atari-small", "atari-smoke")


def test_every_shipped_study_fits_the_recipes():
    """Recipes, keys, types and values; the tasks by their names, for composing takes its time."""
    planner = Planner(Path("runs"))
    tasks = groups(find("giril"))["task"][0]
    for name in STUDIES:
        spec = read_spec(find_study(name))
        for group in spec.groups:
            named = group.knobs["task"]
            assert set(named if isinstance(named, list) else [named]) <= set(tasks)
        task = "breakout" if name in GAMES else "inverted_pendulum"
        assert planner.plan(spec, [f"task={task}", "seed=0"])


@pytest.mark.slow
def test_shipped_studies_hold_what_they_say():
    planner = Planner(Path("runs"))
    plans = {name: planner.plan(read_spec(find_study(name))) for name in STUDIES}
    counts = {name: len(runs) for name, runs in plans.items()}
    # On 2 tasks with 5 seeds: 2 methods in 2 profiles, 2 adversarial, BC, 8 controls and
    # 4 in the profile paper.
    assert counts["pybullet"] == 2 * 5 * (2 * 2 + 2 + 1 + 8 + 4)
    # On 2 tasks with 3 seeds: own settings, 2 betas in 2 profiles, unscaled, I_c, 3 forms, numbers,
    # BC's, controls.
    assert counts["pybullet-ablations"] == 2 * 3 * (4 + 2 + 4 + 4 + 1 + 3 + 4 * 3 + 3 + 3 + 2)
    # 3 experts on 2 tasks, the true reward; on 3 tasks with 3 seeds as above, both forms of 2
    # methods.
    assert counts["pybullet-no-survival"] == 2 * 3 + 3 * 3 + 3 * 3 * (2 * 2 + 2 * 2 + 1 + 8)
    assert counts["atari-smoke"] == 6 * (1 + 5 + 5)
    # A fit of the recipe's own length would take hours on frames.
    fitted = [run for run in plans["atari-smoke"] if hasattr(run.config, "fit")]
    rewards = ("noise", "negated_giril", "centred_giril")
    fits = [
        run.config.fit.steps
        for run in fitted
        if run.recipe.word != "control" or run.config.reward in rewards
    ]
    assert fits == [10] * 6 * 3
    # On 2 games with 2 seeds: GIRIL in 2 profiles, CDIL, 2 adversarial, BC, 7 controls.
    assert counts["atari-small"] == 2 * 2 * (2 + 1 + 2 + 1 + 7)
    pages = Path(__file__).parents[3] / "docs"
    for name, count in counts.items():
        row = rf"^\| `{name}` \|.*"
        (one,) = re.findall(row, (pages / "studies.md").read_text(), re.MULTILINE)
        assert one.endswith(f": {count} runs |"), one
        (one,) = re.findall(row, (pages / "reproduce.md").read_text(), re.MULTILINE)
        assert one.split("|")[2].strip() == str(count), one
    names = {run.name for run in plans["pybullet"]}
    same = planner.plan(read_spec(find_study("pybullet-ablations")), ["steps=1000000"])
    # At one budget own settings and controls are run once for both studies.
    assert len(names & {run.name for run in same}) == 2 * 3 * (4 + 2 + 3 + 2)


def test_experts_go_first(study):
    name = study("groups: [{label: a, recipe: fake.py}, {label: b, recipe: expert}]")
    assert [run.goes_first for run in plan(name)] == [False, True]
