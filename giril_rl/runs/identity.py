"""Which run is it? Its folder, the hash of its settings, and digests of its own code.

A run continues, and a finished one counts as done, only with the same settings and code. Keys that
change no result (:data:`NO_EFFECT`) do not count, nor do keys that earlier versions did not have
(:data:`ADDED`) at the value that those behaved by.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict
from pathlib import Path
from typing import Any

from giril_rl.config.knobs import flat
from giril_rl.config.recipes import Recipe
from giril_rl.config.schema import EvalConfig, ExpertRunConfig, idle_algorithm
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json

NO_EFFECT = frozenset(
    {
        *("out", "root", "imports", "logger", "threads", "device"),
        *("ppo.compile", "sac.compile", "fit.compile", "reward.compile"),
        *("ppo.checkpoint_every", "sac.checkpoint_every", "sac.log_every", "fit.log_every"),
        *("eval.episodes", "eval.seed"),
        "task.demonstration",  # It acts through demo.path.
    }
)
"""Keys that change where, how fast or how often something is written, but not what is learned.

Another device, or compiling, rounds differently and draws other random numbers of the same
distribution. The evaluation can be repeated, see :func:`giril_rl.training.rescore.score_anew`.
"""
ADDED = {
    "task.expert_steps": 5_000_000,
    "task.horizon": "own",
    "task.after_failure": "reset",
    "task.episode": "life",
    "termination": "ends",
    "algorithm": "ppo",
    "ppo.clip_value": False,
    "demo.lives": "first",
    "clip_reward": False,
    "reward.absorbing": None,
    "reward.every": 20,
    "held_episodes": 20,
    "demo.first": None,
    "sac.time_aware_critic": False,
    "sac.precision": "fp32",
    **dict.fromkeys(("reward.use_actions", "giril.use_actions", "icm.use_actions"), True),
}
"""Keys that earlier versions did not have, with the value that they behaved by."""
RETIRED = {"profile": "released", "batch_mean": True}
"""Keys that every recipe had once, also where they had no effect. Every hash still has them, so
that earlier runs are recognised."""
EDITION = 2
"""Part of every hash; increases when the same settings give other numbers than before."""
_IN_PATH_ALREADY = {"task", "task.name", "seed"}
_LONGEST = 80
_making: ContextVar[tuple[Path, dict[str, str]] | None] = ContextVar("making", default=None)


def without_added(
    values: Mapping[str, Any], prefix: str = "", *, drop: Collection[str] = ()
) -> dict[str, Any]:
    """Nested settings without the keys of :data:`ADDED` that have the value given there.

    Args:
        values: nested settings.
        prefix: dotted key of ``values`` itself, with the dot.
        drop: more dotted keys to leave out, whatever their values.

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
    """Twelve hex digits that identify the settings, less what cannot change a result.

    It is the SHA-256 of :data:`EDITION` and the resolved settings as JSON with sorted keys, without
    :data:`NO_EFFECT` and :data:`ADDED`, and with :data:`RETIRED`.

    Args:
        config: an instance of a recipe's ``Config``.

    Examples:
        >>> from giril_rl.config.schema import RunConfig
        >>> config_hash(RunConfig(seed=1)) == config_hash(RunConfig(seed=1, root="elsewhere"))
        True
    """
    values = without_added({**RETIRED, **without_idle(asdict(config))}, drop=NO_EFFECT)
    text = json.dumps([EDITION, values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def without_idle(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings without those of the algorithm that does not run.

    Examples:
        >>> without_idle({"algorithm": "sac", "ppo": {"lr": 0.1}, "sac": {"lr": 0.2}})
        {'algorithm': 'sac', 'sac': {'lr': 0.2}}
    """
    idle = idle_algorithm(values.get("algorithm"))
    return {name: value for name, value in values.items() if name != idle}


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], ignore: Collection[str]
) -> list[str]:
    """Keys whose values differ, each with both values; keys below ``ignore`` are skipped.

    Examples:
        >>> differences({"ppo": {"lr": 0.1}, "out": "a"}, {"ppo": {"lr": 0.2}}, ["out"])
        ['ppo.lr: 0.1 there, 0.2 now']
    """
    now = {**{key: before[key] for key in RETIRED if key in before}, **now}
    old, new = (
        flat(without_added(without_idle(config)), keep_empty=True) for config in (before, now)
    )
    return [
        f"{key}: {old.get(key, 'nothing')!s} there, {new.get(key, 'nothing')!s} now"
        for key in [*new, *(key for key in old if key not in new)]
        if not any(key == name or key.startswith(f"{name}.") for name in ignore)
        and (key not in old or key not in new or old[key] != new[key])
    ]


def safe(name: str, *, distinct: bool = False) -> str:
    """``name`` as one component of a path, at most 80 characters long.

    Quotes and brackets are removed, other unsafe characters become ``-``. A name that is too long
    is cut and ends in 8 hex digits of its hash.

    Args:
        name: any text.
        distinct: also add the hash if a character was replaced, so that ``a/b`` is not ``a-b``.

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
    """The part of a run's path that names the user's overrides, ``default`` without any.

    Args:
        changes: ``{key: "key=value"}``.
        without: more keys to leave out.

    Examples:
        >>> variant({"seed": "seed=3", "ppo.lr": "ppo.lr=0.001", "profile": "profile=paper"})
        'ppo.lr=0.001,profile=paper'
        >>> variant({"seed": "seed=3"})
        'default'
    """
    left_out = _IN_PATH_ALREADY | NO_EFFECT | without
    kept = sorted(text for key, text in changes.items() if key not in left_out)
    return safe(",".join(kept), distinct=True) if kept else "default"


def out_folder(recipe: str, config: Any, changes: Mapping[str, str]) -> Path:
    """The run's folder: ``out`` if given, else ``root/recipe/task/variant/seedN``.

    An expert's is ``root/expert/task/hash``: other recipes look for it by its settings.

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
    place = Path(config.root) / safe(recipe) / safe(config.task.name)
    if isinstance(config, ExpertRunConfig):
        return place / config_hash(config)
    # A task without a name of its own has its environment's name in the path already.
    named = frozenset({"task.env_id"} if config.task.name == config.task.env_id else ())
    return place / variant(changes, named) / f"seed{config.seed}"


def is_scored_as(folder: Path, settings: EvalConfig) -> bool:
    """Whether a finished run was evaluated with these settings; also if its result does not say."""
    result = read_json(folder / "result.json")
    seeds = result.get("seeds")
    seed = seeds.get("evaluation", settings.seed) if isinstance(seeds, dict) else settings.seed
    return bool(
        result.get("episodes", settings.episodes) == settings.episodes and seed == settings.seed
    )


def sources(recipe: Recipe, modules: Iterable[str]) -> dict[str, str]:
    """Digests of the user's own code: a copied recipe's file, and single-file modules.

    A shipped recipe has none, because ``versions.json`` holds the package's version.

    Args:
        recipe: the recipe.
        modules: names of modules; they are not imported, and packages are skipped.

    Examples:
        >>> from giril_rl.config.recipes import find
        >>> sources(find("giril"), [])
        {}
    """
    found = {} if recipe.is_shipped else {"recipe": recipe.path}
    for name in modules:
        spec = None if "." in name else importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None and spec.submodule_search_locations is None:
            found[name] = Path(spec.origin)
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        for name, path in found.items()
        if path.is_file()
    }


@contextmanager
def making(folder: Path, digests: dict[str, str]) -> Iterator[None]:
    """Within this, the :class:`~giril_rl.runs.run.Run` in ``folder`` saves ``digests``."""
    token = _making.set((folder.absolute(), digests))
    try:
        yield
    finally:
        _making.reset(token)


def sources_of(folder: Path) -> dict[str, str]:
    """The digests that :func:`making` gave for ``folder``, if any."""
    current = _making.get()
    return current[1] if current is not None and current[0] == folder.absolute() else {}


def check_sources(folder: Path, now: Mapping[str, str]) -> None:
    """Refuse a run whose recipe or module had another text; a run without digests passes.

    Raises:
        UserError: with the recipe or module that changed.
    """
    path = folder / "versions.json"
    before: Any = read_json(path).get("sources") if now and path.is_file() else None
    if not isinstance(before, dict):
        return
    for name, digest in now.items():
        if before.get(name, digest) != digest:
            what = "recipe" if name == "recipe" else f"module {name}"
            raise UserError(
                f"{folder} was made with an earlier text of the {what}: to begin anew choose "
                "another out=, or delete the folder."
            )
