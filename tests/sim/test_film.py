import av
import numpy as np

from relmm.geometry import camera_geometry
from relmm.sim.body import SimBody
from relmm.sim.film import SIZE, Scene, beside
from relmm.sim.rooms import make_room


def write(path, grey: int, pictures: int) -> None:
    with av.open(str(path), mode="w") as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(pictures):
            picture = np.full((48, 64, 3), grey, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def test_films_side_by_side_last_as_long_as_the_longer(tmp_path):
    write(tmp_path / "dark.mp4", 30, 5)
    write(tmp_path / "light.mp4", 200, 9)
    beside({"I": tmp_path / "dark.mp4", "": tmp_path / "light.mp4"}, tmp_path / "both.mp4")
    with av.open(str(tmp_path / "both.mp4")) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == 9
    for picture in pictures:
        strip, picture = np.vsplit(picture, [len(picture) - 48])
        assert abs(picture[:, :60].mean() - 30) < 10
        assert abs(picture[:, 68:].mean() - 200) < 10
        assert strip[:, :60].max() > 150, "its title"
        assert strip[:, 68:].max() < 60, "has none"


def test_scene_shows_the_inset():
    body = SimBody(make_room("no_obstacles", num_objects=2), camera_geometry("paper"))
    body.reset(np.random.default_rng(0))
    scene = Scene(body)
    inset = np.zeros((3, 3, 3), np.uint8)
    inset[..., 0] = 255
    with_inset, without = scene.picture("two\nlines", inset), scene.picture("two\nlines")
    scene.close()
    body.close()
    assert with_inset.shape == (SIZE[1], SIZE[0], 3)
    changed = (with_inset != without).any(axis=-1)
    assert not changed[:240].any(), "the robot's view"
    assert not changed[:, 240:].any(), "the room"
    assert (with_inset[270:, :240] == (255, 0, 0)).all()


def test_scene_shows_the_caption_over_the_room():
    body = SimBody(make_room("no_obstacles", num_objects=2), camera_geometry("paper"))
    body.reset(np.random.default_rng(0))
    scene = Scene(body)
    changed = (scene.picture("two\nlines") != scene.picture("")).any(axis=-1)
    scene.close()
    body.close()
    assert changed[:30, 240:].any()
    assert changed[30:60, 240:].any()
    assert not changed[60:].any()
    assert not changed[:, :240].any()
