"""Tolerances that demonstrations use, and round numbers within their noise."""

import numpy as np
import pytest
from tests.identification.hidden import demonstrations, drawn

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.identification import identify
from constraint_geodesics.identification.bounds import bounds_of
from constraint_geodesics.identification.vanishing import Sample
from constraint_geodesics.studies.hidden_tasks import CENTRE, LEAN_RAD, TASKS, about

LEANING = TASKS["leaning cup"]


def leaning(scene, rng: int, noise_deg: float = 0.0) -> np.ndarray:
    q = LEANING.draw(scene, 1500, rng)
    return q + np.radians(noise_deg) * np.random.default_rng(rng).normal(size=q.shape)


@pytest.mark.parametrize(("noise_deg", "within_deg"), [(0.0, 0.25), (0.5, 1.2)])
def test_a_tolerance_is_read_as_a_bound(scene, noise_deg, within_deg) -> None:
    robot = scene.robot
    found = identify(leaning(scene, 1, noise_deg), robot)
    assert (found.codim, found.bounds) == (0, 1)
    assert "the tool's y axis stays within" in found.explanation
    assert "of (0, 0, 1)" in found.explanation
    assert np.isnan(found.noise_rad)
    assert found.summary()["noise_rad"] is None
    # what leans more is outside, by as much; what leans less inside
    manifold = ConstraintManifold(robot, found.constraint)
    others = robot.sample(20_000, np.random.default_rng(3))
    lean = np.arccos(np.clip(robot.forward(others)[1][:, 2, 1], -1.0, 1.0))
    outside = manifold.violation(others) > 0.0
    edge = np.radians(within_deg)
    assert outside[lean > LEAN_RAD + edge].all()
    assert not outside[lean < LEAN_RAD - edge].any()
    near = (lean > LEAN_RAD + edge) & (lean < LEAN_RAD + 0.1)
    np.testing.assert_allclose(
        manifold.violation(others[near]), lean[near] - LEAN_RAD, atol=edge + 0.04
    )


def test_demonstrations_of_a_tolerance(scene) -> None:
    shown = LEANING.demonstrate(scene, 10, 0.3, 5)
    assert all((LEANING.missed(scene.robot, own)[0] < 1.5).all() for own in shown)
    assert identify(shown, scene.robot).bounds == 1


def test_a_plate_between_two_heights(xarm) -> None:
    q = xarm.sample(60_000, np.random.default_rng(0))
    heights = xarm.forward(q)[0][:, 2]
    shown = q[np.abs(heights - 0.3) < 0.028]
    assert len(shown) > 500
    found = identify(shown, xarm)
    assert (found.codim, found.bounds) == (0, 1)
    (relation,) = found.constraint.relations
    assert relation.tolerance == pytest.approx(0.028, abs=5e-4)
    assert "mm of a plane, normal (0, 0, 1), " in found.explanation


def test_what_fades_out_is_no_tolerance(xarm) -> None:
    """Leanings of a normal distribution, and what a relation holds already."""
    rng = np.random.default_rng(0)
    q = drawn("cup", xarm, 1500)
    q = q + 0.05 * rng.normal(size=q.shape)
    sample = Sample.of_joints(xarm, [q], False)
    assert bounds_of(sample, False, False, sample.folds()) == ()
    exact = identify(drawn("plane", xarm, 800), xarm)
    assert exact.bounds == 0


def test_motions_that_stay_near_each_other_bound_nothing(xarm, kuka) -> None:
    rng, t = np.random.default_rng(1), np.linspace(0.0, 1.0, 60)[:, None]
    for robot in (xarm, kuka):
        first, last = 0.4 * robot.sample(2, rng)
        noise = rng.normal(size=(2, 10, 1, robot.dof))
        found = identify(first + t * (last - first) + 0.04 * (noise[0] + t * noise[1]), robot)
        assert found.bounds == 0, found.explanation


def test_round_numbers_within_the_noise_are_offered(xarm) -> None:
    rows = drawn("towards a centre", xarm, 2000)
    noise = np.random.default_rng(1).normal(size=rows.shape)
    found = identify(rows + np.radians(0.5) * noise, xarm)
    assert found.rounded is not None
    assert "Within the noise: the tool's tip lies on a sphere, r = 250.0 mm" in found.explanation
    assert "about (420.0, 0.0, -50.0) mm" in found.rounded.relations[0]
    # it is the formula itself, which the one that was found is not
    clean = drawn("towards a centre", xarm, 200, seed=9)
    own, rounded = (
        ConstraintManifold(xarm, one.constraint).violation(clean).max()
        for one in (found, found.rounded)
    )
    assert rounded < 1e-9 < own


def test_what_is_not_round_is_not_rounded(xarm) -> None:
    """Numbers that are no millimetres, without noise."""
    hidden = about(CENTRE + np.array([0.0123, 0.0046, 0.0089]), 0.3034, flat=False)
    manifold = ConstraintManifold(xarm, PolynomialConstraint((hidden,)))
    kept = retract(manifold, xarm.sample(4000, np.random.default_rng(0)))
    inside = kept.converged & (xarm.limit_distance(kept.joints) > 0.0)
    found = identify(kept.joints[inside][:1500], xarm)
    assert found.codim == 1
    assert found.rounded is None


def test_demonstrations_without_noise_are_not_rounded(xarm) -> None:
    """There is nothing to round: the numbers are what they are."""
    assert identify(demonstrations("plane", xarm, 10), xarm).rounded is None


def tilted(scene, count: int, across_deg: float, seed: int) -> np.ndarray:
    """Cups that lean by up to 10° the one way and by up to so much the other."""
    robot = scene.robot
    q = LEANING.draw(scene, 20 * count, seed)
    axis = robot.forward(q)[1][:, :, 1]
    return q[np.abs(axis[:, 0]) < np.sin(np.radians(across_deg))][:count]


def test_leaning_that_was_shown_in_one_direction_alone_is_no_cone(scene) -> None:
    found = identify(tilted(scene, 400, 2.0, 3), scene.robot)
    assert found.bounds == 0


def test_wrong_rows_are_beyond_a_bound(scene, xarm) -> None:
    robot, rng = scene.robot, np.random.default_rng(6)
    rows = leaning(scene, 1)
    found = identify(np.concatenate([rows, robot.sample(90, rng)]), robot)
    assert found.bounds == 1
    assert "wrong rows left out" in found.explanation
    assert 60 <= found.dropped <= 100
    q = xarm.sample(60_000, np.random.default_rng(0))
    plate = q[np.abs(xarm.forward(q)[0][:, 2] - 0.3) < 0.028][:2000]
    found = identify(np.concatenate([plate, xarm.sample(60, rng)]), xarm)
    assert found.bounds == 1
    assert 30 <= found.dropped <= 70
    (relation,) = found.constraint.relations
    assert relation.tolerance == pytest.approx(0.028, abs=1e-3)


def test_a_relation_beside_a_bound_stays(xarm) -> None:
    """A plane that is kept with noise, an axis that leans by up to 2.5°: the one is held, the other
    bounded.
    """
    rng = np.random.default_rng(2)
    rows = drawn("plane", xarm, 1500)
    manifold = ConstraintManifold(xarm, PolynomialConstraint(TASKS["plane"].hidden(xarm).relations))
    away, angle = np.sqrt(rng.random(1500)), 2.0 * np.pi * rng.random(1500)
    wanted = np.stack(
        [
            0.007 * rng.normal(size=1500),
            *(np.sin(0.044) * away * turn(angle) for turn in (np.cos, np.sin)),
        ],
        axis=1,
    )
    for _ in range(3):
        off, slopes = manifold.linearise(rows)
        rows = rows + (np.linalg.pinv(slopes) @ (wanted - off)[:, :, None])[:, :, 0]
    found = identify(rows, xarm)
    assert (found.codim, found.bounds) == (1, 1), found.explanation
    assert "lies in a plane" in found.explanation
    assert "stays within 2." in found.explanation


def test_a_bound_is_held_as_it_was_found_and_looser(scene) -> None:
    found = identify(leaning(scene, 1), scene.robot)
    looser = found.held_loosely(3.0)
    (own,), (wider,) = found.constraint.relations, looser.constraint.relations
    assert wider.tolerance == pytest.approx(own.tolerance + 3.0 * found.left_out[0])
    assert "Held looser by 3 times" in looser.explanation
