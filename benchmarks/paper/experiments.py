"""Every table and figure of the paper as commands of relmm: what is trained, with which seeds, and how long it takes.

Hours are estimates for one core from the measured times below; nothing of the preset `paper` is among them, of which a
step takes 18 s there.
"""

from __future__ import annotations

from dataclasses import dataclass

ROOMS = ("no_obstacles", "obstacles", "diverse", "obstacles_rugs")
EVALUATION = "--eval.n_episodes=10 --eval.seed=0"
PAPER_STEPS, DEFAULT_STEPS = 30_000, 500
# s of one core, measured: an update and what the room takes. Of `relmm_paper` those of the preset paper_small.
STEP_S = {"paper": 0.77, "relmm": 0.4, "single": 0.68}
ATTEMPT_S = {"paper": 0.35, "relmm": 0.35, "single": 0.68}
PRESET = {"paper": "--config_path=paper_small", "relmm": "", "single": "--policy.type=relmm_single"}


@dataclass(frozen=True)
class Experiment:
    """One line of a table, or one curve of a figure.

    Attributes:
        name: of the runs; those before the first slash belong into one figure.
        policy: `paper`, `relmm` or `single`.
        options: of `relmm-train`, beside room and length.
        room: where it learns.
        steps: navigation steps.
        attempts: that practice takes.
        evaluations: between the first step and the last.
        seeds: of the training.
    """

    name: str
    policy: str
    options: str = ""
    room: str = "no_obstacles"
    steps: int = PAPER_STEPS
    attempts: int = 2000
    evaluations: int = 6
    seeds: tuple[int, ...] = (0, 1, 2)

    @property
    def train(self) -> str:
        """Arguments of `relmm-train`."""
        every = max(self.steps // self.evaluations, 1)
        fixed = f"--robot.type=locobot_sim --robot.room={self.room} --steps={self.steps} --env_eval_freq={every}"
        return " ".join(part for part in (PRESET[self.policy], fixed, EVALUATION, self.options) if part)

    @property
    def hours(self) -> float:
        """Estimated, a seed, on one core."""
        return (self.steps * STEP_S[self.policy] + self.attempts * ATTEMPT_S[self.policy]) / 3600


def paper(name: str, options: str = "", **settings: object) -> Experiment:
    """With the paper's policy, its small preset, and a room that is tidied as its simulator tidies it."""
    tidy = "--robot.tidy_every=1000"
    return Experiment(name, "paper", f"{tidy} {options}".strip(), **settings)  # type: ignore[arg-type]


def default(name: str, options: str = "", **settings: object) -> Experiment:
    """The same with relmm's default policy, which needs a hundredth of the steps."""
    return Experiment(name, "relmm", options, **{"steps": DEFAULT_STEPS, "attempts": 100, **settings})  # type: ignore[arg-type]


def autonomous(start: int, stop: int, most: int) -> str:
    """Options of the autonomous curriculum."""
    numbers = f"--policy.num_start={start} --policy.num_stop={stop} --policy.num_max={most}"
    return f"--curriculum.type=autonomous {numbers}"


# --- Table 1 -------------------------------------------------------------------------------------------------
LENGTH = [paper(f"length/{room}", room=room) for room in ROOMS]
DEFAULT_LENGTH = [default(f"default_length/{room}", room=room) for room in ROOMS]
RAND_NAV = [
    paper(f"rand_nav/{room}", "--policy.navigation=random", room=room, steps=1, evaluations=1) for room in ROOMS
]
# --- Figure "ablation", left ---------------------------------------------------------------------------------
N_ST = [
    paper(
        f"n_st/{count}{'_relabel' * relabel}",
        f"--policy.num_stationary={count}" + " --policy.relabel=true" * relabel,
        attempts=count,
    )
    for count in (500, 1000, 2000)
    for relabel in (False, True)
]
DEFAULT_N_ST = [
    default(f"default_n_st/{count}", f"--policy.num_stationary={count}", attempts=count, steps=1, evaluations=1)
    for count in (25, 50, 100, 200, 400)
]
# --- Figure "ablation", centre -------------------------------------------------------------------------------
AUTONOMOUS = [
    paper(f"autonomous/{'_'.join(map(str, each))}", autonomous(*each) + " --policy.relabel=true", attempts=each[2])
    for each in ((10, 50, 2000), (10, 100, 2000), (10, 50, 1000), (5, 50, 2000), (20, 50, 2000))
]
DEFAULT_AUTONOMOUS = [
    default(f"default_autonomous/{'_'.join(map(str, each))}", autonomous(*each), attempts=200, steps=300, evaluations=3)
    for each in ((2, 20, 400), (1, 20, 400), (4, 20, 400), (2, 10, 400), (2, 40, 400), (2, 20, 200), (2, 20, 800))
]
# --- Figure "ablation", right --------------------------------------------------------------------------------
ABLATION = [
    paper("ablation/frozen", "--policy.freeze_grasping=true"),
    paper("ablation/no_uncertainty", "--policy.std_weight=0 --policy.gate_std_weight=0"),
    Experiment(
        "ablation/single",
        "single",
        "--policy.encoder=paper_small --policy.batch_size=64 --curriculum.type=none --robot.tidy_every=1000",
        steps=10_000,
        attempts=10_000,
    ),
    paper("ablation/novelty_resets", "--policy.perturbation=novelty"),
    paper("ablation/scaled_pixels", "--policy.grasp_input_gain=1"),
]
DEFAULT_ABLATION = [
    default("default_ablation/frozen", "--policy.freeze_grasping=true"),
    default("default_ablation/no_uncertainty", "--policy.std_weight=0"),
]
# --- Curricula and relabelling in other rooms ----------------------------------------------------------------
CURRICULA = [
    paper("curricula/obstacles_autonomous", autonomous(10, 50, 2000) + " --policy.relabel=true", room="obstacles"),
    paper("curricula/diverse_relabel", "--policy.relabel=true", room="diverse"),
    default("default_curricula/obstacles_autonomous", "--curriculum.type=autonomous", room="obstacles"),
]
# --- Appendix: discrete and continuous grasps ----------------------------------------------------------------
CONTINUOUS_SETTINGS = (
    "--policy.grasping=continuous --policy.num_members=2 --policy.grasp_learning_rate=1e-4 "
    "--policy.grasp_batch_size=256 --policy.min_attempts_to_update=1000"
)
CONTINUOUS = [
    paper(
        f"grasps/{kind}_{count}",
        f"{options} --policy.num_stationary={count}".strip(),
        steps=1,
        evaluations=1,
        attempts=count,
    )
    for kind, options in (("discrete", ""), ("continuous", CONTINUOUS_SETTINGS))
    for count in (1000, 2000, 4000, 8000)
]

EXPERIMENTS = {
    each.name: each
    for group in (
        LENGTH, DEFAULT_LENGTH, RAND_NAV, N_ST, DEFAULT_N_ST, AUTONOMOUS, DEFAULT_AUTONOMOUS, ABLATION,
        DEFAULT_ABLATION, CURRICULA, CONTINUOUS,
    )
    for each in group
}  # fmt: skip
