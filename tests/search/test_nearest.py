"""The nearest configurations of a constraint."""

import numpy as np
import pytest
from tests.planner_fixtures import NAMES, manifold_of, nodes_of, packaged_planner

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.functions import tip_on_sphere
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.search.nearest import nearest_on


def manifolds() -> dict[str, ConstraintManifold]:
    planner = packaged_planner()
    found = {name: manifold_of(planner, name) for name in NAMES}
    pose = Pose(*planner.robot.forward(nodes_of("level_cup")[0][0]))
    box = Constraint((1, 1, 1, 1, 1, 0), (0.05, 0.02, 0.0, 0.1, 0.2, 0.0), pose)
    found["box"] = ConstraintManifold(planner.robot, box)
    sphere = tip_on_sphere(planner.robot, (0.4, 0.0, 0.1), 0.3)
    found["sphere"] = ConstraintManifold(planner.robot, sphere)
    return found


def beaten(manifold: ConstraintManifold, own: np.ndarray, q: np.ndarray) -> bool:
    """Whether the constraint is nearer somewhere within some 1e-3 rad, by more than the square of
    that.
    """
    robot, rng = manifold.robot, np.random.default_rng(0)
    near = own + 1e-3 * rng.normal(size=(200, robot.dof))
    beside = retract(manifold, near)
    inside = beside.converged & (robot.limit_distance(beside.joints) >= 0.0)
    away = np.linalg.norm(beside.joints[inside] - q, axis=1).min(initial=np.inf)
    return bool(away < np.linalg.norm(own - q) - 1e-5)


@pytest.mark.parametrize("name", [*NAMES, "box", "sphere"])
def test_what_is_near_the_constraint_goes_to_the_nearest_place(name) -> None:
    manifold, rng, tried = manifolds()[name], np.random.default_rng(3), 0
    robot = manifold.robot
    on = retract(manifold, robot.sample(60, rng))
    for q in on.joints[on.converged & (robot.limit_distance(on.joints) > 0.1)][:15]:
        off = q + 0.02 * rng.normal(size=robot.dof)
        (own,) = nearest_on(manifold, off, off[None])
        assert manifold.violation(own) <= 1e-8
        assert np.linalg.norm(own - off) <= np.linalg.norm(q - off) + 1e-9
        assert not beaten(manifold, own, off)
        tried += 1
    assert tried >= 10


@pytest.mark.parametrize("name", [*NAMES, "box", "sphere"])
def test_from_far_away_most_end_where_nothing_beside_is_nearer(name) -> None:
    manifold, rng = manifolds()[name], np.random.default_rng(3)
    robot, ends = manifold.robot, list[bool]()
    for q in robot.sample(12, rng):
        found = nearest_on(manifold, q, np.concatenate([q[None], robot.sample(8, rng)]))
        assert (manifold.violation(found) <= 1e-7).all()
        assert (robot.limit_distance(found) >= 0.0).all()
        assert (np.diff(np.linalg.norm(found - q, axis=1)) >= 0.0).all()
        ends += [not beaten(manifold, own, q) for own in found]
    assert len(ends) >= 12
    # at the edge of a tolerance the descent still ends early now and then
    assert np.mean(ends) >= (0.6 if manifold.rows.tolerance.any() else 0.95)


def test_a_configuration_that_keeps_it_stays() -> None:
    manifold = manifold_of(packaged_planner(), "slide")
    for q in nodes_of("slide")[0][:10]:
        np.testing.assert_allclose(nearest_on(manifold, q, q[None]), q[None], atol=1e-8)


def test_where_nothing_is_found_nothing_is_said() -> None:
    robot = packaged_planner().robot
    far = Constraint((1,) * 6, reference=Pose(np.array([5.0, 0.0, 0.0]), np.eye(3)))
    q = np.zeros(robot.dof)
    assert nearest_on(ConstraintManifold(robot, far), q, q[None]).shape == (0, robot.dof)
