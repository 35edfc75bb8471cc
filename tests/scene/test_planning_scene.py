"""A scene that changes: what follows it is what would be made anew."""

import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier, Event

import numpy as np
import pybullet_data
import pytest
from tests.planner_fixtures import nodes_of, pairs_of

from constraint_geodesics import bundle
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, Pose
from constraint_geodesics.planner import Planner
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene, SceneError
from constraint_geodesics.scene.scene_file import SceneFile
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.urdf import quiet
from constraint_geodesics.scene.world import BodyKey
from constraint_geodesics.search.preparation import KEPT_TASKS

CRATE = Box("crate", (0.45, 0.25, 0.2), (0.2, 0.2, 0.2))
BALL = Sphere("ball", (-0.3, 0.4, 0.5), 0.12)
PIPE = Capsule("pipe", (0.3, -0.5, 0.2), (0.5, -0.2, 0.7), 0.05)
CUP = Cylinder("cup", Placement((0.0, 0.0, 0.09)), 0.12, 0.04)
CARRYING = Placement((0.0, 0.05, 0.12), (0.3, 0.8, -0.2))
FREE = Constraint((0,) * 6)
CARRIED = (
    CUP,
    Box("cup", (0.0, 0.0, 0.0), (0.12, 0.05, 0.2)),
    Sphere("cup", (0.0, 0.0, 0.0), 0.08),
    Capsule("cup", (0.0, -0.1, 0.0), (0.0, 0.1, 0.05), 0.03),
    Mesh("cup", Path(pybullet_data.getDataPath()) / "cube.obj", scale=0.12),
    Body("cup", "cube_small.urdf"),
    PointCloud("cup", np.random.default_rng(6).uniform(-0.08, 0.08, (40, 3)), 0.02),
)


@pytest.fixture
def planner() -> Iterator[Planner]:
    with Planner.load(bundle.PACKAGED) as loaded:
        yield loaded


def changed(planner: Planner) -> None:
    """Every kind of change, some of them taken back."""
    scene = planner.scene
    scene.add(CRATE, BALL)
    scene.add(PIPE)
    scene.attach(CUP, "link6")
    scene.move("crate", Placement((0.4, -0.3, 0.3), (0.1, 0.2, 0.3)))
    scene.remove("ball")
    scene.attach(Box("tray", (0.0, 0.0, 0.05), (0.1, 0.2, 0.02)), "link4")
    scene.detach("tray")
    scene.move("cup", CARRYING)
    scene.allow("cup", "pipe")
    scene.add(BALL)


def test_what_follows_a_scene_is_what_is_made_anew(planner: Planner) -> None:
    """Clearance, certificate and PyBullet."""
    changed(planner)
    now, robot = planner.scene.now, planner.robot
    assert planner.scene.workcell[-1] == BALL
    q = robot.sample(400, np.random.default_rng(0))
    task = planner._preparation.task(FREE)
    fresh = clearance_model(now, planner._certifier.collisions.apart)
    for kept, made in zip(task.clearance.arrays[:3], fresh.arrays[:3], strict=True):
        np.testing.assert_array_equal(kept, made)  # in the same order, too
    np.testing.assert_allclose(
        task.clearance.clearance(robot, q), fresh.clearance(robot, q), atol=1e-6
    )
    own = planner._certifier
    with Certifier(now, own.limits) as anew, now.world() as world:
        assert set(own.collisions.collider.bodies) == set(anew.collisions.collider.bodies)
        for row in q:
            # one that is made anew leaves out more pairs that never meet
            assert own.collisions.clearance(row) <= anew.collisions.clearance(row) + 1e-6
        np.testing.assert_array_equal(own._world.free(q), world.free(q))
        np.testing.assert_array_equal(own.collisions.free(q), anew.collisions.free(q))


@pytest.mark.parametrize("link", ["link4", "link6"])
@pytest.mark.parametrize("shape", CARRIED, ids=lambda shape: type(shape).__name__)
def test_what_is_carried_is_where_pybullet_has_it(
    planner: Planner, shape: Shape, link: str
) -> None:
    """Distances of a carried shape to links and shapes, and contacts found in the same places."""
    planner.scene.add(CRATE, PIPE)
    planner.scene.attach(shape.placed(CARRYING), link)
    now, checks = planner.scene.now, planner._certifier.collisions
    seen, touched = 0, 0
    with now.world() as world:
        q = planner.robot.sample(200, np.random.default_rng(1))
        label = world.label(q)
        hit = label.self_collision | label.workcell_collision
        for row, touches in zip(q, hit, strict=True):
            near = min(
                world.distance(row, BodyKey("cup", True), key, 0.2)
                for key in checks.collider.bodies
                if key.name not in ("cup", link)
            )
            assert touches >= (near < -1e-9)
            touched += near < 0.0
            if near < 0.2:
                seen += 1
                assert checks.clearance(row) < max(near, 0.0) + 3e-5
            if touches:
                assert not checks.is_free(row)
            if checks.clearance(row) > 1e-4:
                assert checks.is_free(row)
                assert not touches
    assert seen > 50
    assert touched > 5


def test_a_shape_is_let_go_where_it_is(planner: Planner) -> None:
    planner.scene.attach(CUP, "link6")
    q = planner.robot.sample(1, np.random.default_rng(2))[0]
    planner.scene.detach("cup", q)
    (cup,) = [shape for shape in planner.scene.workcell if shape.name == "cup"]
    with planner.scene.world() as world:
        (link,) = world.link_poses(q, ["link6"])
    np.testing.assert_allclose(cup.at.matrix, link @ CUP.at.matrix, atol=1e-7)


def test_a_path_keeps_off_what_was_added_and_what_is_carried(planner: Planner) -> None:
    """Checked densely by a world that is made anew."""
    planner.scene.attach(CUP, "link6")
    kept = 0
    for start, goal in pairs_of("level_cup", 8, seed=21):
        between = planner.robot.forward(0.5 * (start + goal))[0].tolist()
        ball = Sphere("ball", tuple(between), 0.06)
        before = planner.scene.now
        path = planner.plan(start, goal, "level_cup", scene=[ball])
        assert planner.scene.now is before
        if path.status != "solved":
            continue
        asked = path.asked.scene
        assert asked.workcell[-1] == ball
        assert asked.attached == planner.scene.attached
        steps = np.linspace(0.0, 1.0, 5)[:, None]
        dense = [a + steps * (b - a) for a, b in zip(path.joints, path.joints[1:], strict=False)]
        with asked.world() as world:
            assert world.free(np.concatenate(dense)).all()
        kept += 1
    assert kept >= 4


def test_what_was_allowed_ends_with_the_shape(planner: Planner) -> None:
    planner.scene.add(CRATE)
    planner.scene.attach(CUP, "link6")
    planner.scene.allow("cup", "crate")
    q = planner.robot.sample(1, np.random.default_rng(2))[0]
    planner.scene.detach("cup", q)
    assert planner.scene.now.allowed == {("cup", "crate")}
    planner.scene.remove("cup")
    assert not planner.scene.now.allowed


def test_adding_adds(planner: Planner) -> None:
    """What was there before is still looked at."""
    planner.scene.add(CRATE)
    into_table = np.array([0.0, 1.9, -0.6, 0.0, 0.0, 0.0])
    assert not planner._certifier.collisions.is_free(into_table)


def test_what_touches_the_carrier_is_said_to(planner: Planner) -> None:
    """A shape that overlaps other links is refused for good, until it may touch them."""
    wide = Box("wide", (0.0, 0.0, 0.0), (0.2, 0.2, 0.1))
    planner.scene.attach(wide, "link6")
    nodes = nodes_of("free")[0]
    assert not planner._certifier.collisions.free(nodes).any()
    planner.scene.detach("wide")
    planner.scene.attach(wide, "link6", touching=("link5", "link4"))
    start, goal = nodes[planner._certifier.collisions.free(nodes)][[0, -1]]
    path = planner.plan(start, goal, "free")
    assert path.status == "solved", path.explanation
    said = planner._certifier.collisions.rests_on
    assert "wide on link6" in said
    assert "link5 with wide" in said
    planner.scene.detach("wide")
    planner.scene.attach(wide, "link6")
    refused = planner.plan(start, goal, "free")
    assert refused.status == "in_collision"
    assert "wide with link5" in refused.explanation


def test_the_certificate_names_what_never_counts(planner: Planner) -> None:
    """Exempt links of a shape, and what is no contact by definition."""
    bolted = Box("bolted", (0.0, 0.0, 2.0), (0.1, 0.1, 0.1), exempt_links=("link3",))
    planner.scene.add(bolted)
    planner.scene.attach(Sphere("ball", (0.0, 0.0, 0.2), 0.02), "link6")
    looked_at, never = planner._certifier.collisions.rests_on.split("; never a contact: ")
    assert "bolted with link3" in looked_at
    assert never == "a link with the one it hangs on, ball with link6"
    planner.scene.remove("bolted")
    planner.scene.detach("ball")
    said = planner._certifier.collisions.rests_on
    assert "bolted" not in said
    assert "ball" not in said


def test_a_change_that_fails_changes_nothing(planner: Planner, tmp_path: Path) -> None:
    planner.scene.add(CRATE)
    before, q = planner.scene.now, planner.robot.sample(50, np.random.default_rng(4))
    free = planner._certifier.collisions.free(q)
    wrong: list[tuple[type[Exception], str, object]] = [
        (SceneError, "already", lambda s: s.add(CRATE)),
        (SceneError, "no shape called 'crates': table, crate", lambda s: s.remove("crates")),
        (SceneError, "no shape called 'cup'", lambda s: s.move("cup", Placement())),
        (SceneError, "nothing called 'cup' is attached", lambda s: s.detach("cup")),
        (SceneError, "no link is called 'hand'", lambda s: s.attach(CUP, "hand")),
        (SceneError, "'gripper' is no link", lambda s: s.attach(CUP, "link6", ["gripper"])),
        (SceneError, "list of names", lambda s: s.attach(CUP, "link6", "link5")),
        (SceneError, "list of names", lambda s: s.attach(CUP, "link6", 5)),
        (SceneError, r"q has shape \(2,\): must be", lambda s: s.link_pose([0.0, 0.0], "link6")),
        (SceneError, r"q\[0\] is not finite", lambda s: s.link_pose([np.nan] * 6, "link6")),
        (ValueError, "no pose", lambda s: s.move("crate", [1, 2, 3])),
        (SceneError, "'tabel' is no link", lambda s: s.allow("crate", "tabel")),
        (SceneError, "is a link of the robot", lambda s: s.add(Sphere("link5", (1, 1, 1), 0.1))),
        (SceneError, "is no shape", lambda s: s.add("crate")),
        (SceneError, "wrist", lambda s: s.add(Sphere("ball", (1, 1, 1), 0.1, ("wrist",)))),
        (RobotError, "no such URDF", lambda s: s.add(_missing(tmp_path))),
    ]
    for kind, text, change in wrong:
        with pytest.raises(kind, match=text):
            change(planner.scene)  # type: ignore[operator]
        assert planner.scene.now is before
    with pytest.raises(SceneError, match="already"):
        planner.plan(q[0], q[1], "free", scene=[CRATE])
    twins = [Sphere("wall", (1.0, 1.0, 1.0), 0.1), Sphere("wall", (-1.0, 1.0, 1.0), 0.1)]
    with pytest.raises(SceneError, match="two shapes are called 'wall'"):
        Planner.from_urdf("franka_panda/panda.urdf", "panda_hand", workcell=twins)
    assert planner.scene.now is before
    np.testing.assert_array_equal(planner._certifier.collisions.free(q), free)
    np.testing.assert_array_equal(planner._certifier._world.free(q), free)


def test_names_are_refused_in_the_same_words_everywhere(planner: Planner) -> None:
    """By a planner, by a certificate of its own and by PyBullet's world."""
    now = planner.scene.now
    twice = replace(now, workcell=(CRATE, CRATE), attached=())
    wrong = (
        (twice, "two shapes are called 'crate'"),
        (replace(now, attached=(Attached(CUP, "link6"), Attached(CUP, "link5"))), "called 'cup'"),
        (replace(now, workcell=(Sphere("link5", (1, 1, 1), 0.1),)), "'link5' is a link of the"),
        (replace(now, workcell=(replace(CRATE, exempt_links=("wrist",)),)), "is called 'wrist'"),
        (replace(now, attached=(Attached(CUP, "hand"),)), "no link is called 'hand'"),
        (replace(now, attached=(Attached(CUP, "link6", ("hand",)),)), "'hand' is no link of the"),
        (replace(now, allowed=frozenset({("table", "hand")})), "'hand' is no link of the robot"),
    )
    for scene, text in wrong:
        for change in (planner.scene.become, clearance_model, Certifier, Scene.world):
            with pytest.raises(SceneError, match=text):
                change(scene)  # type: ignore[operator]
        assert planner.scene.now is now


def test_a_scene_of_another_robot_is_refused(planner: Planner) -> None:
    """That of a robot with other pairs that may touch as well; a copy is the same."""
    now = planner.scene.now
    planner.scene.become(pickle.loads(pickle.dumps(now)).adding(CRATE))
    in_step(planner)
    may = replace(now.robot, allowed=now.robot.allowed | {("link2", "link5")})
    with Planner.from_urdf("franka_panda/panda.urdf", "panda_hand") as panda:
        for robot in (may, panda.robot):
            with pytest.raises(SceneError, match=r"another robot: this one is"):
                planner.scene.become(Scene(robot))
    assert planner.scene.now.names == ("table", "crate")


def _missing(folder: Path) -> Shape:

    return Body("gone", folder / "gone.urdf")


def test_a_body_that_comes_after_another_one_is_not_taken_for_it(planner: Planner) -> None:
    """PyBullet gives its numbers again: what one was allowed the next is not."""
    into = np.zeros(6)
    (link,) = planner._certifier._world.link_poses(into, ["link3"])
    x, y, z = link[:3, 3].tolist()
    planner.scene.add(Sphere("soft", (x, y, z), 0.05, ("link2", "link3", "link4", "link5")))
    assert planner._certifier._world.is_free(into)
    planner.scene.remove("soft")
    planner.scene.add(Sphere("hard", (x, y, z), 0.05))
    assert not planner._certifier._world.is_free(into)
    assert not planner._certifier.collisions.is_free(into)


def test_a_roadmap_outlives_what_comes_and_goes(planner: Planner) -> None:
    """And is made anew once something is gone that it was made round."""
    before = planner.nodes("level_cup")
    planner.scene.add(CRATE)
    planner.scene.remove("crate")
    np.testing.assert_array_equal(planner.nodes("level_cup"), before)
    planner.scene.remove("table")
    below = planner.robot.forward(planner.nodes("level_cup"))[0][:, 2]
    assert (below < 0.0).any()


@pytest.mark.parametrize("comes", ["at first", "later"])
def test_a_roadmap_is_made_anew_where_more_of_what_it_knows_may_touch(comes: str) -> None:
    """Else it would hold apart what a shape held apart that may be touched now."""
    with Planner.load(bundle.PACKAGED) as planner:
        known = "table" if comes == "at first" else CRATE.name
        if comes == "later":
            planner.scene.add(CRATE)
        before = planner.nodes("level_cup")
        for link in ("link3", "link4", "link5", "link6"):
            planner.scene.allow(known, link)
        after = planner.nodes("level_cup")
        assert np.array_equal(before, after) == (comes == "later")


def test_permissions_that_change_nothing_leave_roadmaps_alone(planner: Planner) -> None:
    """As in a file of MoveIt: of adjacent links, of some that never meet, and said twice."""
    before, scene = planner._preparation._roadmaps, planner.scene
    never = next((a.name, b.name) for a, b in planner._certifier.collisions.apart)
    for pair in (("link1", "link2"), never, *planner.robot.allowed):
        scene.allow(*pair)
    assert planner._preparation._roadmaps is before
    scene.allow("table", "link5")
    anew = planner._preparation._roadmaps
    assert anew is not before
    scene.allow("link5", "table")
    assert planner._preparation._roadmaps is anew


def test_what_is_prepared_for_a_name_is_kept(planner: Planner) -> None:
    """Also for a name that came later, however many others are asked for."""
    tilted = Constraint((0, 0, 0, 1, 1, 0), reference=Pose.from_rpy([0, 0, 0], [0.2, 3.0, 0]))
    planner.constraints["tilted"] = tilted
    prepared = planner._preparation
    kept = prepared.task(tilted)
    used = prepared.task(
        Constraint((0, 0, 1, 0, 0, 0), reference=Pose.from_rpy([0, 0, 9], [0, 0, 0]))
    )
    for number in range(KEPT_TASKS + 10):
        pose = Pose.from_rpy([0, 0, 0.01 * number], [0, 0, 0])
        prepared.task(Constraint((0, 0, 1, 0, 0, 0), reference=pose))
        assert prepared.task(used.manifold.constraint) is used, "asked for again and again"
    assert prepared.task(tilted) is kept


def test_a_scene_is_a_value(planner: Planner) -> None:
    """A pose as a user has it moves a shape, and no snapshot."""
    planner.scene.add(CRATE)
    now = planner.scene.now
    planner.scene.move("crate", Pose(np.array([0.5, 0.0, 0.4]), np.eye(3)))
    assert isinstance(now, Scene)
    assert now.workcell[-1] == CRATE
    assert planner.scene.workcell[-1].at.position_m == (0.5, 0.0, 0.4)


def cube(file: Path, half_m: float) -> Path:
    signs = (-half_m, half_m)
    corners = [(x, y, z) for x in signs for y in signs for z in signs]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
    file.write_text("\n".join(lines) + "\n")
    return file


def overlapping(kind: str, folder: Path) -> tuple[Shape, Shape]:
    """Two shapes that overlap by centimetres, at one place of a link's frame."""
    mesh, at = cube(folder / "own.obj", 0.05), Placement((0.0, 0.0, 0.3))
    cloud = np.random.default_rng(7).uniform(-0.03, 0.03, (200, 3))
    return {
        "mesh and mesh": (Mesh("one", mesh, at), Mesh("other", mesh, at)),
        "ball in a mesh": (Mesh("one", mesh, at), Sphere("other", (0.0, 0.0, 0.3), 0.01)),
        "cloud and cloud": (
            PointCloud("one", cloud, 0.02, at),
            PointCloud("other", cloud[::-1], 0.02, at),
        ),
        "box and box": tuple(Box(n, at.position_m, (0.1, 0.1, 0.1)) for n in ("one", "other")),
    }[kind]  # type: ignore[return-value]


@pytest.mark.parametrize(
    "kind", ["mesh and mesh", "ball in a mesh", "cloud and cloud", "box and box"]
)
def test_what_overlaps_for_good_is_refused_though_pybullet_sees_surfaces(
    planner: Planner, tmp_path: Path, kind: str
) -> None:
    """Carried by one link, where nothing moves them apart."""
    start, goal = pairs_of("free", 1, seed=3)[0]
    for shape in overlapping(kind, tmp_path):
        planner.scene.attach(shape, "link6", touching=("link4", "link5"))
    path = planner.plan(start, goal, "free")
    assert path.status == "in_collision"
    assert "touch at every configuration" in path.explanation


def test_a_link_within_a_mesh_is_refused(planner: Planner, tmp_path: Path) -> None:
    """Whose surface it does not reach."""
    start, goal = pairs_of("free", 1, seed=3)[0]
    planner.scene.add(Mesh("room", cube(tmp_path / "own.obj", 3.0)))
    assert planner.plan(start, goal, "free").status == "in_collision"


def test_a_file_that_was_written_anew_is_read_anew_where_its_shape_moves(
    planner: Planner, tmp_path: Path
) -> None:
    file = cube(tmp_path / "own.obj", 0.02)
    planner.scene.add(Mesh("part", file, Placement((0.0, 2.0, 1.0))))
    cube(file, 0.3)
    planner.scene.move("part", Placement((0.0, 2.0, 1.2)))
    body = planner._certifier.collisions.collider.bodies[BodyKey("part", True)]
    assert np.ptp(body.pieces[0].corners, axis=0) == pytest.approx([0.6] * 3)


def test_a_file_that_was_written_anew_is_read_anew_where_an_equal_shape_takes_its_place(
    planner: Planner, tmp_path: Path
) -> None:
    """In one change, of a planner's scene and of a world."""
    file, at = cube(tmp_path / "own.obj", 0.02), Placement((0.0, 2.0, 1.0))
    planner.scene.add(Mesh("part", file, at))
    cube(file, 0.3)
    planner.scene.become(planner.scene.now.removing("part").adding(Mesh("part", file, at)))
    body = planner._certifier.collisions.collider.bodies[BodyKey("part", True)]
    assert np.ptp(body.pieces[0].corners, axis=0) == pytest.approx([0.6] * 3)
    world = planner._certifier._world
    low, high = world._bullet.getAABB(world._shapes["part"].body)
    assert np.subtract(high, low) == pytest.approx([0.6] * 3, abs=0.05)


def test_what_is_away_is_allowed_to_touch_once_it_comes_back(planner: Planner) -> None:
    """PyBullet's filters are those of a world that is made anew."""
    q = planner.robot.sample(200, np.random.default_rng(8))
    planner.scene.attach(CUP.placed(CARRYING), "link6", touching=["link5"])
    planner.scene.add(CRATE)
    planner.scene.allow("cup", "crate")
    planner.scene.attach(Sphere("pad", (0.0, 0.0, 0.2), 0.1), "link6", touching=["cup", "crate"])
    for _ in range(2):
        planner.scene.remove("crate")
        planner.scene.add(CRATE)
        with planner.scene.world() as world:
            np.testing.assert_array_equal(planner._certifier._world.free(q), world.free(q))


@pytest.fixture
def fixtured(tmp_path: Path) -> Iterator[tuple[Planner, Path]]:
    """A planner that was made with a mesh, whose file is gone since, and with a crate."""
    file = cube(tmp_path / "own.obj", 0.05)
    with Planner.load(bundle.PACKAGED) as packaged:
        own = packaged.bundle
    mesh = Mesh("fixture", file, Placement((0.0, 2.0, 1.0)))
    around = own.workcell.including(mesh, CRATE)
    with Planner(replace(own, workcell=around), "with a mesh") as made:
        file.unlink()
        yield made, file


def in_step(planner: Planner) -> None:
    """Scene, certificate, both models and PyBullet have the same shapes."""
    names = {shape.name for shape in planner.scene.workcell}
    names |= {one.name for one in planner.scene.attached}
    own, search = planner._certifier, planner._preparation._clearances._table
    assert own.scene is planner.scene.now
    assert {key.name for key in own.collisions.collider.bodies if key.is_shape} == names
    assert {key.name for key in search.bodies if key.is_shape} == names
    assert own._world._shapes.keys() == names


def test_what_stays_is_not_read_again(fixtured: tuple[Planner, Path]) -> None:
    """Nor is it for the roadmaps that are made anew."""
    planner, _ = fixtured
    planner.scene.remove("crate")
    in_step(planner)
    assert len(planner.nodes("level_cup"))


def test_a_change_that_can_not_be_taken_back_by_reading_is_taken_back(
    fixtured: tuple[Planner, Path],
) -> None:
    planner, _ = fixtured
    q = planner.robot.sample(100, np.random.default_rng(9))
    free = planner._certifier.collisions.free(q)
    for _ in range(2):
        with pytest.raises(RobotError, match="there is no mesh"):
            planner.scene.move("fixture", Placement((0.0, 2.0, 1.2)))
        in_step(planner)
        np.testing.assert_array_equal(planner._certifier.collisions.free(q), free)
    planner.scene.remove("fixture")
    in_step(planner)


def test_what_the_searchs_model_refuses_is_taken_back(
    planner: Planner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what the certificate's, or PyBullet's."""
    planner.scene.add(CRATE)
    q = planner.robot.sample(100, np.random.default_rng(9))
    free = planner._certifier.collisions.free(q)

    def fail(*_: object) -> None:
        raise RobotError("not now")

    own = planner._certifier
    for thing, name in (
        (planner._preparation._clearances, "change"),
        (own.collisions.collider, "change"),
        (own._world, "change"),
        (own._world, "_add"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(thing, name, fail)
            with pytest.raises(RobotError, match="not now"):
                planner.scene.become(planner.scene.now.removing("crate").adding(BALL))
        in_step(planner)
        np.testing.assert_array_equal(own.collisions.free(q), free)


def test_allowances_of_what_is_carried_end_with_the_shape_that_they_name(planner: Planner) -> None:
    planner.scene.add(CRATE)
    planner.scene.attach(CUP, "link6", touching=["crate", "link5"])
    planner.scene.remove("crate")
    assert planner.scene.attached[0].touching == ("link5",)


def test_another_shape_of_a_name_inherits_nothing(planner: Planner) -> None:
    planner.scene.add(CRATE)
    planner.scene.allow("crate", "link4")
    planner.scene.attach(CRATE.placed(CARRYING), "link6")
    assert planner.scene.now.allowed == {("crate", "link4")}
    planner.scene.detach("crate", np.zeros(6))
    planner.scene.attach(Sphere("crate", (0.0, 0.0, 0.1), 0.05), "link6")
    assert not planner.scene.now.allowed


def test_what_the_robot_allows_it_allows_after_a_change_is_taken_back() -> None:
    """PyBullet is not told to examine links that may always touch."""
    with Planner.from_urdf("franka_panda/panda.urdf", "panda_hand") as panda:
        q = panda.robot.sample(100, np.random.default_rng(10))
        before, free = panda.scene.now, panda._certifier._world.free(q)
        panda.scene.become(replace(before, allowed=panda.robot.allowed))
        panda.scene.become(before)
        np.testing.assert_array_equal(panda._certifier._world.free(q), free)
    assert free.any()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box("x", (0, 0, np.nan), (1, 1, 1)),
        lambda: Box("x", (0, 0, 0), (1, -1, 1)),
        lambda: Box("x", ("a", 0, 0), (1, 1, 1)),
        lambda: Sphere("x", (0, 0, 0), 0.0),
        lambda: Capsule("x", (0, 0, 0), (0, 0, np.inf), 0.1),
        lambda: Cylinder("x", Placement(), -1.0, 0.1),
        lambda: Cylinder("x", [1, 2, 3], 1.0, 0.1),  # type: ignore[arg-type]
        lambda: PointCloud("x", np.zeros((1, 3)), np.nan),
        lambda: Placement((0.0, 0.0), (0.0, 0.0, 0.0)),  # type: ignore[arg-type]
        lambda: Placement((0.0, 0.0, np.nan)),
    ],
)
def test_numbers_that_are_none_make_no_shape(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match="must be|no pose"):
        make()


def test_lists_and_arrays_are_taken_for_tuples(planner: Planner) -> None:
    box = Box("x", [0.5, 0.3, 0.1], np.full(3, 0.1))  # type: ignore[arg-type]
    assert box == Box("x", (0.5, 0.3, 0.1), (0.1, 0.1, 0.1))
    planner.scene.add(box)
    in_step(planner)


class _Refused(Sphere):
    """A shape that PyBullet's binding breaks down at, as at some numbers of corners."""

    def add_to(self, bullet: object) -> int:
        raise SystemError("returned a result with an exception set")


@pytest.mark.parametrize("where", ["clearances", "checks", "filter", "world", "scene"])
def test_an_interrupted_change_has_changed_nothing(
    planner: Planner, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Wherever it comes: planner and scene agree, and shapes of one query are gone."""
    own, preparation = planner._certifier, planner._preparation
    asked = {
        "clearances": (preparation._clearances, "model"),
        "checks": (own.collisions, "_follow"),
        "filter": (own._world, "_filter"),
        "world": (own._world, "change"),
        "scene": (planner.scene, "_follow"),
    }[where]
    method, pressed = getattr(*asked), [True]

    def interrupted(*args: object) -> object:
        done = method(*args)
        if pressed:
            pressed.clear()
            raise KeyboardInterrupt
        return done

    planner.scene.add(CRATE)
    before = planner.scene.now
    monkeypatch.setattr(*asked, interrupted)
    start, goal = pairs_of("free", 1, seed=3)[0]
    for change in (
        lambda: planner.scene.add(BALL),
        lambda: planner.scene.move("crate", Placement((0.4, -0.3, 0.3))),
        lambda: planner.scene.allow("crate", "link5"),
        lambda: planner.plan(start, goal, FREE, scene=[BALL]),
    ):
        pressed[:] = [True]
        with pytest.raises(KeyboardInterrupt):
            change()
        assert planner.scene.now is before
        in_step(planner)
        assert own._world._bullet.getNumBodies() == 1 + len(own._world._shapes)
    with pytest.raises(KeyboardInterrupt), planner.scene.including([BALL]):
        pressed[:] = [True]  # while they are taken away
    assert planner.scene.now is before
    in_step(planner)
    planner.scene.add(PIPE)
    with ThreadPoolExecutor(1) as another:
        assert another.submit(lambda: planner.scene.now).result(10.0) is planner.scene.now
    planner.scene.remove("pipe")
    q = planner.robot.sample(1500, np.random.default_rng(9))
    with planner.scene.world() as world:
        np.testing.assert_array_equal(own._world.free(q), world.free(q))
    planner.scene.add(BALL)
    in_step(planner)


def test_threads_that_share_a_planner_have_their_own_shapes(planner: Planner) -> None:
    """And leave none to the other."""
    before, (start, goal) = planner.scene.now, pairs_of("free", 1, seed=3)[0]
    seen = dict[str, list[tuple[str, ...]]]()

    def ask(ball: Sphere) -> None:
        answers = [planner.plan(start, goal, FREE, scene=[ball]) for _ in range(30)]
        seen[ball.name] = [tuple(own.name for own in one.scene.workcell) for one in answers]

    def change() -> None:
        for _ in range(30):
            planner.scene.add(CRATE)
            planner.scene.remove("crate")

    balls = [Sphere(name, (0.3, 0.5, 1.0), 0.05) for name in ("one", "two")]
    waits = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(3) as pool:
            done = [*(pool.submit(ask, ball) for ball in balls), pool.submit(change)]
            for one in done:
                one.result(120.0)
    finally:
        sys.setswitchinterval(waits)
    for own, other in (("one", "two"), ("two", "one")):
        assert all(own in names and other not in names for names in seen[own])
    assert planner.scene.now.names == before.names
    in_step(planner)


def test_a_file_that_is_added_takes_no_shape_of_another_query_along(planner: Planner) -> None:
    """Nor does who looks at the scene see it; and nothing that others add is lost."""
    inside, looked, changed = Event(), Event(), Event()
    seen = dict[str, tuple[str, ...]]()
    said = SceneFile(shapes={"pipe": PIPE})

    def ask() -> None:
        with planner.scene.including([BALL]):
            assert "ball" in planner.scene.now.names
            inside.set()
            assert looked.wait(30.0), "who looks does not wait"
            assert not changed.wait(0.3), "who changes it does"

    def read() -> None:
        inside.wait(30.0)
        seen["names"] = planner.scene.now.names
        looked.set()

    def load() -> None:
        inside.wait(30.0)
        said.into(planner.scene)
        changed.set()

    def add() -> None:
        inside.wait(30.0)
        planner.scene.add(CRATE)
        changed.set()

    with ThreadPoolExecutor(4) as pool:
        for one in [pool.submit(work) for work in (ask, read, load, add)]:
            one.result(60.0)
    assert "ball" not in seen["names"]
    assert {"pipe", "crate"} < set(planner.scene.now.names)
    assert "ball" not in planner.scene.now.names
    in_step(planner)


def test_two_that_are_quiet_at_once_leave_the_output_as_it_was() -> None:
    before, both = [os.fstat(stream).st_ino for stream in (1, 2)], Barrier(2)

    def silent(waits_s: float) -> None:
        both.wait(10.0)
        with quiet():
            time.sleep(waits_s)

    with ThreadPoolExecutor(2) as pool:
        for one in [pool.submit(silent, waits) for waits in (0.05, 0.1)]:
            one.result(10.0)
    assert [os.fstat(stream).st_ino for stream in (1, 2)] == before


def test_what_pybullet_breaks_down_at_is_refused_by_its_name(planner: Planner) -> None:
    before = planner.scene.now
    with pytest.raises(RobotError, match="'odd': PyBullet can't make it"):
        planner.scene.add(CRATE, _Refused("odd", (0.5, 0.0, 1.0), 0.05))
    assert planner.scene.now is before
    in_step(planner)


def test_a_mesh_that_comes_again_is_no_further_shape_of_pybullets(
    planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which frees none: one moved, two of the same, one of which goes, and another content."""
    bullet, made = planner._certifier._world._bullet, list[object]()
    create = bullet.createCollisionShape

    def counted(**geometry: object) -> object:
        made.append(geometry)
        return create(**geometry)

    monkeypatch.setattr(bullet, "createCollisionShape", counted)
    file, scene = cube(tmp_path / "own.obj", 0.05), planner.scene
    cloud = np.random.default_rng(7).uniform(-0.1, 0.1, (50, 3))
    mesh = Mesh("one", file, Placement((0.4, 0.2, 0.6)))
    scene.add(mesh, replace(mesh, name="other"), PointCloud("seen", cloud, 0.02))
    for k in range(4):
        scene.move("one", Placement((0.4, -0.2, 0.5 + 0.1 * k)))
        scene.move("seen", Placement((0.3, 0.1 * k, 0.8)))
    scene.remove("seen", "one")
    assert len(made) == 2
    in_step(planner)
    scene.add(PointCloud("seen", cloud, 0.02), mesh, replace(mesh, name="large", scale=2.0))
    assert len(made) == 3
    cube(file, 0.1)
    for k, name in enumerate(("one", "other", "large")):
        scene.move(name, Placement((0.4, 0.3 * k, 0.7)))
    scene.add(PointCloud("more", cloud, 0.03), PointCloud("fewer", cloud[1:], 0.02))
    assert len(made) == 7
    q = planner.robot.sample(300, np.random.default_rng(8))
    with scene.world() as world:
        np.testing.assert_array_equal(planner._certifier._world.free(q), world.free(q))
