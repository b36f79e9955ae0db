"""Data sets in and out: the same bits, and a card that says what is known."""

import json
from dataclasses import replace
from pathlib import Path

import datasets
import gymnasium
import numpy as np
import pytest
import torch

from giril_rl.cli.command_line import main
from giril_rl.demos import Demonstration, named_task, record_demonstration, to_npz
from giril_rl.demos.importing import import_demonstration
from giril_rl.envs import AtariGymEnv
from giril_rl.errors import UserError

PENDULUM = named_task(None, datasets.ENV)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def cartpole():
    """Discrete actions; the last of several episodes is cut."""
    return record_demonstration(
        lambda: gymnasium.make("CartPole-v1"),
        lambda o: (o[:, 2] > 0).long(),
        length=100,
        seed=0,
        task="cartpole",
        expert={"return_mean": 40.0, "seed": 3},
    )


def pendulum():
    """Continuous actions; the one episode ends at the time limit."""
    return record_demonstration(
        lambda: gymnasium.make(datasets.ENV), lambda o: o[:, 1:2], episodes=1, seed=1
    )


def breakout():
    """Images; one life."""
    pytest.importorskip("ale_py")
    return record_demonstration(
        lambda: AtariGymEnv("breakout"),
        lambda o: torch.tensor([3]),
        episodes=1,
        seed=0,
        task="breakout",
        lives="first",
    )


CASES = {
    "vectors": (pendulum, ("--env-id", "Pendulum-v1")),
    "discrete": (cartpole, ("--env-id", "CartPole-v1", "--name", "mine")),
    "images": (breakout, ("--task", "breakout")),
}


def run(capsys, *argv):
    assert main(["demo", *argv]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


def assert_same_bits(found, wanted):
    assert set(found.keys(True, True)) == set(wanted.keys(True, True))
    for key in wanted.keys(True, True):
        one, other = found.get(key), wanted.get(key)
        assert (one.dtype, one.shape) == (other.dtype, other.shape), key
        assert one.numpy().tobytes() == other.numpy().tobytes(), key


@pytest.mark.parametrize("form", ["npz", "minari"])
@pytest.mark.parametrize("case", CASES)
def test_export_and_import_give_the_same_bits(case, form, capsys):
    make, words = CASES[case]
    demo = make()
    demo.save("demo")
    if form == "npz":
        run(capsys, "export", "demo", "--npz", "demo.npz")
        source = "demo.npz"
    else:
        pytest.importorskip("minari")
        run(capsys, "export", "demo", "--minari", "a/b/demo-v0", *words[:2])
        source = "minari:a/b/demo-v0"
    printed = run(capsys, "import", source, *words, "--out", "again")
    assert printed == (
        f"again has {len(demo):,} transitions, {demo.num_episodes} episodes.\nreplay: same bits\n"
    )
    again = Demonstration.load("again")
    assert_same_bits(again.transitions, demo.transitions)
    assert again.demo_id == demo.demo_id
    for key in ("seeds", "expert", "deterministic"):
        assert again.card[key] == demo.card[key]
    assert again.card.get("lives") == demo.card.get("lives")
    assert again.card.get("actions") == demo.card.get("actions")
    name = "mine" if "mine" in words else source.removeprefix("minari:")
    assert again.card["source"] == {"format": form, "name": name}
    shown = run(capsys, "show", "again")
    assert f"{name} ({form})" in shown and "same bits" in shown


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int64, np.bool_])
@pytest.mark.parametrize("form", ["npz", "memmap"])
def test_vectors_of_whole_numbers_become_float32(form, dtype):
    """As environments show them and the recorder keeps them."""
    shown = np.array([[0, 1, 0], [1, 0, 1], [1, 1, 1]] * 2, dtype)
    columns = {**datasets.columns(), "observation": shown[:5], "next_observation": shown[1:]}
    if form == "npz":
        np.savez("whole.npz", **columns)
        source = "whole.npz"
    else:
        data = datasets.tensors()
        data["observation"] = torch.from_numpy(shown[:5])
        data["next", "observation"] = torch.from_numpy(shown[1:])
        data.memmap("whole", copy_existing=True)
        source = "whole"
    demo = import_demonstration(source, PENDULUM)
    for key, wanted in (("observation", shown[:5]), (("next", "observation"), shown[1:])):
        found = demo.transitions.get(key)
        assert found.dtype == torch.float32 and found.tolist() == wanted.tolist()


def write(form):
    if form == "minari":
        pytest.importorskip("h5py")
        datasets.write_minari(Path("minari"), "foreign-v0", datasets.episodes())
        return "minari:foreign-v0"
    if form == "memmap":
        datasets.tensors().memmap("folder", copy_existing=True)
        return "folder"
    np.savez("foreign.npz", **(datasets.columns() if form == "columns" else datasets.whole()))
    return "foreign.npz"


@pytest.mark.parametrize("form", ["columns", "whole", "minari", "memmap"])
def test_foreign_data_sets_become_the_same_demonstration(form):
    source = write(form)
    demo = import_demonstration(source, PENDULUM)
    data, wanted = demo.transitions, datasets.columns()
    for key, name in (
        ("observation", "observation"),
        ("action", "action"),
        (("next", "observation"), "next_observation"),
    ):
        np.testing.assert_array_equal(data.get(key).numpy(), wanted[name])
    for name in ("reward", "terminated", "truncated"):
        np.testing.assert_array_equal(data["next", name][:, 0].numpy(), wanted[name])
    assert data["episode"].tolist() == [0, 0, 0, 1, 1]
    assert data["step"].tolist() == [0, 1, 2, 0, 1]
    assert (demo.card["rewards"], demo.card["replay"]) == (True, "none: no seeds")
    assert (demo.card["seeds"], demo.card["length"]) == ([], None)
    demo.save("demo")
    assert len(import_demonstration(source, PENDULUM, episodes=1)) == 3


def test_the_first_episodes_are_taken():
    np.savez("foreign.npz", **datasets.whole())
    demo = import_demonstration("foreign.npz", PENDULUM, episodes=1)
    assert (len(demo), demo.num_episodes, len(demo.card["episode_returns"])) == (3, 1, 1)
    with pytest.raises(UserError, match=r"--episodes 3: .* has only 2, give at most that"):
        import_demonstration("foreign.npz", PENDULUM, episodes=3)


def test_double_precision_is_rounded_as_the_recorder_does():
    arrays = {
        name: value.astype(np.float64) if value.dtype == np.float32 else value
        for name, value in datasets.whole().items()
    }
    np.savez("foreign.npz", **arrays)
    demo = import_demonstration("foreign.npz", PENDULUM)
    assert demo.transitions["action"].dtype == torch.float32


@pytest.mark.parametrize("form", ["npz", "minari"])
def test_rewards_may_be_unknown(form, capsys):
    arrays = datasets.whole()
    del arrays["rewards"]
    np.savez("foreign.npz", **arrays)
    words = ("--env-id", datasets.ENV)
    run(capsys, "import", "foreign.npz", *words, "--out", "demo")
    demo = Demonstration.load("demo")
    assert not demo.has_rewards and not demo.transitions["next", "reward"].any()
    assert demo.card["episode_returns"] is None
    page = run(capsys, "show", "demo").splitlines()
    assert page[-2:] == [
        "      0       3  unknown  terminated",
        "      1       2  unknown  time limit",
    ]
    goal = {"npz": "out.npz", "minari": "out-v0"}[form]
    pytest.importorskip("minari")
    run(capsys, "export", "demo", f"--{form}", goal)
    again = goal if form == "npz" else f"minari:{goal}"
    run(capsys, "import", again, *words, "--out", "again")
    assert not Demonstration.load("again").has_rewards


def test_a_replay_that_leads_elsewhere_is_told(capsys):
    demo = pendulum()
    demo.transitions["action"] = demo.transitions["action"].roll(1, 0)
    to_npz(demo, "late.npz")
    printed = run(capsys, "import", "late.npz", "--env-id", datasets.ENV, "--out", "late")
    assert "replay: differs: replaying the demonstration's actions leads elsewhere" in printed


def test_a_card_is_believed_only_where_it_has_the_right_form():
    card = {
        "format_version": 99,
        "seeds": ["__import__('os')", 2],
        "seed": -1,
        "lives": ["first"],
        "deterministic": "\x1b[2J",
        "actions": ["NOOP\x1b[2J"],
        "expert": {"return_mean": float("nan")},
        "length": 4,
        "task": "other",
        "_target_": "os.system",
    }
    text = np.frombuffer(json.dumps(card).encode(), np.uint8)
    np.savez("foreign.npz", **datasets.columns(), card=text)
    demo = import_demonstration("foreign.npz", PENDULUM, name="a\x1b[2Jb")
    assert demo.card["source"] == {"format": "npz", "name": "a[2Jb"}
    assert demo.card["actions"] == ["NOOP[2J"]
    assert (demo.card["seeds"], demo.card["seed"], demo.card["expert"]) == ([], None, None)
    assert (demo.card["length"], demo.card["deterministic"]) == (None, None)
    assert demo.card["task"] == datasets.ENV
    assert not {"format_version", "lives", "_target_"} & set(demo.card)


def test_a_recipe_takes_what_was_imported():
    from giril_rl.config.schema import DemoConfig, ExpertConfig, RunConfig
    from giril_rl.training import check_inputs

    np.savez("foreign.npz", **datasets.whole())
    import_demonstration("foreign.npz", PENDULUM).save("demo")
    check_inputs(RunConfig(task=PENDULUM), ExpertConfig(), DemoConfig(path="demo"))
    with pytest.raises(UserError, match="does not fit CartPole-v1"):
        cart = RunConfig(task=named_task(None, "CartPole-v1"))
        check_inputs(cart, ExpertConfig(), DemoConfig(path="demo"))


@pytest.mark.filterwarnings("ignore:.* is set to None")
def test_what_minari_itself_wrote_is_replayed_from_its_seeds():
    """In double precision, with infos, as its data collector leaves it."""
    minari = pytest.importorskip("minari")
    from minari.data_collector import EpisodeBuffer

    env, buffers = gymnasium.make(datasets.ENV, max_episode_steps=20), []
    for number, seed in enumerate((7, 8)):
        observations, steps = [env.reset(seed=seed)[0]], []
        while not (steps and steps[-1][3]):
            action = -observations[-1][1:2]
            observation, *outcome = env.step(action)
            observations.append(observation)
            steps.append((action, *outcome))
        actions, rewards, terminations, truncations, _ = zip(*steps, strict=True)
        buffer = EpisodeBuffer(
            id=number,
            seed=seed,
            observations=np.array(observations, np.float64),
            actions=np.array(actions),
            rewards=list(rewards),
            terminations=list(terminations),
            truncations=list(truncations),
            infos={"x": np.zeros(21)},
        )
        buffers.append(buffer)
    minari.create_dataset_from_buffers("collected-v0", buffers, env=env)
    env.close()
    task = replace(PENDULUM, max_episode_steps=20)
    demo = import_demonstration("minari:collected-v0", task)
    assert (len(demo), demo.num_episodes, demo.card["seeds"]) == (40, 2, [7, 8])
    assert demo.card["replay"] == "same bits"
