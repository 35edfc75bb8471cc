"""Spheres on the way of curves: what policies learn to go round, and what they are asked to."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Ends
from constraint_geodesics.scene.clearance import ClearanceModel, clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere

NAME = "keep_out"
FEWEST_PAIRS = 3
"""Pairs of ends on whose way a sphere has to be."""
NEAR_M = 1e-4
"""Distance beyond which nothing is measured."""
PAIRS, CURVES = 200, 16
"""Pairs that spheres are looked for between, and random curves of each, of which the cheapest
counts.
"""


def with_spheres(
    problem: LearnedProblem,
    scene: Scene,
    count: int,
    radii_m: tuple[float, float],
    rng: np.random.Generator,
) -> list[LearnedProblem]:
    """The same problem so many times, each with a sphere and the pairs of ends that have it on
    their way: free themselves, while the cheapest curve that is known without it touches it.

    Spheres are centred on the tool somewhere in the middle half of such a curve; fewer than `count`
    where hardly any is on the way of FEWEST_PAIRS pairs.
    """
    robot = problem.manifold.robot
    found: list[LearnedProblem] = []
    ends, curves = _cheapest_curves(problem, rng)
    for row in rng.permutation(len(curves)):
        if len(found) == count:
            break
        points = curves.shape[1]
        node = int(rng.integers(points // 4, points - points // 4))
        x, y, z = map(float, robot.forward(curves[row, node])[0])
        sphere = Sphere(NAME, (x, y, z), float(rng.uniform(*radii_m)))
        clearance = clearance_model(scene.adding(sphere))
        on_way = met_by(problem, clearance, curves)
        if on_way.sum() >= FEWEST_PAIRS:
            pairs = np.stack([ends.q_start[on_way], ends.q_goal[on_way]], axis=1)
            found.append(replace(problem, clearance=clearance, pairs=pairs))
    return found


def met_by(
    problem: LearnedProblem, clearance: ClearanceModel, curves: Float[np.ndarray, "B S D"]
) -> Bool[np.ndarray, "B"]:
    """Which curves touch something between ends that do not."""
    free = clearance.clearance(problem.manifold.robot, curves, NEAR_M) > 0.0
    return free[:, 0] & free[:, -1] & ~free.all(axis=1)


def _cheapest_curves(
    problem: LearnedProblem, rng: np.random.Generator
) -> tuple[Ends, Float[np.ndarray, "B S D"]]:
    """Ends and the cheapest of CURVES curves between them, where one of them is feasible."""
    ends = problem.sample_ends(PAIRS, rng)
    each: Int[np.ndarray, "n"] = np.repeat(np.arange(PAIRS), CURVES)
    phi = problem.sample_curves(ends[each], rng)
    phi[::CURVES] = 0.0
    looked = problem.looked(problem.decoded(phi, ends[each]), ends[each], 0)
    costs = problem.costs_of(looked.figures)
    price = np.where(costs.feasible, costs.cost, np.inf).reshape(PAIRS, CURVES)
    usable = np.flatnonzero(np.isfinite(price).any(axis=1))
    best = usable * CURVES + price[usable].argmin(axis=1)
    return ends[usable], looked.joints[best]
