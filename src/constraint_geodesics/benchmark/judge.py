"""One judge and one routine of measurement for every path, learned or sampled."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.params import JudgeParams
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.clearance import ClearanceModel

if TYPE_CHECKING:
    from constraint_geodesics.learning.learned_manifold import LearnedManifold

Free = Callable[[Float[np.ndarray, "n D"]], Bool[np.ndarray, "n"]]


@dataclass(frozen=True)
class PathMeasures:
    """What one joint path is worth; lengths are nan where there is no path.

    valid: the judge's word, whatever its planner says; reason: the first rule it breaks, or "".
    length_rad: in joint space.  tool_length_m: of the tool's way.  latent_length: on each learned
    manifold, of the encoded path, ∫‖d f‖ (eq. 2) [rad].  max_violation_*: of the constraint, held
    angles [rad], held positions [m].
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


def judge_limits(judge: JudgeParams) -> Limits:
    """What the judge demands, as the certifier takes it."""
    return Limits(
        end_tolerance_rad=judge.end_tolerance_rad,
        max_step_rad=judge.max_step_rad,
        violation_tolerance=judge.violation_tolerance,
    )


def problem_of(
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    manifold: ConstraintManifold,
    certifier: Certifier,
    clearance: ClearanceModel | None,
) -> PlanningProblem:
    """A problem in the certifier's scene: its compiled checks are asked of configurations and
    lines, its certificate of whole paths, once where the same one is asked about again.
    """
    checks = certifier.collisions
    last = list[tuple[Float[np.ndarray, "T D"], bool]]()

    def is_sound(joints: Float[np.ndarray, "T D"]) -> bool:
        if not (last and last[0][0] is joints):
            valid = certifier.certify(joints, manifold.constraint, start, goal).valid
            last[:] = [(joints, valid)]
        return last[0][1]

    known = checks.is_free, clearance, checks.is_clear, is_sound
    return PlanningProblem(start, goal, manifold, *known)


def measure_path(
    joints: Float[np.ndarray, "T D"],
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    manifold: ConstraintManifold,
    charts: Mapping[str, "LearnedManifold"],
    certifier: Certifier,
    spacing_rad: float,
) -> PathMeasures:
    """Judge and measure a path as it is executed: straight joint lines between its points.

    joints: (T, D) [rad], or (0, D) where nothing was found.  The verdict is the certifier's;
    spacing_rad is that of the points the other lengths are measured on.
    """
    if len(joints) < 2:
        return _unmeasured("no path", charts)
    if not np.isfinite(joints).all():
        return _unmeasured("not finite", charts)
    certificate = certifier.certify(joints, manifold.constraint, start, goal)
    dense = densify(joints, spacing_rad)
    broken = certificate.violation
    return PathMeasures(
        certificate.valid,
        "" if broken is None else broken.kind.replace("_", " "),
        certificate.length_rad,
        polyline_length(manifold.robot.forward(dense)[0]),
        {name: polyline_length(chart.embed_joints(dense)) for name, chart in charts.items()},
        certificate.max_violation_rad,
        certificate.max_violation_m,
        certificate.max_step_rad,
    )


def _unmeasured(reason: str, charts: Mapping[str, "LearnedManifold"]) -> PathMeasures:
    nan = float("nan")
    return PathMeasures(False, reason, nan, nan, dict.fromkeys(charts, nan), nan, nan, nan)


def polyline_length(points: Float[np.ndarray, "T A"]) -> float:
    """Length of the straight lines between points, in their unit."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())
