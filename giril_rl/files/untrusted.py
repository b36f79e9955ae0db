"""Safe reading of files that anyone may have written: bounded size and depth, data only."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from giril_rl.errors import UserError

MOST_BYTES = 16 * 2**20
"""The largest file of settings, results or metadata that is read."""
_MOST_NODES = 100_000
_DEEPEST = 50
_PLAIN_REFERENCE = re.compile(r"\$\{[\w.\[\]]+\}")


def read_text(path: Path) -> str:
    """The UTF-8 text of a file of at most :data:`MOST_BYTES`.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it is larger, or not UTF-8.
    """
    with open(path, "rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"it has more than {MOST_BYTES:,} bytes")
    return content.decode("utf-8")


def parse_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: if it is not JSON, or nested too deeply.

    Examples:
        >>> parse_json("[" * 100_000)
        Traceback (most recent call last):
        ...
        ValueError: it is nested too deeply
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def check_yaml(text: str) -> None:
    """Refuse YAML that would fill the memory: a few lines of nested aliases can expand to billions.

    Raises:
        yaml.YAMLError: if it is not YAML.
        ValueError: if it is nested too deeply, or expands to too many values.

    Examples:
        >>> check_yaml("seed: 3")
        >>> lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
        >>> lines += [f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]" for i in range(9)]
        >>> check_yaml(chr(10).join(lines))
        Traceback (most recent call last):
        ...
        ValueError: its aliases stand for more than 100,000 values
    """
    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []
    total = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in [anchor for anchor, _ in open_nodes]:
                raise ValueError("it has an alias for something that it is inside of")
            total += sizes.get(str(event.anchor), 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, total))
            total += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = total - before
        elif isinstance(event, yaml.ScalarEvent):
            total += 1
        if total > _MOST_NODES:
            raise ValueError(f"its aliases stand for more than {_MOST_NODES:,} values")
        if len(open_nodes) > _DEEPEST:
            raise ValueError("it is nested too deeply")


def parse_yaml(text: str) -> Any:
    """Parse YAML of plain values, after :func:`check_yaml`.

    Raises:
        yaml.YAMLError: if it is not YAML, or has a tag for anything but plain values.
        ValueError: as in :func:`check_yaml`.

    Examples:
        >>> parse_yaml("seed: 3")
        {'seed': 3}
    """
    check_yaml(text)
    return yaml.safe_load(text)


def check_references(value: Any, where: str = "") -> None:
    """Refuse ``${...}`` in settings unless it names another setting.

    OmegaConf's resolvers can read environment variables, and a run's settings are saved and shared.

    Args:
        value: unresolved settings.
        where: their dotted key, for the message.

    Raises:
        UserError: for the first other reference.

    Examples:
        >>> check_references({"steps": "${task.steps}"})
        >>> check_references({"task": {"name": "${oc.env:HOME}"}})
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: task.name=${oc.env:HOME}: only ${other.key} ... itself.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            check_references(inner, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list):
        for inner in value:
            check_references(inner, where)
    elif isinstance(value, str) and "${" in _PLAIN_REFERENCE.sub("", value):
        raise UserError(
            f"{where}={value}: only ${{other.key}} may be referred to; write the value itself."
        )


def check_memory(what: str, size: int) -> None:
    """Refuse data larger than the machine's memory, before reading any of it.

    Args:
        what: the data's name, for the message.
        size: bytes it takes once loaded.

    Raises:
        UserError: if that is more than all memory.

    Examples:
        >>> check_memory("demo.npz", 10**18)
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: demo.npz says that it holds 1,000,000,000 GB, more than ...
    """
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return  # Unknown on this system.
    if size > memory:
        raise UserError(
            f"{what} says that it holds {size / 1e9:,.0f} GB, more than this machine's memory: "
            "check where it is from, or take fewer episodes."
        )


def check_format(found: Any, readable: Collection[int], *, where: str, older: str) -> None:
    """Refuse a file format that this version cannot read, and say what to do.

    Args:
        found: the number in the file; it may be of any type.
        readable: the formats that this version reads.
        where: the file and the kind of format, such as ``"a.json has card format"``.
        older: what to do about an older file, or one without a number.

    Raises:
        UserError: if ``found`` is not one of ``readable``.

    Examples:
        >>> check_format(1, [1], where="card.json has format", older="save it again")
        >>> check_format(9, [1], where="card.json has format", older="save it again")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: card.json has format 9, written by a later giril_rl (this one
        reads up to 1): upgrade giril_rl.
    """
    if type(found) is int and found in readable:
        return
    newest = max(readable)
    if type(found) is int and found > newest:
        raise UserError(
            f"{where} {found}, written by a later giril_rl (this one reads up to {newest}): "
            "upgrade giril_rl."
        )
    known = " and ".join(map(str, sorted(readable)))
    raise UserError(f"{where} {found!r}, and this giril_rl reads only {known}: {older}.")
