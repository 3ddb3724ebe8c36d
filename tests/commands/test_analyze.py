"""relmm-analyze as users run it: reports with a policy, selections, comparisons, and its sentences about mistakes."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from relmm.analysis import Collection
from relmm.analysis.comparison import on_common_ground, score_difference
from relmm.commands import analyze as command
from relmm.commands.analyze import (
    AnalyzeConfig,
    AnalyzeDatasetConfig,
    CompareConfig,
    ComparedPolicyConfig,
    ExportConfig,
    learned_episodes,
    told_apart,
)
from relmm.commands.policies import load_config, make_actor
from relmm.errors import ConfigError, DatasetError
from relmm.features import Phase
from relmm.policies.relmm.configuration_relmm import ReLMMConfig

_spec = importlib.util.spec_from_file_location("made", Path(__file__).parents[1] / "analysis" / "made.py")
made = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(made)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Six episodes of ten attempts with a step after each; the first two are practice."""
    episodes = [
        [
            frame
            for i in range(10)
            for frame in (
                made.attempt(
                    20 * episode + i, i % 2 == 0, 0.6, phase=Phase.CURRICULUM if episode < 2 else Phase.LEARNING
                ),
                made.step(),
            )
        ]
        for episode in range(6)
    ]
    return made.write(tmp_path_factory.mktemp("analyze") / "dataset", episodes)


@pytest.fixture(scope="module")
def model(tmp_path_factory, root):
    """A policy that has learned from the first three episodes of that dataset, or says so."""
    folder = tmp_path_factory.mktemp("analyze") / "checkpoints" / "000010"
    make_actor(ReLMMConfig(device="cpu", num_members=2, seed=0)).save_pretrained(folder / "pretrained_model")
    (folder / "training_state").mkdir()
    runs = json.loads((root / "meta/relmm.json").read_text())["runs"]
    state = {"counters": {"episodes": 3}, "random": {}, "runs": runs}
    (folder / "training_state" / "relmm_state.json").write_text(json.dumps(state))
    return folder / "pretrained_model"


def analyze(root, output, **more):
    command.analyze(AnalyzeConfig(output_dir=output, dataset=AnalyzeDatasetConfig(root=root), **more))
    return json.loads((output / "summary.json").read_text())


def test_policy_is_judged_by_what_it_has_not_learned_from(root, model, tmp_path):
    summary = analyze(root, tmp_path / "report", policy=load_config(str(model), ["--device=cpu"]))
    assert summary["policy"]["learned_episodes"] == 3
    assert summary["policy"]["unseen_attempts"] == summary["policy"]["mean"]["attempts"] == 30
    grasps = pd.read_parquet(tmp_path / "report" / "grasps.parquet")
    assert grasps["learned_from"].tolist() == (grasps["episode"] < 3).tolist()
    unseen = grasps[grasps["episode"] >= 3]
    assert summary["policy"]["mean"]["mean_prediction"] == pytest.approx(unseen["policy_mean"].mean())
    assert {"policy", "samples"} <= {path.stem for path in (tmp_path / "report" / "figures").glob("*.png")}
    assert "What does the policy expect now?" in (tmp_path / "report" / "report.html").read_text()


def test_cursor_counts_for_its_own_dataset_only(root, model, tmp_path):
    assert learned_episodes(model, root) == 3
    other = made.write(tmp_path / "other", [[made.step(), made.step()]], {"camera": "paper", "seed": 4})
    assert learned_episodes(model, other) == 0
    assert learned_episodes(tmp_path / "checkpoints" / "1" / "pretrained_model", root) is None


def test_selection_becomes_a_dataset_that_lerobot_opens(root, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    kept = tmp_path / "kept"
    config = {"where": "success == 0 and phase == 'learning'", "export": ExportConfig(root=kept, repo_id="me/kept")}
    summary = analyze(root, tmp_path / "report", **config)
    assert summary["dataset"]["attempts"] == 20
    assert summary["success"]["overall"]["successes"] == 0
    dataset = LeRobotDataset("me/kept", root=kept)
    source = LeRobotDataset("tester/planted", root=root)
    assert (len(dataset), dataset.num_episodes) == (20, 4)
    chosen = pd.read_parquet(tmp_path / "report" / "grasps.parquet").query(config["where"])["index"].tolist()
    for number in (0, 7, 19):
        item, original = dataset[number], source[chosen[number]]
        assert (item["observation.images.front"] == original["observation.images.front"]).all()
        for key in ("action", "next.reward", "complementary_info.robot_time", "complementary_info.odom_x"):
            assert (item[key] == original[key]).all(), key


def test_whole_episodes(root, tmp_path):
    config = {"where": "episode == 2", "export": ExportConfig(root=tmp_path / "kept", whole_episodes=True)}
    analyze(root, tmp_path / "report", **config)
    again = analyze(tmp_path / "kept", tmp_path / "again")
    assert (again["dataset"]["frames"], again["dataset"]["attempts"]) == (20, 10)


def test_two_datasets_and_two_policies_side_by_side(root, model, tmp_path):
    frames = [made.attempt(i, True, 0.6) for i in range(40)]
    other = made.write(tmp_path / "other", [[*frames, made.step()]])
    compare = CompareConfig(dataset=AnalyzeDatasetConfig(root=other), policy=ComparedPolicyConfig(path=str(model)))
    summary = analyze(root, tmp_path / "report", compare=compare)
    both = summary["comparison"]
    assert [row["attempts"] for row in both["rows"]] == [60, 40]
    assert both["success"]["difference"] == pytest.approx(0.5)
    assert "Side by side" in (tmp_path / "report" / "report.html").read_text()


def test_two_policies_are_judged_by_the_attempts_that_neither_has_learned_from(made_collections):
    """One says 0.5 of everything; the other 0.9 where it succeeds and 0.2 where it fails, of which it learned half."""
    here, there = on_common_ground(*made_collections)
    assert here.grasps["index"].tolist() == there.grasps["index"].tolist() == list(range(50, 90))
    score = score_difference(here, there)
    gains = np.where(here.grasps["success"], 0.1**2, 0.2**2) - 0.25
    assert score["attempts"] == 40
    assert score["difference"] == pytest.approx(gains.mean())
    half = 1.959964 * gains.std(ddof=1) / 40**0.5
    assert (score["low"], score["high"]) == pytest.approx((gains.mean() - half, gains.mean() + half))


@pytest.fixture
def made_collections():
    rng = np.random.default_rng(0)
    rows = pd.DataFrame({"index": np.arange(100), "success": rng.random(100) < 0.4})
    here = rows.iloc[:90].assign(policy_mean=0.5, learned_from=pd.Series(rows["index"] < 20).astype("boolean"))
    there = rows.assign(policy_mean=np.where(rows["success"], 0.9, 0.2), learned_from=rows["index"] < 50)
    return [Collection(Path("made"), rows, grasps, [], []) for grasps in (here, there)]


def test_a_comparison_of_policies_says_nothing_of_success(root, model, tmp_path):
    compare = CompareConfig(policy=ComparedPolicyConfig(path=str(model)))
    both = analyze(root, tmp_path / "report", compare=compare)["comparison"]
    assert both["success"] is None
    assert [row["attempts"] for row in both["rows"]] == [30, 30]  # of episodes 3 to 5
    assert both["score"]["attempts"] == 30


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"where": "sucess == 0"}, "the columns are"),
        ({"where": "1 +"}, "cannot be understood"),
        ({"where": "episode + 1"}, "does not say of each attempt"),
        ({"where": "episode > 99", "export": ExportConfig(root=Path("never"))}, "nothing to export"),
    ],
)
def test_bad_selections(root, tmp_path, more, words):
    with pytest.raises(ConfigError, match=words):
        analyze(root, tmp_path / "report", **more)
    assert not Path("never").exists()


def test_nothing_is_overwritten(root, tmp_path):
    (tmp_path / "report").mkdir()
    with pytest.raises(ConfigError, match="exists already"):
        analyze(root, tmp_path / "report")
    with pytest.raises(ConfigError, match="exists already"):
        analyze(root, tmp_path / "new", export=ExportConfig(root=tmp_path))
    with pytest.raises(DatasetError):
        analyze(tmp_path / "missing", tmp_path / "new")


def test_mistakes_end_in_a_sentence(run):
    for arguments, words in [([], "Say which dataset"), (["--dataset.root=x"], "Say where the report goes")]:
        done = run("relmm-analyze", *arguments)
        assert done.returncode == 2
        assert words in done.stderr
        assert "Traceback" not in done.stderr


def test_what_is_compared_has_short_names_that_tell_it_apart(model, tmp_path):
    """A dataset that relmm-train has put into its run's folder is called after the run."""
    assert AnalyzeDatasetConfig(root=tmp_path / "first" / "dataset").name == "local/first"
    assert AnalyzeDatasetConfig(root=tmp_path / "room").name == "local/room"
    checkpoint = f"{model.parents[2].name} at step 10"
    assert told_apart(("local/first", str(model)), ("local/second", str(model))) == ["local/first", "local/second"]
    assert told_apart(("local/first", None), ("local/first", str(model))) == ["as recorded", checkpoint]
    both = told_apart(("local/first", "me/cleaner@main"), ("local/second", str(model)))
    assert both == ["local/first, me/cleaner@main", f"local/second, {checkpoint}"]
