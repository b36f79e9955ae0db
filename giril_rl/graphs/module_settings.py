"""Plain attributes of a module, which a recording of it holds fast."""

from __future__ import annotations

from typing import Any

from torch import nn


class ModuleSettings:
    """Numbers, flags and words of a module and its parts, ``training`` among them.

    Whatever Python decides by them is decided once, while a graph is recorded. Names that begin
    with an underscore, and attributes that are added later, are not looked at.

    Args:
        module: the module.

    Examples:
        >>> dropout = nn.Dropout(0.25)
        >>> settings = ModuleSettings(dropout)
        >>> before = settings.read()
        >>> before
        (True, 0.25, False)
        >>> dropout.eval().p = 0.5
        >>> settings.read()
        (False, 0.5, False)
        >>> settings.write(before)
        >>> dropout.training, dropout.p
        (True, 0.25)
    """

    def __init__(self, module: nn.Module) -> None:
        self._places = [
            (vars(part), name)
            for part in module.modules()
            for name, value in vars(part).items()
            if isinstance(value, bool | int | float | str) and not name.startswith("_")
        ]

    def read(self) -> tuple[Any, ...]:
        """All values; some three microseconds for a loss of twenty parts."""
        return tuple([attributes[name] for attributes, name in self._places])

    def write(self, values: tuple[Any, ...]) -> None:
        """Puts back what :meth:`read` gave."""
        for (attributes, name), value in zip(self._places, values, strict=True):
            attributes[name] = value
