"""An evaluation while training: it can be stopped between two steps."""

import av

from relmm.commands.policies import make_actor
from relmm.commands.train_config import TrainEvalConfig
from relmm.commands.train_evaluation import RoomEvaluation
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.sim.config_locobot_sim import LocobotSimConfig


def test_a_stopped_evaluation_has_no_scores_and_a_whole_film(tmp_path):
    actor = make_actor(ReLMMConfig(device="cpu", seed=0))
    actor.policy.sampling = True
    shown = []
    evaluation = RoomEvaluation(
        LocobotSimConfig(),
        actor,
        TrainEvalConfig(n_episodes=2, n_videos=1),
        tmp_path,
        should_stop=lambda: len(shown) == 3,
        show=shown.append,
    )
    assert evaluation(7) == {}
    assert len(shown) == 3
    assert shown[-1] <= 3 / 500, "the share of both episodes"
    assert actor.policy.sampling, "training goes on as before"
    with av.open(str(tmp_path / "videos_step_000007" / "eval_episode_0.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) > 1
