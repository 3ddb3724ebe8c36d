"""Pictures of a dataset on one sheet: what the robot saw when it drove, grasped, and put things down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from relmm.episodes.follow import Episode, read_episodes
from relmm.features import ACTION_NAMES, Phase, Skill

_SKILL = ACTION_NAMES.index("skill.pos")
_COLUMNS = 6
_SCALE = 2
_CAPTION_HEIGHT = 20  # pixels
_MARGIN = 6
_EPISODES = 60  # spread over the dataset, and enough to choose from

_Mask = Callable[[Episode], NDArray[np.bool_]]
_ROWS: dict[str, _Mask] = {
    "drives": lambda e: (_skills(e) == Skill.NAVIGATE) & (e.phases != Phase.PSEUDO_RESET),
    "picks up": lambda e: (_skills(e) == Skill.GRASP) & (e.rewards > 0),
    "misses": lambda e: (_skills(e) == Skill.GRASP) & (e.rewards == 0),
    "pseudo-reset": lambda e: e.phases == Phase.PSEUDO_RESET,
}


def draw_contact_sheet(root: Path, picture: Path, episodes: int) -> bool:
    """Draw a row of pictures for each kind of frame that the dataset has.

    Args:
        root: a dataset that relmm can train on.
        picture: PNG to write.
        episodes: of the dataset.

    Returns:
        Whether there was anything to draw.

    Raises:
        DatasetError: the dataset is damaged.
    """
    chosen = _choose(root, episodes)
    if not any(chosen.values()):
        return False
    _draw({name: cells for name, cells in chosen.items() if cells}).save(picture)
    return True


def _skills(episode: Episode) -> NDArray[np.float32]:
    skills: NDArray[np.float32] = episode.actions[:, _SKILL].round()
    return skills


def _choose(root: Path, episodes: int) -> dict[str, list[tuple[str, NDArray[np.uint8]]]]:
    """At most `_COLUMNS` captioned pictures for each row, from as many episodes as possible."""
    step = max(1, episodes // _EPISODES)
    found: dict[str, list[tuple[str, NDArray[np.uint8]]]] = {name: [] for name in _ROWS}
    for episode in read_episodes(root):
        if episode.index % step:
            continue
        for name, mask in _ROWS.items():
            frames = np.flatnonzero(mask(episode))
            if len(frames):
                frame = int(frames[len(frames) // 2])
                found[name].append((f"{name} {episode.index}:{frame}", episode.images[frame]))
    return {name: _spread(cells) for name, cells in found.items()}


def _spread(cells: list[Any]) -> list[Any]:
    if len(cells) <= _COLUMNS:
        return cells
    return [cells[round(i)] for i in np.linspace(0, len(cells) - 1, _COLUMNS)]


def _draw(rows: dict[str, list[tuple[str, NDArray[np.uint8]]]]) -> Any:
    from PIL import Image, ImageDraw, ImageFont

    side = _SCALE * next(iter(rows.values()))[0][1].shape[0]
    width = max(len(cells) for cells in rows.values()) * (side + _MARGIN) + _MARGIN
    sheet = Image.new("RGB", (width, len(rows) * (side + _CAPTION_HEIGHT + _MARGIN) + _MARGIN), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for row, cells in enumerate(rows.values()):
        top = _MARGIN + row * (side + _CAPTION_HEIGHT + _MARGIN)
        for column, (caption, pixels) in enumerate(cells):
            left = _MARGIN + column * (side + _MARGIN)
            sheet.paste(Image.fromarray(pixels).resize((side, side), Image.Resampling.NEAREST), (left, top))
            draw.text((left, top + side + 2), caption, fill="black", font=font)
    return sheet
