"""Laws that hold for every shape of the workcell: its distances, its gradient, PyBullet's body."""

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
import rerun
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from constraint_geodesics.robot.kinematics import SerialRobot, load_robot, rpy_of
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.clearance import (
    ClearanceModel,
    clearance_model,
    contact_row,
    near_contacts,
    new_contacts,
)
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, RoundedBox, Shape, add_body
from constraint_geodesics.scene.shapes import AnyShape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import World

ROOM, TIP, SKIN = 0.6, 0.002, 0.004
"""Half width of the room the shapes stand in, radius of what is moved round in it, and the margin
of PyBullet's contacts [m].
"""
LINK = """<link name="{name}"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>{tip}</link>"""
JOINT = """<joint name="slide_{name}" type="prismatic"><parent link="{parent}"/>
<child link="{name}"/><axis xyz="{axis}"/>
<limit lower="-0.6" upper="0.6" velocity="1" effort="1"/></joint>"""


@dataclass(frozen=True)
class Slab(Shape):
    """A shape that the package knows nothing of: a box at an angle."""

    name: str
    exempt_links: tuple[str, ...] = ()
    centre: tuple[float, float, float] = (0.1, -0.05, 0.2)
    half_edges: tuple[float, float, float] = (0.3, 0.05, 0.12)
    turn: tuple[float, float, float] = (0.4, -0.3, 1.1)

    @property
    def at(self) -> Placement:
        return Placement(self.centre, rpy_of(Rotation.from_rotvec(self.turn).as_matrix()))

    def pieces(self) -> tuple[Piece, ...]:
        turn = Rotation.from_rotvec(self.turn).as_matrix()
        return (RoundedBox(self.centre, self.half_edges, 0.0, turn).piece(),)

    def add_to(self, bullet: Any) -> int:
        turn, kind = Rotation.from_rotvec(self.turn).as_quat().tolist(), bullet.GEOM_BOX
        size = {"shapeType": kind, "halfExtents": self.half_edges}
        return add_body(bullet, self.centre, turn, **size)

    def placed(self, at: Placement) -> "Slab":
        turn = Rotation.from_matrix(at.turn).as_rotvec()
        x, y, z = turn.tolist()
        return replace(self, centre=at.position_m, turn=(x, y, z))

    def drawn(self, rerun: Any, style: Mapping[str, Any]) -> Any:
        return None


def brick() -> Path:
    """A box about the origin, as an OBJ file."""
    file = Path(mkdtemp()) / "brick.obj"
    corners = [(x, y, z) for x in (-0.25, 0.25) for y in (-0.1, 0.1) for z in (-0.15, 0.15)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
    file.write_text("\n".join(lines) + "\n")
    return file


TURNED = Placement((0.1, 0.0, -0.2), (0.4, -0.3, 1.1))
CLOUD = np.random.default_rng(5).uniform(-0.2, 0.2, (60, 3))
SHAPES: dict[str, Shape] = {
    "box": Box("box", (0.1, 0.0, -0.2), (0.5, 0.2, 0.3)),
    "sphere": Sphere("sphere", (-0.1, 0.2, 0.1), 0.25),
    "upright capsule": Capsule("post", (0.2, 0.1, -0.3), (0.2, 0.1, 0.2), 0.15),
    "capsule that points down": Capsule("post", (0.2, 0.1, 0.2), (0.2, 0.1, -0.3), 0.15),
    "tilted capsule": Capsule("pipe", (-0.3, 0.1, -0.2), (0.25, -0.2, 0.3), 0.1),
    "capsule of no length": Capsule("ball", (0.1, 0.2, 0.1), (0.1, 0.2, 0.1), 0.2),
    "turned box": Box("box", (0.1, 0.0, -0.2), (0.5, 0.2, 0.3), rpy_rad=(0.4, -0.3, 1.1)),
    "cylinder": Cylinder("cup", Placement((0.1, -0.1, 0.0), (0.5, 0.2, 0.0)), 0.4, 0.2),
    "mesh": Mesh("part", brick(), TURNED),
    "point cloud": PointCloud("seen", CLOUD, 0.05, TURNED),
    "own": Slab("own"),
}
POINTS = st.tuples(*[st.floats(-ROOM, ROOM, allow_subnormal=False)] * 3)
kinds = pytest.mark.parametrize("kind", SHAPES)


@cache
def room() -> SerialRobot:
    """A small ball that three joints slide to any point: a configuration is its position."""
    tip = f'<collision><geometry><sphere radius="{TIP}"/></geometry></collision>'
    names, axes = ("base", "x", "y", "tip"), ("1 0 0", "0 1 0", "0 0 1")
    links = [LINK.format(name=n, tip=tip if n == "tip" else "") for n in names]
    pairs = zip(names, names[1:], axes, strict=False)
    joints = [JOINT.format(parent=a, name=b, axis=axis) for a, b, axis in pairs]
    folder = Path(mkdtemp())
    (folder / "room.urdf").write_text(f"<robot name='room'>{''.join(links + joints)}</robot>")
    return load_robot(folder / "room.urdf", "tip")


@cache
def model_of(kind: str) -> ClearanceModel:
    return clearance_model(Scene(room(), (SHAPES[kind],)))


def distance(kind: str, points: Any) -> Any:
    """Of the moving ball's centre."""
    return model_of(kind).clearance(room(), np.asarray(points, float)) + TIP


COVERED_M = {Cylinder: 0.0015, Mesh: 0.0015, PointCloud: 0.09}
"""By how much what bounds a shape may lie further out, for those that it is not exact for."""
SURFACES = (Mesh, PointCloud)
"""What PyBullet knows by its surface alone."""


def closed_form(shape: Shape, point: np.ndarray) -> float:
    """The distance by a formula of each kind."""
    if isinstance(shape, PointCloud):
        points = CLOUD @ shape.pose.turn.T + shape.pose.position_m
        return float(np.linalg.norm(points - point, axis=1).min()) - shape.radius_m
    if isinstance(shape, Sphere):
        return float(np.linalg.norm(point - shape.centre_m)) - shape.radius_m
    if isinstance(shape, Capsule):
        a, line = np.array(shape.from_m), np.subtract(shape.to_m, shape.from_m)
        share = np.clip((point - a) @ line / max(line @ line, 1e-12), 0.0, 1.0)
        return float(np.linalg.norm(point - a - share * line)) - shape.radius_m
    if isinstance(shape, Cylinder):
        local = (point - shape.pose.position_m) @ shape.pose.turn
        out = np.array([np.linalg.norm(local[:2]) - shape.radius_m, np.abs(local[2])])
        out[1] -= 0.5 * shape.length_m
        return float(np.linalg.norm(np.maximum(out, 0.0)) + min(out.max(), 0.0))
    if isinstance(shape, Mesh):
        local, half = (point - shape.pose.position_m) @ shape.pose.turn, np.array([0.25, 0.1, 0.15])
    elif isinstance(shape, Box):
        local = (point - shape.centre_m) @ Placement((0.0, 0.0, 0.0), shape.rpy_rad).turn
        half = 0.5 * np.array(shape.size_m)
    else:
        assert isinstance(shape, Slab)
        local = Rotation.from_rotvec(shape.turn).inv().apply(point - shape.centre)
        half = np.array(shape.half_edges)
    out = np.abs(local) - half
    return float(np.linalg.norm(np.maximum(out, 0.0)) + min(out.max(), 0.0))


@kinds
@given(point=POINTS)
@settings(max_examples=200)
def test_the_distance_is_that_of_the_formula(kind: str, point: tuple[float, ...]) -> None:
    """Outside; inside it is known how deep in some directions."""
    wanted, found = closed_form(SHAPES[kind], np.array(point)), distance(kind, point)
    if (covered := COVERED_M.get(type(SHAPES[kind]))) is not None:
        assert found <= wanted + 1e-6
        if wanted > 0.0:
            assert found > wanted - covered
        return
    if wanted > -inscribed(SHAPES[kind]):
        assert found == pytest.approx(wanted, abs=1e-6)
    else:
        assert 3.0 * wanted - 1e-6 <= found <= wanted + 1e-6


def inscribed(shape: Shape) -> float:
    """How deep a point may lie in it and still be outside of its core [m]."""
    return getattr(shape, "radius_m", 0.0) - 1e-6 if not isinstance(shape, Box) else 0.0


@kinds
@given(a=POINTS, b=POINTS)
@settings(max_examples=200)
def test_the_distance_changes_no_faster_than_the_point(kind: str, a: Any, b: Any) -> None:
    apart = np.linalg.norm(np.subtract(a, b))
    there, here = distance(kind, a), distance(kind, b)
    if min(there, here) > 0.0:
        assert abs(there - here) <= apart + 1e-6


@kinds
@given(point=POINTS)
@settings(max_examples=100)
def test_the_gradient_is_a_unit_vector_that_finite_differences_agree_with(
    kind: str, point: tuple[float, ...]
) -> None:
    q, chain, model = np.array(point), room().chain, model_of(kind).arrays
    contacts, row = new_contacts(model, 3), np.empty(3)
    assert near_contacts(chain, model, q, np.inf, contacts) == 1
    contact_row(chain.prismatic, contacts, 0, row)
    assert np.linalg.norm(row) == pytest.approx(1.0, abs=1e-9)
    steps = 1e-4 * np.eye(3)
    here, above, below = distance(kind, q), distance(kind, q + steps), distance(kind, q - steps)
    # outside, where no kink is nearby
    if here > 0.001 and np.abs(above + below - 2.0 * here).max() < 1e-7:
        np.testing.assert_allclose(row, (above - below) / 2e-4, atol=2e-3)


@kinds
def test_its_sign_is_what_pybullet_says(kind: str) -> None:
    q = np.random.default_rng(0).uniform(-0.4, 0.4, (3000, 3))
    clearance = distance(kind, q) - TIP
    with World(room(), (SHAPES[kind],)) as world:
        hit = world.label(q).workcell_collision
    assert not hit[clearance > SKIN].any()
    if isinstance(SHAPES[kind], SURFACES):
        assert 0.002 < hit.mean() < 0.6
        return
    assert 0.02 < hit.mean() < 0.6
    assert hit[clearance < -TIP].all()
    assert (np.abs(clearance) < SKIN).mean() < 0.05


@kinds
def test_a_shape_that_is_placed_elsewhere_is_the_same_there(kind: str) -> None:
    shape, at = SHAPES[kind], Placement((0.1, 0.2, -0.1), (0.3, -0.2, 0.5))
    there, back = shape.placed(at), shape.placed(Placement())
    assert there.name == shape.name
    own = np.random.default_rng(4).uniform(-0.5, 0.5, (100, 3))
    first, second = (
        clearance_model(Scene(room(), (one,))).clearance(room(), points)
        for one, points in ((back, own), (there, own @ at.turn.T + at.position_m))
    )
    # inside it is known how deep in some directions
    np.testing.assert_allclose(np.maximum(first, 0.0), np.maximum(second, 0.0), atol=1e-6)


@kinds
def test_links_that_may_touch_it_do_not_count(kind: str) -> None:
    touching = replace(SHAPES[kind], exempt_links=("tip",))  # type: ignore[type-var]
    q = np.random.default_rng(1).uniform(-ROOM, ROOM, (200, 3))
    assert (clearance_model(Scene(room(), (touching,))).clearance(room(), q) == np.inf).all()
    with World(room(), (touching,)) as world:
        assert world.free(q).all()


@kinds
def test_a_worker_gets_the_same_shape(kind: str) -> None:
    shape = SHAPES[kind]
    assert pickle.loads(pickle.dumps(shape)) == shape


def test_a_mesh_and_a_cloud_are_drawn_where_they_are() -> None:
    """To a viewer that takes numbers in single precision."""

    def numbers(batch: Any) -> np.ndarray:
        flat = batch.as_arrow_array().flatten().to_numpy()
        return flat.reshape(-1, 3)

    style = {"colors": [(1, 2, 3)]}
    corners = [(x, y, z) for x in (-0.25, 0.25) for y in (-0.1, 0.1) for z in (-0.15, 0.15)]
    mesh = SHAPES["mesh"].drawn(rerun, style)
    places = TURNED.turn @ np.transpose(corners) + np.reshape(TURNED.position_m, (3, 1))
    np.testing.assert_allclose(
        np.unique(numbers(mesh.vertex_positions).round(5), axis=0),
        np.unique(places.T.astype(np.float32).round(5), axis=0),
        atol=1e-4,
    )
    cloud = SHAPES["point cloud"].drawn(rerun, style)
    places = CLOUD @ TURNED.turn.T + TURNED.position_m
    np.testing.assert_allclose(numbers(cloud.positions), places, atol=1e-6)
    assert cloud.radii.as_arrow_array().to_pylist() == pytest.approx([0.05])


def test_either_end_of_a_capsule_may_come_first() -> None:
    q = np.random.default_rng(2).uniform(-ROOM, ROOM, (500, 3))
    there = distance("upright capsule", q)
    np.testing.assert_allclose(there, distance("capsule that points down", q), atol=1e-6)


def test_several_shapes_leave_the_smallest_distance() -> None:
    q = np.random.default_rng(3).uniform(-ROOM, ROOM, (500, 3))
    shapes = (replace(one, name=f"s{k}") for k, one in enumerate(SHAPES.values()))
    model = clearance_model(Scene(room(), tuple(shapes)))
    smallest = np.min([distance(kind, q) for kind in SHAPES], axis=0)
    np.testing.assert_allclose(model.clearance(room(), q) + TIP, smallest, atol=1e-6)


def test_a_kind_is_known_in_its_own_file_and_among_the_shapes() -> None:
    """A new kind takes two files.  The benchmarks choose a sphere as what stands in the way, so do
    the warm-up and the training of policies; the proof of collisions is tried among spheres and
    boxes, ways among thin boxes, planners among shapes of all kinds, and a cup is a cylinder.
    Some are offered to users by a short name, or read from the files of MoveIt and
    MotionBenchMaker; meshes lie beside a scene's file.
    """
    package = Path(__file__).resolve().parents[2] / "src" / "constraint_geodesics"
    chosen = {"benchmark/queries.py", "benchmark/runner.py", "studies/growth.py", "kernel_jobs.py"}
    chosen |= {"geodesics/obstacles.py"}
    tried = {"studies/collision_proof.py"}
    offered = {"__init__.py", "moveit.py", "benchmark/problem_files.py", "scene/scene_file.py"}
    tried |= {"studies/changing_scenes.py", "studies/episodes.py"}
    others = {
        Sphere: chosen | tried,
        Box: tried | {"studies/thin_shapes.py"},
        Cylinder: {"studies/cup.py"},
        Mesh: {"studies/changing_scenes.py"},
    }
    for kind in (Box, Sphere, Capsule, Cylinder, Mesh, PointCloud, Body):
        home = kind.__module__.split(".", 1)[1].replace(".", "/") + ".py"
        named = {
            file.relative_to(package).as_posix()
            for file in package.rglob("*.py")
            if kind.__module__ in file.read_text()
        }
        known = {"scene/shapes.py", "studies/clutter.py", *offered}
        assert named <= known | others.get(kind, set())
        assert f"class {kind.__name__}(Shape)" in (package / home).read_text()
    assert "Capsule" in str(AnyShape)
