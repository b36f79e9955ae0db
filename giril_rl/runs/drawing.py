"""What the report's pictures have in common."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from giril_rl.files.disk import write_atomically


def new_figure(width: float, height: float) -> Any:
    """A matplotlib figure of its own, not pyplot's: no window, no global state is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def thousands(axis: Any) -> None:
    """Write an axis's numbers in full, such as 1,000,000."""
    from matplotlib.ticker import FuncFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))


def save(figure: Any, path: Path) -> None:
    """Write the figure as PNG, at once."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    write_atomically(path, picture.getvalue())
