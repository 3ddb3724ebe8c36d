"""The notebook of datasets/ runs from top to bottom."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_notebook_runs_and_learns(tmp_path, monkeypatch):
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    monkeypatch.chdir(tmp_path)
    cells = json.loads((ROOT / "datasets" / "first_look.ipynb").read_text())["cells"]
    space: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), space)
    assert {"success", "cells", "time"} <= space["drawn"].keys()
    assert space["losses"][-1] < space["losses"][0]
    assert space["expected"][True] > space["expected"][False]
