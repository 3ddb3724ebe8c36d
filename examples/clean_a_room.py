"""A trained policy cleans a simulated room: python examples/clean_a_room.py CHECKPOINT [DECISIONS]."""

import sys

import relmm

policy = relmm.load_policy(sys.argv[1])
with relmm.make_robot(room="no_obstacles") as robot:
    for _ in range(int(sys.argv[2]) if len(sys.argv) > 2 else 100):
        action = robot.send_action(policy.act(robot.get_observation()))
        print(policy.describe(action))
