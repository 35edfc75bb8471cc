"""What every constraint must satisfy, over all kinds of held axes and both robots."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from constraint_geodesics.constraints.pose import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import Retraction, retract

AXES = [
    (0, 0, 0, 0, 0, 0),
    (0, 0, 0, 1, 1, 0),
    (0, 0, 0, 0, 1, 1),
    (0, 0, 0, 1, 0, 1),
    (0, 0, 0, 1, 1, 1),
    (0, 0, 0, 0, 0, 1),
    (0, 0, 1, 1, 1, 0),
    (1, 1, 1, 0, 0, 0),
    (0, 1, 0, 1, 0, 0),
]
REFERENCE = Pose.from_rpy([0.35, 0.1, 0.3], [np.pi / 2, 0.1, 0.4])


@pytest.fixture(params=["xarm", "kuka"])
def robot(request: pytest.FixtureRequest):
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("axes", AXES)
def test_the_jacobian_is_the_residuals_derivative(robot, axes) -> None:
    manifold = ConstraintManifold(robot, Constraint(axes, reference=REFERENCE))
    q = robot.sample(40, np.random.default_rng(0))
    # close to a half turn away the derivative grows without bound, and finite differences say
    # nothing
    q = q[np.linalg.norm(manifold.residual(q)[:, 3:], axis=-1) < 2.8]
    assert len(q) > 10
    jacobian, step = manifold.jacobian(q), 1e-6
    for joint in range(robot.dof):
        shift = step * np.eye(robot.dof)[joint]
        difference = (manifold.residual(q + shift) - manifold.residual(q - shift)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., joint], difference, atol=1e-6)


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_retraction_ends_on_the_manifold_and_leaves_its_points_alone(robot, axes, share) -> None:
    tolerance = tuple(share * 0.1 * held for held in axes)
    manifold = ConstraintManifold(robot, Constraint(axes, tolerance, REFERENCE))
    result = retract(manifold, robot.sample(200, np.random.default_rng(1)))
    assert result.converged.mean() > 0.95
    on = result.joints[result.converged]
    assert manifold.violation(on).max() <= 1e-9
    np.testing.assert_array_equal(retract(manifold, on, Retraction(accuracy=1e-8)).joints, on)


def test_retraction_is_first_order(xarm) -> None:
    """Tangent steps stay to second order: halving the step divides the retraction's correction by
    four.
    """
    manifold = ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0), reference=REFERENCE))
    result = retract(manifold, xarm.sample(50, np.random.default_rng(2)))
    q = result.joints[result.converged]
    jacobian = manifold.jacobian(q)[:, 3:5]
    direction = np.random.default_rng(3).normal(size=q.shape)
    direction -= np.einsum(
        "bji,bj->bi",
        np.linalg.pinv(jacobian).transpose(0, 2, 1),
        np.einsum("bij,bj->bi", jacobian, direction),
    )
    sizes = []
    for step in (0.02, 0.01):
        moved = q + step * direction
        sizes.append(np.linalg.norm(retract(manifold, moved).joints - moved, axis=-1))
    assert 3.0 < np.median(sizes[0] / sizes[1]) < 5.0


@given(st.floats(0.0, np.pi - 0.05), st.floats(-np.pi, np.pi))
@settings(max_examples=30, deadline=None)
def test_a_tilt_is_measured_as_its_angle(xarm, tilt: float, heading: float) -> None:
    """Roll and pitch together give the angle of the tool axis, up to upside down, whatever the
    yaw.
    """
    q = np.array([0.3, -0.4, -0.6, 0.2, 0.5, 0.1])
    position, rotation = xarm.forward(q)
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
    reference = Pose(position, turn @ rotation)
    residual = ConstraintManifold(
        xarm, Constraint((0, 0, 0, 1, 1, 0), reference=reference)
    ).residual(q)
    # the axis that should be vertical is off by the tilt, wherever that tilt points
    np.testing.assert_allclose(np.linalg.norm(residual[3:5]), tilt, atol=1e-7)
    assert residual[5] == 0.0
