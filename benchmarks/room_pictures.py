"""Draws docs/rooms.png: every room from above, and through the robot's camera.

python benchmarks/room_pictures.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.geometry import camera_geometry
from relmm.sim.body import SimBody
from relmm.sim.renderer import Renderer, overview_camera
from relmm.sim.rooms import make_room, room_names

WIDTH, HEIGHT = 480, 360  # pixels
VIEW = 300  # pixels, side of the robot's view, three times its size
CAPTION = 28  # pixels


def picture(name: str, seed: int) -> NDArray[np.uint8]:
    """One room: its name, itself from above, and the robot's view."""
    body = SimBody(make_room(name), camera_geometry("paper"))
    body.reset(np.random.default_rng(seed))
    overview = Renderer(body.model, overview_camera(body.room.size), (WIDTH, HEIGHT))
    above, _ = overview.render(body.data)
    view = cv2.resize(body.capture()[0], (VIEW, VIEW), interpolation=cv2.INTER_NEAREST)
    overview.close()
    body.close()
    side = (WIDTH - VIEW) // 2
    view = cv2.copyMakeBorder(view, 10, 0, side, side, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    caption = np.full((CAPTION, WIDTH, 3), 255, np.uint8)
    cv2.putText(caption, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (30, 30, 30), 1, cv2.LINE_AA)
    return np.vstack([caption, above, view])


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--output", type=Path, default=Path("docs/rooms.png"))
    arguments = parser.parse_args()
    columns = [picture(name, arguments.seed) for name in room_names()]
    cv2.imwrite(str(arguments.output), np.hstack(columns)[..., ::-1])
    print(arguments.output)


if __name__ == "__main__":
    main()
