"""A demonstration shown: as text, and images as an animated GIF."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path

from PIL import Image
from torch import Tensor

from giril_rl.demos.demonstration import Demonstration
from giril_rl.errors import UserError
from giril_rl.files.disk import write_atomically

SCALE = 4
_LIVES = {"first": ", each up to the first lost life", "all": ", each through all lives"}
_PLAYED = {"True": "deterministic", "False": "sampled", "by hand": "by hand"}


def describe(demo: Demonstration) -> str:
    """A table of a demonstration's origin, actions and episodes.

    Args:
        demo: the demonstration; its card may lack anything.

    Examples:
        >>> import gymnasium
        >>> from giril_rl.demos import record_demonstration
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), lambda o: o.new_ones(1).long(),
        ...     length=15, seed=0, task="cartpole", expert={"return_mean": 9.5, "seed": 1},
        ... )
        >>> demo.card["processor"] = "of this example"
        >>> print(describe(demo))
        task         cartpole (CartPole-v1)
        id           ...
        transitions  15
        episodes     2
        observation  4 numbers
        actions      1: 15 (100%)
        played       deterministic, seed 0
        expert       return 9.5, seed 1
        processor    of this example
        <BLANKLINE>
        episode  length  score  end
              0      10   10.0  terminated
              1       5    5.0  cut
    """
    card = demo.card
    lives = str(card.get("lives"))
    shape = list(demo.transitions["observation"].shape[1:])
    images = f"images {' x '.join(map(str, shape))}"
    played = _PLAYED.get(str(card.get("deterministic")), "not known how")
    rows = {
        "task": f"{card.get('task')} ({card.get('env_id')})",
        "id": demo.demo_id,
        "transitions": f"{len(demo):,}",
        "episodes": f"{demo.num_episodes:,}{_LIVES.get(lives, '')}",
        "observation": images if demo.has_images else _numbers(shape[0]),
        "actions": _actions(demo),
        "played": f"{played}, seed {card.get('seed')}",
        "expert": _expert(card.get("expert")),
    }
    if isinstance(card.get("processor"), str):
        rows["processor"] = card["processor"]
    source = card.get("source")
    if isinstance(source, dict):
        rows["source"] = f"{source.get('name')} ({source.get('format')})"
        rows["replay"] = str(card.get("replay"))
    width = max(map(len, rows)) + 2
    lines = [f"{name:<{width}}{value}" for name, value in rows.items()]
    return "\n".join([*lines, "", *_episodes(demo)])


def _numbers(count: int) -> str:
    return "1 number" if count == 1 else f"{count} numbers"


def _actions(demo: Demonstration) -> str:
    if not demo.has_actions:
        return "none, states alone"
    action, names = demo.transitions["action"], demo.card.get("actions")
    if action.ndim > 1:
        return f"{_numbers(action.shape[1])} from {action.min():.2f} to {action.max():.2f}"
    values, counts = action.unique(return_counts=True)
    parts = []
    for value, count in zip(values.tolist(), counts.tolist(), strict=True):
        name = names[value] if isinstance(names, list) and value < len(names) else value
        parts.append(f"{name}: {count:,} ({count / len(demo):.0%})")
    return ", ".join(parts)


def _expert(expert: object) -> str:
    if not isinstance(expert, dict) or not isinstance(expert.get("return_mean"), int | float):
        return "not known"
    steps = expert.get("env_steps")
    trained = f", {steps:,} steps" if isinstance(steps, int) else ""
    return f"return {expert['return_mean']:,.1f}, seed {expert.get('seed')}{trained}"


def _episodes(demo: Demonstration) -> list[str]:
    after = demo.transitions["next"]
    last = (demo.lengths.cumsum(0) - 1).tolist()
    lives = _lives_left(demo)
    rows = [["episode", "length", "score", *(["lives"] if lives else []), "end"]]
    parts = zip(demo.lengths.tolist(), demo.returns.tolist(), last, strict=True)
    for number, (length, score, row) in enumerate(parts):
        if after["terminated"][row]:
            end = _ended(demo, lives[number] if lives else None)
        else:
            end = "time limit" if after["truncated"][row] else "cut"
        shown = f"{score:,.1f}" if demo.has_rewards else "unknown"
        left = ["{} -> {}".format(*lives[number])] if lives else []
        rows.append([str(number), f"{length:,}", shown, *left, end])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    return [
        "  ".join([*(f"{x:>{w}}" for x, w in zip(row[:-1], widths, strict=True)), row[-1]])
        for row in rows
    ]


def _lives_left(demo: Demonstration) -> list[list[int]] | None:
    """Lives at each episode's beginning and end, if the card has them in the right form."""
    found = demo.card.get("lives_left")
    if not isinstance(found, list) or len(found) != demo.num_episodes:
        return None
    pairs = (
        isinstance(pair, list) and len(pair) == 2 and all(isinstance(n, int) for n in pair)
        for pair in found
    )
    return found if all(pairs) else None


def _ended(demo: Demonstration, lives: list[int] | None) -> str:
    """Why an episode terminated; in a game without lives, "first" is the whole game."""
    kind = demo.card.get("lives")
    if kind not in ("first", "all"):
        return "terminated"
    if lives is not None:
        return "life lost" if kind == "first" and lives[1] > 0 else "game over"
    return "life lost" if kind == "first" else "game over"


def write_gif(demo: Demonstration, path: Path, fps: int = 15) -> None:
    """Writes every frame of every episode, terminal ones included.

    Args:
        demo: a demonstration of images; the last plane of a stack is the latest.
        path: the file, replaced if it exists.
        fps: frames per second; 15 is an Atari game's own speed, as an action lasts 4 of 60 frames.

    Raises:
        UserError: if the observations are vectors.

    Examples:
        >>> demo = Demonstration.load("runs/demos/breakout/0a1b")  # doctest: +SKIP
        >>> write_gif(demo, Path("breakout.gif"))  # doctest: +SKIP
    """
    if not demo.has_images:
        raise UserError(
            f"--out {path}: this demonstration's observations are vectors, of which there is no "
            "picture."
        )
    planes = list(_planes(demo))
    frames = map(_picture, planes)
    # GIF counts in hundredths of a second: durations differ by one so that their sum is right.
    ends = [round(100 * number / fps) for number in range(len(planes) + 1)]
    content = io.BytesIO()
    next(frames).save(
        content,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=[10 * (end - start) for start, end in pairwise(ends)],
        loop=0,
    )
    write_atomically(path, content.getvalue())


def _planes(demo: Demonstration) -> Iterator[Tensor]:
    data = demo.transitions
    starts = data["step"] == 0
    for row, after in enumerate(data["next", "observation"]):
        first = [data["observation"][row]] if starts[row] else []
        yield from (stack[-1] for stack in chain(first, [after]))


def _picture(plane: Tensor) -> Image.Image:
    picture = Image.fromarray(plane.numpy())
    return picture.resize((SCALE * picture.width, SCALE * picture.height), Image.Resampling.NEAREST)
