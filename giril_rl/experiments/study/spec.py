"""A study's YAML file, groups of runs with lists of values, and the study's own settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from giril_rl.config.knobs import flat
from giril_rl.config.nearest import did_you_mean
from giril_rl.config.recipes import load_yaml, shipped_conf
from giril_rl.config.schema import knob
from giril_rl.errors import UserError

_KEYS = ("title", "all", "groups")


@dataclass
class StudyConfig:
    """The settings of `giril study` itself; every other key is a knob of the runs."""

    jobs: int | None = knob(
        None,
        "runs at a time; null: one for each core, or CPU of the cluster, and per_gpu for each GPU",
        low=1,
    )
    launcher: str = knob("local", "local processes, or a Ray cluster", choices=("local", "ray"))
    ray_address: str = knob("auto", "the cluster's address; auto: one that runs on this machine")
    per_gpu: int = knob(4, "runs with device=cuda that share a GPU", low=1)
    retries: int = knob(2, "how often a run is started again whose process was killed", low=0)
    root: str = knob("runs", "where runs, experts, demonstrations and studies are kept")


@dataclass(frozen=True)
class Group:
    """Runs of one label: every combination of the recipes and of the knobs' values.

    Attributes:
        label: the group's name.
        recipes: names of recipes or paths of copied ones.
        knobs: ``{dotted key: value}``; see :func:`override_text` for lists.
        player: whether its runs are the experts that the other groups record; the command line's
            ``steps=`` is not for them.
    """

    label: str
    recipes: tuple[str, ...]
    knobs: dict[str, Any]
    player: bool = False


@dataclass(frozen=True)
class Spec:
    """The content of a study's file.

    Attributes:
        name: the file's name without its suffix.
        title: one line about it.
        groups: its groups, each with the knobs of ``all`` as well.
    """

    name: str
    title: str
    groups: tuple[Group, ...]


def shipped_studies() -> dict[str, Path]:
    """The shipped studies, by name.

    Examples:
        >>> "smoke" in shipped_studies()
        True
    """
    return {path.stem: path for path in sorted((shipped_conf() / "study").glob("*.yaml"))}


def find_study(text: str) -> Path:
    """The file of the study that a user named: a shipped one's name, or a path.

    Raises:
        UserError: for an unknown name or a missing file.

    Examples:
        >>> find_study("smok")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: 'smok' is not a study; did you mean 'smoke'?
    """
    if text.endswith((".yaml", ".yml")):
        path = Path(text)
        if not path.is_file():
            raise UserError(f"there is no file {text}: write the study there, or name another.")
        return path
    known = shipped_studies()
    if text not in known:
        hint = did_you_mean(text, known)
        hint = hint or f": choose one of {', '.join(known)}, or give the path of a .yaml file."
        raise UserError(f"{text!r} is not a study{hint}")
    return known[text]


def read_spec(path: Path) -> Spec:
    """Read a study's file; its recipes check the knobs later.

    Raises:
        UserError: where the file is not valid YAML or not a study.
    """
    from omegaconf import OmegaConf

    content = OmegaConf.to_container(load_yaml(path), resolve=False)
    if not isinstance(content, dict):
        raise UserError(f"{path} is not a study: it needs `groups`, a list.")
    for key in content:
        if key not in _KEYS:
            hint = did_you_mean(str(key), _KEYS) or f": a study has {', '.join(_KEYS)}."
            raise UserError(f"{path}: {key!r} is not a key of a study{hint}")
    shared, groups = content.get("all") or {}, content.get("groups")
    if not isinstance(shared, dict):
        raise UserError(f"{path}: `all` holds knobs that all groups have, as key: value.")
    if not isinstance(groups, list) or not groups:
        raise UserError(f"{path}: `groups` is missing: list at least one, with label and recipe.")
    found = tuple(_group(path, number, entry, shared) for number, entry in enumerate(groups, 1))
    for label in {group.label for group in found}:
        if sum(group.label == label for group in found) > 1:
            raise UserError(f"{path}: two groups have the label {label!r}: give each its own.")
    return Spec(path.stem, str(content.get("title") or ""), found)


def _group(path: Path, number: int, entry: Any, shared: Mapping[str, Any]) -> Group:
    if not isinstance(entry, dict) or not isinstance(entry.get("label"), str):
        raise UserError(f"{path}: group {number} has no label: give it one, label: TEXT.")
    own = dict(entry)
    label, recipes, player = own.pop("label"), own.pop("recipe", None), own.pop("player", False)
    if not isinstance(player, bool):
        raise UserError(f"{path}: group {label!r} has player: {player}: write true or false.")
    recipes = recipes if isinstance(recipes, list) else [recipes]
    if not recipes or not all(isinstance(name, str) for name in recipes):
        raise UserError(f"{path}: group {label!r} has no recipe: give one, or a list of them.")
    return Group(label, tuple(recipes), {**flat(shared), **flat(own)}, player)


def override_text(key: str, value: Any, *, is_list: bool = False) -> str:
    """A knob of a study as ``key=value``, in the grammar of ``giril run -m``.

    A list of values is a sweep. For a knob that is itself a list, a list is one value and a list of
    lists a sweep. Text that the command line could not read is quoted.

    Args:
        key: the knob's dotted key.
        value: its value in the YAML.
        is_list: whether the knob holds a list.

    Examples:
        >>> override_text("seed", [0, 1]), override_text("demo.length", None)
        ('seed=0,1', 'demo.length=null')
        >>> override_text("ppo.hidden", [16, 16], is_list=True)
        'ppo.hidden=[16,16]'
        >>> override_text("demo.path", "old runs, (two)")
        "demo.path='old runs, (two)'"
    """
    sweeps = isinstance(value, list) and (not is_list or any(isinstance(v, list) for v in value))
    entries = value if sweeps else [value]
    return f"{key}=" + ",".join(_text(key, entry, alone=len(entries) == 1) for entry in entries)


def _text(key: str, value: Any, *, alone: bool) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ",".join(_text(key, entry, alone=False) for entry in value) + "]"
    text = str(value)
    return text if _readable(f"{key}={text}", alone=alone) else "'" + text.replace("'", "\\'") + "'"


def _readable(text: str, *, alone: bool) -> bool:
    from giril_rl.config.overrides import parse

    try:
        (override,) = parse([text])
    except UserError:
        return False
    # Beside other values, text with commas would become several.
    return alone or not override.is_sweep_override()
