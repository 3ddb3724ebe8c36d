"""Pictures for people: the robot's own view beside the room from above, and videos of them."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from relmm.sim.body import SimBody
from relmm.sim.renderer import Renderer, overview_camera

_ROOM_SIZE = (640, 480)  # pixels
_VIEW = 240  # pixels, side of the robot's own view, and of a picture below it, beside the room
SIZE = (_ROOM_SIZE[0] + _VIEW, _ROOM_SIZE[1])
_LIGHT, _DARK = (235, 235, 235), (24, 24, 24)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Scene:
    """Looks at a simulated robot through a third-person camera.

    Args:
        body: what to look at.
    """

    def __init__(self, body: SimBody) -> None:
        self._body = body
        self._renderer = Renderer(body.model, overview_camera(body.room.size), _ROOM_SIZE)

    def picture(self, caption: str = "", inset: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """The robot's view and the room now, uint8 (480, 880, 3).

        Args:
            caption: lines of text over the room.
            inset: a square picture of what the robot remembers, any size, under its view.
        """
        panel = np.full((SIZE[1], _VIEW, 3), _DARK, np.uint8)
        panel[:_VIEW] = cv2.resize(self._body.capture()[0], (_VIEW, _VIEW), interpolation=cv2.INTER_NEAREST)
        _write(panel, "what it sees", (8, 18))
        if inset is not None:
            panel[_VIEW:] = cv2.resize(inset, (_VIEW, _VIEW), interpolation=cv2.INTER_AREA)
            _write(panel, "what it remembers", (8, _VIEW + 18))
        room = np.ascontiguousarray(self._renderer.render(self._body.data)[0])
        for row, line in enumerate(caption.split("\n")):
            _write(room, line, (10, 24 + 24 * row))
        return np.hstack([panel, room])

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def _write(picture: NDArray[np.uint8], text: str, place: tuple[int, int]) -> None:
    """Light text with a dark edge, which can be read on anything."""
    for color, thickness in ((_DARK, 3), (_LIGHT, 1)):
        cv2.putText(picture, text, place, _FONT, 0.5, color, thickness, cv2.LINE_AA)


def beside(films: Mapping[str, Path], path: Path) -> None:
    """Put two films of equal height beside each other; the shorter one stands still at its end.

    Args:
        films: mp4 files, from left to right, by their titles.
        path: of the new one.
    """
    import av

    first, second = films.values()
    with av.open(str(first)) as left, av.open(str(second)) as right, av.open(str(path), mode="w") as output:
        rate = left.streams.video[0].average_rate
        stream = output.add_stream("libx264", rate=rate, options={"crf": "23"})
        widths = [film.streams.video[0].width for film in (left, right)]
        titles = np.hstack([_title(title, width) for title, width in zip(films, widths, strict=True)])
        stream.width, stream.height = sum(widths), len(titles) + left.streams.video[0].height
        stream.pix_fmt = "yuv420p"
        shown: list[Any] = [None, None]
        for pair in zip_longest(left.decode(video=0), right.decode(video=0)):
            shown = [
                old if new is None else new.to_ndarray(format="rgb24") for new, old in zip(pair, shown, strict=True)
            ]
            picture = np.vstack([titles, np.hstack(shown)])
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        output.mux(stream.encode())


def _title(text: str, width: int) -> NDArray[np.uint8]:
    """A strip to put above a film, uint8 (32, width, 3)."""
    strip = np.full((32, width, 3), 24, np.uint8)
    cv2.putText(strip, text, (10, 22), _FONT, 0.6, (235, 235, 235), 1, cv2.LINE_AA)
    return strip


class Film:
    """An mp4 of a simulated robot's life, arm motions included.

    Args:
        body: what to film.
        path: of the mp4.
        period: simulated seconds between pictures.
        fps: pictures per second when it is played; 1 / (period * fps) is slow motion, its inverse time lapse.

    Attributes:
        caption, inset: what the next pictures show beside the room; see `Scene.picture`.
    """

    def __init__(self, body: SimBody, path: Path, period: float = 0.2, fps: int = 20) -> None:
        import av

        self._body, self._period = body, period
        self._scene = Scene(body)
        self._next = 0.0
        self.caption = ""
        self.inset: NDArray[np.uint8] | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), mode="w")
        self._stream = self._container.add_stream("libx264", rate=Fraction(fps), options={"crf": "23"})
        self._stream.width, self._stream.height, self._stream.pix_fmt = *SIZE, "yuv420p"

    def _watch(self) -> None:
        if self._body.data.time >= self._next:
            self._next += self._period
            self._encode(self._scene.picture(self.caption, self.inset))

    def _encode(self, picture: NDArray[np.uint8]) -> None:
        import av

        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def __enter__(self) -> Self:
        self._next = self._body.data.time
        self._body.watcher = self._watch
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._body.watcher = None
        self._encode(self._scene.picture(self.caption, self.inset))  # how it ended
        self._container.mux(self._stream.encode())
        self._container.close()
        self._scene.close()
