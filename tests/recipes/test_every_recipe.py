"""Every recipe from its command to its result, with settings so small that nothing is learned."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from short_runs import weights

from giril_rl.cli.command_line import main
from giril_rl.envs import GymVectorEnv
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.metrics import read_metrics

BATCH = 128
TINY = [
    "ppo.num_envs=2",
    "ppo.rollout=64",
    "ppo.minibatch=64",
    "ppo.epochs=1",
    "ppo.hidden=[16,16]",
    "ppo.checkpoint_every=256",
    "eval.episodes=2",
    "logger=null",
]
GIRIL = [
    "expert.steps=2000",
    "demo.length=100",
    "demo.subsample=2",
    "fit.steps=20",
    "fit.log_every=10",
    "reward.hidden=[16]",
    "reward.beta=0.7",  # Then the reward is noisy: more to save and restore.
]
CDIL = [word for word in GIRIL if "beta" not in word]
ADVERSARIAL = [word for word in CDIL if "fit" not in word] + ["reward.penalty=1"]
EXTRA = {
    "giril": GIRIL,
    "cdil": CDIL,
    "gail": ADVERSARIAL,
    "vail": ADVERSARIAL,
    "airl": ADVERSARIAL,
    "ilde": [word for word in CDIL if "reward" not in word],
    "expert": ["stop_early=false"],
    "control": [],
}

SCORES = ["return_mean", "return_std", "return_median", "episode_length_mean", "episodes"]
FIELDS = [
    *("method", "task", "seed", "env_steps", *SCORES),
    *("wall_seconds", "fit_seconds", "steps_per_second"),
    *("expert_return_mean", "demo_return_mean", "demo_transitions", "config_hash", "versions"),
    *("algorithm", "score_over_demo", "finished_at"),
]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def words(recipe, out, root, *more, steps=4 * BATCH):
    place = [f"out={out}", f"root={root}", f"steps={steps}", "task.env_id=CartPole-v1"]
    # A key may be given once, so later words take the place of earlier ones.
    by_key = {word.split("=")[0]: word for word in [*TINY, *EXTRA[recipe], *place, *more]}
    if "task" in by_key:
        del by_key["task.env_id"]
    return ["run", recipe, *by_key.values()]


def run(recipe, out, root, *more, **kwargs):
    assert main(words(recipe, out, root, *more, **kwargs)) == 0
    return json.loads((Path(out) / "result.json").read_text())


def timeless(folder):
    """Metrics less what a clock says."""
    rows = read_metrics(Path(folder) / "metrics.jsonl")
    return [{k: v for k, v in row.items() if "seconds" not in k} for row in rows]


def stamps(folder):
    files = [path for path in Path(folder).rglob("*") if path.is_file()]
    # A run's lock and versions are written whenever it is opened.
    kept = [path for path in files if path.name != "versions.json" and path.suffix != ".lock"]
    return {path: path.stat().st_mtime_ns for path in kept if path.name != ".lock"}


def assert_whole(folder, result, recipe, task, steps):
    assert set(FIELDS) <= set(result)
    assert result["task"] == task and result["env_steps"] == steps
    assert result["method"] == {"control": "control:constant"}.get(recipe, recipe)
    for scores in (result, result["deterministic"]):
        assert all(math.isfinite(scores[name]) for name in SCORES)
        assert len(scores["returns"]) == scores["episodes"] == 2
        assert scores["return_mean"] == pytest.approx(sum(scores["returns"]) / 2)
        assert scores["episode_length_mean"] >= 1
    assert (result["fit_seconds"] > 0) == (recipe in ("giril", "cdil", "ilde"))
    trained = result["wall_seconds"] - result["fit_seconds"]
    assert trained > 0
    speed = steps / trained
    assert result["steps_per_second"] == pytest.approx(speed)
    assert result["versions"]["torch"] == str(torch.__version__)
    found = [row for row in timeless(folder) if row["phase"] == "ppo"]
    assert [row["step"] for row in found] == list(range(BATCH, steps + 1, BATCH))
    assert {
        "config.yaml",
        "versions.json",
        "policy",
        "curve.csv",
        "curve.png",
    } <= {path.name for path in Path(folder).iterdir()}


QUICK = ("giril", "gail")  # A reward trained before the policy, and one beside it.


@pytest.mark.parametrize(
    "recipe", [r if r in QUICK else pytest.param(r, marks=pytest.mark.slow) for r in EXTRA]
)
def test_a_recipe_leaves_a_whole_result(recipe, root, tmp_path, capsys):
    result = run(recipe, tmp_path / "run", root)
    assert_whole(tmp_path / "run", result, recipe, "CartPole-v1", 4 * BATCH)
    printed = capsys.readouterr().out
    assert f"{result['return_mean']:,.1f}" in printed
    if recipe in ("expert", "control"):
        keys = ("expert_return_mean", "demo_return_mean", "demo_transitions")
        assert [result[key] for key in (*keys, "score_over_demo")] == [None] * 4
    else:
        assert result["demo_transitions"] == 100
        ratio = result["return_mean"] / result["demo_return_mean"]
        assert (result["algorithm"], result["score_over_demo"]) == ("ppo", ratio)
        assert math.isfinite(result["expert_return_mean"]) and result["demo_return_mean"] > 5
        expert = json.loads(next(root.glob("expert/*/*/result.json")).read_text())
        assert result["expert_return_mean"] == expert["return_mean"]
    if recipe in ("giril", "cdil"):
        fit = [row for row in timeless(tmp_path / "run") if row["phase"] == "fit"]
        assert [row["step"] for row in fit] == [10, 20]
    if recipe in ("gail", "vail", "airl", "ilde"):
        row = timeless(tmp_path / "run")[-1]
        assert math.isfinite(row["discriminator/loss_expert"])
        assert ("discriminator/beta" in row) == (recipe == "vail")
    # What was saved is what was scored.
    assert main(["eval", str(tmp_path / "run")]) == 0
    again = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert again["returns"] == result["returns"]
    assert again["deterministic"] == result["deterministic"]


@pytest.mark.slow
def test_continuous_actions_with_pybullet(root, tmp_path, capfd):
    """The shipped task; the expert's folder and demonstration are given by their paths."""
    task = "task=inverted_pendulum"
    run("expert", tmp_path / "expert", root, task, "seed=3")
    more = [task, f"expert.path={tmp_path / 'expert'}", "demo.length=40"]
    result = run("giril", tmp_path / "giril", root, *more)
    assert_whole(tmp_path / "giril", result, "giril", "inverted_pendulum", 4 * BATCH)
    demo = next(root.glob("demos/inverted_pendulum/*/card.json")).parent
    given = run("giril", tmp_path / "given", root, task, f"demo.path={demo}")
    assert weights(tmp_path / "given") == weights(tmp_path / "giril")
    assert given["expert_return_mean"] == result["expert_return_mean"]  # The card tells.
    assert given["demo_return_mean"] == result["demo_return_mean"]
    # The seeds that it was made with, not those that another expert would have had.
    seeds = {"policy": 0, "evaluation": 10_000, "reward": 0, "expert": 3, "demo": 0}
    assert given["seeds"] == result["seeds"] == seeds
    assert "argv" not in capfd.readouterr().out


def test_expert_and_demonstration_are_made_once(root, tmp_path):
    run("giril", tmp_path / "a", root)
    before = stamps(root)
    assert len(list(root.glob("expert/CartPole-v1/*/result.json"))) == 1
    assert len(list(root.glob("demos/CartPole-v1/*/card.json"))) == 1
    run("giril", tmp_path / "b", root, "reward.seed=1", "ppo.lr=0.001", "demo.subsample=5")
    seeds = ("expert.seed=0", "demo.seed=0")
    run("giril", tmp_path / "d", root, "seed=1", *seeds)
    assert stamps(root) == before
    # A demonstration with other settings is another one, of the same expert.
    run("giril", tmp_path / "c", root, "demo.length=60")
    assert len(list(root.glob("demos/CartPole-v1/*/card.json"))) == 2
    assert {path: stamps(root)[path] for path in before} == before


def test_a_finished_command_does_not_train_again(root, tmp_path, monkeypatch, capsys):
    run("giril", tmp_path, root)
    before, shown = stamps(tmp_path), capsys.readouterr().out
    monkeypatch.setattr(GymVectorEnv, "_step", None)
    run("giril", tmp_path, root, "ppo.checkpoint_every=100", "fit.log_every=7")
    assert stamps(tmp_path) == before
    again = capsys.readouterr()
    assert again.out == shown
    assert again.err == f"giril: {tmp_path} was finished earlier: nothing was run.\n"


@pytest.mark.parametrize(
    "recipe", [r if r == "giril" else pytest.param(r, marks=pytest.mark.slow) for r in EXTRA]
)
def test_a_run_follows_from_its_seed(recipe, root, tmp_path):
    results = {}
    for number, (name, seed) in enumerate((("one", 0), ("two", 0), ("three", 1))):
        torch.manual_seed(number)  # What this process did before decides nothing.
        results[name] = run(recipe, tmp_path / name, root, f"seed={seed}")
    assert timeless(tmp_path / "one") == timeless(tmp_path / "two")
    assert weights(tmp_path / "one") == weights(tmp_path / "two")
    clock = {"wall_seconds", "fit_seconds", "steps_per_second", "finished_at"}
    one, two = ({k: v for k, v in results[n].items() if k not in clock} for n in ("one", "two"))
    assert one == two
    assert weights(tmp_path / "one") != weights(tmp_path / "three")
    assert timeless(tmp_path / "one")[0] != timeless(tmp_path / "three")[0]


# Stopping a process

LONG = 60 * BATCH


def start_and_stop(command, folder, number):
    """Starts ``giril`` and signals it once five batches are on record; its code and its words."""
    process = subprocess.Popen(
        [sys.executable, "-m", "giril_rl", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        # Processes of some shells ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    try:
        while sum(row["phase"] == "ppo" for row in timeless(folder)) < 5:
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert not (folder / "result.json").exists()
    return process.returncode, error


def test_a_killed_run_ends_as_an_undisturbed_one(root, tmp_path):
    expected = run("giril", tmp_path / "whole", root, steps=LONG)
    command = words("giril", tmp_path / "run", root, steps=LONG)
    assert start_and_stop(command, tmp_path / "run", signal.SIGKILL)[0] == -signal.SIGKILL
    saved = load_state(tmp_path / "run" / "ppo.safetensors")["steps"]
    assert 0 < saved < LONG
    result = run("giril", tmp_path / "run", root, steps=LONG)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole")
    assert timeless(tmp_path / "run") == timeless(tmp_path / "whole")
    assert result["returns"] == expected["returns"]


def test_an_interrupted_run_says_so_and_ends_as_an_undisturbed_one(root, tmp_path):
    run("control", tmp_path / "whole", root, steps=LONG)
    command = words("control", tmp_path / "run", root, steps=LONG)
    code, error = start_and_stop(command, tmp_path / "run", signal.SIGINT)
    assert code == 130
    saved = load_state(tmp_path / "run" / "ppo.safetensors")["steps"]
    # Nothing was lost, not even what came after the last regular checkpoint.
    assert saved == timeless(tmp_path / "run")[-1]["step"]
    sentence = f"interrupted in the policy's training at {saved:,} of {LONG:,} steps: the same"
    assert error.splitlines()[-1] == f"giril: {sentence} command continues from there."
    assert "Traceback" not in error
    run("control", tmp_path / "run", root, steps=LONG)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole")
    assert timeless(tmp_path / "run") == timeless(tmp_path / "whole")


class Grid(gymnasium.Env):
    """Observations that no policy here is for, which is seen once an environment is made."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2, 2), np.float32)
    action_space = gymnasium.spaces.Discrete(2)


@pytest.mark.parametrize("recipe", [*EXTRA, "bc"])
def test_a_refused_run_leaves_neither_its_folder_nor_its_experts(recipe, tmp_path, capsys):
    if "Grid-v0" not in gymnasium.registry:
        gymnasium.register("Grid-v0", entry_point=Grid, max_episode_steps=10)
    place = [f"out={tmp_path}/runs/a", f"root={tmp_path}/runs", "task.env_id=Grid-v0"]
    steps = f"steps={0 if recipe == 'bc' else 2000}"
    assert main(["run", recipe, "task=gymnasium", "logger=null", *place, steps]) == 2
    assert "vector" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "recipe",
    [*(pytest.param(r, marks=pytest.mark.slow) for r in ("giril", "gail", "expert")), "control"],
)
def test_no_simulator_is_left_open(recipe, root, tmp_path, monkeypatch):
    """Nor where every part is loaded from its checkpoint."""
    open_now: set[int] = set()
    made, close = CartPoleEnv.__init__, CartPoleEnv.close

    def counted(self, *args, **kwargs):
        open_now.add(id(self))
        made(self, *args, **kwargs)

    def closed(self):
        open_now.discard(id(self))
        close(self)

    monkeypatch.setattr(CartPoleEnv, "__init__", counted)
    monkeypatch.setattr(CartPoleEnv, "close", closed)
    run(recipe, tmp_path / "run", root)
    assert open_now == set()
    (tmp_path / "run" / "result.json").unlink()
    run(recipe, tmp_path / "run", root)
    assert open_now == set()
