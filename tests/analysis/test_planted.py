"""The report finds what was planted."""

import json
import math
from itertools import pairwise

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from relmm.analysis import collect, summarize_collection, write_report
from relmm.features import Phase

GOOD, BAD, COPIED, DRY, WRONG = 112, 0, 3, 5, 8  # cells, and episodes with something planted
RED, GREY = (200, 20, 20), (120, 120, 120)


@pytest.fixture(scope="module")
def planted(made, tmp_path_factory):
    """Cell 112 works in 8 of 10, cell 0 in 1 of 10; P[grasp] always says 0.9; red things work better than grey ones."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(12):
        good = [made.attempt(GOOD, i < 8, 0.9, colour=RED, mean=0.8, std=0.1) for i in range(10)]
        bad = [made.attempt(BAD, i < 1, 0.9, colour=GREY, mean=0.1, std=0.3) for i in range(10)]
        mixed = [frame for i in rng.permutation(10) for frame in (good[i], made.step(), bad[i], made.step())]
        episodes.append(mixed)
    for i, frame in enumerate(episodes[COPIED]):
        frame["seed"] = 100 + i
    episodes[DRY] = [made.attempt(GOOD, False, 0.9, mean=0.8, std=0.1) for _ in range(40)]
    episodes[WRONG] = [made.attempt(GOOD, False, 0.9, judged=True, mean=0.8, std=0.1), *episodes[WRONG]]
    episodes[9] = [made.step(phase=Phase.PSEUDO_RESET, seconds=2.5), made.step(), made.step()]
    root = made.write(tmp_path_factory.mktemp("planted") / "dataset", episodes)
    return root, episodes


@pytest.fixture(scope="module")
def report(planted, tmp_path_factory):
    root, _ = planted
    output = tmp_path_factory.mktemp("planted") / "report"
    collection = collect(root, output)
    summary = summarize_collection(collection, "tester/planted")
    write_report(output, collection, {**summary, "where": None, "policy_path": None, "comparison": None})
    return output, collection, summary


def judged(episodes):
    """Cell and judged outcome of all attempts."""
    grasps = [frame for episode in episodes for frame in episode if "cell" in frame]
    return [(frame["cell"], frame.get("judged", frame["success"])) for frame in grasps]


def test_cells_have_their_attempts_and_successes(planted, report):
    _, episodes = planted
    outcomes, grid = judged(episodes), report[2]["cells"]
    for cell in (GOOD, BAD):
        of_cell = [success for where, success in outcomes if where == cell]
        assert (grid["attempts"][cell], grid["successes"][cell]) == (len(of_cell), sum(of_cell))
    assert grid["share"][1] is None
    assert sum(grid["attempts"]) == len(outcomes)
    assert report[2]["parts"]["best"]["part"] == "middle centre"
    assert report[2]["parts"]["worst"]["part"] == "near right"


def test_success_and_objects_an_hour(planted, report):
    _, episodes = planted
    successes = sum(success for _, success in judged(episodes))
    seconds = sum(f.get("seconds", 4.0 if "cell" in f else 0.5) for episode in episodes for f in episode)
    seconds -= 4.0 if "cell" in episodes[-1][-1] else 0.5  # nobody knows how long the last frame took
    numbers = report[2]["success"]
    assert numbers["overall"]["successes"] == successes
    assert numbers["robot_hours"] == pytest.approx(seconds / 3600, rel=1e-4)
    assert numbers["objects_per_hour"]["rate"] == pytest.approx(successes / (seconds / 3600), rel=1e-4)


def test_overconfidence_is_found_and_measured(planted, report):
    outcomes = [success for _, success in judged(planted[1])]
    numbers = report[2]["calibration"]
    assert numbers["p_grasp"]["verdict"] == "overconfident"
    assert numbers["p_grasp"]["bias"] == pytest.approx(0.9 - np.mean(outcomes), abs=1e-6)
    assert numbers["p_grasp"]["brier"]["score"] == pytest.approx(np.mean((0.9 - np.array(outcomes)) ** 2), abs=1e-6)
    assert numbers["mean"]["brier"]["resolution"] > 0.05


def test_most_surprising_attempts_are_failures_that_were_expected_to_work(report):
    rows = report[2]["surprises"]["attempts"]
    assert len(rows) == 20
    assert rows[0]["bits"] == pytest.approx(-math.log2(0.1), abs=1e-4)  # a success at 0.1
    assert all(row["bits"] >= after["bits"] for row, after in pairwise(rows))


def test_time_is_shared_out(report):
    time = report[2]["time"]
    assert time["turning_away"] == pytest.approx(2.0, abs=1e-3)
    known = report[1].frames
    assert time["grasping"] == pytest.approx(4.0 * (known["follows"] & (known["skill"] == "grasp")).sum(), rel=1e-4)


def test_dry_stretch_and_wrong_judgement_are_found(report):
    found = {finding["kind"]: finding for finding in report[2]["findings"]}
    assert found["no_success"]["attempts"] >= 40
    assert found["no_success"]["first_episode"] <= DRY <= found["no_success"]["last_episode"]
    assert found["wrong_judgements"]["attempts"] == [{"episode": WRONG, "frame": 0, "success": True}]
    assert "duplicates" not in found


def test_colours_are_told_apart(report):
    colours = {row["name"]: row for row in report[2]["groups"]["colour"]}
    assert colours["red"]["share"] > 0.7 > 0.2 > colours["grey"]["share"]


def test_files_hold_what_the_report_says(report):
    output, _, summary = report
    grasps, steps = (pd.read_parquet(output / name) for name in ("grasps.parquet", "steps.parquet"))
    assert len(grasps) == summary["dataset"]["attempts"]
    assert len(grasps) + len(steps) == summary["dataset"]["frames"]
    assert grasps["picture"].str[:4].eq(b"\x89PNG").all()
    assert json.loads((output / "summary.json").read_text())["success"]["overall"] == summary["success"]["overall"]
    page = (output / "report.html").read_text()
    assert "wrong" in page
    assert "NaN" not in page
    for name in ("success", "cells", "calibration", "time", "track", "next"):
        assert (output / "figures" / f"{name}.png").stat().st_size > 1000
    assert "http" not in page.replace("http://www.w3.org", "")  # it needs no network
    assert pq.ParquetFile(output / "grasps.parquet").metadata.num_rows == len(grasps)


def test_copied_episode_is_found(made, planted, tmp_path):
    episodes = [[{**frame, "seed": i} for i, frame in enumerate(planted[1][COPIED])] for _ in range(2)]
    root = made.write(tmp_path / "dataset", [planted[1][0], *episodes])
    summary = summarize_collection(collect(root, tmp_path / "report"), "tester/planted")
    (found,) = [finding for finding in summary["findings"] if finding["kind"] == "duplicates"]
    assert found["episodes"] == [2]
    assert "[2]" in found["command"]
