"""What a user may write as ``key=value``: Hydra's grammar, refused early and in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from giril_rl.config.knobs import Knob, flat, knobs
from giril_rl.config.nearest import did_you_mean
from giril_rl.errors import UserError


def parse(texts: Sequence[str]) -> list[Override]:
    """Read ``key=value`` texts with Hydra's override grammar.

    Raises:
        UserError: for a missing ``=``, a key given twice, an addition (``+key``) or a deletion
            (``~key``), and for a value that the grammar cannot read.

    Examples:
        >>> [override.value() for override in parse(["seed=3", "ppo.hidden=[64,64]"])]
        [3, [64, 64]]
    """
    parsed: dict[str, Override] = {}
    for text in texts:
        if text[:1] in "+~":
            raise UserError(f"{text}: keys can be changed, not added or removed; write key=value.")
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise UserError(f"{text!r} is not of the form key=value.")
        try:
            (override,) = OverridesParser.create().parse_overrides([text])
        except (OverrideParseException, ValueError):  # The latter for thousands of digits.
            raise UserError(
                f"{text}: the value cannot be read; put text with special characters in quotes, "
                f"such as {key}=\"'{value}'\"."
            ) from None
        if key in parsed:
            raise UserError(f"{key} is given twice: give it once.")
        parsed[key] = override
    return list(parsed.values())


def normalised(override: Override) -> str:
    """The override as text in one spelling: ``1e-3`` and ``0.001`` are the same change."""
    return f"{override.get_key_element()}={override.get_value_element_as_str()}"


def words_by_key(texts: Sequence[str]) -> dict[str, str]:
    """``key=value`` texts by key, a mapping as one text for each of its entries.

    Raises:
        UserError: as :func:`parse`, and for a key that is given twice.

    Examples:
        >>> words_by_key(["seed=3", "ppo={lr:1e-3,hidden:[8,8]}"])
        {'seed': 'seed=3', 'ppo.lr': 'ppo.lr=0.001', 'ppo.hidden': 'ppo.hidden=[8,8]'}
    """
    words: dict[str, str] = {}
    for override, text in zip(parse(texts), texts, strict=True):
        key, value = override.get_key_element(), override._value
        entries = {key: text}
        if isinstance(value, dict):
            entries = {
                name: f"{name}={Override._get_value_element_as_str(entry)}"
                for name, entry in flat({key: value}).items()
            }
        for name, word in entries.items():
            if name in words:
                raise UserError(f"{name} is given twice: give it once.")
            words[name] = word
    return words


class KeyCheck:
    """Checks keys and types against a recipe's ``Config``, one override at a time.

    Hydra refuses the same overrides, in several lines about its internals.

    Args:
        recipe: the recipe's name or path, for messages.
        config: its ``Config`` class.
        groups: config groups and their choices.
    """

    def __init__(self, recipe: str, config: type[Any], groups: Mapping[str, Sequence[str]]) -> None:
        self.recipe = recipe
        self.groups = groups
        self.knobs: dict[str, Knob] = {knob.key: knob for knob in knobs(config)}
        self._scratch: DictConfig = OmegaConf.structured(config)

    def override(self, override: Override) -> None:
        """Check one parsed override.

        Raises:
            UserError: for several values without ``-m``, an unknown key, an unknown choice of a
                group, or a value of the wrong type.
        """
        text = override.input_line or normalised(override)
        key = override.get_key_element()
        if override.is_sweep_override():
            raise UserError(f"{text} gives several values: add -m to run one after another.")
        if key not in self.groups:
            self.value(key, override.value(), text)
        elif override.value() not in self.groups[key]:
            known = ", ".join(self.groups[key])
            if key == "task":
                known += ", or give a Gymnasium id, such as task.env_id=ALE/Pong-v5"
            raise UserError(f"{text}: choose one of {known}.")

    def settings(self, settings: Mapping[str, Any], file: str) -> None:
        """Check the settings of a recipe's YAML, which a copy may have wrong.

        Raises:
            UserError: names the file, then the key.
        """
        for key, value in flat(settings, keep_empty=True).items():
            self.value(key, value, f"{key}={value}", where=f"{file}: ")

    def value(self, key: str, value: Any, text: str, where: str = "") -> None:
        """Check one dotted key and its value; ``text`` is how the user wrote it."""
        if key not in self.knobs:
            inside = [name for name in self.knobs if name.startswith(f"{key}.")]
            if inside and isinstance(value, Mapping) and not value:
                return
            if inside:
                raise UserError(
                    f"{where}{text}: {key} holds several keys; set one, such as {inside[0]}."
                )
            hint = did_you_mean(key, [*self.knobs, *self.groups]) or self._help(key)
            raise UserError(f"{where}{key!r} is not a key of {self.recipe}{hint}")
        try:
            OmegaConf.update(self._scratch, key, value, merge=False)
        except (OmegaConfBaseException, OverflowError):
            needed = self.knobs[key].needed
            whole = isinstance(value, float) and value.is_integer() and "whole" in needed
            hint = f", such as {int(value)}" if whole else ""
            raise UserError(f"{where}{text}: {needed} is needed{hint}.") from None

    def _help(self, key: str) -> str:
        part = key.rpartition(".")[0]
        names = [name.rpartition(".")[2] for name in self.knobs if name.startswith(f"{part}.")]
        if part and names:
            return f": {part} has {', '.join(names)}."
        return f": see `giril run {self.recipe} --help`."


def sweep(texts: Sequence[str]) -> list[list[str]]:
    """All combinations of the values in ``texts``, the last one changing fastest.

    Raises:
        UserError: for a kind of sweep that has no list of values, such as ``interval(0, 1)``.

    Examples:
        >>> sweep(["seed=0,1", "ppo.lr=0.1"])
        [['seed=0', 'ppo.lr=0.1'], ['seed=1', 'ppo.lr=0.1']]
    """
    listed = []
    for override in parse(texts):
        if override.value_type in (ValueType.INTERVAL_SWEEP, ValueType.GLOB_CHOICE_SWEEP):
            raise UserError(f"{override.input_line}: a sweep needs its values listed, such as a,b.")
        if override.is_sweep_override():
            key = override.get_key_element()
            listed.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            listed.append([normalised(override)])
    return [list(job) for job in product(*listed)]
