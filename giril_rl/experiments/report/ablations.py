"""Which settings the paper has a table about, and how ours are named in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from giril_rl.experiments.report.settings import Changes, text_of


@dataclass(frozen=True)
class Ablation:
    """A table about one thing that is varied.

    Attributes:
        name: short name, used in files and in ``paper.yaml``.
        title: the table's title.
        keys: the settings that are varied.
        methods: the methods that it is about; empty: all that have the settings.
    """

    name: str
    title: str
    keys: tuple[str, ...]
    methods: tuple[str, ...] = ()

    def covers(self, method: str, changes: Changes) -> bool:
        """Whether a row with these changes belongs into the table."""
        ours = not self.methods or method in self.methods
        return ours and bool(changes) and {key for key, _ in changes} <= set(self.keys)

    def has(self, method: str, config: Mapping[str, Any]) -> bool:
        """Whether a run has the settings at all."""
        return (not self.methods or method in self.methods) and self.keys[0] in config

    def value(self, config: Mapping[str, Any]) -> str:
        """The row's value, as ``paper.yaml`` spells it.

        Examples:
            >>> ABLATIONS[0].value({"reward.beta": 0.9})
            '0.9'
            >>> ABLATIONS[-1].value({"demo.length": None, "demo.episodes": 5})
            '5'
        """
        if self.name == "demonstrations":
            length, episodes = config.get("demo.length"), config.get("demo.episodes")
            return str(episodes) if length is None else f"{length:,} transitions"
        return text_of(config.get(self.keys[0]))

    def label(self, config: Mapping[str, Any]) -> str:
        """The row's value in words.

        Examples:
            >>> ABLATIONS[1].label({"scaling.enabled": False})
            'original'
        """
        value = self.value(config)
        if self.name == "standardisation":
            return {"true": "standardised", "false": "original"}.get(value, value)
        if self.name == "demonstrations" and value.isdecimal():
            return f"{value} full episode{'s' if value != '1' else ''}"
        return {"beta": "β = {}", "information": "I_c = {}"}.get(self.name, "{}").format(value)


ABLATIONS = (
    Ablation("beta", "β, the weight of the true action", ("reward.beta",), ("giril",)),
    Ablation("standardisation", "with and without standardised rewards", ("scaling.enabled",)),
    Ablation("information", "I_c, the information constraint", ("reward.information",), ("vail",)),
    Ablation("form", "form of the reward r_t", ("reward.form",)),
    Ablation("demonstrations", "number of demonstrations", ("demo.length", "demo.episodes")),
)
ABLATION_KEYS = frozenset(key for ablation in ABLATIONS for key in ablation.keys)
