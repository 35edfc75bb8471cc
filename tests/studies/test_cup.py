import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.params import Params
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import (
    CupSettings,
    Execution,
    _cup_boxes,
    carried_cup,
    execute,
)

UP_IN_TOOL = np.array([0.0, 1.0, 0.0])
"""Direction of a level cup's opening in the tool frame of the side grasp."""
QUICK = CupSettings(settle_s=0.25)


@pytest.fixture(scope="module")
def level(scene: Scene, params: Params) -> np.ndarray:
    """A configuration with the tool level, 0.4 m beside the base."""
    near = np.array([-1.35, -0.47, -0.87, -2.28, 0.34, 0.74])
    return retract(constraint_manifold(scene.robot, params.constraints["level_cup"]), near).joints


def turned(start: np.ndarray, joint: int, angle: float, rows: int = 300) -> np.ndarray:
    """A path that turns one joint by an angle [rad]."""
    path = np.tile(start, (rows, 1))
    path[:, joint] += np.linspace(0.0, angle, rows)
    return path


def timed(robot: SerialRobot, path: np.ndarray, acceleration: float = 4.0) -> np.ndarray:
    return time_parametrisation(path, robot.velocity, np.full(robot.dof, acceleration))


def test_the_cup_that_is_carried_encloses_the_one_of_the_simulation(params: Params) -> None:
    """All corners of its walls."""
    (held,) = Scene.from_params(params, "level_cup").attached
    assert held.link == params.robot.tool_link
    round_it = carried_cup(UP_IN_TOOL)
    np.testing.assert_allclose(held.shape.at.matrix[:3, 3], round_it.at.matrix[:3, 3])
    assert held.shape.at.matrix[:3, 2] @ round_it.at.matrix[:3, 2] == pytest.approx(1.0)
    assert isinstance(held.shape, Cylinder)
    assert (held.shape.length_m, held.shape.radius_m) == (round_it.length_m, round_it.radius_m)
    halves, centres, turns = _cup_boxes(CupSettings())
    for half, centre, turn in zip(halves[1:], centres[1:], turns[1:], strict=True):
        corners = np.array(list(itertools.product(*[(-x, x) for x in half])))
        corners = Rotation.from_quat(turn).apply(corners) + centre
        assert np.hypot(*corners.T[:2]).max() <= held.shape.radius_m
        assert np.abs(corners[:, 2]).max() <= 0.5 * held.shape.length_m + 1e-12
    assert not Scene.from_params(params, "tool_down").attached


def run(
    scene: Scene, path: np.ndarray, times: np.ndarray, settings: CupSettings = QUICK
) -> Execution:
    return execute(scene, path, times, UP_IN_TOOL, settings)


@pytest.fixture(scope="module")
def swung(scene: Scene, level: np.ndarray) -> Execution:
    """The level cup carried a third of a turn about the base, which keeps it level."""
    path = turned(level, 0, 2.1)
    return run(scene, path, timed(scene.robot, path))


@pytest.fixture(scope="module")
def tipped(scene: Scene, level: np.ndarray) -> Execution:
    """The cup turned over about the tool's axis, at the same pace."""
    path = turned(level, 5, -2.6)
    return run(scene, path, timed(scene.robot, path))


def in_cup(execution: Execution, frame: int) -> np.ndarray:
    """Centres of the spheres in the cup's frame (S, 3) [m]."""
    to_base = Rotation.from_quat(execution.cup_pose[frame, 3:]).as_matrix()
    return (execution.sphere_positions[frame] - execution.cup_pose[frame, :3]) @ to_base


def test_a_level_path_keeps_the_spheres(swung: Execution) -> None:
    assert swung.kept == swung.spheres == QUICK.spheres
    assert swung.kept_share == 1.0
    assert swung.largest_tilt_rad < 1e-3


def test_a_path_that_turns_the_cup_over_loses_them(tipped: Execution) -> None:
    assert tipped.kept == 0
    assert tipped.largest_tilt_rad == pytest.approx(2.6, abs=1e-3)


def test_a_level_path_spills_where_it_is_too_fast(scene: Scene, level: np.ndarray) -> None:
    path = turned(level, 0, 1.6)
    rushed = time_parametrisation(path, np.full(6, 30.0), np.full(6, 150.0))
    result = run(scene, path, rushed)
    assert result.largest_tilt_rad < 0.2
    assert result.kept < result.spheres


def test_the_spheres_rest_in_the_cup_before_and_after(swung: Execution) -> None:
    for frame in (0, -1):
        centres = in_cup(swung, frame)
        lowest = 0.5 * -QUICK.height_m + QUICK.wall_m + QUICK.sphere_radius_m
        assert centres[:, 2].min() == pytest.approx(lowest, abs=1e-3)
        # a corner of the ring is 3.5 % further out than the middle of a wall
        assert (
            np.hypot(*centres.T[:2]).max()
            < 1.036 * QUICK.inner_radius_m - QUICK.sphere_radius_m + 1e-3
        )
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + np.eye(len(centres))
        assert apart.min() > 1.9 * QUICK.sphere_radius_m


def test_spheres_that_fall_out_land_on_the_table(tipped: Execution) -> None:
    heights = tipped.sphere_positions[-1][:, 2]
    on_table = np.hypot(*tipped.sphere_positions[-1].T[:2]) < 1.2
    assert on_table.sum() > 6
    assert (heights[on_table] > 0.9 * QUICK.sphere_radius_m).all()


def test_frames_follow_the_path(scene: Scene, level: np.ndarray, swung: Execution) -> None:
    path = turned(level, 0, 2.1)
    times = timed(scene.robot, path)
    assert swung.duration_s == times[-1]
    assert swung.times[0] == 0.0
    assert swung.times[-1] == pytest.approx(times[-1] + QUICK.settle_s, abs=2 * QUICK.step_s)
    np.testing.assert_allclose(np.diff(swung.times)[:-1], 1 / 30, rtol=1e-9)
    frames = len(swung.times)
    assert swung.joints.shape == (frames, 6)
    assert swung.sphere_positions.shape == (frames, QUICK.spheres, 3)
    assert swung.cup_pose.shape == (frames, 7)
    wanted = np.interp(swung.times, times, path[:, 0])
    np.testing.assert_allclose(swung.joints[:, 0], wanted, atol=2.5e-3)
    np.testing.assert_allclose(swung.joints[-1], path[-1], atol=1e-4)
    assert swung.largest_tracking_error_rad < 1e-3


def test_the_cup_moves_with_the_tool(scene: Scene, tipped: Execution) -> None:
    position, rotation = scene.robot.forward(tipped.joints)
    from_tool = np.einsum("fji,fj->fi", rotation, tipped.cup_pose[:, :3] - position)
    front = QUICK.gap_m + QUICK.inner_radius_m + QUICK.wall_m
    np.testing.assert_allclose(
        from_tool, np.tile([0.0, 0.0, front], (len(from_tool), 1)), atol=5e-4
    )
    opening = Rotation.from_quat(tipped.cup_pose[:, 3:]).as_matrix()[:, :, 2]
    np.testing.assert_allclose(opening, rotation @ UP_IN_TOOL, atol=1e-3)


def test_motors_that_are_too_weak_show_as_tracking_error(scene: Scene, level: np.ndarray) -> None:
    path = turned(level, 0, 2.1)
    result = run(scene, path, 0.1 * timed(scene.robot, path), replace(QUICK, spheres=1))
    assert result.largest_tracking_error_rad > 0.1


SAME = """
import sys
import numpy as np
from pathlib import Path
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, execute
from constraint_geodesics.robot.kinematics import load_robot

given = np.load(sys.argv[1])
robot = load_robot(Path(str(given["urdf"])), str(given["tool"]))
table = Box("table", tuple(given["centre"]), tuple(given["size"]), ("link_base",))
settings = CupSettings(settle_s=0.25)
result = execute(Scene(robot, (table,)), given["path"], given["times"], given["axis"], settings)
np.savez(sys.argv[2], spheres=result.sphere_positions, joints=result.joints, cup=result.cup_pose)
"""


def test_the_same_call_gives_the_same_in_a_fresh_process(
    scene: Scene, level: np.ndarray, tipped: Execution, tmp_path: Path
) -> None:
    path = turned(level, 5, -2.6)
    (table,) = scene.workcell
    np.savez(
        tmp_path / "in.npz",
        urdf=str(scene.robot.urdf),
        tool=scene.robot.tool_link,
        centre=table.centre_m,
        size=table.size_m,
        path=path,
        times=timed(scene.robot, path),
        axis=UP_IN_TOOL,
    )
    subprocess.run(
        [sys.executable, "-c", SAME, tmp_path / "in.npz", tmp_path / "out.npz"], check=True
    )
    with np.load(tmp_path / "out.npz") as fresh:
        np.testing.assert_array_equal(fresh["spheres"], tipped.sphere_positions)
        np.testing.assert_array_equal(fresh["joints"], tipped.joints)
        np.testing.assert_array_equal(fresh["cup"], tipped.cup_pose)


def test_the_seed_moves_the_spheres_only(scene: Scene, level: np.ndarray) -> None:
    path = turned(level, 0, 0.3, rows=20)
    first, second = (
        run(scene, path, timed(scene.robot, path), replace(QUICK, seed=seed)) for seed in (1, 2)
    )
    assert not np.array_equal(first.sphere_positions, second.sphere_positions)
    np.testing.assert_allclose(first.joints, second.joints, atol=1e-4)
    assert first.kept == second.kept == QUICK.spheres


def test_a_cup_that_hangs_upside_down_is_empty(scene: Scene, level: np.ndarray) -> None:
    path = turned(level, 0, 0.2, rows=10)
    result = execute(scene, path, timed(scene.robot, path), -2.0 * UP_IN_TOOL, QUICK)
    assert result.kept == 0
    assert result.largest_tilt_rad == pytest.approx(np.pi, abs=1e-2)


def test_another_robot_and_axis(kuka_scene: Scene) -> None:
    robot = kuka_scene.robot
    up = np.array([0.0, 0.6, 0.0, -1.2, 0.0, -1.8, 0.0])  # the tool's z axis points up
    path = turned(up, 0, 1.0)
    assert robot.forward(up)[1][2, 2] == pytest.approx(1.0, abs=1e-9)
    result = execute(kuka_scene, path, timed(robot, path, 3.0), np.array([0.0, 0.0, 1.0]), QUICK)
    assert result.kept == result.spheres
    assert result.joints.shape[1] == 7
    assert result.cup_pose[0, 2] == pytest.approx(
        robot.forward(up)[0][2] + QUICK.gap_m + 0.05, abs=1e-3
    )
