"""Knobs: the fields of a config dataclass, with their dotted keys, types, help and bounds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, Optional, get_args, get_type_hints

from giril_rl.errors import UserError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

MOST = 2**63 - 1
"""The largest integer of any knob: what torch accepts as a seed or a size."""
_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    list[int]: "a list of whole numbers such as [100,100]",
    list[float]: "a list of numbers such as [0.5,1.0]",
    list[str]: "a list of words such as [a,b]",
}


def knob(
    default: Any,
    help: str,
    *,
    choices: Sequence[str] | Callable[[], Collection[str]] | None = None,
    low: float | None = None,
    high: float | None = None,
    low_open: bool = False,
    high_open: bool = False,
) -> Any:
    """A dataclass field with a default, one line of help and what its value may be.

    Args:
        default: the value used unless another is given; ``MISSING`` makes the knob mandatory.
        help: one line, shown by ``--help``.
        choices: the only texts allowed, or a function that returns them when they are needed.
        low: smallest number allowed; in a list, of each entry.
        high: largest number allowed; in a list, of each entry.
        low_open: ``low`` itself is not allowed.
        high_open: ``high`` itself is not allowed.

    Examples:
        >>> from dataclasses import dataclass, fields
        >>> @dataclass
        ... class Part:
        ...     beta: float = knob(1.0, "a weight in (0, 1]", low=0, high=1, low_open=True)
        >>> Part().beta, fields(Part)[0].metadata["help"]
        (1.0, 'a weight in (0, 1]')
    """
    bounds = {"gt" if low_open else "ge": low, "lt" if high_open else "le": high}
    metadata = {
        "help": help,
        "choices": choices if callable(choices) else tuple(choices or ()) or None,
        "bounds": {name: bound for name, bound in bounds.items() if bound is not None},
    }
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Knob:
    """One knob of a config dataclass.

    Attributes:
        key: its dotted key.
        type: the field's type.
        metadata: what :func:`knob` was given.
    """

    key: str
    type: Any
    metadata: Mapping[str, Any]

    @property
    def help(self) -> str:
        """One line of help."""
        return self.metadata.get("help", "")

    @property
    def choices(self) -> tuple[str, ...] | None:
        """The only texts allowed, None where any is."""
        choices = self.metadata.get("choices")
        return tuple(choices()) if callable(choices) else choices

    @property
    def line(self) -> str:
        """The line that ``--help`` shows: the help and the choices.

        Examples:
            >>> Knob("form", str, {"help": "form of the reward", "choices": ("a", "b")}).line
            'form of the reward {a, b}'
        """
        choices = self.choices
        return self.help + (f" {{{', '.join(choices)}}}" if choices else "")

    @property
    def optional(self) -> bool:
        """Whether the knob may be null."""
        return type(None) in get_args(self.type)

    @property
    def needed(self) -> str:
        """What type a value must have, in words.

        Examples:
            >>> Knob("seed", int | None, {}).needed
            'a whole number or null'
        """
        kind = self._kind
        words = _WORDS.get(kind, getattr(kind, "__name__", str(kind)))
        return words + (" or null" if self.optional else "")

    @property
    def is_list(self) -> bool:
        """Whether a value is a list."""
        return getattr(self._kind, "__origin__", None) is list

    def check(self, value: Any) -> None:
        """Refuses a value of another type, outside the bounds or not among the choices.

        Raises:
            UserError: says what the value must be.

        Examples:
            >>> Knob("ppo.hidden", list[int], {"bounds": {"ge": 1}}).check([64, 0])
            Traceback (most recent call last):
            ...
            giril_rl.errors.UserError: ppo.hidden[1]=0 must be greater than or equal to 1.
        """
        from pydantic import ValidationError

        try:
            self._adapter.validate_python(value)
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            entry = "".join(f"[{index}]" for index in fault["loc"])
            shown = default_text(fault["input"])
            shown = shown if len(shown) <= 100 else f"{shown[:20]}..."
            must = fault["msg"].replace("Input should be", "must be")
            null = ", or null" if self.optional else ""
            raise UserError(f"{self.key}{entry}={shown} {must}{null}.") from None

    @property
    def _kind(self) -> Any:
        kinds = [kind for kind in get_args(self.type) if kind is not type(None)]
        return kinds[0] if self.optional else self.type

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        from pydantic import ConfigDict, TypeAdapter

        kind = self._bounded(self._kind)
        strict = ConfigDict(strict=True)  # Neither "3" nor true is a number.
        return TypeAdapter(Optional[kind] if self.optional else kind, config=strict)  # noqa: UP045

    def _bounded(self, kind: Any) -> Any:
        """The type with the knob's bounds, as pydantic reads them."""
        from pydantic import Field

        whole: dict[str, Any] = {"ge": -MOST, "le": MOST}
        bounds: dict[str, Any] = self.metadata.get("bounds") or {}
        if self.choices:
            return Literal[self.choices]
        if self.is_list and kind is self._kind:
            return list[self._bounded(get_args(kind)[0])]  # type: ignore[misc]
        if kind is int:
            return Annotated[int, Field(**(whole | bounds))]
        if kind is float:
            return Annotated[float, Field(allow_inf_nan=False, **bounds)]
        return kind


def default_text(value: Any) -> str:
    """A value as ``--help`` shows it, and as it is written on the command line.

    Examples:
        >>> default_text(None), default_text(True), default_text([64, 64]), default_text("???")
        ('null', 'true', '[64,64]', '(needed)')
    """
    if value == "???":
        return "(needed)"
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value).replace(" ", "")


def knobs(config: type[Any], prefix: str = "") -> Iterator[Knob]:
    """The knobs of a config dataclass and of its parts, in the order in which they are written.

    Args:
        config: a dataclass, its parts dataclasses too.
        prefix: dotted key of ``config`` itself, with the dot.

    Examples:
        >>> from giril_rl.config.schema import RunConfig
        >>> [each.key for each in knobs(RunConfig)][:2]
        ['task.name', 'task.env_id']
    """
    hints = get_type_hints(config)
    for part in fields(config):
        kind = hints[part.name]
        if is_dataclass(kind):
            yield from knobs(kind, f"{prefix}{part.name}.")  # type: ignore[arg-type]
        else:
            yield Knob(f"{prefix}{part.name}", kind, part.metadata)


def flat(
    values: Mapping[Any, Any], prefix: str = "", *, keep_empty: bool = False
) -> dict[str, Any]:
    """Nested settings as ``{dotted key: value}``.

    Args:
        values: nested settings.
        prefix: dotted key of ``values`` itself, with the dot.
        keep_empty: keep an empty mapping as a value instead of leaving it out.

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
