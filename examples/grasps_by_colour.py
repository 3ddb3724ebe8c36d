"""How well a robot grasps things of each colour: python examples/grasps_by_colour.py DATASET."""

import sys

import relmm

grasps = relmm.load_grasps(sys.argv[1])
print(grasps.groupby("colour")["success"].agg(["count", "mean"]).sort_values("count", ascending=False))
