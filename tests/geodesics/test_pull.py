import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.pull_kernels import Bounds, tangential_gradient

TIMES = 0.5 - 0.5 * np.cos(np.pi * np.arange(13) / 12)


def pulls_of(manifold, joints: np.ndarray) -> np.ndarray:
    robot, pulls = manifold.robot, np.empty_like(joints)
    bounds = Bounds(robot.lower, robot.upper, 1e-6)
    tangential_gradient(manifold.arrays, bounds, TIMES, joints, pulls)
    return pulls


def energy(joints: np.ndarray) -> np.ndarray:
    return 0.5 * (np.square(np.diff(joints, axis=1)).sum(-1) / np.diff(TIMES)).sum(1)


def curves(manifold, count: int) -> np.ndarray:
    """Retracted lines between near configurations, well inside the joint limits."""
    robot, rng = manifold.robot, np.random.default_rng(0)
    low, high = robot.lower + 0.3, robot.upper - 0.3
    start = retract(manifold, rng.uniform(low, high, (count, robot.dof))).joints
    goal = retract(manifold, start + rng.uniform(-0.4, 0.4, start.shape)).joints
    lines = start[:, None] + TIMES[:, None] * (goal - start)[:, None]
    joints = retract(manifold, lines).joints
    inside = (robot.limit_distance(joints) > 0.01).all(1) & (manifold.violation(joints) < 1e-8).all(
        1
    )
    return np.ascontiguousarray(joints[inside])


@pytest.mark.parametrize("name", ["level_cup", "slide", "fixed_orientation", "tool_down", "free"])
def test_the_pull_is_minus_the_gradient_on_the_tangent_space(scene, params, name) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints[name])
    joints = curves(manifold, 20)
    assert len(joints) >= 5
    pulls = pulls_of(manifold, joints)
    np.testing.assert_array_equal(pulls[:, [0, -1]], 0.0)
    rows = manifold.jacobian(joints[:, 1:-1])
    assert np.abs(rows @ pulls[:, 1:-1, :, None]).max() < 1e-7 * max(1.0, np.abs(pulls).max())
    step = 1e-5
    tangent = np.random.default_rng(1).normal(size=joints.shape)
    tangent -= (
        np.linalg.pinv(manifold.jacobian(joints)) @ manifold.jacobian(joints) @ tangent[..., None]
    )[..., 0]
    tangent[:, [0, -1]] = 0.0
    moved = [retract(manifold, joints + sign * step * tangent).joints for sign in (1, -1)]
    slope = (energy(moved[0]) - energy(moved[1])) / (2 * step)
    np.testing.assert_allclose(slope, -(pulls * tangent).sum((1, 2)), rtol=1e-3, atol=1e-4)


def test_a_tolerance_counts_only_on_its_bound_and_only_outward(xarm) -> None:
    q = np.random.default_rng(3).uniform(xarm.lower + 0.5, xarm.upper - 0.5, (1, xarm.dof))
    position, rotation = xarm.forward(q[0])
    bound = 0.03
    joints = np.repeat(q[:, None], len(TIMES), axis=1)
    for offset, sides in ((0.0, (False, False)), (bound, (True, False)), (-bound, (False, True))):
        pose = Pose(position - np.array([0.0, 0.0, offset]), rotation)
        manifold = ConstraintManifold(
            xarm, Constraint((0, 0, 1, 0, 0, 0), (0, 0, bound, 0, 0, 0), pose)
        )
        up = manifold.jacobian(q[0])[2]
        for direction, held in zip((1.0, -1.0), sides, strict=True):
            bent = joints.copy()
            bent[0, 5] += direction * 0.01 * up
            bent[0, 7] += (
                direction * 0.01 * up
            )  # point 6, still on its bound, is pulled towards its neighbours
            pull = pulls_of(manifold, bent)[0, 6]
            assert (abs(pull @ up) < 1e-9) == held


def test_a_joint_limit_stops_what_pulls_across_it(xarm) -> None:
    manifold = ConstraintManifold(xarm, Constraint((0,) * 6))
    joints = np.tile(0.5 * (xarm.lower + xarm.upper), (1, len(TIMES), 1))
    joints[0, :, 1] = xarm.upper[1]
    joints[0, [5, 7], 1] += 0.01
    assert pulls_of(manifold, joints)[0, 6, 1] == 0.0
    joints[0, [5, 7], 1] -= 0.02
    assert pulls_of(manifold, joints)[0, 6, 1] < 0.0
