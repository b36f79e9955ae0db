"""Text of files that anyone may have written: bounded in size, depth and expansion, only data."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import yaml

from giril_rl.errors import UserError

MOST_BYTES = 16 * 2**20
"""Of a file of settings, results or metadata."""
_MOST_NODES = 100_000
_DEEPEST = 50
_PLAIN_REFERENCE = re.compile(r"\$\{[\w.\[\]]+\}")


def read_text(path: Path) -> str:
    """The UTF-8 text of a file that is not larger than :data:`MOST_BYTES`.

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
    """``text`` as JSON.

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
    """Looks whether ``text`` can be loaded as YAML without filling the memory.

    A few lines of aliases to aliases stand for more nodes than there is room for.

    Raises:
        yaml.YAMLError: if it is not YAML.
        ValueError: if it is nested too deeply or stands for too many nodes.

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
    """``text`` as YAML of plain values, after :func:`check_yaml`.

    Raises:
        yaml.YAMLError: if it is not YAML, or has a tag that is not of plain values.
        ValueError: as :func:`check_yaml`.

    Examples:
        >>> parse_yaml("seed: 3")
        {'seed': 3}
    """
    check_yaml(text)
    return yaml.safe_load(text)


def check_references(value: Any, where: str = "") -> None:
    """Refuses ``${...}`` in settings unless it is the key of another setting.

    OmegaConf's resolvers read what is no setting, such as environment variables, and a run's
    settings are written down and shared.

    Args:
        value: settings, unresolved.
        where: what names them in the refusal.

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
    """Refuses data that the machine's memory cannot hold, before any of it is read.

    Args:
        what: names the data in the refusal.
        size: bytes that it takes once loaded.

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
        return  # Not to be known here.
    if size > memory:
        raise UserError(
            f"{what} says that it holds {size / 1e9:,.0f} GB, more than this machine's memory: "
            "check where it is from, or take fewer episodes."
        )
