"""`report.html` of a run: in the background, seldom enough, and never in the way."""

import subprocess
import time
from pathlib import Path

import pytest

from relmm.commands import training_report
from relmm.commands.training_report import TrainingReport

SAMPLE = Path(__file__).parents[2] / "datasets" / "first_attempts"


class Process:
    """Of a report that has not ended yet."""

    returncode = None

    def __init__(self, *_, **__):
        Process.begun.append(self)

    def poll(self):
        return self.returncode


@pytest.fixture
def clock(monkeypatch):
    """Seconds, to be set; processes are only noted."""
    now = [0.0]
    Process.begun = []
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(subprocess, "Popen", Process)
    return now


def test_a_new_one_begins_after_twenty_times_as_long_as_the_last_one_took(clock, tmp_path):
    report = TrainingReport(tmp_path, "me/life", tmp_path / "report.html")
    for clock[0] in (0.0, 4.0, 8.0):
        report.refresh()
    assert len(Process.begun) == 1  # it is still being made
    clock[0], Process.begun[0].returncode = 10.0, 0
    report.check()
    for clock[0] in (11.0, 209.0):
        report.refresh()
    assert len(Process.begun) == 1
    clock[0] = 211.0
    report.refresh()
    assert len(Process.begun) == 2


def test_one_that_fails_is_a_sentence(tmp_path, capsys):
    report = TrainingReport(tmp_path / "nowhere", "me/life", tmp_path / "report.html")
    report.finish()
    said = capsys.readouterr().out
    assert said.startswith("report: ")
    assert said.endswith(f"relmm-analyze --dataset.root={tmp_path / 'nowhere'} tries again.\n")
    assert "nowhere" in said


def test_whatever_a_report_meets_the_run_has_ended_well(tmp_path, capsys, monkeypatch):
    for error in (ZeroDivisionError("division by zero"), KeyboardInterrupt()):
        monkeypatch.setattr(training_report, "write_page", lambda *_, error=error: (_ for _ in ()).throw(error))
        TrainingReport(tmp_path, "me/life", tmp_path / "report.html").finish()
    assert "division by zero. The run is none the worse" in capsys.readouterr().out


@pytest.mark.slow
def test_the_background_makes_the_page_and_says_what_failed(tmp_path):
    said, page = [], tmp_path / "report.html"
    for root in (SAMPLE, tmp_path / "nowhere"):
        report = TrainingReport(root, "me/life", page, said.append)
        report.refresh()
        deadline = time.monotonic() + 300
        while report._making is not None:
            assert time.monotonic() < deadline
            time.sleep(0.2)
            report.check()
        assert page.exists()
    (sentence,) = said
    assert "nowhere" in sentence
