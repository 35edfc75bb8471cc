import numpy as np

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.lift import as_executed, densify, jump_excess


def test_dense_points_keep_the_given_ones_and_the_spacing() -> None:
    joints = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 1.0]])
    dense = densify(joints, 0.3)
    assert np.linalg.norm(np.diff(dense, axis=0), axis=1).max() <= 0.3
    for row in joints:
        assert (dense == row).all(axis=1).any()
    np.testing.assert_array_equal(dense[[0, -1]], joints[[0, -1]])


def test_a_jump_is_what_no_continuous_curve_needs() -> None:
    line = np.linspace([0.0, 0.0], [2.0, 0.0], 11)
    assert jump_excess(line, np.linspace(0, 1, len(line))) == 0.0
    broken = line.copy()
    broken[5:] += [0.0, 3.0]
    assert jump_excess(broken, np.linspace(0, 1, len(broken))) > 1.0


def test_executed_rows_are_on_the_constraint(scene, params) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    q = retract(manifold, scene.robot.sample(200, np.random.default_rng(0))).joints
    pair = np.stack([q[0], q[0] + 0.05])
    pair[1] = retract(manifold, pair[1]).joints
    path = as_executed(manifold, pair, 0.01)
    assert len(path) > 5
    assert manifold.violation(path).max() <= 1e-9
    np.testing.assert_array_equal(path[[0, -1]], pair)


def test_a_change_of_branch_stays_a_jump(scene, params) -> None:
    """Rows in between do not turn a leap between two branches of the constraint into a path."""
    manifold = constraint_manifold(scene.robot, params.constraints["fixed_orientation"])
    q = retract(manifold, scene.robot.sample(80, np.random.default_rng(0))).joints
    steps = [
        np.linalg.norm(np.diff(as_executed(manifold, np.stack(pair), 0.02), axis=0), axis=1).max()
        for pair in zip(q[:40], q[40:], strict=True)
    ]
    assert sum(step > 0.5 for step in steps) > 5
