"""The same runs on a Ray cluster; a real one only where Ray is installed, see the slow test."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from giril_rl.cli.command_line import main

STUDY = """
all:
  {task: inverted_pendulum, logger: null, eval.episodes: 1, steps: 25_600,
   ppo: {num_envs: 2, rollout: 64, minibatch: 64, epochs: 1, hidden: [16], checkpoint_every: 640}}
groups: [{label: a, recipe: control, seed: [0, 1]}]
"""


def test_without_ray_the_extra_is_named(study, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["study", study("groups: [{label: a, recipe: fake.py}]"), "launcher=ray"]) == 2
    assert capsys.readouterr().err == (
        'giril: launcher=ray needs the package ray: pip install "giril-rl[ray]", or leave it out.\n'
    )
    assert not Path("runs").exists()


def test_a_worker_makes_a_run_as_the_command_does(study):
    """Output of Python and of bare descriptors, and the exit code."""
    study("")
    Path("fake.py").write_text(
        Path("fake.py")
        .read_text()
        .replace('if cfg.how == "user"', 'os.write(1, b"bare")\n    if cfg.how == "user"')
    )
    code = (
        "from giril_rl.experiments.study.launchers import run_in_worker as run; import sys;"
        "from giril_rl.cli.command_line import main;"
        "sys.exit(run(main, ['run', 'fake.py', 'how=user'], "
        f"{str(Path('logs/a.log').absolute())!r}, "
        f"{str(Path.cwd())!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd="/", capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")
    log = Path("logs/a.log").read_text()
    assert log.startswith("\n$ giril run fake.py how=user\n")
    assert "bare" in log
    assert log.endswith("giril: the demonstration is empty: record a longer one.\n")


def kill_a_worker(root, killed):
    """Kills the worker of the first run that has a checkpoint."""
    while not (saved := list(root.glob("control/*/*/*/ppo.safetensors"))):
        time.sleep(0.05)
    run = saved[0].parent.relative_to(root).as_posix()
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = process.read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
        if line.startswith(f"ray::{run}"):
            os.kill(int(process.parent.name), signal.SIGKILL)
            killed.append(run)
            return


@pytest.mark.slow
def test_a_cluster_gives_the_same_results_though_a_worker_dies(study):
    pytest.importorskip("ray")
    name = study(STUDY)
    assert main(["study", name, "root=here", "jobs=2"]) == 0
    killed = []
    killer = threading.Thread(target=kill_a_worker, args=(Path("there"), killed), daemon=True)
    killer.start()
    assert main(["study", name, "root=there", "launcher=ray", "ray_address=local"]) == 0
    assert killed
    status = json.loads(Path("there/studies/mine/status.json").read_text())
    assert sorted(run["attempts"] for run in status["runs"]) == [1, 2]

    from giril_rl.runs.checkpoint import load_state
    from giril_rl.runs.metrics import read_metrics

    for here in Path("here").rglob("result.json"):
        there = Path("there") / here.relative_to("here")
        one, two = (
            {
                key: tensor.tolist()
                for key, tensor in load_state(path.parent / "policy" / "model.safetensors").items()
            }
            for path in (here, there)
        )
        assert one == two
        one, two = (
            [
                {key: value for key, value in row.items() if "seconds" not in key}
                for row in read_metrics(path.with_name("metrics.jsonl"))
            ]
            for path in (here, there)
        )
        assert one == two
        one, two = (json.loads(path.read_text())["returns"] for path in (here, there))
        assert one == two
