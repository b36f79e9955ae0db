"""Made-up runs that look as recipes leave them."""

import json
from dataclasses import asdict
from functools import cache

import pytest
import yaml
from matplotlib.figure import Figure

from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.runs.identity import config_hash


@cache
def settings(recipe, *words):
    found = find(recipe)
    return resolved(found, config_class(found), words)[0]


@pytest.fixture
def made(tmp_path):
    """``made(recipe, *words, score=…)`` writes a run's folder below ``runs`` and returns it."""

    def write(recipe, *words, score=None, mode=None, name=None, extra=None, **result):
        config = settings(recipe, *words)
        name = name or "/".join([recipe, config.task.name, ",".join(words) or "default"])
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        values = {"recipe": recipe, **asdict(config), **(extra or {})}
        (folder / "config.yaml").write_text(yaml.safe_dump(values))
        method = f"control:{config.reward}" if recipe == "control" else recipe
        trained = 0 if method in ("bc", "control:random") else config.steps
        rows = [
            {
                "phase": config.algorithm,
                "step": trained * i // 4,
                "train/return_mean": i * (score or 1.0) / 4,
            }
            for i in range(1, 5)
            if trained
        ]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        if score is None:
            return folder
        lengths = {"return_std": 1.0, "return_median": score, "episode_length_mean": 100.0}
        other = "sampled" if config.algorithm == "sac" else "deterministic"
        has_demo = recipe not in ("expert", "control")
        values = {
            "method": method,
            "task": config.task.name,
            "profile": getattr(config, "profile", None),
            "seed": config.seed,
            "seeds": {"policy": config.seed, "reward": config.seed + 100},
            "env_steps": trained,
            "return_mean": score,
            **lengths,
            "episodes": 20,
            "algorithm": config.algorithm if trained else None,
            other: {**lengths, "return_mean": score if mode is None else mode},
            "demo_transitions": 1000 if has_demo else None,
            "expert_return_mean": 900.0 if has_demo else None,
            "demo_return_mean": 1000.0 if has_demo else None,
            "wall_seconds": 1.0,
            "config_hash": config_hash(config),
            **result,
        }
        (folder / "result.json").write_text(json.dumps(values))
        return folder

    write.root = tmp_path / "runs"
    return write


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved."""
    figures, savefig = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *a, **k: (savefig(self, *a, **k), figures.append(self))
    )
    return figures
