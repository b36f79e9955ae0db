"""A demonstration of images as a moving picture."""

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


def write_gif(demo: Demonstration, path: Path, fps: int = 15) -> None:
    """Write every frame of every episode, the terminal ones included, one after another.

    Args:
        demo: a demonstration of images; of a stack the last plane is the latest.
        path: the file, which is replaced if it is there.
        fps: frames per second. An Atari game shows 60 and an action lasts 4 of them, so that 15 is
            its own speed.

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
    # GIF counts hundredths of a second: durations differ by one so that their sum is right.
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
    for row, following in enumerate(data["next", "observation"]):
        first = [data["observation"][row]] if starts[row] else []
        yield from (stack[-1] for stack in chain(first, [following]))


def _picture(plane: Tensor) -> Image.Image:
    picture = Image.fromarray(plane.numpy())
    return picture.resize((SCALE * picture.width, SCALE * picture.height), Image.Resampling.NEAREST)
