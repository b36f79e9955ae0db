"""Jobs of a command line or a study: each composed, and named by what it changes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from omegaconf import OmegaConf

from giril_rl.config.compose import Composed, compose, groups
from giril_rl.config.leaves import default_text, flat
from giril_rl.config.overrides import leaf_words
from giril_rl.config.recipe_files import Recipe
from giril_rl.config.validation import validate


@dataclass(frozen=True)
class Job:
    """One job.

    Attributes:
        config: the validated configuration.
        changes: ``{key: "key=value"}`` of what makes a difference, in one spelling: the same for
            the same configuration, however it was asked for.
        words: the texts of those, as they were given.
    """

    config: Any
    changes: dict[str, str]
    words: tuple[str, ...]


class Jobs:
    """Composes jobs, and remembers them: composing takes a tenth of a second.

    Examples:
        >>> from giril_rl.config.recipe_config import config_class
        >>> from giril_rl.config.recipe_files import find
        >>> giril = find("giril")
        >>> words = ["seed=3", "profile=paper", "batch_mean=false", "ppo.lr=3e-4", "ppo.clip=0.20"]
        >>> job = Jobs().job(giril, config_class(giril), words)
        >>> job.changes
        {'ppo.clip': 'ppo.clip=0.2', 'profile': 'profile=paper', 'seed': 'seed=3'}
        >>> job.words
        ('profile=paper', 'ppo.clip=0.20', 'seed=3')
    """

    def __init__(self) -> None:
        self._composed: dict[tuple[Any, ...], _Once] = {}
        self._jobs: dict[tuple[Any, ...], Job] = {}

    def job(self, recipe: Recipe, schema: type[Any], texts: Sequence[str]) -> Job:
        """One job.

        Args:
            recipe: the recipe.
            schema: its ``Config`` class.
            texts: ``key=value``, one value each.

        Raises:
            UserError: as :func:`giril_rl.config.compose.resolved`.
        """
        words = leaf_words(texts)
        # Most jobs of a sweep differ in their seed alone.
        rest = {key: text for key, text in words.items() if key != "seed"}
        seed = words.get("seed", "").partition("=")[2]
        if not re.fullmatch(r"[0-9]{1,20}", seed) or self._refers(recipe, schema, rest, "seed"):
            job = self._settled(recipe, schema, words)
        else:
            text = f"seed={int(seed)}"
            known = self._settled(recipe, schema, rest)
            job = Job(
                replace(known.config, seed=int(seed)),
                {**known.changes, "seed": text},
                (*known.words, text),
            )
        validate(job.config)
        return job

    def _settled(self, recipe: Recipe, schema: type[Any], words: dict[str, str]) -> Job:
        """The job, not validated, without the words that change nothing."""
        known = (recipe.word, schema, *words.values())
        if known not in self._jobs:
            config = self._config(recipe, schema, words)
            kept = self._needed(recipe, schema, words, _values(config))
            values = _values(config)
            choices = groups(recipe)
            changes = {
                key: text if key in choices else f"{key}={default_text(values[key])}"
                for key, text in sorted(kept.items())
            }
            self._jobs[known] = Job(config, changes, tuple(kept.values()))
        return self._jobs[known]

    def _needed(
        self, recipe: Recipe, schema: type[Any], words: dict[str, str], values: dict[str, Any]
    ) -> dict[str, str]:
        """``words`` without those whose absence would change none of ``values``.

        Composing without each in turn would tell, and take long. It is only done where two words
        bear on the same key, such as ``profile=paper batch_mean=false``.
        """
        first = {key: text for key, text in words.items() if key == "task"}
        if not first and "task.env_id" in words:
            first = {"task.env_id": words["task.env_id"]}
        missing = self._compose(recipe, schema, first).missing
        first |= {key: words[key] for key in missing if key in words}
        base = _values(self._config(recipe, schema, first))
        bears_on = {
            key: self._bears_on(recipe, schema, key, words, first, base)
            for key in words
            if key not in first
        }
        for key in sorted(bears_on):
            mine = bears_on[key]
            others = set().union(*(keys for other, keys in bears_on.items() if other != key))
            changed = {name for name in mine if values.get(name) != base.get(name)}
            if changed - others:
                continue
            rest = {other: text for other, text in words.items() if other != key}
            if not mine & others or _values(self._config(recipe, schema, rest)) == values:
                words = rest
                del bears_on[key]
        return words

    def _bears_on(
        self,
        recipe: Recipe,
        schema: type[Any],
        key: str,
        words: dict[str, str],
        first: dict[str, str],
        base: dict[str, Any],
    ) -> set[str]:
        """The keys that a word sets: of a choice, all those in its file."""
        found = {key}
        for texts in (first, words):
            found.update(self._refers(recipe, schema, texts, key))
        if key in groups(recipe):
            alone = _values(self._config(recipe, schema, {**first, key: words[key]}))
            found = {name for name in alone if alone[name] != base.get(name)}
        return found

    def _refers(
        self, recipe: Recipe, schema: type[Any], words: dict[str, str], key: str
    ) -> list[str]:
        """The keys whose values are written as ``${key}``."""
        name = re.escape(key.rpartition(".")[2])
        reference = re.compile(rf"\$\{{({re.escape(key)}|\.+{name})\}}")
        values = self._compose(recipe, schema, words).unresolved
        return [where for where, value in values.items() if reference.search(str(value))]

    def _config(self, recipe: Recipe, schema: type[Any], words: dict[str, str]) -> Any:
        return self._compose(recipe, schema, words).config

    def _compose(self, recipe: Recipe, schema: type[Any], words: dict[str, str]) -> _Once:
        known = (recipe.word, schema, *words.values())
        if known not in self._composed:
            self._composed[known] = _Once(compose(recipe, schema, list(words.values())))
        return self._composed[known]


class _Once:
    """What a composed configuration tells: resolving it changes it."""

    def __init__(self, composed: Composed) -> None:
        self._composed = composed
        self.missing = composed.missing()
        values = OmegaConf.to_container(composed.node, resolve=False)
        self.unresolved: dict[str, Any] = flat(values)  # type: ignore[arg-type]

    @cached_property
    def config(self) -> Any:
        return self._composed.config()


def _values(config: Any) -> dict[str, Any]:
    return flat(asdict(config), keep_empty=True)
