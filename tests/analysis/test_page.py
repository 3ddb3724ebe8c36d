"""The page of a run that goes on."""

import subprocess
import sys

import pytest

from relmm.analysis.page import write_page
from relmm.errors import DatasetError


def test_the_page_is_replaced_and_nothing_else_is_left(made, tmp_path):
    attempts = [made.attempt(112, success, 0.5) for success in (True, False, False)]
    root, page = made.write(tmp_path / "dataset", [attempts]), tmp_path / "run" / "report.html"
    page.parent.mkdir()
    page.write_text("the last one")
    write_page(root, "me/life", page)
    assert "1 of 3 attempts picked something up" in page.read_text()
    assert list(page.parent.iterdir()) == [page]


def test_what_cannot_be_read_leaves_the_last_page(tmp_path):
    page = tmp_path / "report.html"
    page.write_text("the last one")
    with pytest.raises(DatasetError):
        write_page(tmp_path / "nowhere", "me/life", page)
    assert page.read_text() == "the last one"
    assert list(tmp_path.iterdir()) == [page]


@pytest.mark.slow
def test_it_costs_no_import_of_torch_or_lerobot():
    code = "import sys, relmm.analysis.page; print(sorted({'torch', 'lerobot', 'datasets'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
