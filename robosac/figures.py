"""Figures and films to draw, by matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robosac.extras import need
from robosac.files import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILM_SUFFIXES = (".gif", ".mp4")
GIF_COLOURS = 64


def need_figures() -> None:
    """Refuse before long work if its pictures cannot be drawn.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need("matplotlib", "pictures")


def check_picture(path: Path) -> None:
    """Refuse before long work if a picture cannot be written.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    ValueError
        If the suffix is none of a picture.
    """
    need_figures()
    from matplotlib.backend_bases import FigureCanvasBase  # noqa: PLC0415 (a second to import)

    known = sorted(FigureCanvasBase.filetypes)
    if path.suffix.lower().removeprefix(".") not in known:
        raise ValueError(f"a picture's name ends with one of {', '.join(known)}, not with {path.suffix or 'no suffix'}")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches; its parts are laid out so that they do not overlap.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    """
    need_figures()
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import, and only pictures need it)

    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path, dpi: int, **options: Any) -> None:
    """Write a picture by `replacing`; the suffix chooses the format. ``options`` are those of ``Figure.savefig``."""
    with replacing(path) as beside:
        figure.savefig(beside, dpi=dpi, **options)


def check_film(path: Path) -> None:
    """Refuse before long work if a film cannot be written.

    Raises
    ------
    MissingExtra
        If matplotlib is not installed.
    ValueError
        If the suffix is none of a film, or needs a program that is not installed.
    """
    need_figures()
    from matplotlib.animation import FFMpegWriter  # noqa: PLC0415 (as above)

    if path.suffix.lower() not in FILM_SUFFIXES:
        raise ValueError(f"a film's name ends with {' or '.join(FILM_SUFFIXES)}, not with {path.suffix or 'no suffix'}")
    if path.suffix.lower() == ".mp4" and not FFMpegWriter.isAvailable():
        raise ValueError("ffmpeg is not installed, and an MP4 needs it: a name that ends with .gif needs nothing else")


def save_film(figure: Figure, draw: Callable[[int], None], frames: int, path: Path, *, fps: int, dpi: int) -> None:
    """Write a film by `replacing`; the suffix chooses the format, see `check_film`.

    Parameters
    ----------
    figure : Figure
    draw : callable
        Draws the frame of a number into the figure, which is cleared before.
    frames : int
        How many, at least 1.
    path : Path
    fps : int
        Frames a second.
    dpi : int
    """
    with replacing(path) as beside:
        write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_gif
        write(figure, _drawn(figure, draw, frames), beside, fps, dpi)


def _drawn(figure: Figure, draw: Callable[[int], None], frames: int) -> Iterator[None]:
    for number in range(frames):
        figure.clear()
        draw(number)
        yield


def _write_gif(figure: Figure, drawn: Iterator[None], path: Path, fps: int, dpi: int) -> None:
    """All frames with one palette, so that what stands still takes no room."""
    from PIL import Image  # noqa: PLC0415 (as above)

    width, height = (int(inches * dpi) for inches in figure.get_size_inches())
    images = []
    for _ in drawn:
        pixels = BytesIO()
        figure.savefig(pixels, format="rgba", dpi=dpi)
        images.append(Image.frombytes("RGBA", (width, height), pixels.getvalue()).convert("RGB"))
    some = images[:: max(1, len(images) // 4)]
    together = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for row, image in enumerate(some):
        together.paste(image, (0, row * image.height))
    palette = together.quantize(GIF_COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, optimize=True)


def _write_mp4(figure: Figure, drawn: Iterator[None], path: Path, fps: int, dpi: int) -> None:
    from matplotlib.animation import FFMpegWriter  # noqa: PLC0415 (as above)

    writer = FFMpegWriter(fps=fps, extra_args=["-pix_fmt", "yuv420p"])
    with writer.saving(figure, str(path), dpi):
        for _ in drawn:
            writer.grab_frame()
