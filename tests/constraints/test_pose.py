import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintError,
    ConstraintManifold,
    Pose,
)


def pose_of(robot, q) -> Pose:
    return Pose(*robot.forward(q))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axes": (0, 0, 0, 1, 1)}, "5 entries"),
        ({"axes": (0, 0, 0, 2, 1, 0)}, r"axes\[roll\] = 2"),
        (
            {"axes": (0, 0, 0, 1, 1, 0), "tolerance": (0, 0, 0, -0.1, 0, 0)},
            r"tolerance\[roll\] = -0.1",
        ),
        (
            {"axes": (0, 0, 0, 1, 1, 0), "tolerance": (0, 0, 0, float("nan"), 0, 0)},
            r"tolerance\[roll\] = nan",
        ),
        ({"axes": (0, 0, 0, 1, 1, 0), "tolerance": (0.1, 0, 0, 0, 0, 0)}, r"tolerance\[x\] = 0.1"),
        (
            {"axes": (0, 0, 0, 1, 1, 0), "tolerance": (0, 0, 0, 10, 10, 0)},
            r"tolerance\[roll\] = 10: must be at most π, it is in rad",
        ),
    ],
)
def test_a_constraint_that_cannot_be_meant_is_refused(arguments, message) -> None:
    with pytest.raises(ConstraintError, match=message):
        Constraint(**arguments)


def test_a_pose_from_a_quaternion_is_the_rotation_that_it_says() -> None:
    for xyzw in np.random.default_rng(0).normal(size=(50, 4)):
        found = Pose.from_quaternion([0.1, 0.2, 0.3], 3.0 * xyzw)
        np.testing.assert_allclose(found.rotation, Rotation.from_quat(xyzw).as_matrix(), atol=1e-12)
    for wrong in ([0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0], "none"):
        with pytest.raises(ConstraintError, match="xyzw = .*: must be 4 finite numbers"):
            Pose.from_quaternion([0.1, 0.2, 0.3], wrong)


def test_a_held_axis_needs_a_reference(xarm) -> None:
    with pytest.raises(ConstraintError, match="reference"):
        ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0)))


def test_relative_to_the_start_the_start_satisfies_it(xarm) -> None:
    q = xarm.sample(1, np.random.default_rng(0))[0]
    constraint = Constraint((1, 1, 1, 1, 1, 1)).relative_to(pose_of(xarm, q))
    assert ConstraintManifold(xarm, constraint).violation(q) < 1e-12


def test_equal_angle_tolerances_are_a_cone(xarm) -> None:
    """10 degrees on roll and on pitch allow a tilt of 10 degrees in every direction, not 14 along
    the diagonal.
    """
    q = np.array([0.3, -0.4, -0.6, 0.2, 0.5, 0.1])
    position, rotation = xarm.forward(q)
    tilt = np.radians(12.0) / np.sqrt(2.0) * np.array([1.0, 1.0, 0.0])
    angle = np.linalg.norm(tilt)
    axis = tilt / angle
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ rotation
    ten = np.radians(10.0)
    cone = Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, ten, ten, 0), Pose(position, turned))
    assert ConstraintManifold(xarm, cone).violation(q) == pytest.approx(np.radians(2.0), abs=1e-7)
    box = Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, ten, 2 * ten, 0), Pose(position, turned))
    assert ConstraintManifold(xarm, box).violation(q) == 0.0


def test_position_is_in_metres(xarm) -> None:
    q = np.zeros(6)
    position, rotation = xarm.forward(q)
    above = Pose(position + np.array([0.0, 0.0, 0.05]), rotation)
    manifold = ConstraintManifold(
        xarm, Constraint((0, 0, 1, 0, 0, 0), (0, 0, 0.02, 0, 0, 0), above)
    )
    assert manifold.residual(q)[2] == pytest.approx(-0.05)
    assert manifold.inclusion(q)[2] == pytest.approx(0.03)


def test_codimension_counts_exact_axes_only() -> None:
    assert Constraint((0, 0, 1, 1, 1, 0), (0, 0, 0.1, 0, 0, 0)).codim == 2
