"""Learners of joint space side by side: the VAE, a GPLVM, a GAN, and uniform joints with nothing
learned.

Each is trained on the same configurations of no constraint, once a seed, and asked the same: how
well it reproduces configurations that it never saw, what its samples are worth as they are and
projected onto each constraint, and how long geodesics of its metric are.  Times are those of the
processor, on one thread: other processes take no part in them.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial import KDTree

from constraint_geodesics.constraints.constraint import ConstraintManifold, constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.problem import ChartProblem, Samples
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import CurveFamily
from constraint_geodesics.geometry.manifold import EmbeddedManifold
from constraint_geodesics.learning.gan import train_gan
from constraint_geodesics.learning.gplvm import train_gplvm
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.learning.latent_manifold import LatentManifold
from constraint_geodesics.learning.learned_manifold import JointManifold
from constraint_geodesics.learning.lift import Chart, corrected
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import CompareManifoldsParams, ManifoldParams, Params
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.studies.geodesic_search import curve_family

Joints = Float[np.ndarray, "n D"]
Figures = dict[str, float]

POINTS = 101
"""Configurations of a decoded geodesic that are looked at for collisions."""
WARM = 10
"""Configurations projected before the clock starts."""
ROUNDS = 5
"""Times that a projection is timed, of which the median counts."""


class Charted(EmbeddedManifold, Chart, Protocol):
    """An embedded manifold that knows the latent coordinates of joints."""


@dataclass(frozen=True)
class Learned:
    """What a learner has made: its manifold, and joints [rad] drawn from it."""

    manifold: Charted
    draw: Callable[[int, np.random.Generator], Joints]


@dataclass(frozen=True)
class LearnerTask:
    """One learner and seed, with the rows that it sees and those that it is asked about [rad]."""

    learner: str
    seed: int
    scene: Scene
    rows: Joints
    held_out: Joints
    constraints: Mapping[str, ConstraintManifold]
    tolerance: float
    """Violation [rad or m] that passes for none."""
    curve: CurveFamily
    vae: ManifoldParams
    settings: CompareManifoldsParams
    scratch: Path


def learn_vae(task: LearnerTask) -> Learned:
    """The VAE of params.yaml, sampled about its variance network's centres."""
    params = task.vae.model_copy(update={"seed": task.seed})
    run = TrainingRun(task.scratch / str(task.seed), lambda *_: None, False)
    manifold = train_manifold(task.rows, task.scene.robot, params, run).manifold
    arrays = {name: values.numpy() for name, values in manifold.vae.state_dict().items()}
    sampled = FrozenManifold(arrays)
    return Learned(manifold, lambda count, rng: manifold.decode(sampled.sample(count, rng)))


def learn_gplvm(task: LearnerTask) -> Learned:
    """The Gaussian processes, sampled about as many centres as the VAE."""
    return _sampled(train_gplvm(task.rows, task.scene.robot, task.settings.gplvm, task.seed))


def learn_gan(task: LearnerTask) -> Learned:
    """The generator, sampled as it was trained."""
    return _sampled(train_gan(task.rows, task.scene.robot, task.settings.gan, task.seed))


def learn_nothing(task: LearnerTask) -> Learned:
    """Joint space itself, sampled uniformly within the limits."""
    return Learned(JointManifold.of(task.rows), task.scene.robot.sample)


def _sampled(manifold: LatentManifold) -> Learned:
    return Learned(manifold, lambda count, rng: manifold.decode(manifold.sample(count, rng)))


UNIFORM = "uniform joints"
LEARNERS: dict[str, Callable[[LearnerTask], Learned]] = {
    "VAE": learn_vae,
    "GPLVM": learn_gplvm,
    "GAN": learn_gan,
    UNIFORM: learn_nothing,
}


def tasks_of(params: Params, joints: Joints, scratch: Path) -> list[LearnerTask]:
    """Every learner with every seed, the slow ones first.

    joints: configurations free of collision; those held out are the same for all.
    """
    settings, scene = params.compare_manifolds, Scene.from_params(params)
    mixed = np.random.default_rng(settings.split_seed).permutation(joints)
    vae = params.manifolds[settings.vae]
    constraints = {
        name: constraint_manifold(scene.robot, own)
        for name, own in params.all_constraints.items()
        if not own.is_free
    }
    return [
        LearnerTask(
            learner,
            seed,
            scene,
            mixed[settings.held_out :],
            mixed[: settings.held_out],
            constraints,
            params.judge.violation_tolerance,
            curve_family(_dim_of(learner, params), params.geodesics),
            vae,
            settings,
            scratch,
        )
        for learner in LEARNERS
        for seed in settings.seeds
    ]


def _dim_of(learner: str, params: Params) -> int:
    settings = params.compare_manifolds
    dims = {
        "VAE": params.manifolds[settings.vae].latent_dim,
        "GPLVM": settings.gplvm.latent_dim,
        "GAN": settings.gan.latent_dim,
    }
    return dims.get(learner, Scene.from_params(params).robot.dof)


def measure(task: LearnerTask) -> list[dict[str, Any]]:
    """Train, then every figure of one learner and seed, one row each: learner, seed, constraint
    (blank where none takes part), figure, value.
    """
    began = time.process_time()
    learned = LEARNERS[task.learner](task)
    found: dict[str, Figures] = {"": {"train_cpu_s": time.process_time() - began}}
    rng = np.random.default_rng(task.seed)
    drawing = time.process_time()
    samples = learned.draw(task.settings.samples, rng)
    found[""]["drawn_us"] = 1e6 * (time.process_time() - drawing) / len(samples)
    robot, checked = task.scene.robot, samples[: task.settings.checked]
    with task.scene.world() as world:
        found[""] |= reproduction_figures(learned.manifold, robot, task.held_out)
        found[""] |= sample_figures(samples, checked, task.held_out, robot, world)
        found[""] |= geodesic_figures(task, learned.manifold, world)
        for name, constraint in task.constraints.items():
            found[name] = projection_figures(constraint, checked, task.tolerance, world)
    named = {"learner": task.learner, "seed": task.seed}
    return [
        named | {"constraint": constraint, "figure": figure, "value": value}
        for constraint, own in found.items()
        for figure, value in own.items()
    ]


def reproduction_figures(manifold: Chart, robot: SerialRobot, joints: Joints) -> Figures:
    """How far a configuration lies from where it is encoded and decoded to: the mean over joints
    [rad], the tool's position [mm] and orientation [°].
    """
    decoded = manifold.decode(manifold.encode(joints))
    error = np.abs(decoded - joints)
    (position, rotation), (wanted, wanted_rotation) = robot.forward(decoded), robot.forward(joints)
    tool_mm = 1e3 * np.linalg.norm(position - wanted, axis=-1)
    turn_deg = np.degrees(angles_between(rotation, wanted_rotation))
    return {
        "joint_error_mean_rad": float(error.mean()),
        "joint_error_p95_rad": float(np.quantile(error, 0.95)),
        "tool_error_median_mm": float(np.median(tool_mm)),
        "tool_error_p95_mm": float(np.quantile(tool_mm, 0.95)),
        "orientation_error_median_deg": float(np.median(turn_deg)),
        "orientation_error_p95_deg": float(np.quantile(turn_deg, 0.95)),
    }


def angles_between(
    first: Float[np.ndarray, "*batch 3 3"], second: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch"]:
    """Angle [rad] of the rotation that takes one to the other: ‖R − R'‖ = √8 sin(θ/2)."""
    apart = np.linalg.norm(first - second, axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0))


def sample_figures(
    samples: Joints, checked: Joints, held_out: Joints, robot: SerialRobot, world: World
) -> Figures:
    """Share of samples within the limits, share of those checked that also touch nothing, and the
    distance from held-out configurations to the nearest of all samples [rad].
    """
    nearest = np.asarray(KDTree(samples).query(held_out)[0])
    return {
        "sample_inside": float((robot.limit_distance(samples) >= 0.0).mean()),
        "sample_free": float(_usable(checked, robot, world).mean()),
        "coverage_mean_rad": float(nearest.mean()),
        "coverage_p95_rad": float(np.quantile(nearest, 0.95)),
    }


def _usable(joints: Joints, robot: SerialRobot, world: World) -> np.ndarray:
    """Which configurations are within the limits and touch nothing."""
    return (robot.limit_distance(joints) >= 0.0) & world.free(joints)


def projection_figures(
    constraint: ConstraintManifold, samples: Joints, tolerance: float, world: World
) -> Figures:
    """Share of samples that keep a constraint as they are, projected, and projected within the
    limits without a contact; and what the projection of one that keeps it then takes.
    """
    retract(constraint, samples[:WARM])
    seconds = []
    for _ in range(ROUNDS):
        began = time.process_time()
        projected = retract(constraint, samples)
        seconds.append(time.process_time() - began)
    kept = projected.joints[projected.violation <= tolerance]
    return {
        "kept_before": float((constraint.violation(samples) <= tolerance).mean()),
        "kept_after": len(kept) / len(samples),
        "usable_after": float(_usable(kept, constraint.robot, world).sum()) / len(samples),
        "projected_us": 1e6 * float(np.median(seconds)) / max(len(kept), 1),
    }


def geodesic_figures(task: LearnerTask, manifold: Charted, world: World) -> Figures:
    """Geodesics of the metric (eq. 5) between pairs of held-out configurations, over the straight
    joint line's length: as the metric measures them, and decoded with their ends corrected.
    """
    count = task.settings.pairs
    start, goal = task.held_out[:count], task.held_out[count : 2 * count]
    z = manifold.encode(np.concatenate([start, goal]))
    problem = ChartProblem(manifold, task.curve, Samples(z))
    began = time.process_time()
    found = geodesics_between(GradientSolver(starts=1), problem, z[:count], z[count:])
    spent, t = time.process_time() - began, np.linspace(0.0, 1.0, POINTS)
    decoded = manifold.decode(np.array([own.points(t) for own in found]))
    paths = corrected(decoded, t, start, goal)
    straight = np.linalg.norm(goal - start, axis=1)
    lengths = np.linalg.norm(np.diff(paths, axis=1), axis=-1).sum(axis=1)
    free = _usable(paths.reshape(-1, paths.shape[-1]), task.scene.robot, world)
    return {
        "geodesic_converged": float(np.mean([own.status == "converged" for own in found])),
        "geodesic_ratio_mean": float(np.mean([own.length for own in found] / straight)),
        "decoded_ratio_mean": float(np.mean(lengths / straight)),
        "decoded_free": float(free.reshape(paths.shape[:2]).all(axis=1).mean()),
        "geodesic_ms": 1e3 * spent / count,
    }


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """All rows, in the order of the learners, then by seed."""
    table = pd.DataFrame(rows)
    order = table["learner"].map({name: place for place, name in enumerate(LEARNERS)})
    return (
        table.assign(order=order)
        .sort_values(["order", "seed"], kind="stable", ignore_index=True)
        .drop(columns="order")
    )


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """Mean and standard deviation over seeds of every figure: those of the learners, and by
    constraint.
    """
    own = table[table["constraint"] == ""]
    kept = table[table["constraint"] != ""]
    return {
        "learners": {str(name): _figures(part) for name, part in own.groupby("learner")},
        "constraints": {
            str(constraint): {str(name): _figures(own) for name, own in part.groupby("learner")}
            for constraint, part in kept.groupby("constraint")
        },
    }


def _figures(part: pd.DataFrame) -> dict[str, dict[str, float]]:
    return {
        str(figure): {"mean": float(values.mean()), "deviation": float(values.std(ddof=0))}
        for figure, values in part.groupby("figure")["value"]
    }
