"""Entry points of the commands: `--help` answers at once, everything else loads LeRobot, which takes seconds."""

from __future__ import annotations

from importlib import import_module

from relmm.commands.arguments import said
from relmm.commands.terminal import lasting, say_loading

SHORT_HELP = {
    "relmm-train": """\
relmm-train: a robot is put into a room and learns to clean it.

  relmm-train --robot.type=locobot_sim --robot.room=no_obstacles
  relmm-train --output_dir=FOLDER --resume=true

  --robot.type=locobot          a real robot, see docs/locobot.md
  --robot.room=NAME             no_obstacles, obstacles, diverse, obstacles_rugs
  --robot.num_objects=N         that lie about
  --robot.realism=none          or mild, harsh: sensors, wheels and light as bad as real ones
  --policy.type=relmm           or relmm_paper: the paper's networks and soft actor-critic; or relmm_single
  --config_path=paper           or paper_small, paper_continuous: relmm_paper with the paper's numbers; or a file
  --policy.path=DIR             or user/repo[@revision]: go on from its weights
  --policy.device=cpu           or cuda, mps
  --curriculum.type=stationary  or autonomous, none
  --steps=2000                  navigation steps
  --seed=0                      of everything random
  --env_eval_freq=500           steps between evaluations in the room; 0 for none
  --eval.n_episodes=3           episodes each time
  --output_dir=FOLDER           new; else outputs/train/DATE/TIME_relmm
  --resume=true                 go on with the run in that folder
  --dataset.repo_id=USER/NAME   name of the dataset that is recorded while learning
  --dataset.init=PATH_OR_REPO   a dataset to learn from first
  --dataset.follow=PATH,PATH    datasets that other processes record, or folders of them, instead of a robot
  --fleet.rooms=N               N simulated rooms at once, a process each, for one learner
  --dataset.push_to_hub=true    upload it
  --policy.push_to_hub=true     upload the checkpoint to --policy.repo_id=USER/NAME
  --hub.every=STEPS             upload while training, too
  --wandb.enable=true           also log to Weights & Biases; --wandb.mode=offline without an account
  --display_data=true           see what the robot sees and believes, in a viewer of rerun
  --display_path=FILE.rrd       in a file for that viewer instead
""",
    "relmm-eval": """\
relmm-eval: how much of a room a policy cleans, with videos.

  relmm-eval --policy.path=outputs/train/DATE/TIME_relmm/checkpoints/last/pretrained_model --env.room=no_obstacles

  --policy.path=DIR             or user/repo[@revision]
  --policy.type=relmm_scripted  or relmm_random: policies without weights
  --policy.sample=true          sampled actions instead of greedy ones (relmm, relmm_paper)
  --env.room=NAME               no_obstacles, obstacles, diverse, obstacles_rugs
  --env.num_objects=N           that lie about
  --env.navigation_steps=250    length of an episode
  --eval.n_episodes=10          of the seeds --seed, --seed + 1, ...
  --eval.n_videos=1             of them filmed
  --seed=1000                   of the first episode
  --display_data=true           see what the robot sees and believes, in a viewer of rerun
  --display_path=FILE.rrd       in a file for that viewer instead
  --output_dir=FOLDER           new; else outputs/eval/DATE/TIME_ROOM_POLICY
""",
    "relmm-record": """\
relmm-record: record a robot's life as a LeRobot dataset.

  relmm-record --robot.type=locobot_sim --robot.room=no_obstacles --policy.type=relmm_scripted \\
      --dataset.repo_id=USER/NAME --dataset.num_episodes=20

  --robot.room=NAME             no_obstacles, obstacles, diverse, obstacles_rugs
  --policy.type=relmm_scripted  or relmm_random
  --policy.path=DIR             or user/repo[@revision]; checkpoints/last of a running training is followed
  --dataset.repo_id=USER/NAME   name of the dataset
  --dataset.root=FOLDER         where it goes; else where LeRobot keeps datasets
  --dataset.num_episodes=N      to record in this run
  --dataset.push_to_hub=true    upload it at the end
  --mode=practice               or clean: an episode is one room that is cleaned into the basket
  --max_steps=250               navigation steps after which an episode is cut off
  --pseudo_reset_steps=20       steps, at most, before and after an object is put down again
  --fleet.server=HOST:PORT      send the episodes to relmm-serve there, and act by its newest weights
  --fleet.token_file=FILE       the fleet's token
  --fleet.certificate=FILE      of the server
  --seed=0                      of everything random
  --resume=true                 go on with the dataset in its folder
  --display_data=true           see what the robot sees and believes, in a viewer of rerun
  --display_path=FILE.rrd       in a file for that viewer instead
""",
    "relmm-serve": """\
relmm-serve: robots on other machines send their episodes here, and get the newest weights of a training.

  relmm-serve --dataset.root=data/fleet --output_dir=outputs/train/fleet \\
      --fleet.token_file=token --fleet.certificate=server.pem --fleet.key=server.key

  --dataset.root=FOLDER         of the robots' datasets; relmm-train --dataset.follow=FOLDER learns from them
  --output_dir=FOLDER           of that relmm-train, whose newest weights the robots get
  --fleet.listen=0.0.0.0:50151  HOST:PORT
  --fleet.token_file=FILE       the token that robots must know
  --fleet.certificate=FILE      of this server, PEM
  --fleet.key=FILE              of the certificate, PEM
""",
    "relmm-analyze": """\
relmm-analyze: what a robot did, where it grasps well, and whether its confidence can be trusted.

  relmm-analyze --dataset.root=outputs/train/first/dataset --output_dir=report
  relmm-analyze --dataset.repo_id=USER/NAME --policy.path=USER/POLICY --output_dir=report

  --dataset.repo_id=USER/NAME   or USER/NAME@REVISION; downloaded if it is not here
  --dataset.root=FOLDER         of the dataset, which may be being recorded
  --policy.path=DIR             or user/repo[@revision]: what does it expect of each attempt?
  --where="success == 0"        of some attempts only, as pandas.DataFrame.query takes it
  --export.root=FOLDER          write these attempts as a dataset
  --compare.dataset.root=FOLDER another dataset beside this one, or --compare.dataset.repo_id
  --compare.policy.path=DIR     another policy beside this one
  --output_dir=FOLDER           new: report.html, summary.json, grasps.parquet, steps.parquet, figures/
  --overwrite=true              replace the report in that folder
""",
    "relmm-calibrate": """\
relmm-calibrate: measure what is particular to one LoCoBot; a person presses Enter.

  relmm-calibrate --robot.type=locobot --robot.id=NAME

  --robot.id=NAME               tells robots apart; say the same to relmm-train
  --robot.base_port=DEVICE      if relmm-doctor --robot.type=locobot does not find it
  --robot.arm_port=DEVICE       likewise
  --steps=[camera,gripper]      only these of camera, gripper, arm, wheels, grasp
""",
    "relmm-upload": """\
relmm-upload: upload the newest checkpoint of a run, and a dataset; what is on the Hub already is not sent again.

  relmm-upload --output_dir=FOLDER --policy.repo_id=USER/NAME --dataset.repo_id=USER/NAME
  relmm-upload --dataset.root=FOLDER --dataset.repo_id=USER/NAME

  --output_dir=FOLDER           of a run of relmm-train, which may be running
  --policy.repo_id=USER/NAME    where the checkpoint goes
  --policy.private=true         a new repository is private
  --dataset.root=FOLDER         the dataset, if it is not that of the run
  --dataset.repo_id=USER/NAME   where it goes
  --dataset.private=true        a new repository is private
  --dataset.license=apache-2.0  for the card
""",
}


def train() -> None:
    """Entry point of `relmm-train`."""
    _start("relmm-train", "train")


def evaluate() -> None:
    """Entry point of `relmm-eval`."""
    _start("relmm-eval", "evaluate")


def record() -> None:
    """Entry point of `relmm-record`."""
    _start("relmm-record", "record")


def analyze() -> None:
    """Entry point of `relmm-analyze`."""
    _start("relmm-analyze", "analyze")


def serve() -> None:
    """Entry point of `relmm-serve`."""
    _start("relmm-serve", "serve")


def upload() -> None:
    """Entry point of `relmm-upload`."""
    _start("relmm-upload", "upload")


def calibrate() -> None:
    """Entry point of `relmm-calibrate`."""
    _start("relmm-calibrate", "calibrate")


def _start(command: str, module: str) -> None:
    if said().asks_for_help:
        with lasting():
            print(f"{SHORT_HELP[command]}\n{command} --help_all lists every option.")
        return
    say_loading(command)
    import_module(f"relmm.commands.{module}").main()
