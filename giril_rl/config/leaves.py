"""Dotted keys: of a config dataclass, with their type, help and limits, and of plain settings."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_LISTS = {
    int: "a list of whole numbers such as [100,100]",
    float: "a list of numbers such as [0.5,1.0]",
    str: "a list of words such as [a,b]",
}


@dataclass(frozen=True)
class Leaf:
    """One knob of a recipe."""

    key: str
    type: Any
    metadata: Mapping[str, Any]

    @property
    def help(self) -> str:
        """What the knob is, in a line."""
        return self.metadata.get("help", "")

    @property
    def choices(self) -> tuple[str, ...] | None:
        """The only texts allowed, None where any is."""
        choices = self.metadata.get("choices")
        return tuple(choices()) if callable(choices) else choices

    @property
    def line(self) -> str:
        """The line that ``--help`` shows: the help, and the choices.

        Examples:
            >>> Leaf("form", str, {"help": "form of the reward", "choices": ("a", "b")}).line
            'form of the reward {a, b}'
        """
        return self.help + (f" {{{', '.join(self.choices)}}}" if self.choices else "")

    @property
    def optional(self) -> bool:
        """Whether the knob may be null."""
        return type(None) in get_args(self.type)

    def takes(self, value: Any) -> bool:
        """Whether a value read from a file is of the knob's type; limits are not looked at.

        Examples:
            >>> Leaf("lr", float, {}).takes(1), Leaf("seed", int, {}).takes("1")
            (True, False)
        """
        if value is None:
            return self.optional
        kinds = [kind for kind in get_args(self.type) if kind is not type(None)]
        kind = kinds[0] if self.optional else self.type
        if get_origin(kind) is list:
            return isinstance(value, list) and all(
                Leaf(self.key, get_args(kind)[0], {}).takes(entry) for entry in value
            )
        return type(value) is kind or (kind is float and type(value) is int)

    @property
    def needed(self) -> str:
        """What a value must be, in words.

        Examples:
            >>> Leaf("seed", int | None, {}).needed
            'a whole number or null'
        """
        kind = self.type
        if get_origin(kind) in (Union, types.UnionType):
            kind = next(arg for arg in get_args(kind) if arg is not type(None))
        if get_origin(kind) is list:
            words = _LISTS.get(get_args(kind)[0], "a list")
        else:
            words = _WORDS.get(kind, getattr(kind, "__name__", str(kind)))
        return words + (" or null" if self.optional else "")


def default_text(value: Any) -> str:
    """A knob's default as ``--help`` shows it.

    Examples:
        >>> default_text(None), default_text(True), default_text([64, 64]), default_text("???")
        ('null', 'true', '[64,64]', '(needed)')
    """
    if value == "???":
        return "(needed)"
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value).replace(" ", "")


def leaves(config: type[Any], prefix: str = "") -> Iterator[Leaf]:
    """Walk a config dataclass and its parts in the order in which they are written.

    Args:
        config: a dataclass, its parts dataclasses too.
        prefix: dotted key of ``config`` itself, with the dot.

    Examples:
        >>> from giril_rl.config.schema import RunConfig
        >>> [leaf.key for leaf in leaves(RunConfig)][:2]
        ['task.name', 'task.env_id']
    """
    hints = get_type_hints(config)
    for part in fields(config):
        kind = hints[part.name]
        if is_dataclass(kind):
            yield from leaves(kind, f"{prefix}{part.name}.")  # type: ignore[arg-type]
        else:
            yield Leaf(f"{prefix}{part.name}", kind, part.metadata)


def flat(
    values: Mapping[Any, Any], prefix: str = "", *, keep_empty: bool = False
) -> dict[str, Any]:
    """Nested settings as ``{dotted key: value}``.

    Args:
        values: nested settings.
        prefix: dotted key of ``values`` itself, with the dot.
        keep_empty: whether a mapping with nothing in it is a value; else it is left out.

    Examples:
        >>> flat({"seed": 1, "ppo": {"lr": 0.1}, "task": {}})
        {'seed': 1, 'ppo.lr': 0.1}
        >>> flat({"ppo": {"lr": 0.1}, "task": {}}, keep_empty=True)
        {'ppo.lr': 0.1, 'task': {}}
    """
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and (value or not keep_empty):
            found.update(flat(value, f"{prefix}{key}.", keep_empty=keep_empty))
        else:
            found[f"{prefix}{key}"] = value
    return found
