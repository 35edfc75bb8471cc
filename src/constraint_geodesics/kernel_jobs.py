"""Small pieces of the planner's work, each the first to need some of the compiled kernels: what
runs them has compiled everything that a user of the documented features meets.

What the kernels are compiled for depends neither on the robot nor on the constraint.  Run as a
program: the jobs whose names come on standard input, one a line, each answered by a line.
"""

import signal
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.both import Both, both
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_from_json,
)
from constraint_geodesics.constraints.functions import values_batch
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.identification import identify
from constraint_geodesics.identification.vanishing import Sample
from constraint_geodesics.plugs import PULL, PULL_BOUNDS, plug
from constraint_geodesics.progress import shown_already
from constraint_geodesics.robot.inverse_kinematics import solutions
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene import convex_kernels as convex
from constraint_geodesics.scene.bodies import block_of
from constraint_geodesics.scene.clearance import clearance_model, path_stays_clear
from constraint_geodesics.scene.pieces import Piece, prism
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.band import PROJECTION, project
from constraint_geodesics.search.candidates import Task, refined, rows_of
from constraint_geodesics.search.nearest import nearest_on
from constraint_geodesics.search.roadmap import build_roadmap, join, points_along, shortest_way
from constraint_geodesics.search.run_out import rows_from
from constraint_geodesics.search.space import Space, space_of
from constraint_geodesics.search.tree import tree_way
from constraint_geodesics.search.ways_round import bent_round

DONE, FAILED = "done", "failed: "
"""What an answer begins with."""
_ROBOT = Path(__file__).parent / "robot" / "small.urdf"
_ROWS = np.linspace([-0.1, -0.1, 0.0], [0.1, 0.1, 0.0], 9)
_TIMES = np.linspace(0.0, 9.0, 9)


@cache
def _scene() -> Scene:
    return Scene(load_robot(_ROBOT, "tool"), (Sphere("ball", (2.0, 0.0, 0.0), 0.1),))


@cache
def _level() -> Constraint:
    return Constraint((0, 0, 1, 0, 0, 0), reference=Pose(np.zeros(3), np.eye(3)))


@cache
def _space() -> Space:
    robot = _scene().robot
    clearance = clearance_model(_scene())
    return space_of(ConstraintManifold(robot, _level()), clearance, 0.01)


def _distances() -> None:
    arrays = clearance_model(_scene()).arrays
    frames, simplex = np.zeros((_scene().robot.dof + 1, 12)), np.empty(convex.SIMPLEX)
    convex.place_balls(arrays.nodes, frames)
    convex.distance(arrays[:3], frames, 0, (0.0, 0.0), simplex)
    block_of([Piece(prism(8, 0.1, 0.0, 0.1))], 3)


def _kinematics() -> None:
    robot = _scene().robot
    ConstraintManifold(robot, _level()).linearise(_ROWS)
    robot.forward(_ROWS)
    robot.jacobian(_ROWS)
    robot.skeleton(_ROWS)


def _space_searched() -> None:
    own = _space()
    path_stays_clear(own.chain, own.clearance, _ROWS)
    clearance_model(_scene()).clearance(_scene().robot, _ROWS)
    project(own, _ROWS.copy())


def _certificate() -> None:
    limits = Limits(acceleration_rad_s2=(10.0,) * _scene().robot.dof)
    with Certifier(_scene(), limits) as certifier:
        found = certifier.certify(_ROWS, _level(), _ROWS[0], _ROWS[-1], _TIMES)
        assert found.valid, found.violation  # what follows a violation is not looked at
        certifier.collisions.clearance(_ROWS[0])
        certifier.tool_poses(_ROWS)


def _constraints_and_times() -> None:
    robot, none = _scene().robot, np.empty((0, 1))
    manifold = ConstraintManifold(robot, _level())
    retract(manifold, _ROWS)
    manifold.violation(_ROWS)
    manifold.inclusion(_ROWS)
    values_batch(0, none, none)  # without rows no function is called
    time_parametrisation(_ROWS, robot.velocity, np.full(robot.dof, 10.0))


def _band() -> None:
    model = clearance_model(_scene())
    task = Task(ConstraintManifold(_scene().robot, _level()), model, lambda: None)
    found = refined(task, "straight", _ROWS)
    assert found is not None
    rows_of(found, 1e-4)
    bent_round(task.open, task.clear, _ROWS.copy(), 1.0, PROJECTION)
    pace = Pace(_scene().robot.velocity, np.full(_scene().robot.dof, 10.0))
    rows_from(found, _ROWS[0] + 1e-5, _ROWS[1] - _ROWS[0], pace, 1e-4)


def _roadmap() -> None:
    own, (start, goal) = _space(), _ROWS[[0, -1]]
    graph = build_roadmap(own, _ROWS, 3)
    shortest_way(graph, start, goal, join(graph, own, start), join(graph, own, goal), own)
    points_along(own, _ROWS[[0, -1]].copy())


def _trees() -> None:
    tree_way(_space(), _ROWS[0], _ROWS[-1], 0)


def _inverse_kinematics() -> None:
    robot = _scene().robot
    position, rotation = robot.forward(_ROWS[0])
    solutions(robot, position, rotation)


def _nearest() -> None:
    across = Constraint((1, 0, 0, 0, 0, 0), reference=Pose(np.zeros(3), np.eye(3)))
    nearest_on(ConstraintManifold(_scene().robot, both(_level(), across)), _ROWS[0], _ROWS)


def _learned() -> None:
    robot, joints = _scene().robot, _ROWS[None].copy()
    bounds = plug(PULL_BOUNDS)(robot.lower, robot.upper, 1e-8)
    manifold = ConstraintManifold(robot, _level())
    plug(PULL)(manifold.arrays, bounds, _TIMES, joints, np.empty_like(joints))


def _demonstrations() -> None:
    robot, rng = _scene().robot, np.random.default_rng(0)
    shown = rng.uniform(-1.0, 1.0, (200, robot.dof))
    identify(shown, robot)
    Sample.of_joints(robot, [shown], False).of_joint(robot, shown, 1)
    row = {"name": "x", "unit": "m", "constant": 0.0, "linear": [1.0, *[0.0] * 11]}
    row |= {"tolerance": 0.0, "quadratic": None, "spline": -1}
    rows = {"relations": [row], "left_out": [], "splines": []}
    kinds = [constraint_from_json(rows | {"kind": kind}) for kind in ("polynomial", "spline")]
    ConstraintManifold(robot, Both(*kinds)).linearise(_ROWS)


class Job(NamedTuple):
    """after: jobs that compile what this one needs too, so that two processes do not both."""

    work: Callable[[], None]
    after: tuple[str, ...] = ()


JOBS = {
    "distances of bodies": Job(_distances),
    "kinematics": Job(_kinematics),
    "space": Job(_space_searched, ("distances of bodies", "kinematics")),
    "certificate": Job(_certificate, ("distances of bodies",)),
    "constraints and times": Job(_constraints_and_times, ("kinematics",)),
    "elastic band": Job(_band, ("space",)),
    "roadmap": Job(_roadmap, ("space",)),
    "trees": Job(_trees, ("roadmap",)),
    "nearest configurations": Job(_nearest, ("roadmap",)),
    "inverse kinematics": Job(_inverse_kinematics, ("kinematics",)),
    "learned method": Job(_learned, ("constraints and times",)),
    "demonstrations": Job(_demonstrations, ("kinematics",)),
}
"""By their names, those that others wait for and the longest first."""


def _serve() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started it ends it
    for line in sys.stdin:
        try:
            JOBS[line.strip()].work()
        except Exception as error:
            line = " ".join(f"{type(error).__name__}: {error}".split())
            print(f"{FAILED}{line}", flush=True)
        else:
            print(DONE, flush=True)


if __name__ == "__main__":
    with shown_already():
        _serve()
