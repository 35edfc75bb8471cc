"""One judge and one routine of measurement for every path, learned or sampled."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.lift import densify
from constraint_geodesics.constraints.vector import ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import JudgeParams

Free = Callable[[Float[np.ndarray, "n D"]], Bool[np.ndarray, "n"]]


@dataclass(frozen=True)
class PathMeasures:
    """What one joint path is worth; lengths are nan where there is no path.

    valid: the judge's word, whatever its planner says; reason: the first rule it breaks, or "".
    length_rad: in joint space.  tool_length_m: of the tool's way.  latent_length: on each learned manifold, of the
    encoded path, ∫‖d f‖ (eq. 2) [rad].  max_violation_*: of the constraint, held angles [rad], held positions [m].
    """

    valid: bool
    reason: str
    length_rad: float
    tool_length_m: float
    latent_length: dict[str, float]
    max_violation_rad: float
    max_violation_m: float
    max_step_rad: float

    def row(self) -> dict[str, Any]:
        """As columns of a table."""
        columns = asdict(self)
        latent = columns.pop("latent_length")
        return columns | {f"latent_length_{name}": value for name, value in latent.items()}


def measure_path(
    joints: Float[np.ndarray, "T D"], start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"],
    manifold: ConstraintManifold, charts: Mapping[str, LearnedManifold], free: Free, judge: JudgeParams,
) -> PathMeasures:  # fmt: skip
    """Judge and measure a path as it is executed: straight joint lines between its points.

    joints: (T, D) [rad], or (0, D) where nothing was found.
    """
    if len(joints) < 2:
        return _unmeasured("no path", charts)
    if not np.isfinite(joints).all():
        return _unmeasured("not finite", charts)
    dense = densify(joints, judge.spacing_rad)
    # halfway between two points on the constraint a straight line is furthest from it
    checked = np.concatenate([dense, 0.5 * (dense[1:] + dense[:-1])])
    largest_m = float(manifold.inclusion(checked)[:, :3].max())
    largest_rad = manifold_angle(manifold, checked)
    steps = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    position = manifold.robot.forward(dense)[0]
    ends_off = max(np.abs(joints[0] - start).max(), np.abs(joints[-1] - goal).max())
    rules = (
        (lambda: ends_off <= judge.end_tolerance_rad, "ends missed"),
        (lambda: steps.max() <= judge.max_step_rad, "jump"),
        (lambda: manifold.robot.limit_distance(dense).min() >= -1e-9, "outside the limits"),
        (lambda: max(largest_m, largest_rad) <= judge.violation_tolerance, "constraint violated"),
        (lambda: bool(free(dense).all()), "collision"),
    )
    reason = next((name for rule, name in rules if not rule()), "")
    return PathMeasures(
        reason == "",
        reason,
        polyline_length(joints),
        polyline_length(position),
        {name: polyline_length(chart.embed_joints(dense)) for name, chart in charts.items()},
        largest_rad,
        largest_m,
        float(steps.max()),
    )


def _unmeasured(reason: str, charts: Mapping[str, LearnedManifold]) -> PathMeasures:
    nan = float("nan")
    return PathMeasures(False, reason, nan, nan, dict.fromkeys(charts, nan), nan, nan, nan)


def manifold_angle(manifold: ConstraintManifold, q: Float[np.ndarray, "n D"]) -> float:
    """Largest excess of the held angles over their tolerance [rad], of the whole angle where they form a cone."""
    angles = manifold.inclusion(q)[:, 3:]
    if len(set(manifold.tolerance[3:][manifold.held[3:]])) == 1:
        return float(np.linalg.norm(angles, axis=-1).max())
    return float(angles.max())


def polyline_length(points: Float[np.ndarray, "T A"]) -> float:
    """Length of the straight lines between points, in their unit."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())
