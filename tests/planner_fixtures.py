"""The planner of the files that come with the package, loaded once for all tests that use it, and queries for it."""

from functools import cache

import numpy as np

from constraint_geodesics import bundle
from constraint_geodesics.bundle import Bundle, read_bundle
from constraint_geodesics.constraints.retraction import retract
from constraint_geodesics.constraints.vector import ConstraintManifold
from constraint_geodesics.planner import Planner

NAMES = ("free", "level_cup", "level_cup_relaxed", "slide", "fixed_orientation", "tool_down")


@cache
def packaged_bundle() -> Bundle:
    return read_bundle(bundle.PACKAGED)


@cache
def packaged_planner() -> Planner:
    return Planner.load(bundle.PACKAGED)


def manifold_of(planner: Planner, name: str) -> ConstraintManifold:
    return ConstraintManifold(planner.scene.robot, planner.constraints[name])


@cache
def nodes_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Nodes of a graph, on the constraint to rounding, free and within the limits, and their components."""
    planner = packaged_planner()
    roadmap = planner.bundle.roadmaps[name]
    joints = retract(manifold_of(planner, name), roadmap.joints[:300]).joints
    with planner.scene.world() as world:
        kept = world.free(joints) & (planner.scene.robot.limit_distance(joints) > 0.01)
    return joints[kept], roadmap.labels[:300][kept]


def pairs_of(name: str, count: int, seed: int, *, joined: bool = True) -> list[tuple[np.ndarray, np.ndarray]]:
    """Starts and goals in one component of the graph, or in two."""
    joints, labels = nodes_of(name)
    rng = np.random.default_rng(seed)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    while len(found) < count:
        a, b = rng.choice(len(joints), 2, replace=False)
        if (labels[a] == labels[b]) == joined:
            found.append((joints[a], joints[b]))
    return found
