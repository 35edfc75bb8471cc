"""Queries with a held tilt in the scenes of a file of problems: a tool that carries something open
goes where the file's own problems go.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.benchmark.problem_files import Problem
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.search.preparation import Draw, Freedom, free_configurations

TILT_RAD, ENDS_RAD = np.radians(15.0), np.radians(10.0)
"""Tilt on the way at most, and at the ends."""
TILTED = "tilt of 15° at most"
"""Name of the constraint."""
AROUND_M = 0.25
"""How far beyond the box that the problem's two tool positions span a start may have the tool."""
BESIDE_M = 0.2
"""How far from the problem's goal a goal may have it, along each axis."""
MOVED_M = 0.25
"""Distance of the two tool positions of a query at least."""
SPREAD_RAD = 0.5
"""Deviation of the configurations drawn about the problem's own ends, half of all."""
DRAWN = 64
"""Configurations of each end that pairs are looked for among."""
TRIES = 4
"""Times that these are drawn, where they hold no pair."""


def tilted(problems: Sequence[Problem], count: int, seed: int) -> list[Problem]:
    """So many queries in the scenes of each group's problems, evenly spread over them, one a scene;
    fewer where a group has fewer problems, or its scenes hardly any room.

    Level is the tool as the group's goals have it: the axis of the tool that is nearest to
    vertical there in the mean, up or down.
    """
    found = []
    for _, grouped in groupby(problems, key=lambda problem: problem.group):
        own = list(grouped)
        reference = level_pose(own)
        chosen = np.linspace(0, len(own), min(count, len(own)), endpoint=False).astype(int)
        queries = (tilted_query(own[k], reference, seed) for k in chosen)
        found += [query for query in queries if query is not None]
    return found


def level_pose(problems: Sequence[Problem]) -> Pose:
    """The orientation that puts that axis of the tool upright, at no place in particular."""
    up = np.zeros(3)
    for problem in problems:
        up += problem.scene.robot.forward(problem.goal)[1][2]
    axis = int(np.abs(up).argmax())
    sign = float(np.sign(up[axis])) or 1.0
    # rows: the base's axes in the tool's; the last is what is upright
    turn = np.roll(np.eye(3), axis + 1, axis=1)
    if sign < 0.0:
        turn = np.diag([1.0, -1.0, -1.0]) @ turn
    return Pose(np.zeros(3), turn)


def tilted_query(problem: Problem, reference: Pose, seed: int) -> Problem | None:
    """A query near a problem's own: ends drawn at random, projected, free of collision, within
    ENDS_RAD of level, at tool positions MOVED_M apart; None where none is found.
    """
    robot = problem.scene.robot
    tools = np.stack([robot.forward(q)[0] for q in (problem.start, problem.goal)])
    level = ConstraintManifold(robot, held_tilt(reference, ENDS_RAD))
    rng = np.random.default_rng((seed, zlib.crc32(problem.group.encode()), problem.number))
    with Certifier(problem.scene) as certifier:
        checks = certifier.collisions
        starts = _Near(checks, robot, tools.min(0) - AROUND_M, tools.max(0) + AROUND_M)
        goals = _Near(checks, robot, tools[1] - BESIDE_M, tools[1] + BESIDE_M)
        for _ in range(TRIES):
            first, last = (
                free_configurations(level, near, _drawn_about(robot, about), DRAWN, rng)
                for near, about in ((starts, problem.start), (goals, problem.goal))
            )
            for start, goal in zip(first, last, strict=False):
                moved = robot.forward(goal)[0] - robot.forward(start)[0]
                if np.linalg.norm(moved) >= MOVED_M:
                    return replace(
                        problem,
                        start=start,
                        goal=goal,
                        constraint=held_tilt(reference, TILT_RAD),
                        constraint_name=TILTED,
                    )
    return None


def held_tilt(reference: Pose, most_rad: float) -> Constraint:
    """Roll and pitch within a cone around a reference's."""
    angle = float(most_rad)
    return Constraint((0, 0, 0, 1, 1, 0), (0.0, 0.0, 0.0, angle, angle, 0.0), reference)


def _drawn_about(robot: SerialRobot, about: Float[np.ndarray, "D"]) -> Draw:
    """Half of them anywhere, half about a configuration, in an order that mixes them."""

    def draw(count: int, rng: np.random.Generator) -> Float[np.ndarray, "n D"]:
        anywhere = robot.sample(count - count // 2, rng)
        near = about + SPREAD_RAD * rng.normal(size=(count // 2, robot.dof))
        drawn = np.concatenate([anywhere, np.clip(near, robot.lower, robot.upper)])
        return drawn[rng.permutation(count)]

    return draw


@dataclass(frozen=True)
class _Near:
    """Freedom with the tool between two corners of a box [m]."""

    checks: Freedom
    robot: SerialRobot
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Which of n configurations touch nothing and have the tool there."""
        tool = self.robot.forward(q)[0]
        found = np.zeros(len(q), bool)
        inside = np.flatnonzero(((tool >= self.low) & (tool <= self.high)).all(axis=1))
        found[inside] = self.checks.free(q[inside])
        return found
