"""The planner of the files that come with the package, loaded once for all tests that use it, and
queries for it.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from constraint_geodesics import bundle
from constraint_geodesics.bundle import Bundle, read_bundle
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.learned_method import FOLDER, LearnedFiles, read_learned
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.path_diffusion import PathDiffusion
from constraint_geodesics.learning.path_diffusion_training import Denoiser
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.world import World

NAMES = ("free", "level_cup", "level_cup_relaxed", "slide", "fixed_orientation", "tool_down")
TURN_ROWS = 33
"""Configurations of a turn that are looked at."""


@cache
def packaged_bundle() -> Bundle:
    return read_bundle(bundle.PACKAGED)


@cache
def packaged_planner() -> Planner:
    return Planner.load(bundle.PACKAGED)


@cache
def packaged_learned() -> LearnedFiles:
    return read_learned(bundle.PACKAGED / FOLDER)


def manifold_of(planner: Planner, name: str) -> ConstraintManifold:
    return ConstraintManifold(planner.scene.robot, planner.constraints[name])


@cache
def nodes_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Configurations on the constraint to rounding, free and within the limits, and their
    components; none is a node of the planner's own roadmap.
    """
    planner = packaged_planner()
    roadmap = packaged_learned().submanifolds[name]
    joints = retract(manifold_of(planner, name), roadmap.joints[:300]).joints
    with planner.scene.world() as world:
        kept = world.free(joints) & (planner.scene.robot.limit_distance(joints) > 0.01)
    return joints[kept], roadmap.labels[:300][kept]


def pairs_of(
    name: str, count: int, seed: int, *, joined: bool = True
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Starts and goals in one component of the graph, or in two."""
    joints, labels = nodes_of(name)
    rng = np.random.default_rng(seed)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    while len(found) < count:
        a, b = rng.choice(len(joints), 2, replace=False)
        if (labels[a] == labels[b]) == joined:
            found.append((joints[a], joints[b]))
    return found


@cache
def packaged_chart() -> LearnedManifold:
    return LearnedManifold.from_arrays(packaged_learned().manifold)


@cache
def untrained_diffusion() -> PathDiffusion:
    """A diffusion model of paths that learned nothing: what it draws hangs on noise alone."""
    torch.manual_seed(0)
    weights = Denoiser(4 * 6, 120, 8, 1).state_dict()
    scales = {
        "scale": np.full((4, 6), 0.05, np.float32),
        "seen_mean": np.zeros(120, np.float32),
        "seen_scale": np.ones(120, np.float32),
    }
    return PathDiffusion({name: value.numpy() for name, value in weights.items()} | scales)


def length(joints: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())


def problem(world: World, name: str, seed: int) -> PlanningProblem:
    """One query of a constraint, its boxes unknown."""
    start, goal = pairs_of(name, 1, seed)[0]
    return PlanningProblem(start, goal, manifold_of(packaged_planner(), name), world.is_free)


def walled(robot: SerialRobot, is_free: Callable[[np.ndarray], bool]) -> PlanningProblem:
    """A turn without a constraint, through what `is_free` says."""
    free = ConstraintManifold(robot, Constraint((0,) * 6))
    start, goal = np.array([-1.0, 0, -1.0, 0, 0, 0]), np.array([1.0, 0, -1.0, 0, 0, 0])
    return PlanningProblem(start, goal, free, is_free)


def problems(world: World, name: str, count: int) -> list[PlanningProblem]:
    """Queries of one constraint in the packaged planner's workcell."""
    planner = packaged_planner()
    clearance = clearance_model(planner.scene.now)
    manifold = manifold_of(planner, name)
    known = world.is_free, clearance, planner._certifier.collisions.is_clear
    return [PlanningProblem(a, b, manifold, *known) for a, b in pairs_of(name, count, 3)]


def assert_sound(path: Solution, asked: PlanningProblem, certifier: Certifier) -> None:
    """A peer's answer that the certifier accepts, its ends those of the problem to the bit."""
    assert path.status == "solved"
    assert path.time_s > 0.0
    assert path.iterations > 0
    np.testing.assert_array_equal(path.joints[[0, -1]], [asked.start, asked.goal])
    certificate = certifier.certify(path.joints, asked.manifold.constraint, asked.start, asked.goal)
    assert certificate.valid, certificate.violation
    assert certificate.violation_bound <= 1e-4


def turning(joints: np.ndarray, times: np.ndarray, start_velocity: np.ndarray | None) -> np.ndarray:
    """Configurations (n, D) of an arm that moves at first: its velocity becomes the first line's
    evenly until the middle of that line's time.
    """
    if start_velocity is None or not np.any(start_velocity):
        return joints[:1]
    lasting = 0.5 * (times[1] - times[0])
    line = 0.5 * (joints[1] - joints[0]) / lasting
    s = np.linspace(0.0, 1.0, TURN_ROWS)[:, None]
    return joints[0] + lasting * (s * start_velocity + 0.5 * s**2 * (line - start_velocity))
