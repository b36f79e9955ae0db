"""Names of runs: where one is kept, and the hash by which two are known to be the same."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from giril_rl.config.schema import EvalConfig, ExpertRunConfig
from giril_rl.files.disk import read_json

_OWN_PLACE = {"task", "task.name", "seed"}
NO_EFFECT = frozenset(
    {
        *("out", "root", "imports", "logger", "threads", "device"),
        *("ppo.compile", "fit.compile", "reward.compile"),
        *("ppo.checkpoint_every", "fit.log_every"),
        *("eval.episodes", "eval.seed"),
        "task.demonstration",  # It acts through demo.path.
    }
)
"""Keys that change where, how fast and how closely watched a run is made, and not what it is a run
of.

On another device, or compiled, rounding differs and random numbers are others, of the same
distribution. A policy may be scored again in any other way, see
:func:`giril_rl.training.rescore.score_anew`.
"""
EDITION = 2
"""Counts up where the same settings give other numbers than before; part of every hash."""
_LONGEST = 80
ADDED = {
    "task.expert_steps": 5_000_000,
    "task.horizon": "own",
    "task.after_failure": "reset",
    "task.episode": "life",
    "termination": "ends",
    "ppo.clip_value": False,
    "demo.lives": "first",
    "clip_reward": False,
    "held_episodes": 20,
}
"""Keys that earlier runs did not have, with the value that they behaved by."""
RETIRED = {"profile": "released", "batch_mean": True}
"""Keys that every recipe once had, also where they had no effect. All hashes go on counting them,
so that earlier runs are known."""


def without_added(
    values: Mapping[str, Any], prefix: str = "", *, drop: Collection[str] = ()
) -> dict[str, Any]:
    """Nested settings less the keys of :data:`ADDED` that have the value given there.

    What is hashed or compared this way is the same as before those keys existed.

    Args:
        values: nested settings.
        prefix: dotted key of ``values`` itself, with the dot.
        drop: further dotted keys to leave out, whatever their values.

    Examples:
        >>> without_added({"seed": 1, "task": {"name": "reach", "horizon": "own"}})
        {'seed': 1, 'task': {'name': 'reach'}}
        >>> without_added({"termination": "bootstrap"})
        {'termination': 'bootstrap'}
    """
    kept: dict[str, Any] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if key in drop:
            continue
        if isinstance(value, Mapping):
            kept[name] = without_added(value, f"{key}.", drop=drop)
        elif key not in ADDED or ADDED[key] != value:
            kept[name] = value
    return kept


def config_hash(config: Any) -> str:
    """Twelve hex digits of the configuration, less what cannot change a result.

    sha256 of :data:`EDITION` and of the resolved configuration as JSON with sorted keys, without
    :data:`NO_EFFECT` and without later keys at the value they had before they existed.

    Args:
        config: an instance of a recipe's ``Config``.

    Examples:
        >>> from giril_rl.config.schema import RunConfig
        >>> config_hash(RunConfig(seed=1)) == config_hash(RunConfig(seed=1, root="elsewhere"))
        True
    """
    values = without_added({**RETIRED, **asdict(config)}, drop=NO_EFFECT)
    text = json.dumps([EDITION, values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def safe(name: str, *, distinct: bool = False) -> str:
    """``name`` as one component of a path, at most 80 characters long.

    Quotes and brackets go, other unsafe characters become ``-``. A name that is too long is cut and
    ends in 8 hex digits of its hash.

    Args:
        name: any text.
        distinct: add the hash also where a character was replaced: ``a/b`` and ``a-b`` differ.

    Examples:
        >>> safe("ppo.hidden=[64,64]")
        'ppo.hidden=64,64'
        >>> safe("ALE/Pong-v5"), safe("ALE/Pong-v5", distinct=True)
        ('ALE-Pong-v5', 'ALE-Pong-v5-d3b6e4aa')
        >>> len(safe("x" * 200))
        80
    """
    bare = re.sub(r"[\[\]'\"]", "", name)
    clean = re.sub(r"[^A-Za-z0-9._=,+-]", "-", bare).lstrip(".") or "-"
    if len(clean) <= _LONGEST and (clean == bare or not distinct):
        return clean
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{clean[: _LONGEST - 9]}-{digest}"


def variant(changes: Mapping[str, str], without: frozenset[str] = frozenset()) -> str:
    """The part of a run's path that names the user's changes, ``default`` where there are none.

    Args:
        changes: ``{key: "key=value"}``.
        without: further keys to leave out.

    Examples:
        >>> variant({"seed": "seed=3", "ppo.lr": "ppo.lr=0.001", "profile": "profile=paper"})
        'ppo.lr=0.001,profile=paper'
        >>> variant({"seed": "seed=3"})
        'default'
    """
    left_out = _OWN_PLACE | NO_EFFECT | without
    kept = sorted(text for key, text in changes.items() if key not in left_out)
    return safe(",".join(kept), distinct=True) if kept else "default"


def out_folder(recipe: str, config: Any, changes: Mapping[str, str]) -> Path:
    """The run's folder: ``out`` where it is given, else ``root/recipe/task/variant/seedN``.

    An expert's is ``root/expert/task/hash`` instead.

    Args:
        recipe: the recipe's name.
        config: an instance of its ``Config``.
        changes: ``{key: "key=value"}``, the user's overrides.

    Examples:
        >>> from giril_rl.config.schema import RunConfig, TaskConfig
        >>> config = RunConfig(task=TaskConfig(name="reach", env_id="Reach-v0"), seed=3)
        >>> out_folder("giril", config, {"seed": "seed=3"}).as_posix()
        'runs/giril/reach/default/seed3'
    """
    if config.out is not None:
        return Path(config.out)
    if isinstance(config, ExpertRunConfig):
        # Other recipes look for an expert by its settings, however they were arrived at.
        return Path(config.root) / safe(recipe) / safe(config.task.name) / config_hash(config)
    # The folder of a task that is named after its environment names the environment already.
    named = frozenset({"task.env_id"} if config.task.name == config.task.env_id else ())
    place = Path(config.root) / safe(recipe) / safe(config.task.name)
    return place / variant(changes, named) / f"seed{config.seed}"


def is_scored_as(folder: Path, settings: EvalConfig) -> bool:
    """Whether a finished run's scores are of the episodes that ``settings`` ask for.

    Where its ``result.json`` does not say, they are.
    """
    result = read_json(folder / "result.json")
    seeds = result.get("seeds")
    seed = seeds.get("evaluation", settings.seed) if isinstance(seeds, dict) else settings.seed
    return bool(
        result.get("episodes", settings.episodes) == settings.episodes and seed == settings.seed
    )
