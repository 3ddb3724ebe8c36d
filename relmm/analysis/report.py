"""The report as one page that needs nothing else, with its numbers as JSON and its pictures as files."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shlex
from importlib import resources
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from relmm.analysis.collection import GRASPS, Collection
from relmm.analysis.comparison import compare
from relmm.analysis.figures import INK, STYLE, figures
from relmm.analysis.sentences import sentences
from relmm.analysis.summary import SUMMARY

REPORT = "report.html"
_DPI = 150


def write_report(
    output: Path,
    collection: Collection,
    summary: dict[str, Any],
    other: tuple[str, str, dict[str, Any]] | None = None,
    files: bool = True,
) -> None:
    """Write `figures/`, `summary.json` and last `report.html`, each whole or not at all.

    Args:
        output: folder, with the `grasps.parquet` of the collection.
        collection: the attempts.
        summary: of `summarize_collection`.
        other: name of this report and of another one, and the summary of that, to compare with.
        files: also write `figures/`; else the pictures are only in the page.
    """
    made = figures(summary, collection.samples)
    comparison = None
    if other is not None:
        comparison, picture = compare(summary, other[2], other[:2])
        made["comparison"] = picture
        summary = {**summary, "comparison": comparison}
    folder = output / "figures" if files else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    drawn = {name: _save(figure, name, folder) for name, figure in made.items()}
    _replace(output / SUMMARY, json.dumps(summary, indent=2, allow_nan=False))
    _replace(output / REPORT, render(summary, drawn, _surprising(output / GRASPS, summary)))


def render(summary: dict[str, Any], drawn: dict[str, str], surprising: list[dict[str, Any]]) -> str:
    """The page.

    Args:
        summary: every number.
        drawn: SVG by name.
        surprising: rows with a picture, as a data URL, and a command.
    """
    template = resources.files("relmm.analysis").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        summary=summary, says=sentences(summary), figures=drawn, surprising=surprising
    )


def _save(figure: Figure, name: str, folder: Path | None) -> str:
    """Write a picture as PNG and SVG, if there is a folder; returns the SVG for the page."""
    import matplotlib as mpl

    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        if folder is not None:
            figure.savefig(folder / f"{name}.png", dpi=_DPI, facecolor="white")
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    if folder is not None:
        _replace(folder / f"{name}.svg", text.getvalue())
    svg = text.getvalue()[text.getvalue().index("<svg") :].replace(INK, "currentColor")
    # Names of elements are counted from one in every picture, and there are several in the page.
    svg = re.sub(r'(id="|xlink:href="#|url\(#)', rf"\g<1>{name}-", svg)
    return re.sub(r"<metadata>.*?</metadata>", "", svg, count=1, flags=re.DOTALL)


def _surprising(grasps: Path, summary: dict[str, Any]) -> list[dict[str, Any]]:
    """The most surprising attempts with their pictures."""
    rows = summary["surprises"]["attempts"]
    wanted = {row["index"] for row in rows}
    pictures: dict[int, bytes | None] = {}
    with pq.ParquetFile(grasps) as file:
        for group in range(file.num_row_groups if wanted else 0):
            indices = file.read_row_group(group, ["index"])["index"].to_pylist()
            places = [i for i, index in enumerate(indices) if index in wanted]
            if places:
                column = file.read_row_group(group, ["picture"])["picture"]
                pictures |= {indices[i]: column[i].as_py() for i in places}
    return [row | {"src": _data_url(pictures.get(row["index"])), "command": _open(row, summary)} for row in rows]


def _open(row: dict[str, Any], summary: dict[str, Any]) -> str:
    dataset = summary["dataset"]
    return (
        f"lerobot-dataset-viz --repo-id {shlex.quote(dataset['repo_id'])} --root {shlex.quote(dataset['root'])} "
        f"--episode-index {row['episode']}"
    )


def _data_url(picture: bytes | None) -> str:
    return "" if picture is None else f"data:image/png;base64,{base64.b64encode(picture).decode()}"


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
