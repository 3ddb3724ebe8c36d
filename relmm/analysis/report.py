"""The report as one page that needs nothing else, with its numbers as JSON and its pictures as files."""

from __future__ import annotations

import base64
import json
import shlex
from importlib import resources
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from relmm.analysis.collection import GRASPS, Collection
from relmm.analysis.drawing import Drawn, draw, replace
from relmm.analysis.figures import figures
from relmm.analysis.sentences import sentences
from relmm.analysis.summary import SUMMARY

REPORT = "report.html"


def write_report(
    output: Path,
    collection: Collection,
    summary: dict[str, Any],
    comparison: tuple[dict[str, Any], Figure] | None = None,
    files: bool = True,
) -> None:
    """Write `figures/`, `summary.json` and last `report.html`, each whole or not at all.

    Args:
        output: folder, with the `grasps.parquet` of the collection.
        collection: the attempts.
        summary: of `summarize_collection`.
        comparison: of `relmm.analysis.comparison.compare`.
        files: also write `figures/`; else the pictures are only in the page.
    """
    made = figures(summary, collection.samples)
    if comparison is not None:
        summary, made["comparison"] = {**summary, "comparison": comparison[0]}, comparison[1]
    folder = output / "figures" if files else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    drawn = {name: draw(figure, name, folder) for name, figure in made.items()}
    replace(output / SUMMARY, json.dumps(summary, indent=2, allow_nan=False))
    replace(output / REPORT, render(summary, drawn, _surprising(output / GRASPS, summary), files))


def render(summary: dict[str, Any], drawn: dict[str, Drawn], surprising: list[dict[str, Any]], files: bool) -> str:
    """The page.

    Args:
        summary: every number.
        drawn: the pictures, by name.
        surprising: rows with a picture, as a data URL, and a command.
        files: whether there are others beside it.
    """
    template = resources.files("relmm.analysis").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        summary=summary, says=sentences(summary), figures=drawn, surprising=surprising, files=files
    )


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
