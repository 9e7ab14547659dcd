"""Figures one after the other, as a film."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from torchcover.files import write_atomically

WRITERS: dict[str, type[FFMpegWriter] | type[PillowWriter]] = {".gif": PillowWriter, ".mp4": FFMpegWriter}


def check_film(path: Path) -> None:
    """Refuse, before the first figure is drawn, a film that could not be written.

    Raises:
        ValueError: Neither .gif nor .mp4.
        FileNotFoundError: .mp4, and the program ffmpeg is not there.
    """
    if path.suffix not in WRITERS:
        raise ValueError(f"a film is a .gif or .mp4 file; got {path.name!r}")
    if not WRITERS[path.suffix].isAvailable():
        raise FileNotFoundError(f"{path.name}: the program ffmpeg is needed for .mp4 and is not there; write a .gif")


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    """(rows, columns, 4) red, green, blue, alpha."""
    canvas: Any = FigureCanvasAgg(figure)  # matplotlib has no types for it
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def write_film(path: Path, figures: Iterable[Figure], *, per_s: float) -> None:
    """Write figures as a film. It is as large as the first of them; what a later one has beyond that is cut off.

    Args:
        path: The file, .gif or .mp4; `check_film` says whether it can be written.
        figures: At least one, each drawn when it is its turn.
        per_s: How many of them a second shows.
    """
    write_atomically(path, partial(_write, figures, per_s))


def _write(figures: Iterable[Figure], per_s: float, path: Path) -> None:
    writer: AbstractMovieWriter = WRITERS[path.suffix](fps=per_s)  # type: ignore[arg-type]  # any number will do
    screen: Figure | None = None
    for figure in figures:
        image = _pixels(figure)
        if screen is None:
            # What encodes films wants even numbers of pixels.
            height, width = (size + size % 2 for size in image.shape[:2])
            screen = Figure(figsize=(width / figure.dpi, height / figure.dpi), dpi=figure.dpi)
            FigureCanvasAgg(screen)
            writer.setup(screen, str(path), dpi=figure.dpi)
        screen.clear()
        # Images lie with their first row at the top of the screen.
        screen.figimage(image, 0, height - len(image))
        writer.grab_frame()
    writer.finish()
