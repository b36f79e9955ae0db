"""Demonstrations of states alone: kept, checked, shown, imported and exported."""

import datasets
import numpy as np
import pytest

from giril_rl.cli.command_line import main
from giril_rl.demos import (
    Demonstration,
    check_demonstration,
    import_demonstration,
    named_task,
    to_minari,
    verify_by_replay,
)
from giril_rl.demos.check import check_for_task
from giril_rl.errors import UserError

PENDULUM = named_task(None, datasets.ENV)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def less(columns, *names):
    return {name: value for name, value in columns.items() if name not in names}


def sources():
    """The same five transitions, of which only the last source has actions."""
    np.savez("rows.npz", **less(datasets.columns(), "action"))
    np.savez("whole.npz", **less(datasets.whole(), "actions", "rewards"))
    datasets.tensors().exclude("action").memmap("memmap")
    np.savez("actions.npz", **datasets.columns())
    return ["rows.npz", "whole.npz", "memmap", "actions.npz"]


def test_it_is_saved_loaded_and_checked(demo):
    states = demo.without_actions()
    assert not states.has_actions and demo.has_actions and "action" in demo.transitions.keys()
    states.save("states")
    again = Demonstration.load("states")
    assert again.card["actions"] is False and "action" not in again.transitions.keys()
    assert again.demo_id == states.demo_id != demo.demo_id
    assert (again.returns == demo.returns).all()
    check_demonstration(again, 2, None)
    late = again.transitions.clone()
    late["observation"] = late["observation"].roll(1, 0)
    with pytest.raises(UserError, match="misaligned"):
        check_demonstration(Demonstration(late, again.card))


def test_card_and_transitions_say_the_same(demo):
    lost = Demonstration(demo.transitions.exclude("action"), demo.card)
    with pytest.raises(UserError, match="has no 'action'"):
        lost.check()
    more = Demonstration(demo.transitions, {**demo.card, "actions": False})
    with pytest.raises(UserError, match="has actions and a card that says that it has none"):
        more.save("more")


def test_it_fits_a_task_by_its_observations_alone(demo):
    np.savez("actions.npz", **datasets.columns())
    states = import_demonstration("actions.npz", PENDULUM).without_actions()
    check_for_task(states, PENDULUM)
    with pytest.raises(UserError, match="2 numbers in an observation and the task has 3"):
        check_for_task(demo.without_actions(), PENDULUM)


@pytest.mark.parametrize("number", range(4))
def test_states_are_imported_from_each_format(number, capsys):
    source = sources()[number]
    words = ["demo", "import", source, "--env-id", datasets.ENV, "--out", "out"]
    if source != "actions.npz":
        assert main(words) == 2
        told = capsys.readouterr().err
        assert " no action" in told and "--without-actions takes states alone." in told
    assert main([*words, "--without-actions"]) == 0
    assert "replay: none: no actions" in capsys.readouterr().out
    found, wanted = Demonstration.load("out"), datasets.columns()
    assert not found.has_actions and found.lengths.tolist() == [3, 2]
    assert np.array_equal(found.transitions["observation"].numpy(), wanted["observation"])
    after = found.transitions["next"]
    assert np.array_equal(after["observation"].numpy(), wanted["next_observation"])
    assert np.array_equal(after["terminated"].reshape(-1).numpy(), wanted["terminated"])
    assert np.array_equal(after["truncated"].reshape(-1).numpy(), wanted["truncated"])
    assert main(["demo", "show", "out"]) == 0
    assert "actions      none, states alone" in capsys.readouterr().out


def test_states_are_imported_from_minari_whatever_its_actions_are(tmp_path):
    h5py = pytest.importorskip("h5py")
    parts = [less(part, "actions") for part in datasets.episodes()]
    folder = datasets.write_minari(tmp_path / "minari", "robot/reach-v0", parts)
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        for number in range(2):
            file[f"episode_{number}/actions/gripper"] = np.zeros(3)  # A Dict space.
    with pytest.raises(UserError, match="actions of several parts"):
        import_demonstration("minari:robot/reach-v0", PENDULUM)
    found = import_demonstration("minari:robot/reach-v0", PENDULUM, actions=False)
    assert found.lengths.tolist() == [3, 2] and not found.has_actions


def test_exports(demo, make_fn, capsys):
    np.savez("actions.npz", **datasets.columns())
    states = import_demonstration("actions.npz", PENDULUM).without_actions()
    states.save("states")
    assert main(["demo", "export", "states", "--npz", "states.npz"]) == 0
    again = import_demonstration("states.npz", PENDULUM, actions=False)
    assert again.demo_id == states.demo_id
    assert main(["demo", "export", "states", "--minari", "a/b-v0"]) == 2
    assert "has none: export it with --npz." in capsys.readouterr().err
    pytest.importorskip("minari")
    with pytest.raises(UserError, match="has none: export it with --npz"):
        to_minari(states, "a/b-v0", make_fn)


def test_there_is_nothing_to_replay(demo, make_fn):
    with pytest.raises(UserError, match="no actions, so there is nothing to replay"):
        verify_by_replay(demo.without_actions(), make_fn)


def test_rows_that_do_not_fit_are_refused_without_actions_too():
    np.savez("short.npz", **{**less(datasets.columns(), "action"), "terminated": np.zeros(4, bool)})
    with pytest.raises(UserError, match="5 rows of observation and 4 of terminated"):
        import_demonstration("short.npz", PENDULUM, actions=False)
    to_few = {**less(datasets.whole(), "actions"), "lengths": np.array([3, 3])}
    np.savez("few.npz", **to_few)
    with pytest.raises(UserError, match="7 rows of observations and lengths ask for 8"):
        import_demonstration("few.npz", PENDULUM, actions=False)
