"""Normalised scores by hand, what is missing for them, and what an interval covers."""

import pytest

from giril_rl.experiments.report.captions import intervals_text, what_is_missing
from giril_rl.experiments.report.reading import read_runs
from giril_rl.experiments.report.tables import panels_of, tables_of


def panel(made):
    (found,) = panels_of(read_runs(made.root)[0])
    return found


def lines(made):
    return {line.row.name: line for line in tables_of(panel(made))[0].lines}


def test_each_run_is_on_the_scale_of_its_own_player(made):
    for seed, low in enumerate((-400.0, -200.0)):  # Their mean, -300, is 0.
        made("control", "reward=random", f"seed={seed}", score=low)
    for seed, (score, player) in enumerate(((-200.0, -100.0), (50.0, 100.0))):
        made("giril", f"seed={seed}", score=score, expert_return_mean=player)
    made("control", "seed=1", score=-400.0)  # Without a player: that of seed 1.
    found = lines(made)
    # (-200 + 300) / (-100 + 300) and (50 + 300) / (100 + 300)
    assert found["GIRIL (released)"].normalised[0].value == pytest.approx((0.5 + 0.875) / 2)
    assert found["GIRIL (released)"].normalised[0][1:] == (0.5, 0.875)
    assert found["control: random"].normalised[0].value == pytest.approx(
        ((-400 + 300) / (-100 + 300) + (-200 + 300) / (100 + 300)) / 2
    )
    assert found["control: constant"].normalised[0].value == pytest.approx(-100 / 400)
    assert found["GIRIL (released)"].row.estimates[0].value == -75.0
    assert panel(made).references("expert") == [-100.0, 100.0]
    assert what_is_missing(panel(made)) == ""


def test_of_one_run_without_a_number_its_row_has_none(made):
    made("control", "reward=random", score=10.0)
    made("giril", score=50.0, expert_return_mean=110.0)
    made("giril", "seed=1", score=50.0, expert_return_mean=10.0)  # No better than chance.
    made("expert", score=110.0)
    found = lines(made)
    assert found["GIRIL (released)"].normalised is found["expert"].normalised is None
    assert what_is_missing(panel(made)) == (
        "Not all are normalised: the player of seed 1 scores 10.0, not more than the random policy "
        "(10.0); `giril run bc task=inverted_pendulum seed=1 demo.path=null "
        f"expert.steps=10000000 root={made.root}` trains it for longer."
    )


def test_a_missing_player_is_named_with_the_command_that_has_it(made):
    words = ("task.horizon=fixed", "termination=bootstrap")
    for seed in (3, 4):
        made("control", *words, f"seed={seed}", score=50.0)
    made("control", *words, "reward=random", score=10.0)
    made("giril", *words, "seed=5", score=50.0, expert_return_mean=None, name="theirs")
    command = (
        f"`giril run bc task=inverted_pendulum task.horizon=fixed -m seed=0,3,4 root={made.root}`"
    )
    assert what_is_missing(panel(made)) == (
        f"Not all are normalised: no run tells the score of the player of seeds 0, 3, 4; {command} "
        "does. Also, the demonstration of `theirs` does not tell its player's score; write it "
        'into the demonstration\'s `card.json`, `"expert": {"return_mean": SCORE}`, and make the '
        "run again."
    )


@pytest.mark.parametrize(
    ("origins", "text"),
    [
        (
            [("d0", 0), ("d1", 1), ("d2", 2)],
            "Each seed has its own player and demonstration, so that the interval covers the "
            "choice of both.",
        ),
        (
            [("d0", 0), ("d0", 0), ("d0", 0)],
            "One demonstration for all seeds, so that the interval does not cover the choice of "
            "the demonstration.",
        ),
        (
            [(None, 0), (None, 0)],  # Of before results told their demonstration.
            "One demonstration for all seeds, so that the interval does not cover the choice of "
            "the demonstration.",
        ),
        (
            [("d0", 0), ("d1", 0)],
            "Each seed has its own demonstration of one player, so that the interval does not "
            "cover the choice of the player.",
        ),
        (
            [("d0", 0), ("d0", 0), ("d1", 1)],
            "2 demonstrations of 2 players for 3 seeds, so that the interval covers their choice "
            "in part.",
        ),
    ],
)
def test_what_an_interval_covers(made, origins, text):
    for seed, (demo, player) in enumerate(origins):
        made(
            "giril",
            f"seed={seed}",
            score=1.0,
            demo_id=demo,
            demo_transitions=1000,
            seeds={"expert": player},
        )
        made("control", f"seed={seed}", score=2.0)
    assert intervals_text(tables_of(panel(made))[0]) == text


def test_rows_of_other_origins_are_told_apart(made):
    for seed in range(2):
        about = {"demo_transitions": 9, "seeds": {"expert": seed}}
        made("giril", f"seed={seed}", score=1.0, demo_id=f"d{seed}", **about)
        made("bc", f"seed={seed}", score=1.0, demo_id="d0", **about)
    assert intervals_text(tables_of(panel(made))[0]) == (
        "GIRIL (released): each seed has its own player and demonstration, so that the interval "
        "covers the choice of both; BC: one demonstration for all seeds, so that the interval does "
        "not cover the choice of the demonstration."
    )
