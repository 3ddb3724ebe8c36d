from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import mujoco
import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.sim import rooms
from relmm.sim.furniture import Obstacle, Rug
from relmm.sim.objects import MAX_RADIUS, add_object, object_names, register_object
from relmm.sim.rooms import OBJECT_PREFIX, Room, make_room, register_room, room_names, set_objects
from relmm.sim.scenery import TIMESTEP

PAPER_ROOMS = ["diverse", "no_obstacles", "obstacles", "obstacles_rugs"]
GRIPPER_OPENING = 0.044  # m
GRIPPER_FORCE = 10.0  # N


def build(name: str, seed: int = 0) -> tuple[Room, mujoco.MjModel, mujoco.MjData]:
    room = make_room(name)
    model = room.build(np.random.default_rng(seed)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return room, model, data


def object_positions(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    ids = [i for i in range(model.nbody) if model.body(i).name.startswith(OBJECT_PREFIX)]
    return data.xpos[ids].copy()


def run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    mujoco.mj_step(model, data, round(seconds / TIMESTEP))


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, type[Room]]]:
    """A copy, so that a test's rooms end with it."""
    copy = dict(rooms._ROOMS)
    monkeypatch.setattr(rooms, "_ROOMS", copy)
    return copy


# --- Every room ----------------------------------------------------------------------------------------------
def test_the_papers_rooms_are_there() -> None:
    assert set(PAPER_ROOMS) <= set(room_names())


@pytest.mark.parametrize("name", PAPER_ROOMS)
def test_objects_settle_where_they_were_put_and_fall_asleep(name: str) -> None:
    room, model, data = build(name)
    before = object_positions(model, data)
    assert before.shape == (room.num_objects, 3)
    run(model, data, 2.0)

    after = object_positions(model, data)
    assert np.linalg.norm((after - before)[:, :2], axis=1).max() < 0.05
    assert np.abs(after[:, 2] - before[:, 2]).max() < 0.002
    assert np.isfinite(data.qpos).all()
    assert np.isfinite(data.qvel).all()
    assert not any(warning.number for warning in data.warning)
    assert data.ntree_awake == 0


@pytest.mark.parametrize("name", PAPER_ROOMS)
@pytest.mark.parametrize("seed", range(5))
def test_clearances(name: str, seed: int) -> None:
    room = make_room(name)
    poses = room.scatter(np.random.default_rng(seed))
    xy = poses[:, :2]
    assert poses.shape == (room.num_objects, 3)
    assert np.linalg.norm(xy, axis=1).min() >= room.robot_clearance
    assert (np.abs(xy) <= np.asarray(room.size) / 2 - room.wall_clearance).all()
    for obstacle in room.obstacles:
        assert obstacle.distance(xy).min() >= room.obstacle_clearance
    gaps = np.linalg.norm(xy[:, None] - xy[None], axis=-1)[np.triu_indices(len(xy), 1)]
    assert gaps.min() >= room.object_spacing


@pytest.mark.parametrize("name", PAPER_ROOMS)
def test_a_seed_gives_one_room_and_another_seed_another(name: str) -> None:
    (_, model, data), (_, again, _), (_, other, _) = build(name, 5), build(name, 5), build(name, 6)
    assert np.array_equal(model.qpos0, again.qpos0)
    assert np.array_equal(model.geom_rgba, again.geom_rgba)
    assert np.array_equal(model.tex_data, again.tex_data)
    assert not np.array_equal(model.qpos0, other.qpos0)
    poses = make_room(name).scatter(np.random.default_rng(5))
    assert np.array_equal(object_positions(model, data)[:, :2], poses[:, :2])


def test_objects_move_to_another_scatter_without_compiling() -> None:
    room, model, data = build("diverse")
    run(model, data, 1.0)
    data.qvel[:] = 1.0
    poses = room.scatter(np.random.default_rng(1))
    set_objects(model, data, poses)
    mujoco.mj_forward(model, data)
    assert np.array_equal(object_positions(model, data)[:, :2], poses[:, :2])
    assert (data.qvel == 0).all()

    run(model, data, 2.0)
    after = object_positions(model, data)
    assert np.linalg.norm(after[:, :2] - poses[:, :2], axis=1).max() < 0.05
    assert after[:, 2].max() < 0.02
    assert data.ntree_awake == 0


def test_places_are_uniform_over_the_free_floor() -> None:
    room = make_room("no_obstacles")
    xy = np.concatenate([room.scatter(np.random.default_rng(seed))[:, :2] for seed in range(100)])
    assert np.abs(xy.mean(axis=0)).max() < 0.06  # 0.8 m standard deviation over the square root of 2000
    quadrants = np.bincount(2 * (xy[:, 0] > 0) + (xy[:, 1] > 0))
    assert quadrants.min() > 0.8 * quadrants.max()


def test_walls_hold_a_fast_ball() -> None:
    room, model, data = build("no_obstacles")
    data.qvel[0] = 2.0  # m/s along x
    run(model, data, 3.0)
    assert np.abs(object_positions(model, data)[:, :2]).max() < room.size[0] / 2


def test_rugs_are_for_the_eyes_only() -> None:
    room, model, _ = build("obstacles_rugs")
    assert len({rug.texture for rug in room.rugs}) >= 4
    for index in range(len(room.rugs)):
        rug = model.geom(f"rug_{index}")
        assert rug.contype[0] == rug.conaffinity[0] == 0


def test_obstacles_are_the_originals() -> None:
    _, model, data = build("obstacles")
    box, cylinder = model.geom("obstacle_00"), model.geom("obstacle_01")
    assert np.allclose(box.size, (0.15, 0.15, 0.3))
    assert np.allclose(cylinder.size[:2], (0.15, 0.3))
    assert np.allclose(data.geom("obstacle_00").xpos, (-0.5, 0.5, 0.3))
    assert np.allclose(data.geom("obstacle_03").xpos, (-0.75, -0.75, 0.2))


# --- Objects -------------------------------------------------------------------------------------------------
def support(model: mujoco.MjModel, data: mujoco.MjData, geom: int, direction: np.ndarray) -> float:
    """How far a geom reaches along a unit vector, m."""
    along = data.geom_xmat[geom].reshape(3, 3).T @ direction
    size, shape = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    across = np.hypot(along[0], along[1])
    reach = {
        mujoco.mjtGeom.mjGEOM_SPHERE: size[0],
        mujoco.mjtGeom.mjGEOM_CAPSULE: size[0] + size[1] * abs(along[2]),
        mujoco.mjtGeom.mjGEOM_CYLINDER: size[0] * across + size[1] * abs(along[2]),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: np.linalg.norm(size * along),
        mujoco.mjtGeom.mjGEOM_BOX: size @ np.abs(along),
    }[shape]
    return float(data.geom_xpos[geom] @ direction + reach)


def lone_object(kind: str, seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = make_room("no_obstacles", num_objects=1).build(np.random.default_rng(0))
    add_object(spec, kind, "thing", np.random.default_rng(seed))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("kind", object_names())
@pytest.mark.parametrize("seed", range(4))
def test_every_object_fits_the_gripper_at_any_yaw(kind: str, seed: int) -> None:
    model, data = lone_object(kind, seed)
    body = model.body("thing")
    geoms = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])

    def reach(direction: np.ndarray) -> float:
        return max(support(model, data, geom, direction) for geom in geoms)

    turns = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.linspace(0, np.pi, 36, endpoint=False)]
    widths = np.array([reach(turn) + reach(-turn) for turn in turns])
    assert widths.max() <= 0.9 * GRIPPER_OPENING + 1e-3
    assert widths.min() >= 0.014
    assert max(reach(sign * turn) for turn in turns for sign in (-1, 1)) <= MAX_RADIUS + 1e-9

    up = np.array([0.0, 0.0, 1.0])
    assert -reach(-up) == pytest.approx(0.0, abs=2.5e-4)  # stands on the floor, at most its decoration in it
    assert 0.018 <= reach(up) <= 0.036
    assert 0.008 <= body.mass[0] <= 0.040


def test_a_pushed_ball_rolls_on_for_a_hand_or_two() -> None:
    model, data = lone_object("green_ball", 0)
    joint = model.joint("thing")
    data.qvel[joint.dofadr[0]] = 0.3
    data.qvel[joint.dofadr[0] + 4] = 0.3 / 0.015
    run(model, data, 4.0)
    assert 0.10 < data.body("thing").xpos[0] < 0.20
    assert data.ntree_awake == 0


@pytest.mark.parametrize("finger_mass", [0.03, 0.1])
@pytest.mark.parametrize("kind", ["green_ball", "block", "duck"])
def test_a_squeezed_object_neither_sinks_in_nor_flies_off(kind: str, finger_mass: float) -> None:
    spec = make_room("no_obstacles", num_objects=1).build(np.random.default_rng(0))
    add_object(spec, kind, "thing", np.random.default_rng(0))
    for side in (-1, 1):
        finger = spec.worldbody.add_body(name=f"finger{side}", pos=(0.0, 0.026 * side, 0.02))
        finger.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0.0, -side, 0.0), damping=4.0)
        finger.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.03, 0.004, 0.014),
            mass=finger_mass,
            solref=(0.01, 1.0),
            solimp=(0.95, 0.99, 0.001, 0.5, 2.0),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    fingers = [model.joint(model.body(f"finger{side}").jntadr[0]).dofadr[0] for side in (-1, 1)]
    data.qfrc_applied[fingers] = GRIPPER_FORCE
    run(model, data, 2.0)
    thing = model.body("thing").id
    depths = [c.dist for c in data.contact if thing in model.geom_bodyid[c.geom]]
    assert min(depths) > -0.0015
    assert np.linalg.norm(data.body("thing").xpos[:2]) < 0.005
    assert np.abs(data.qvel).max() < 0.1


# --- Errors --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"size": (0.0, 3.0)}, r"size of the room is \(0.0, 3.0\).*positive"),
        ({"size": (0.3, 3.0)}, "no space for the robot"),
        ({"num_objects": 0}, "num_objects is 0; choose 1 to 100"),
        ({"objects": ()}, "no kinds of objects"),
        ({"objects": ("anvil",)}, "no object 'anvil'; choose from .*green_ball"),
        ({"floor": "lava"}, "no texture 'lava'; choose one of .*wood"),
        ({"wall_clearance": -0.1}, "wall_clearance is -0.1 m; choose 0 or more"),
        ({"colour": 1}, "has no colour; choose from size, "),
        ({"obstacles": (Obstacle(shape="box", x=0.2, y=0.0, height=1.0),)}, "stands where the robot starts"),
    ],
)
def test_impossible_rooms_are_refused(overrides: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_room("no_obstacles", **overrides)


def test_impossible_obstacles_and_rugs_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"begins 0.5 m above the floor.*choose 0 or at least 0.75 m"):
        Obstacle(shape="box", x=1.0, y=1.0, height=0.1, bottom=0.5)
    with pytest.raises(ConfigError, match="positive"):
        Obstacle(shape="cylinder", x=1.0, y=1.0, height=0.1, radius=-1.0)
    with pytest.raises(ConfigError, match="cannot be a 'cone'"):
        Obstacle(shape="cone", x=1.0, y=1.0, height=0.1)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="positive"):
        Rug(x=0.0, y=0.0, size=(0.0, 1.0), texture="rug_checks")


@pytest.mark.parametrize("size", [(1.0, 1.0), (1.2, 1.2)])
def test_a_full_room_says_how_many_fit(size: tuple[float, float]) -> None:
    room = make_room("no_obstacles", num_objects=100, size=size)
    with pytest.raises(ConfigError, match=r"'no_obstacles' has no space for 100 objects; at most about \d+ fit"):
        room.build(np.random.default_rng(0))


def test_unknown_room_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"no room 'no_such_room'; choose one of .*no_obstacles"):
        make_room("no_such_room")


def test_distance_to_a_turned_box() -> None:
    box = Obstacle(shape="box", x=1.0, y=0.0, half_size=(0.5, 0.1), height=1.0, yaw=np.pi / 2)
    assert np.allclose(box.distance(np.array([[1.0, 0.7], [1.3, 0.0], [1.0, 0.0]])), [0.2, 0.2, 0.0])


# --- Rooms of others -----------------------------------------------------------------------------------------
def test_a_registered_room_works_everywhere(registry: dict[str, type[Room]]) -> None:
    @register_room("corridor")
    @dataclass(frozen=True, kw_only=True)
    class Corridor(Room):
        size: tuple[float, float] = (5.0, 1.0)
        objects: tuple[str, ...] = ("blue_ball", "duck")
        num_objects: int = 4

    room = make_room("corridor", num_objects=6)
    assert "corridor" in room_names()
    assert room.build(np.random.default_rng(0)).compile().nq == 6 * 7
    with pytest.raises(ConfigError, match="already is a room 'corridor'"):
        register_room("corridor")(Room)


def test_a_room_of_an_installed_package_is_found(
    registry: dict[str, type[Room]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "somebodys_rooms.py").write_text(
        "from dataclasses import dataclass\n"
        "from relmm.sim.rooms import Room, register_room\n"
        "@register_room('attic')\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Attic(Room):\n"
        "    num_objects: int = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    points = [
        EntryPoint(name="broken", value="no_such_module", group="relmm.rooms"),
        EntryPoint(name="attic", value="somebodys_rooms", group="relmm.rooms"),
    ]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: points if group == "relmm.rooms" else [])
    assert make_room("attic").num_objects == 3
    assert "attic" in room_names()


def test_an_object_is_registered_once() -> None:
    with pytest.raises(ConfigError, match="already is an object 'duck'"):
        register_object("duck")(lambda body, rng: 0.0)
