"""The pages that ``--help`` prints."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from giril_rl.config.compose import compose, groups
from giril_rl.config.leaves import default_text, leaves
from giril_rl.config.recipe_files import Recipe
from giril_rl.config.task_defaults import task_defaults


def _row(columns: Sequence[str], widths: Sequence[int], text: str, width: int) -> list[str]:
    head = (
        "  "
        + "  ".join(f"{cell:<{size}}" for cell, size in zip(columns, widths, strict=True))
        + "  "
    )
    room = max(width - len(head), 30)
    first, *rest = textwrap.wrap(text, room) or [""]
    return [(head + first).rstrip(), *(" " * len(head) + line for line in rest)]


def recipe_help(recipe: Recipe, config: type[Any], texts: Sequence[str] = ()) -> str:
    """A recipe's page: its docstring, its config groups, and every knob with default and help.

    Args:
        recipe: the recipe.
        config: its ``Config`` class.
        texts: overrides whose effect on the defaults is shown.
    """
    width = min(shutil.get_terminal_size((100, 24)).columns, 120)
    page = [f"giril run {recipe.word} [key=value ...] [-m]", "", recipe.docstring, ""]

    page.append("Choices")
    for name, (choices, default) in groups(recipe).items():
        marked = [f"{choice} (default)" if choice == default else choice for choice in choices]
        page += _row([name], [8], ", ".join(marked), width)
    page += _row([""], [8], "task.env_id=ID alone chooses the task gymnasium or atari", width)

    composed = compose(recipe, config, texts)
    node = composed.node
    missing = OmegaConf.is_missing(node.task, "env_id")
    kind = {} if missing else task_defaults(node.task.env_id, composed.chosen)
    rows = []
    for leaf in leaves(config):
        parent = OmegaConf.select(node, leaf.key.rpartition(".")[0]) if "." in leaf.key else node
        name = leaf.key.rpartition(".")[2]
        if OmegaConf.is_missing(parent, name):
            rows.append((leaf, "(needed)"))
        else:
            value = kind[leaf.key] if leaf.key in kind else _value(parent, name)
            rows.append((leaf, default_text(value)))
    widths = [
        max(len(leaf.key) for leaf, _ in rows),
        min(max(len(default) for _, default in rows), 12),
    ]
    # A recipe's own knobs come first, then its parts in order.
    for part in [
        "",
        *dict.fromkeys(leaf.key.partition(".")[0] for leaf, _ in rows if "." in leaf.key),
    ]:
        title = part or "Knobs (key, default, meaning)"
        page += ["", title]
        for leaf, default in rows:
            if (leaf.key.partition(".")[0] if "." in leaf.key else "") == part:
                page += _row([leaf.key, default], widths, leaf.line, width)
    page += ["", "Several values, such as seed=0,1,2, run one after another with -m."]
    return "\n".join(page)


def _value(parent: Any, name: str) -> Any:
    from omegaconf.errors import InterpolationToMissingValueError

    try:
        return parent[name]
    except InterpolationToMissingValueError:
        return "???"
