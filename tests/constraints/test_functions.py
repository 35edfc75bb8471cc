"""A constraint of two functions, from the planner to the recording."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.planner_fixtures import packaged_planner

from constraint_geodesics.constraints.constraint import (
    ConstraintError,
    ConstraintManifold,
    constraint_from_json,
)
from constraint_geodesics.constraints.functions import (
    FunctionsConstraint,
    constraint_factory,
    made_by,
    tip_on_sphere,
)
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.trajectory import read_trajectory

SPHERE = "constraint_geodesics.constraints.functions:tip_on_sphere"
CENTRE, RADIUS = np.array([0.35, 0.0, 0.15]), 0.25


@constraint_factory
def sphere_of(robot: SerialRobot, **arguments: Any) -> FunctionsConstraint:
    return replace(tip_on_sphere(robot, **arguments), origin=None)


@constraint_factory
def sphere_of_three(robot: SerialRobot, *centre: float) -> FunctionsConstraint:
    return replace(tip_on_sphere(robot, centre, RADIUS), origin=None)


@constraint_factory
def sphere_of_numbers(robot: SerialRobot, numbers: dict[int, Any]) -> FunctionsConstraint:
    return replace(tip_on_sphere(robot, numbers[0], numbers[1]), origin=None)


def unmarked(robot: SerialRobot) -> FunctionsConstraint:
    return tip_on_sphere(robot, CENTRE, RADIUS)


def plain(
    robot: SerialRobot, centre_m: list[float], file: Path | None = None
) -> FunctionsConstraint:
    return tip_on_sphere(robot, centre_m, RADIUS)


marked = constraint_factory(plain)


@pytest.fixture(scope="module")
def manifold() -> ConstraintManifold:
    robot = packaged_planner().scene.robot
    arguments = {"centre_m": CENTRE.tolist(), "radius_m": RADIUS}
    return ConstraintManifold(robot, made_by(SPHERE, arguments, robot))


@pytest.fixture(scope="module")
def path(manifold):
    """The first of a few queries that is solved."""
    planner, robot = packaged_planner(), manifold.robot
    found = retract(manifold, robot.sample(400, np.random.default_rng(0)))
    inside = found.converged & (robot.limit_distance(found.joints) >= 0.05)
    free = found.joints[inside]
    with planner.scene.world() as world:
        free = free[world.free(free)]
    away = np.linalg.norm(free - free[0], axis=1)
    near = free[np.argsort(away)[1:6]]
    paths = [planner.plan(free[0], goal, manifold.constraint) for goal in near]
    return next(path for path in paths if path.status == "solved")


def test_it_is_planned_and_certified(path, manifold) -> None:
    assert path.certificate.valid
    assert 0.0 < path.certificate.violation_bound_m <= 1e-4
    assert path.certificate.violation_bound_rad == 0.0
    t = np.linspace(0.0, 1.0, 20)[:, None, None]
    between = path.joints[:-1] + t * (path.joints[1:] - path.joints[:-1])
    tips, _ = manifold.robot.forward(between)
    assert np.abs(np.linalg.norm(tips - CENTRE, axis=-1) - RADIUS).max() < 1.1e-4


def test_its_path_is_read_again(path, manifold, tmp_path) -> None:
    file = tmp_path / "path.csv"
    path.save(file)
    joints, _, constraint, *_ = read_trajectory(file, manifold.robot.joint_names, manifold.robot)
    np.testing.assert_array_equal(joints, path.joints)
    assert constraint.key == manifold.constraint.key
    assert packaged_planner().check(file).valid


def test_what_a_factory_makes_when_it_is_called_knows_how(path, manifold, tmp_path) -> None:
    """As if a file had named it, with arrays in the place of lists."""
    robot = manifold.robot
    for made in (
        tip_on_sphere(robot, CENTRE, radius_m=RADIUS),
        sphere_of(robot, centre_m=CENTRE, radius_m=RADIUS),
    ):
        again = pickle.loads(pickle.dumps(made))
        np.testing.assert_array_equal(again.values(path.joints), made.values(path.joints))
        read = constraint_from_json(made.to_json(), robot)
        assert read.key == again.key == constraint_from_json(read.to_json(), robot).key

    @constraint_factory
    def within(robot: SerialRobot) -> FunctionsConstraint:
        return replace(tip_on_sphere(robot, CENTRE, RADIUS), origin=None)

    many = sphere_of_three(robot, *CENTRE), sphere_of_numbers(robot, {0: CENTRE, 1: RADIUS})
    for made in (within(robot=robot), *many):
        with pytest.raises(ConstraintError, match="not made by a factory of a module"):
            made.to_json()


def test_what_is_made_by_calling_is_told_apart_by_its_functions(manifold) -> None:
    """A factory may read a file that was written anew; what a file names is the same for all."""
    first, second = (tip_on_sphere(manifold.robot, CENTRE, RADIUS) for _ in range(2))
    assert first.key != second.key
    arguments = {"centre_m": CENTRE.tolist(), "radius_m": RADIUS}
    assert made_by(SPHERE, arguments, manifold.robot).key == manifold.constraint.key


def test_a_factory_is_marked_where_it_stands(manifold) -> None:
    """By its own name, and by that of what marks it."""
    arguments = {"centre_m": CENTRE.tolist()}
    for name in ("marked", "plain"):
        found = made_by(f"{__name__}:{name}", arguments, manifold.robot)
        read = constraint_from_json(found.to_json(), manifold.robot)
        assert read.key == found.key
    with pytest.raises(ConstraintError, match="is no constraint_factory"):
        made_by(f"{__name__}:unmarked", {}, manifold.robot)
    with pytest.raises(ConstraintError, match="plain.*Path"):
        made_by(f"{__name__}:plain", arguments | {"file": Path()}, manifold.robot)


def test_its_path_is_recorded(path, tmp_path) -> None:
    file = tmp_path / "path.rrd"
    path.record(file)
    assert b"distance to the sphere" in file.read_bytes()


def test_an_end_off_the_sphere_is_named_in_millimetres(path, manifold) -> None:
    lower = path.joints[0] - 0.02
    answer = packaged_planner().plan(lower, path.joints[-1], manifold.constraint)
    assert answer.status == "start_violates"
    assert "distance to the sphere by" in answer.explanation
    assert "mm" in answer.explanation
