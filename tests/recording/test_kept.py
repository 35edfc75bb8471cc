"""What a constraint keeps, and the tool and its load, drawn in recordings and read back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.planner_fixtures import packaged_planner
from tests.recording.files import HELD_AT, TABLE, column, seconds

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.recording.colours import CARRIED, GROUND, OTHER
from constraint_geodesics.recording.kept import LEVEL_M, UPRIGHT_M
from constraint_geodesics.recording.recording import PathRecord, read_recording, record_path
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.studies import episodes as study

FRAMES, TOLERANCE = 12, 0.17
LINE = "LineStrips3D:strips"


def straight(change=0.3):
    planner = packaged_planner()
    start = planner.nodes("level_cup")[0]
    return planner.scene.robot, start + np.linspace(0.0, change, 20)[:, None] * np.ones(6)


def recorded(folder, constraint, joints, robot):
    file = folder / "path.rrd"
    path = PathRecord("planner", "kept", 0, 0, joints, "", meshes=False)
    record_path(file, path, ConstraintManifold(robot, constraint), [], frames=FRAMES)
    return file


def packed(colour, alpha=255):
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | alpha


def drawn(file):
    return {entity for entity in read_recording(file).entity_paths if entity.startswith("/tool/")}


def test_a_planned_path_shows_the_cup_that_it_was_planned_with(tmp_path):
    planner = packaged_planner()
    with study.carrying(planner, "level_cup"):
        path = study.drawn(planner, "level_cup", 1, 0).first
    assert path.status == "solved"
    cup = path.scene.attached[0].shape
    path.record(tmp_path / "path.rrd", frames=FRAMES)
    shown = tmp_path / "path.rrd"
    assert column(shown, "/attached/cup", "CoordinateFrame:frame") == [["link6"]]
    np.testing.assert_allclose(
        column(shown, "/attached/cup", "Cylinders3D:lengths"), [[cup.length_m]], atol=1e-7
    )
    centres = column(shown, "/attached/cup", "Cylinders3D:centers")
    np.testing.assert_allclose(centres, [[cup.pose.position_m]], atol=1e-7)
    assert column(shown, "/attached/cup", "Cylinders3D:colors") == [[packed(CARRIED)]]
    assert column(shown, "/workcell/table", "Boxes3D:colors") == [[packed(GROUND)]]
    # the cup's axis and the level plane's stay upright
    turns = np.array(column(shown, "/tool/frame", "Transform3D:quaternion"))[:, 0]
    (up,) = column(shown, "/tool/frame/upright", "Arrows3D:vectors")[0]
    upright = Rotation.from_quat(turns).apply(up)
    np.testing.assert_allclose(upright, np.tile([0, 0, UPRIGHT_M], (FRAMES, 1)), atol=1e-3)
    assert column(shown, "/tool/place/level", "Cylinders3D:radii")[0] == pytest.approx([LEVEL_M])


def test_what_the_arm_stands_on_is_light_and_what_it_must_not_touch_dark(tmp_path):
    robot, joints = straight()
    ground, ball = replace(TABLE, exempt_links=("link_base",)), Sphere("ball", (0.5, 0.0, 0.5), 0.1)
    path = PathRecord("planner", "free", 0, 0, joints, "", meshes=False)
    manifold = ConstraintManifold(robot, Constraint((0,) * 6))
    record_path(tmp_path / "path.rrd", path, manifold, [ground, ball], frames=FRAMES)
    for entity, kind, colour in (("table", "Boxes3D", GROUND), ("ball", "Ellipsoids3D", OTHER)):
        found = column(tmp_path / "path.rrd", f"/workcell/{entity}", f"{kind}:colors")
        assert found == [[packed(colour)]]


def test_without_a_load_no_cup_is_drawn(tmp_path):
    planner = packaged_planner()
    start, goal = planner.nodes("level_cup")[[0, 1]]
    path = planner.plan(start, goal, "level_cup")
    path.record(tmp_path / "path.rrd", frames=FRAMES)
    entities = read_recording(tmp_path / "path.rrd").entity_paths
    assert not any("attached" in entity for entity in entities)
    assert "/tool/place/level" in entities


def test_the_tool_s_frame_and_place_move_with_it(tmp_path):
    robot, joints = straight()
    file = recorded(tmp_path, Constraint((0,) * 6), joints, robot)
    positions, rotations = robot.forward(read_recording(file).joints)
    for entity in ("/tool/frame", "/tool/place"):
        places = np.array(column(file, entity, "Transform3D:translation"))[:, 0]
        np.testing.assert_allclose(places, positions, atol=1e-6)
        assert seconds(file, entity, "Transform3D:translation") == pytest.approx(
            read_recording(file).times
        )
    turns = np.array(column(file, "/tool/frame", "Transform3D:quaternion"))[:, 0]
    np.testing.assert_allclose(Rotation.from_quat(turns).as_matrix(), rotations, atol=1e-6)
    assert len(column(file, "/tool/frame/axes", "Arrows3D:vectors")[0]) == 3
    assert not drawn(file) & {"/tool/place/level", "/tool/region", "/tool/frame/upright"}


@pytest.mark.parametrize("free", [0, 1, 2])
def test_the_direction_that_is_kept_stands_on_its_plane_within_its_limit(free, tmp_path):
    robot, joints = straight()
    axes = tuple(int(k != free) for k in range(3))
    loose = tuple(TOLERANCE * k for k in axes)
    kept = Constraint((0, 0, 0, *axes), (0.0, 0.0, 0.0, *loose), HELD_AT)
    file = recorded(tmp_path, kept, joints, robot)
    held = ConstraintManifold(robot, kept)
    shown = read_recording(file).joints
    turns = np.array(column(file, "/tool/frame", "Transform3D:quaternion"))[:, 0]
    (arrow,) = column(file, "/tool/frame/upright", "Arrows3D:vectors")[0]
    tips = Rotation.from_quat(turns).apply(arrow)
    angle = np.arccos(np.clip(tips[:, free] / UPRIGHT_M, -1.0, 1.0))
    size = np.linalg.norm(held.residual(shown)[:, 3:], axis=1)
    np.testing.assert_allclose(angle, size, atol=1e-3)  # single precision, near upright
    (circle,) = column(file, "/tool/place/level", LINE)[0]
    np.testing.assert_allclose(np.linalg.norm(circle, axis=1), UPRIGHT_M, atol=1e-6)
    np.testing.assert_allclose(np.array(circle)[:, free], UPRIGHT_M * np.cos(TOLERANCE), atol=1e-6)
    turn = column(file, "/tool/place/level", "Cylinders3D:quaternions")[0][0]
    normal = Rotation.from_quat(turn).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.abs(normal), np.eye(3)[free], atol=1e-6)


def test_a_held_orientation_and_height_are_drawn_as_axes_and_a_plane(tmp_path):
    robot, joints = straight()
    kept = Constraint((0, 0, 1, 1, 1, 1), (0, 0, 0.01, 0, 0, 0), HELD_AT)
    file = recorded(tmp_path, kept, joints, robot)
    lines = np.array(column(file, "/tool/place/kept", LINE)[0])
    np.testing.assert_array_equal(lines[:, 0], 0.0)
    directions = lines[:, 1] / np.linalg.norm(lines[:, 1], axis=1, keepdims=True)
    np.testing.assert_allclose(directions, HELD_AT.rotation.T, atol=1e-6)
    centre = column(file, "/tool/region", "Boxes3D:centers")[0][0]
    half = column(file, "/tool/region", "Boxes3D:half_sizes")[0][0]
    assert centre[2] == pytest.approx(HELD_AT.position[2])
    assert half[2] == pytest.approx(0.01)
    tool = robot.forward(read_recording(file).joints)[0]
    assert (np.abs(tool - centre)[:, :2] < np.array(half)[:2]).all()
    exact = replace(kept, tolerance=(0.0,) * 6)
    flat = column(recorded(tmp_path, exact, joints, robot), "/tool/region", "Boxes3D:half_sizes")
    assert 0.0 < flat[0][0][2] < 0.001
