"""The proof of freedom from collision against PyBullet, dense sampling and known geometry."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.scene.judge import Judge
from tests.scene.mesh_files import Brick, write_bricks

from constraint_geodesics.certification import collision_kernels as kernels
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.certification.collider import Collider
from constraint_geodesics.certification.collisions import MARGIN_M
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.robot.kinematics import RobotError, load_robot
from constraint_geodesics.scene import bodies
from constraint_geodesics.scene import convex_kernels as convex
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.pieces import Piece
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.studies.collision_proof import (
    KINDS,
    Grazing,
    Trial,
    graze,
    random_shapes,
    try_scene,
)

FREE = Constraint((0,) * 6)
ABOVE_M = 2e-5
"""How far distances may lie above PyBullet's."""
LINK = """
  <link name="link{i}"><inertial><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <collision><origin xyz="0.03 0 0.08" rpy="0.2 0 0"/>
      <geometry>{shape}</geometry></collision></link>"""
JOINT = """
  <joint name="joint{i}" type="{kind}"><parent link="link{i}"/><child link="link{next}"/>
    <origin xyz="0.05 0 0.22" rpy="0.3 {i} -0.7"/><axis xyz="{axis}"/>
    <limit lower="-0.6" upper="0.7" velocity="2" effort="1"/></joint>"""
JOINTS = (("revolute", "0 1 0"), ("prismatic", "0 0.6 0.8"), ("revolute", "1 0 0"))
SHAPES = (
    '<box size="0.1 0.08 0.12"/>',
    '<cylinder radius="0.04" length="0.15"/>',
    '<sphere radius="0.06"/>',
    '<capsule radius="0.03" length="0.1"/>',
)


@pytest.fixture(scope="module")
def sliding(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """An arm of two hinges and a slide between them, of primitive shapes, among three others."""
    links = "".join(LINK.format(i=i, shape=shape) for i, shape in enumerate(SHAPES))
    joints = "".join(
        JOINT.format(i=i, next=i + 1, kind=kind, axis=axis) for i, (kind, axis) in enumerate(JOINTS)
    )
    file = tmp_path_factory.mktemp("sliding") / "arm.urdf"
    file.write_text(f'<robot name="sliding">{links}{joints}</robot>')
    around = (
        Box("box", (0.3, 0.1, 0.5), (0.1, 0.2, 0.1)),
        Capsule("pipe", (-0.3, -0.3, 0.3), (-0.2, 0.3, 0.8), 0.03),
        Sphere("ball", (0.1, -0.35, 0.6), 0.08),
    )
    return Scene(load_robot(file, "link3"), around)


@pytest.fixture(scope="module", params=["xarm", "kuka", "sliding"])
def any_scene(request: pytest.FixtureRequest) -> Scene:
    name = {"xarm": "scene", "kuka": "kuka_scene", "sliding": "sliding"}[request.param]
    found: Scene = request.getfixturevalue(name)
    return found


@pytest.fixture(scope="module")
def certifier(scene: Scene) -> Iterator[Certifier]:
    with Certifier(scene) as own:
        yield own


def lines(scene: Scene, count: int, seed: int = 0) -> list[np.ndarray]:
    """Straight joint lines between random configurations, some of them bent."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(count):
        corners = scene.robot.sample(2 + k % 2, rng)
        found.append(np.ascontiguousarray(densify(corners, 0.05 + 0.3 * rng.uniform())))
    return found


# The distance of convex pieces.


def test_distances_are_pybullets(any_scene: Scene) -> None:
    """Of all pairs: hardly above, which is what the margin is for, and below by what PyBullet drops
    of a hull's corners, or by how it rounds a box's edges and draws a cylinder with few sides.
    """
    below, seen = (2e-3 if any_scene.robot.name == "sliding" else 1e-4), 0
    with Certifier(any_scene) as certifier, any_scene.world() as world:
        whole = Collider(any_scene, certifier.collisions.collider.arrays.chain, np.inf, 0.0)
        assert not whole.apart
        for q in any_scene.robot.sample(60, np.random.default_rng(0)):
            for p, (a, b) in enumerate(whole.moving):
                row = whole.arrays.pairs[[p]]
                first, last = int(row[0, 2]), int(row[0, 3])
                keep = np.concatenate([row, whole.arrays.pairs[first:last]])
                keep[0, 2:4] = (1, len(keep)) if last > first else (0, 0)
                alone = whole.arrays._replace(pairs=keep, top=1)
                own, _ = kernels.nearest_pair(alone, q, 0.3)
                theirs = world.distance(q, a, b, 0.3)
                if own < 0.29 and theirs > 0.0:
                    seen += 1
                    assert -below < own - theirs < ABOVE_M
    assert seen > 300


def test_limits_that_are_no_numbers_prove_nothing(scene: Scene) -> None:
    with Certifier(scene) as certifier:
        arrays = certifier.collisions.collider.arrays
        for low, high in ((-np.inf, np.inf), (np.nan, 1.0)):
            limits = np.array([[low] * 6, [high] * 6])
            assert not any(
                kernels.never_meets(arrays, body, limits, MARGIN_M, 1000)
                for body in range(arrays.top)
            )


def test_pairs_that_are_left_out_never_meet(any_scene: Scene) -> None:
    with Certifier(any_scene) as certifier, any_scene.world() as world:
        named = certifier.collisions.collider.apart
        for q in any_scene.robot.sample(300, np.random.default_rng(3)):
            assert all(world.distance(q, *keys, 0.0) == np.inf for keys in named)
    assert named


def test_cylinders_balls_and_capsules_reach_as_far_as_they_should(sliding: Scene) -> None:
    """In the URDF and in the scene, with PyBullet as the measure: the prism around a cylinder is
    the largest difference.
    """
    seen = {True: 0, False: 0}
    with Certifier(sliding) as certifier, sliding.world() as world:
        for q in sliding.robot.sample(400, np.random.default_rng(1)):
            clearance = certifier.collisions.clearance(q)
            if abs(clearance) > 2e-4:
                seen[clearance > 0.0] += 1
                assert world.is_free(q) == (clearance > 0.0)
    assert min(seen.values()) > 20


def furthest(arrays: kernels.Bodies, node: int, direction: np.ndarray) -> tuple[float, float]:
    """How far a piece reaches along a direction, from the worst corner to begin at; and the
    truth.
    """
    hulls, first = arrays.hulls, int(arrays.nodes[node, convex.CORNER])
    corners, waiting = {first}, [first]
    while waiting:
        at = waiting.pop()
        beside = {at + int(k) for k in hulls[at + 4 : at + 4 + int(hulls[at + 3])]}
        waiting += beside - corners
        corners |= beside
    true = max(float(hulls[k : k + 3] @ direction) for k in corners)
    return min(convex.furthest(hulls, k, *direction)[1] for k in corners), true


def nodes_of_pieces(own: Collider) -> Iterator[tuple[int, bodies.Body, Piece]]:
    """Where each piece is among the nodes; a body of several has one of its own before them."""
    first = 0
    for body in own.bodies.values():
        several = len(body.pieces) > 1
        for k, piece in enumerate(body.pieces):
            yield first + several + k, body, piece
        first += several + len(body.pieces)


def test_a_way_along_edges_leads_to_the_furthest_corner(any_scene: Scene) -> None:
    rng = np.random.default_rng(0)
    with Certifier(any_scene) as certifier:
        own = certifier.collisions.collider
        for node, *_ in nodes_of_pieces(own):
            for direction in rng.normal(size=(10, 3)):
                np.testing.assert_allclose(*furthest(own.arrays, node, direction), atol=1e-12)


def test_corners_that_all_but_coincide_hide_nothing(tmp_path: Path, scene: Scene) -> None:
    """A cylinder's mesh whose corners are there several times, but for rounding."""
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn), np.ones(48)], 1)
    corners = np.concatenate([rim, rim * [1.0, 1.0, -1.0]]) * [0.04, 0.04, 0.07]
    rng = np.random.default_rng(0)
    for noise in (0.0, 1e-15, 1e-13, 1e-9):
        many = np.concatenate([corners + noise * rng.normal(size=corners.shape) for _ in range(4)])
        faces = [
            f"f {i + 1} {(i + 7) % len(many) + 1} {(i + 59) % len(many) + 1}" for i in range(384)
        ]
        text = [f"v {x!r} {y!r} {z!r}" for x, y, z in many.tolist()]
        (tmp_path / "wall.obj").write_text("\n".join([*text, *faces]))
        walled = replace(scene, workcell=(room(tmp_path, '<mesh filename="wall.obj"/>'),))
        with Certifier(walled) as certifier:
            arrays = certifier.collisions.collider.arrays
            for direction in rng.normal(size=(100, 3)):
                found, true = furthest(arrays, len(arrays.nodes) - 1, direction)
                truth = ((corners + np.ones(3)) @ direction).max()
                np.testing.assert_allclose((found, true), truth, atol=1e-6)


def test_what_one_frame_carries_is_left_out_only_where_it_is_apart(scene: Scene) -> None:
    """Boxes and balls at any distance of a link: the balls around them say no more than is so."""
    rng, left_out, near = np.random.default_rng(5), 0, 0
    carried = []
    for k, place in enumerate(rng.uniform(-0.1, 0.1, (40, 3)).tolist()):
        shape: Shape = Sphere(f"ball {k}", tuple(place), 0.03)
        if k % 2:
            shape = Box(f"box {k}", tuple(place), (0.1, 0.02, 0.05), rpy_rad=(0.3 * k, 0.2, 0.1))
        carried.append(Attached(shape, "link6" if k % 3 else "link5"))
    with Certifier(replace(scene, attached=tuple(carried))) as certifier:
        check, own = certifier.collisions, certifier.collisions.collider
        looked_at, every = own.rigid(MARGIN_M), own.rigid(np.inf)
        for row, pair in every.items():
            apart = check._near(row, np.zeros(6))
            frames = {own.bodies[key].frame for key in pair}
            assert len(frames) == 1
            if row not in looked_at:
                left_out += 1
                assert apart >= MARGIN_M
            near += apart < MARGIN_M
    assert left_out > 100
    assert near > 20


# The proof along a path.


def test_bodies_move_no_further_than_the_bounds_say(any_scene: Scene) -> None:
    """The two laws that the proof rests on, for every piece and the frame of every joint: how far
    corners move, and how far they get off the line between the ends of their way.
    """
    rng, dof = np.random.default_rng(2), any_scene.robot.dof
    shares = np.linspace(0.0, 1.0, 21)
    moved, bent = [0.0], [0.0]
    with Certifier(any_scene) as certifier:
        own = certifier.collisions.collider
    frames = np.empty((len(shares), dof + 1, 12))
    for _ in range(20):
        start = any_scene.robot.sample(1, rng)[0]
        step = rng.uniform(-0.5, 0.5, dof)
        steps = np.stack([np.abs(step), np.abs(step), np.zeros(dof)])
        for frame, share in zip(frames, shares, strict=True):
            kernels.joint_frames(own.arrays.chain, start + share * step, frame)
        for node, body, piece in nodes_of_pieces(own):
            for below in range(body.frame):
                nodes = own.arrays.nodes[[node, node]]
                nodes[0, convex.FRAME] = below
                motion, bend = kernels._bounds_of_motion(nodes, 0, 1, steps)
                seen = np.stack([seen_from(frame, below, body.frame, piece) for frame in frames])
                away = np.linalg.norm(seen - seen[0], axis=2).max()
                line = seen[0] + shares[:, None, None] * (seen[-1] - seen[0])
                off = np.linalg.norm(seen - line, axis=2).max()
                assert away <= motion + 1e-12
                assert off <= bend + 1e-12
                moved.append(away / motion)
                bent.append(off / bend)
    assert max(moved) > 0.8
    assert max(bent) > 0.8


def seen_from(frames: np.ndarray, below: int, own: int, piece: Piece) -> np.ndarray:
    """A piece's corners in the frame below."""
    lower, upper = frames[below], frames[own]
    in_base = piece.corners @ upper[3:].reshape(3, 3).T + upper[:3]
    return (in_base - lower[:3]) @ lower[3:].reshape(3, 3)


def test_what_is_proven_holds_everywhere(any_scene: Scene) -> None:
    """Against the distances at dense configurations: the proven one is less, and at least half of
    what is attained; and a judge of its own finds nothing that touches.
    """
    proven = 0
    with Certifier(any_scene) as certifier, Judge(any_scene, {}) as judge:
        check, arrays = certifier.collisions, certifier.collisions.collider.arrays
        for rows in lines(any_scene, 60):
            undecided = np.empty((4, 4))
            bound, attained, count = kernels.prove_apart(arrays, rows, MARGIN_M, undecided)
            truth = min(check.clearance(q) for q in densify(rows, 0.01))
            # between the configurations a distance may still fall by what the bodies move
            assert attained >= truth - 0.01
            if count == 0:
                proven += 1
                assert MARGIN_M < bound <= truth
                assert not touches(judge, rows)
                assert bound >= min(0.5 * attained, attained) - 1e-12
            else:
                assert truth < 0.01
    assert proven > 10


def touches(judge: Judge, rows: np.ndarray) -> bool:
    """Anything that must not, at every 0.005 rad of a path."""
    return any(judge.deepest(q)[0] < -1e-6 for q in densify(rows, 0.005))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_certified_touches_nothing_by_a_judge_of_its_own(scene: Scene, kind: str) -> None:
    """Which asks other pairs of bodies than the certifier, should that leave one out."""
    shapes = random_shapes(kind, np.random.default_rng(2))
    around, certified, refused = replace(scene, workcell=(*scene.workcell, *shapes)), 0, 0
    with Certifier(around) as certifier, Judge(around, {}) as judge:
        for rows in lines(around, 30):
            if certifier.collisions.along(rows).violation is None:
                certified += 1
                assert not touches(judge, rows)
            else:
                refused += 1
    assert certified > 3
    assert refused > 3


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_certified_that_touches(scene: Scene, kuka_scene: Scene, kind: str) -> None:
    """Lines among shapes, PyBullet asked at every 0.005 rad."""
    for seed, own in enumerate((scene, kuka_scene)):
        for counts in try_scene(Trial(own, "arm", kind, seed, 40)):
            assert counts.wrongly_certified == 0
            assert counts.certified >= counts.free - 1
            assert counts.undecided <= 1
            assert 10 < counts.free <= counts.paths


@pytest.mark.parametrize("kind", ["sphere", "box"])
def test_a_shape_that_is_only_just_missed(scene: Scene, kind: str) -> None:
    """A millimetre smaller than what touches it is certified, half a millimetre larger is not."""
    start = np.array([0.3, -0.4, -0.9, 0.2, 1.2, 0.1])
    rows = densify(np.stack([start, start + np.array([1.2, 0.3, -0.2, 0.4, 0.1, 1.0])]), 0.05)
    grazed = graze(Grazing(scene, kind, rows, (0.35, 0.45, 0.35)))
    assert grazed is not None
    assert grazed.beside_smaller
    assert not grazed.beside_larger


def test_a_thin_plate_between_two_rows_is_seen(scene: Scene) -> None:
    """Both rows are free of it, and so is all but a little of the way."""
    rows = np.array([[q, -0.4, -0.9, 0.0, 1.2, 0.0] for q in (-0.5, 0.5)])
    middle = rows.mean(axis=0)
    x, y, z = scene.robot.skeleton(middle[None])[0, -1].tolist()
    plate = Box("plate", (x, y, z), (0.05, 1e-4, 0.05))
    with_plate = replace(scene, workcell=(*scene.workcell, plate))
    with with_plate.world() as world:
        assert world.free(rows).all()
        assert not world.is_free(middle)
    with Certifier(with_plate) as certifier:
        assert certifier.collisions.along(rows).violation.kind == "workcell_collision"


def test_many_rows_and_few_say_the_same(certifier: Certifier, scene: Scene) -> None:
    for line in lines(scene, 20, seed=5):
        ends = np.ascontiguousarray(line[[0, -1]])
        finer = np.ascontiguousarray(densify(ends, 0.02))
        found = {certifier.collisions.is_clear(rows) for rows in (ends, finer)}
        assert len(found) == 1


def test_a_path_that_stands_still(certifier: Certifier) -> None:
    q = np.array([0.3, -0.4, -0.9, 0.2, 1.2, 0.1])
    found = certifier.collisions.along(np.stack([q, q, q]))
    assert found.violation is None
    assert 0.5 * certifier.collisions.clearance(q) <= found.clearance_m


# What PyBullet is asked, and what is said.


def beside_the_tool(scene: Scene, q: np.ndarray, gap_m: float) -> Scene:
    """With a ball that is so far from the arm at q, by PyBullet's distance."""
    place = scene.robot.forward(q)[0] * [1.3, 1.3, 1.0]
    x, y, z = map(float, place)
    with replace(scene, workcell=(Sphere("ball", (x, y, z), 0.01),)).world() as world:
        from constraint_geodesics.scene.world import BodyKey

        links = ("link3", "link4", "link5", "link6")
        apart = min(world.distance(q, BodyKey("ball", True), BodyKey(n, False), 1.0) for n in links)
    ball = Sphere("ball", (x, y, z), 0.01 + apart - gap_m)
    return replace(scene, workcell=(*scene.workcell, ball))


@pytest.mark.parametrize(
    ("gap_m", "asked", "kind"), [(5e-4, 0, None), (3e-5, 1, None), (-3e-5, 0, "workcell_collision")]
)
def test_pybullet_decides_where_bodies_all_but_touch(
    scene: Scene, gap_m: float, asked: int, kind: str | None
) -> None:
    q = np.array([0.3, -0.4, -0.9, 0.2, 1.2, 0.1])
    # the base alone turns away from the ball, so that the gap is least at the first row
    with Certifier(beside_the_tool(scene, q, gap_m)) as certifier:
        for side in (-0.01, 0.01):
            rows = np.stack([q, q + np.array([side, 0, 0, 0, 0, 0])])
            found = certifier.collisions.along(rows)
            if found.violation is None:
                break
    assert (found.violation.kind if found.violation else None) == kind
    assert min(found.asked, 1) == asked


def test_a_collision_is_named(certifier: Certifier, scene: Scene) -> None:
    """By both bodies, where it is."""
    rows = densify(np.stack([np.zeros(6), np.array([0.0, 1.3, -0.5, 0.0, 0.0, 0.0])]), 0.05)
    violation = certifier.certify(rows, FREE).violation
    assert violation.kind == "workcell_collision"
    assert " touches table on the line from row " in violation.message
    assert 0 <= violation.row < len(rows)


def meeting_half_way(scene: Scene, kind: str, folder: Path) -> tuple[Scene, np.ndarray]:
    """A scene in which a carried shape comes to touch one around the arm in the middle of a line of
    joint 0, to 0.1 µm, and overlaps it by millimetres from there on; the line's middle.
    """
    file = write_bricks(folder / "own.obj", [Brick((0.0, 0.0, 0.0), (0.03, 0.03, 0.03))])
    q, origin = np.array([0.3, -0.5, -1.2, 0.2, 0.5, 0.1]), Placement()
    held, other = {
        "mesh and mesh": (Mesh("held", file), Mesh("other", file)),
        "mesh and cloud": (Mesh("held", file), PointCloud("other", [[0.0, 0.0, 0.0]], 0.05)),
        "cloud and ball": (
            PointCloud("held", [[0.0, 0.0, 0.0]], 0.05),
            Sphere("other", origin.position_m, 0.05),
        ),
    }[kind]
    carried = Attached(
        held.placed(Placement((0.0, 0.0, 0.2))), "link6", ("link3", "link4", "link5")
    )
    with scene.world() as world:
        (link,) = world.link_poses(q, ["link6"])
    middle = (link @ carried.shape.at.matrix)[:3, 3]
    ahead = np.cross([0.0, 0.0, 1.0], middle)
    ahead /= np.linalg.norm(ahead)

    def at(way: float) -> Scene:
        place = Placement(tuple((middle + way * ahead).tolist()), (0.0, 0.0, 0.0))
        return replace(scene, workcell=(*scene.workcell, other.placed(place)), attached=(carried,))

    low, high = 0.0, 0.3
    with Certifier(at(high)) as own:
        while high - low > 1e-7:
            way = 0.5 * (low + high)
            own.change(at(way))
            low, high = (low, way) if own.collisions.clearance(q) > 0.0 else (way, high)
    return at(high), q


@pytest.mark.parametrize("kind", ["mesh and mesh", "mesh and cloud", "cloud and ball"])
def test_what_pybullet_does_not_see_is_no_way_through(
    scene: Scene, tmp_path: Path, kind: str
) -> None:
    """It has no distance of two meshes, and less than the balls of a cloud: that bodies are apart
    in the middle of a part says nothing of its ends.
    """
    met, q = meeting_half_way(scene, kind, tmp_path)
    with Certifier(met) as own:
        for half in (0.002, 0.02, 0.1):
            line = np.stack([q - half * np.eye(6)[0], q + half * np.eye(6)[0]])
            found = own.collisions.along(line).violation
            assert found is not None
            assert found.kind == "workcell_collision"
            assert own.collisions.along(line - 0.2 * half * np.eye(6)[0]).violation is not None
            before = line - half * np.eye(6)[0] - 0.01 * np.eye(6)[0]
            assert own.collisions.along(before).violation is None


def test_boxes_are_as_sharp_as_they_are(scene: Scene) -> None:
    """PyBullet rounds the edges of two boxes that cross, by up to 0.8 mm."""
    q, edge = np.array([0.3, -0.5, -1.2, 0.2, 0.5, 0.1]), 0.1
    with scene.world() as world:
        (link,) = world.link_poses(q, ["link6"])
    carried = Attached(
        Box("held", (0.0, 0.0, 0.2), (edge, edge, edge), rpy_rad=(0.0, 0.0, 0.25 * np.pi)),
        "link6",
        ("link3", "link4", "link5"),
    )
    for overlap, free in ((3e-4, False), (-3e-4, True)):
        there = np.eye(4)  # edge across edge, along the link's x axis
        there[:3, 3] = (np.sqrt(2.0) * edge - overlap, 0.0, 0.2)
        there[:3, :3] = Placement((0.0, 0.0, 0.0), (0.0, 0.25 * np.pi, 0.0)).turn
        other = Box("other", (0.0, 0.0, 0.0), (edge, edge, edge))
        around = other.placed(Placement.of_matrix(link @ there))
        own = replace(scene, workcell=(*scene.workcell, around), attached=(carried,))
        with Certifier(own) as certifier:
            assert certifier.collisions.is_free(q) == free
            assert (certifier.collisions.along(np.stack([q, q])).violation is None) == free


@pytest.mark.parametrize(
    ("turned", "overlap", "free"),
    [(True, 3e-4, False), (True, -3e-4, True), (False, 3e-4, False), (False, 0.0, True)],
)
def test_boxes_that_never_move_against_each_other_are_as_sharp(
    scene: Scene, turned: bool, overlap: float, free: bool
) -> None:
    """Two that one link carries: edge across edge, or face on face, which is no contact."""
    edge, quarter = 0.1, 0.25 * np.pi
    away = edge * np.sqrt(2.0) if turned else edge
    rpy = ((0.0, 0.0, quarter), (0.0, quarter, 0.0)) if turned else ((0.0, 0.0, 0.0),) * 2
    held = [
        Attached(Box("one", (0.0, 0.0, 0.2), (edge,) * 3, rpy_rad=rpy[0]), "link6", ("other",)),
        Attached(Box("another", (away - overlap, 0.0, 0.2), (edge,) * 3, rpy_rad=rpy[1]), "link6"),
    ]
    others = tuple(f"link{i}" for i in range(1, 6))
    own = replace(scene, attached=tuple(replace(one, touching=others) for one in held))
    q = np.array([0.3, -0.5, -1.2, 0.2, 0.5, 0.1])
    with Certifier(own) as certifier:
        found = certifier.collisions.along(np.stack([q, q])).violation
        assert certifier.collisions.is_free(q) == free
    assert (found is None) == free
    assert free or found.message == "another and one touch at every configuration"


def test_a_ball_that_grazes_the_corner_of_a_box_touches_it(scene: Scene) -> None:
    """PyBullet rounds the corner off, and a ball's rounding is all of it matter."""
    q, radius = np.array([0.3, -0.5, -1.2, 0.2, 0.5, 0.1]), 0.05
    ball = Attached(Sphere("ball", (0.0, 0.0, 0.25), radius), "link6", ("link4", "link5"))
    with scene.world() as world:
        (link,) = world.link_poses(q, ["link6"])
    centre = (link @ np.array([0.0, 0.0, 0.25, 1.0]))[:3]
    for overlap, free in ((9e-5, False), (-9e-5, True)):
        corner = centre + (radius - overlap) / np.sqrt(3.0)
        around = Box("other", tuple(corner + 0.05), (0.1, 0.1, 0.1))
        own = replace(scene, workcell=(around,), attached=(ball,))
        with Certifier(own) as certifier:
            assert certifier.collisions.is_free(q) == free
            assert (certifier.collisions.along(np.stack([q, q])).violation is None) == free


def test_what_touches_for_good_refuses_every_path(scene: Scene) -> None:
    blocked = replace(scene, workcell=(*scene.workcell, Sphere("stone", (0.0, 0.0, 0.1), 0.05)))
    with Certifier(blocked) as certifier:
        q = np.array([0.3, -0.4, -0.9, 0.2, 1.2, 0.1])
        violation = certifier.certify(np.stack([q, q + 0.01]), FREE).violation
        assert not certifier.collisions.is_free(q)
    assert violation.kind == "workcell_collision"
    assert violation.message == "link_base and stone touch at every configuration"


# What can't be bounded.


def room(folder: Path, geometry: str) -> Body:
    """A URDF of one link."""
    file = folder / "room.urdf"
    file.write_text(
        f'<robot name="room"><link name="wall"><collision><geometry>{geometry}</geometry>'
        "</collision></link></robot>"
    )
    return Body("room", file, (1.0, 1.0, 1.0))


def solid(corners: np.ndarray) -> str:
    """Triangles over all corners, as an ASCII STL file."""
    faces = [corners[[i, i + 1, (i + 2) % len(corners)]] for i in range(len(corners) - 1)]
    rows = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face)
        + "endloop\nendfacet\n"
        for face in faces
    )
    return f"solid s\n{rows}endsolid s\n"


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ('<plane normal="0 0 1"/>', "'plane' of link 'wall' can't be bounded"),
        ('<box size="1 0 1"/>', "link 'wall': a box with size 1 0 1, which must be 3 positive"),
        ('<mesh filename="wall.dae"/>', "wall.dae is no mesh that can be read: must be OBJ or STL"),
        ('<mesh filename="none.obj"/>', "there is no mesh 'none.obj'"),
        ('<mesh filename="flat.stl"/>', "link 'wall'"),
        ('<mesh filename="empty.obj"/>', "empty.obj has no faces"),
    ],
)
def test_what_cannot_be_bounded_is_named(
    tmp_path: Path, scene: Scene, geometry: str, message: str
) -> None:
    (tmp_path / "wall.dae").write_text("<COLLADA/>")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    (tmp_path / "flat.stl").write_text(solid(flat))
    with pytest.raises(RobotError, match="room.urdf") as found:
        room(tmp_path, geometry).pieces()
    assert message in str(found.value)


def test_a_shape_without_pieces_is_refused(scene: Scene) -> None:
    """A new kind that only PyBullet knows would be left out."""

    class Bare(Box):
        pieces = Shape.pieces

    bare = Bare("bare", (0.5, 0.0, 0.5), (0.1, 0.1, 0.1))
    with pytest.raises(RobotError, match="'bare': a shape without pieces can't be bounded"):
        Certifier(replace(scene, workcell=(*scene.workcell, bare)))


def test_objects_of_a_mesh_are_pieces_of_their_own(tmp_path: Path) -> None:
    """Where they have a name, as PyBullet takes them; corners may be counted backwards, and a mesh
    scaled and turned over.
    """
    cube = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    far = [f"v {x} {y} {z}" for x in (3, 4) for y in (0, 1) for z in (0, 1)]
    faces = ["f -8 -7 -6", "f -5 -4 -3", "f -2/1 -1/2/3 -8"]
    for line, count in (("o second", 2), ("g second", 2), ("o", 1), ("g", 1)):
        (tmp_path / "wall.obj").write_text("\n".join([*cube, *faces, line, *far, *faces]))
        geometry = '<mesh filename="wall.obj" scale="0.1 -0.1 0.2"/>'
        pieces = room(tmp_path, geometry).pieces()
        assert len(pieces) == count
        corners = np.concatenate([piece.corners for piece in pieces]) - 1.0
        np.testing.assert_allclose(corners.min(axis=0), [0.0, -0.1, 0.0], atol=1e-9)
        np.testing.assert_allclose(corners.max(axis=0), [0.4, 0.0, 0.2], atol=1e-9)


def test_binary_and_plain_stl_say_the_same(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.zeros(4, np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))
    faces["c"] = corners[[[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]]
    (tmp_path / "b.stl").write_bytes(bytes(80) + (4).to_bytes(4, "little") + faces.tobytes())
    (tmp_path / "a.stl").write_text(solid(corners.astype(float)))
    binary, plain = (
        room(tmp_path, f'<mesh filename="{name}.stl"/>').pieces()[0].corners for name in "ba"
    )
    np.testing.assert_array_equal(binary, plain)


def test_a_mesh_that_is_not_convex_is_covered_by_its_hull_and_named(
    tmp_path: Path, scene: Scene
) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]], float)
    (tmp_path / "wall.stl").write_text(solid(0.1 * corners))
    (piece,) = room(tmp_path, '<mesh filename="wall.stl"/>').pieces()
    assert len(piece.corners) == 4
    np.testing.assert_allclose(piece.hollow_m, 0.02, atol=1e-9)
    added = replace(
        scene, workcell=(*scene.workcell, room(tmp_path, '<mesh filename="wall.stl"/>'))
    )
    with Certifier(added) as certifier:
        assert "hulls that cover more than the meshes of room" in certifier.collisions.rests_on
