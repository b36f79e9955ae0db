"""Studies of a fake recipe, each run in a process of its own."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from filelock import FileLock

from giril_rl.cli.command_line import main
from giril_rl.experiments.study.execute import startable
from giril_rl.experiments.study.plan import Planner
from giril_rl.experiments.study.spec import read_spec

FOLDER = Path("runs/studies/mine")


def status():
    return json.loads((FOLDER / "status.json").read_text())


def began():
    return {path.parent.as_posix(): len(path.read_text()) for path in Path("runs").rglob("began")}


def test_runs_are_made_once_and_their_output_kept(study, capsys):
    name = study("title: some\ngroups: [{label: a, recipe: fake.py, seed: [0, 1]}]")
    assert main(["study", name, "jobs=2"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out == [
        "study mine: 2 runs, 0 finished before, 2 at a time; runs/studies/mine",
        "2 of 2 runs are finished.",
    ]
    assert began() == {f"runs/fake/inverted_pendulum/default/seed{seed}": 1 for seed in (0, 1)}
    kept = status()
    assert kept["study"] == "mine" and kept["states"] == {"finished": 2}
    first = kept["runs"][0]
    assert (first["label"], first["recipe"], first["task"]) == ("a", "fake", "inverted_pendulum")
    assert (first["state"], first["attempts"], first["exit_code"]) == ("finished", 1, 0)
    log = (FOLDER / first["log"]).read_text()
    assert log.splitlines()[1] == "$ giril run fake.py seed=0 root=runs"
    assert "scores of runs/fake/inverted_pendulum/default/seed0" in log
    rows = list(csv.DictReader((FOLDER / "status.csv").open()))
    assert [(row["seed"], row["state"]) for row in rows] == [("0", "finished"), ("1", "finished")]
    resolved = yaml.safe_load((FOLDER / "study.yaml").read_text())
    assert resolved["title"] == "some"
    assert [run["folder"] for run in resolved["runs"]] == [row["folder"] for row in rows]

    assert main(["study", name, "jobs=2"]) == 0
    assert "2 finished before" in capsys.readouterr().out
    assert set(began().values()) == {1}
    assert status() == kept  # What the runs took is not forgotten.


def test_a_run_that_giril_run_made_is_not_made_again(study):
    name = study("groups: [{label: a, recipe: fake.py, seed: 4, ppo.epochs: 10}]")
    assert main(["run", "fake.py", "seed=4"]) == 0
    assert main(["study", name]) == 0
    assert began() == {"runs/fake/inverted_pendulum/default/seed4": 1}


def test_failures_are_listed_and_the_others_made(study, capsys):
    name = study("groups: [{label: a, recipe: fake.py, how: [user, well, bug, killed]}]")
    assert main(["study", name, "jobs=4", "retries=0"]) == 1
    captured = capsys.readouterr()
    assert captured.out.splitlines()[-1] == "1 of 4 runs are finished."
    lines = captured.err.splitlines()
    ends = {
        "user": "giril: the demonstration is empty: record a longer one.",
        "bug": "RuntimeError: boom",
        "killed": "killed by signal 9; $ giril run fake.py how=killed root=runs",
    }
    expected = ["giril: 3 of 4 runs failed:"]
    for how, end in ends.items():
        expected.append(f"  a: fake/inverted_pendulum/how={how}/seed0: {end}")
        expected.append(f"    {FOLDER}/logs/fake--inverted_pendulum--how={how}--seed0.log")
    assert lines[-7:] == expected
    assert status()["states"] == {"failed": 3, "finished": 1}
    # The same command tries the failed ones again, and no other.
    assert main(["study", name, "jobs=4", "retries=0"]) == 1
    counts = {Path(name).parent.name: count for name, count in began().items()}
    assert counts == {"how=user": 2, "default": 1, "how=bug": 2, "how=killed": 2}


def test_a_run_whose_process_is_killed_is_started_again(study):
    name = study("groups: [{label: a, recipe: fake.py, how: once}]")
    assert main(["study", name]) == 0
    assert list(began().values()) == [2]
    assert status()["runs"][0]["attempts"] == 2


def test_a_run_is_started_again_so_often_and_no_oftener(study):
    name = study("groups: [{label: a, recipe: fake.py, how: killed}]")
    assert main(["study", name, "retries=1"]) == 1
    assert list(began().values()) == [2]


def test_dry_run_starts_nothing(study, capsys):
    name = study("groups: [{label: a, recipe: fake.py, seed: [0, 1]}]")
    assert main(["run", "fake.py"]) == 0
    capsys.readouterr()
    assert main(["study", name, "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "finished  a: giril run fake.py seed=0 root=runs",
        "waiting   a: giril run fake.py seed=1 root=runs",
        "2 runs, 1 of them finished.",
    ]
    assert not FOLDER.exists()


def test_what_the_command_line_changed_names_the_folder(study):
    name = study("groups: [{label: a, recipe: fake.py}]")
    assert main(["study", name, "seed=7", "root=else where"]) == 0
    assert Path("else where/studies/mine,seed=7/status.json").exists()
    assert Path("else where/fake/inverted_pendulum/default/seed7/result.json").exists()


def found(marker):
    return list(Path("runs").rglob(marker))


def interrupted(name, *, times):
    """Runs a study of slow runs and interrupts it, again once they know; its code and its words."""
    process = subprocess.Popen(
        [sys.executable, "-m", "giril_rl", "study", name, "jobs=2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 120
        for number in range(times):
            while len(found("told" if number else "ready")) < 2:
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < deadline
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    return process.returncode, error


def test_ctrl_c_lets_runs_save_and_the_same_command_continues(study, capsys):
    name = study("groups: [{label: a, recipe: fake.py, how: slow, seed: [0, 1, 2]}]")
    code, error = interrupted(name, times=1)
    assert code == 130
    assert error.splitlines()[-1] == (
        "giril: interrupted with 0 of 3 runs finished: the same command continues."
    )
    assert len(found("saved")) == 2  # Each child was told, and once.
    states = [run["state"] for run in status()["runs"]]
    assert states == ["interrupted", "interrupted", "waiting"]
    for path in Path("runs/fake/inverted_pendulum/how=slow").glob("*"):
        (path / "saved").touch()
    Path("runs/fake/inverted_pendulum/how=slow/seed2").mkdir()
    Path("runs/fake/inverted_pendulum/how=slow/seed2/saved").touch()
    assert main(["study", name, "jobs=2"]) == 0
    assert status()["states"] == {"finished": 3}


def test_a_second_ctrl_c_kills(study):
    name = study("groups: [{label: a, recipe: fake.py, how: stubborn, seed: [0, 1]}]")
    code, _ = interrupted(name, times=2)
    assert code == 130
    assert not found("saved")
    assert {run["exit_code"] for run in status()["runs"]} == {-9}
    assert {run["state"] for run in status()["runs"]} == {"interrupted"}


def test_runs_of_a_study_that_is_killed_save_and_stop(study):
    name = study("groups: [{label: a, recipe: fake.py, how: slow, seed: [0, 1]}]")
    process = subprocess.Popen(
        [sys.executable, "-m", "giril_rl", "study", name, "jobs=2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        wait_until(lambda: len(found("ready")) == 2)
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: len(found("saved")) == 2)
    logs = [FOLDER / run["log"] for run in status()["runs"]]
    wait_until(lambda: all("giril: interrupted." in log.read_text() for log in logs))
    assert all("the study's process is gone" in log.read_text() for log in logs)
    assert main(["study", name, "jobs=2"]) == 0
    assert status()["states"] == {"finished": 2}


def wait_until(true):
    deadline = time.monotonic() + 120
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_run_that_another_process_makes_is_waited_for(study):
    name = study("groups: [{label: a, recipe: fake.py, seed: [0, 1]}]")
    runs = Planner(Path("runs")).plan(read_spec(Path(name)))
    runs[0].folder.mkdir(parents=True)
    lock = FileLock(str(runs[0].folder / ".lock"))
    with lock:
        assert list(startable(runs, [])) == runs[1:]
    assert list(startable(runs, [])) == runs


def test_runs_wait_for_their_tasks_expert_alone(study):
    name = study(
        """
all: {task: [inverted_pendulum, inverted_double_pendulum]}
groups: [{label: a, recipe: fake.py}, {label: b, recipe: expert, task: inverted_pendulum}]
"""
    )
    one, two, expert = Planner(Path("runs")).plan(read_spec(Path(name)))
    assert list(startable([one, two, expert], [])) == [expert, two]
    assert list(startable([one, two], [expert])) == [two]
    assert list(startable([one, two], [])) == [one, two]


@pytest.mark.parametrize("cores", [None, 3])
def test_at_once_there_are_as_many_runs_as_cores(study, capsys, monkeypatch, cores):
    if cores is not None:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    here = cores or len(os.sched_getaffinity(0))
    name = study("groups: [{label: a, recipe: fake.py}]")
    assert main(["study", name]) == 0
    assert f" {here} at a time; " in capsys.readouterr().out
