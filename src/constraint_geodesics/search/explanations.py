"""Why a query has no path, as a status and one line for people."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.collisions import CollisionCheck
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.problem import LIMIT_SLACK, SATISFIED, Status, end_refused
from constraint_geodesics.search.candidates import Answer
from constraint_geodesics.search.nearest import projection
from constraint_geodesics.search.preparation import Query
from constraint_geodesics.search.roadmap import Roadmap, join

ALTERNATIVES = 64
"""Configurations from which another goal with the same tool pose is looked for."""


def refused_end(
    query: Query, end: Literal["start", "goal"], collisions: CollisionCheck
) -> tuple[Status, str] | None:
    """Why this end can't be that of a path; None where it can."""
    manifold, q = query.task.manifold, getattr(query, end)
    status = end_refused(manifold, q, end)
    if status == "out_of_limits":
        return status, _limit(manifold, end, q)
    if status is not None:
        line = f"the {end} violates {query.name} by {manifold.amount(q)}"
        nearest = projection(manifold, q)
        if nearest is not None:
            where, away = _listed(nearest.configuration), nearest.distance_rad
            line += f"; {where} rad, {away:.2g} rad away, keeps it"
        return status, line
    if not collisions.is_free(q):
        return "in_collision", f"the {end} touches {collisions.what_touches(q)}"
    return None


def _limit(manifold: ConstraintManifold, end: str, q: Float[np.ndarray, "D"]) -> str:
    robot = manifold.robot
    beyond = np.maximum(robot.lower - q, q - robot.upper)
    for k in np.flatnonzero(beyond > LIMIT_SLACK):
        unit = "m" if robot.chain.prismatic[k] else "rad"
        limits = f"its limits are {robot.lower[k]:.4g} and {robot.upper[k]:.4g} {unit}"
        if robot.joint_names[k] in robot.continuous:
            limits += ", whole turns beyond them are for its controller to add"
        digits = 4 if beyond[k] > 1e-3 else 10
        return f"{robot.joint_names[k]} of the {end} is {q[k]:.{digits}g} {unit}: {limits}"
    return ""


def not_connected(query: Query, answer: Answer, collisions: CollisionCheck) -> str:
    """That start and goal are not joined, and the nearest goal that the graph joins with the start
    instead: among the shapes that it was made among, it knows no later ones.
    """
    line = f"start and goal lie in different components of {query.name}'s graph"
    roadmap = query.task.roadmap()
    if roadmap is None or answer.at_start is None:
        return line
    reached = answer.at_start.components(roadmap)
    nodes = roadmap.joints[np.isin(roadmap.labels, list(reached))]
    nodes = nodes[np.argsort(np.linalg.norm(nodes - query.goal, axis=1))]
    seeds = nodes[:: max(len(nodes) // ALTERNATIVES, 1)]
    for q in _same_pose(query, seeds):
        if collisions.is_free(q) and _component(query, roadmap, q) & reached:
            return f"{line}; it joins the start with the goal's tool pose at {_listed(q)} rad"
    nearest = next((q for q in nodes if collisions.is_free(q)), None)  # of the scene as it is now
    if nearest is None:
        return line
    away = float(np.linalg.norm(nearest - query.goal))
    told = f"the nearest configuration that it joins with the start, {away:.2f} rad away"
    return f"{line}; {told}, is {_listed(nearest)}"


def _same_pose(query: Query, seeds: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "m D"]:
    """Other configurations with the goal's tool pose that keep the constraint, which may be of more
    than the tool; the nearest first.
    """
    manifold = query.task.manifold
    robot = manifold.robot
    pose = Constraint((1,) * 6, reference=Pose(*robot.forward(query.goal)))
    result = retract(ConstraintManifold(robot, pose), seeds)
    kept = manifold.violation(result.joints) <= SATISFIED
    kept &= result.converged & (robot.limit_distance(result.joints) >= 0.0)
    found = result.joints[kept]
    return found[np.argsort(np.linalg.norm(found - query.goal, axis=1), kind="stable")]


def _component(query: Query, roadmap: Roadmap, q: Float[np.ndarray, "D"]) -> set[int]:
    return join(roadmap, query.task.clear, q).components(roadmap)


def _listed(q: Float[np.ndarray, "D"]) -> str:
    return "[" + ", ".join(f"{x:.9f}" for x in q) + "]"
