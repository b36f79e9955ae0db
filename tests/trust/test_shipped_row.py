"""A short run from a shipped demonstration has the numbers that it had where it was first made."""

import hashlib
import json
from pathlib import Path

import pytest
from safetensors.torch import load_file

from giril_rl.cli.command_line import main
from giril_rl.files.disk import read_json
from giril_rl.runs.machine import installed_versions, processor
from giril_rl.runs.metrics import read_metrics

KEPT = read_json(Path(__file__).resolve().parents[1] / "data" / "short_row.json")
"""The words of the run, where it was made, the digest of its weights and some of its numbers.

Write it anew, with ``made_here`` below, only where equal settings are meant to give other numbers.
"""
DECIDES = ("python", "torch", "torchrl", "tensordict", "gymnasium", "pybullet")


def instructions():
    """What a processor can do, of which its name says too little."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    return hashlib.sha256("".join(flags[:1]).encode()).hexdigest()[:12]


def made_here(run):
    digest = hashlib.sha256()
    for part in ("policy", "reward"):
        weights = load_file(run / part / "model.safetensors")
        # A file numbers its tensors, and their order decides nothing.
        named = {name.partition(":")[2]: weight for name, weight in weights.items()}
        for name in sorted(named):
            digest.update(name.encode() + named[name].contiguous().numpy().tobytes())
    fit, first, _ = read_metrics(run / "metrics.jsonl")
    versions = installed_versions()
    return {
        "words": KEPT["words"],
        "versions": {name: versions[name] for name in DECIDES},
        "processor": f"{processor()} ({instructions()})",
        "demo": read_json(run / "result.json")["demo"],
        "demo_id": read_json(run / "result.json")["demo_id"],
        "weights": digest.hexdigest(),
        "fitted": fit["fit/fitted/reconstruction"],
        "reward_mean": first["ppo/reward_mean"],
        "return_mean": first["train/return_mean"],
    }


def test_a_short_row_comes_out_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "giril", *KEPT["words"], "out=run"]) == 0
    made = made_here(tmp_path / "run")
    assert (made["demo"], made["demo_id"]) == (KEPT["demo"], KEPT["demo_id"])
    if all(made[key] == KEPT[key] for key in ("versions", "processor")):
        assert made == KEPT, json.dumps(made, indent=2)
    # Elsewhere sums are rounded in another order, which 500 steps of a fit and one batch of a
    # policy that has learned nothing yet do not blow up.
    assert made["fitted"] == pytest.approx(KEPT["fitted"], rel=0.02)
    assert made["reward_mean"] == pytest.approx(KEPT["reward_mean"], rel=0.1)
    assert made["return_mean"] == pytest.approx(KEPT["return_mean"], rel=0.2)
