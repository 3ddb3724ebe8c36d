"""Pictures in the page: whole where there is room for them, and in pieces below each other on a phone."""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from relmm.analysis.figures import INK, STYLE

_DPI = 150
_POINTS = 72  # an inch, matplotlib's unit in SVG
_COLORBAR = "<colorbar>"  # matplotlib's name for the axes of one
_PIECE = 4.3  # inches, as wide as a phone shows with text that can be read


@dataclass(frozen=True)
class Piece:
    """A part of a picture that stands for itself, points.

    Attributes:
        left, width: where it is.
        height: of the whole picture.
    """

    left: float
    width: float
    height: float


@dataclass(frozen=True)
class Drawn:
    """A picture.

    Attributes:
        svg: of the whole.
        content: name of the element that holds all that is drawn.
        pieces: from left to right; none where it cannot be divided.
    """

    svg: str
    content: str
    pieces: list[Piece]


def draw(figure: Figure, name: str, folder: Path | None) -> Drawn:
    """Draw a picture for the page, and write it as PNG and SVG if there is a folder."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        if folder is not None:
            figure.savefig(folder / f"{name}.png", dpi=_DPI, facecolor="white")
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
        pieces = _pieces(figure)
    if folder is not None:
        replace(folder / f"{name}.svg", text.getvalue())
    svg = text.getvalue()[text.getvalue().index("<svg") :].replace(INK, "currentColor")
    # Names of elements are counted from one in every picture, and there are several in the page.
    svg = re.sub(r'(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, count=1, flags=re.DOTALL)
    return Drawn(svg, f"{name}-figure_1", pieces)


def replace(path: Path, text: str) -> None:
    """Write a file that is there whole, or as it was."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def _pieces(figure: Figure) -> list[Piece]:
    """Between neighbouring columns of axes, each as wide as possible but not above `_PIECE`."""
    width, height = figure.get_size_inches()
    columns = _columns(figure)
    cuts = [0.0]
    for i in range(1, len(columns)):
        if columns[i].x1 - cuts[-1] > _PIECE:
            cuts.append((columns[i - 1].x1 + columns[i].x0) / 2)
    ends = [*cuts[1:], width]
    if len(cuts) == 1:
        return []
    return [
        Piece(begin * _POINTS, (end - begin) * _POINTS, height * _POINTS) for begin, end in zip(cuts, ends, strict=True)
    ]


def _columns(figure: Figure) -> list[Bbox]:
    """Where the columns of axes are with all that belongs to them, inches, from left to right."""
    columns: list[Bbox] = []
    for axes in sorted(figure.axes, key=lambda axes: axes.get_position().x0):
        box = axes.get_tightbbox()
        if box is None:
            continue
        box = box.transformed(figure.dpi_scale_trans.inverted())
        if columns and (axes.get_label() == _COLORBAR or box.x0 < columns[-1].x1):
            columns[-1] = Bbox.union([columns[-1], box])
        else:
            columns.append(box)
    return columns
