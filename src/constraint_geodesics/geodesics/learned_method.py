"""The paper's system as a method of the planner: one learned manifold, the constraint's part of it,
and cubic curves that a trained policy proposes in its chart, alone or refined.  The chart is what
it was trained in: joint space, in the pipeline as it stands, or the learned manifold, as in the
paper.

A query's ends are joined to the sub-manifold's graph (eq. 8); where they lie in different
components there is no path.  Otherwise the policy proposes curves in rounds (eqs. 9-15), which are
decoded and projected onto the constraint; the planner certifies them like any others.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float, Int
from pydantic import ValidationError

from constraint_geodesics.bundle import (
    Bundle,
    BundleError,
    bundle_folder,
    read_files,
    roadmap_arrays,
    roadmaps_of,
    write_files,
)
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.formats import LEARNED
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Ends
from constraint_geodesics.geodesics.proposals import MeanPolicy, Met, rounds
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.learning.learned_manifold import JOINT_SPACE, LearnedManifold, joint_space
from constraint_geodesics.learning.lift import closely
from constraint_geodesics.params import GeodesicParams, RobotParams
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.search.band import ACCURACY, step_lengths
from constraint_geodesics.search.candidates import (
    Answer,
    Candidate,
    Parts,
    Task,
    connection,
    refined,
)
from constraint_geodesics.search.curve_kernels import CHECK_STEP
from constraint_geodesics.search.roadmap import Roadmap
from constraint_geodesics.taken_along import as_taken

FOLDER = "learned"
"""Beside the planner's folder, or in it, as in the package."""
CARD, MANIFOLD, POLICY, SUBMANIFOLDS = (
    "learned.json",
    "manifold.safetensors",
    "policy.safetensors",
    "submanifolds.safetensors",
)
PAST = 1000
"""Random configurations that are projected onto a constraint, for curves to bend towards."""
MOST_CHECKED = 12
"""Curves of a round that are looked at closely: those behind them are mostly alike."""
TOUCHING_M = 1e-4
"""Clearance below which a configuration counts as touching something."""
KEPT = 32
"""Constraints whose problem is kept for the next query."""
_SLACK_RAD = 1e-9


@dataclass(frozen=True)
class LearnedFiles:
    """What the method is made of: the robot it was trained for, the name of the policy's chart and
    its settings, the arrays of the networks, and the sub-manifolds' graphs by constraint.
    """

    robot: RobotParams
    chart: str
    settings: GeodesicParams
    manifold: Mapping[str, np.ndarray]
    policy: Mapping[str, np.ndarray]
    submanifolds: Mapping[str, Roadmap]

    def write(self, folder: Path) -> None:
        """Write all files."""
        card = {
            "robot": self.robot.model_dump(mode="json"),
            "chart": self.chart,
            "policy": self.settings.model_dump(mode="json"),
        }
        arrays = {
            MANIFOLD: self.manifold,
            POLICY: self.policy,
            SUBMANIFOLDS: roadmap_arrays(self.submanifolds),
        }
        write_files(folder / CARD, LEARNED, card, arrays)


def read_learned(folder: Path) -> LearnedFiles:
    """Read what `LearnedFiles.write` wrote.

    Raises BundleError if a file is missing, altered (its checksum differs), or of a format that
    this release can't read.
    """
    names = (MANIFOLD, POLICY, SUBMANIFOLDS)
    card, arrays = read_files(folder / CARD, LEARNED, names)
    try:
        robot, chart = RobotParams.model_validate(card["robot"]), str(card["chart"])
        settings = GeodesicParams.model_validate(card["policy"])
    except (KeyError, ValidationError) as error:
        about = " ".join(str(error).split())[:200]
        raise BundleError(f"{folder / CARD}: not a learned method's card: {about}") from None
    manifold, policy, graphs = (arrays[name] for name in names)
    readers = {MANIFOLD: LearnedManifold.from_arrays, POLICY: MeanPolicy.from_arrays}
    for name, reader in readers.items():
        try:
            reader(arrays[name])
        except (KeyError, TypeError, ValueError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise BundleError(f"{folder / name}: not what it is called: {what}") from None
    graphs_file = folder / SUBMANIFOLDS
    return LearnedFiles(robot, chart, settings, manifold, policy, roadmaps_of(graphs, graphs_file))


@dataclass(frozen=True)
class LatentCurve:
    """One curve between two ends on the learned manifold (eqs. 9-11) as a curve in joint space.

    phi (p,): its free coefficients.
    """

    problem: LearnedProblem
    ends: Ends
    phi: Float[np.ndarray, "p"]

    def decoded(self, t: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T D"]:
        """Points at times from 0 to 1, both among them, decoded with their ends corrected, not
        projected [rad].
        """
        return self.problem.lifted_at(self.phi[None], self.ends, t, None).joints[0]

    def at(self, s: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n D"], float]:
        """Points at any times, projected [rad], and what is left of the violation; the ends are the
        query's, to the bit.
        """
        t = np.concatenate([[0.0], s, [1.0]])
        lifted = self.problem.lifted_at(self.phi[None], self.ends, t, Retraction())
        points = lifted.joints[0, 1:-1]
        points[s == 0.0], points[s == 1.0] = self.ends.q_start[0], self.ends.q_goal[0]
        inner = lifted.violation[0, 1:-1][(s > 0.0) & (s < 1.0)]
        return points, float(inner.max(initial=0.0))


class LearnedMethod:
    """The policy's curves as they are."""

    name = "learned"

    def __init__(self, files: LearnedFiles) -> None:
        self.files = files
        self.roadmaps: Mapping[str, Roadmap] | None = files.submanifolds
        learned = FrozenManifold(files.manifold)
        self.draw = learned.draw
        self._problems: dict[int, LearnedProblem] = {}

    @classmethod
    def open(cls, source: str | Path | None, bundle: Bundle) -> Self:
        """From the folder `learned` in the planner's folder, or beside it.

        Raises BundleError if its files are missing, altered, or of another robot.
        """
        if isinstance(source, str) and ":/" in source:
            raise BundleError(f"{source}: holds no learned method: name a folder")
        folder = bundle_folder(source)
        inside = folder / FOLDER
        place = inside if inside.is_dir() else folder.parent / FOLDER
        files = read_learned(place)
        if as_taken(files.robot) != as_taken(bundle.robot):
            raise BundleError(f"{place / CARD}: trained for another robot than the planner's")
        return cls(files)

    @cached_property
    def _policy(self) -> MeanPolicy:
        return MeanPolicy.from_arrays(self.files.policy)

    def _chart(self, robot: SerialRobot) -> LearnedManifold:
        if self.files.chart == JOINT_SPACE:
            return joint_space(robot)
        return LearnedManifold.from_arrays(self.files.manifold)

    def _problem(self, task: Task) -> LearnedProblem:
        key = id(task.manifold)  # the problem holds the manifold, so that its id stays its own
        kept = self._problems.get(key)
        if kept is not None and kept.clearance is task.clearance:
            return kept
        while len(self._problems) >= KEPT:
            self._problems.pop(next(iter(self._problems)))
        learned, settings = self._chart(task.manifold.robot), self.files.settings
        curve, degree = PinnedPolynomial(learned.dim, settings.degree), settings.length_degree
        past = _free_configurations(task)
        space = learned, task.manifold, curve, past, degree, True, 0.0
        self._problems[key] = LearnedProblem(*space, clearance=task.clearance)
        return self._problems[key]

    def curves(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
    ) -> Iterator[tuple[LatentCurve, ...]]:
        """Rounds of curves from the straight chart line on, under any constraint, seen in training
        or not.
        """
        problem = self._problem(task)
        ends = problem.ends(start[None], goal[None])
        policy, settings = self._policy, self.files.settings
        for met in rounds(problem, policy, settings, ends, np.random.default_rng(0)):
            yield tuple(LatentCurve(problem, ends, met.phi[k]) for k in self.chosen(met))

    def chosen(self, met: Met) -> Int[np.ndarray, "k"]:
        """Which curves of a round are worth a look: all that seem feasible, the cheapest first."""
        return met.usable[:MOST_CHECKED]

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer | None]:
        """The policy's curves, the cheapest first, round after round; none where the sub-manifold's
        graph holds the ends to be unconnected.
        """
        answer = connection(task, start, goal)
        if answer.status != "not_connected":
            for curves in self.curves(task, start, goal):
                yield from self.sound(task, curves)
                yield None
        yield answer

    def sound(self, task: Task, curves: Sequence[LatentCurve]) -> Iterator[Candidate]:
        """Curves that are continuous and within the limits, in their order."""
        found = (sampled(task, curve) for curve in curves)
        return (candidate for candidate in found if candidate is not None)

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """Curves of later rounds too, which may turn out shorter than the first."""
        for candidate in self.candidates(task, start, goal, parts):
            if isinstance(candidate, Candidate):
                yield candidate

    def further(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Iterator[Candidate]]:
        """No others: the curves of all rounds are candidates."""
        return iter(())


class RefinedLearnedMethod(LearnedMethod):
    """The policy's curves, each relaxed by the planner's elastic band."""

    name = "learned+band"

    def chosen(self, met: Met) -> Int[np.ndarray, "k"]:
        """The best of every roll-out: refined, the others of it become the same curve."""
        return met.best_of_each

    def sound(self, task: Task, curves: Sequence[LatentCurve]) -> Iterator[Candidate]:
        """The shortest first, then the curves as they are: a band may meet what they pass."""
        t = np.linspace(0.0, 1.0, task.settings.segments + 1)
        found = (refined(task, "policy", curve.decoded(t)) for curve in curves)
        yield from sorted((c for c in found if c is not None), key=lambda c: c.length)
        yield from super().sound(task, curves)


def _free_configurations(task: Task) -> Float[np.ndarray, "n D"]:
    """Configurations that keep constraint, limits and clearance, which random curves bend
    towards; others where PAST draws find none.
    """
    robot, rng = task.manifold.robot, np.random.default_rng(0)
    found = retract(task.manifold, robot.sample(PAST, rng))
    kept = found.converged & (robot.limit_distance(found.joints) >= 0.0)
    joints = found.joints[kept]
    free = joints[task.clearance.clearance(robot, joints, TOUCHING_M) >= TOUCHING_M]
    return free if len(free) else found.joints


def sampled(task: Task, curve: LatentCurve) -> Candidate | None:
    """The curve through its points about CHECK_STEP apart; None where it jumps, leaves the
    constraint or the joint limits.
    """
    worst = 0.0

    def at(times: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n D"]:
        nonlocal worst
        points, left = curve.at(times)
        worst = max(worst, left)
        return points

    _, points = closely(at, CHECK_STEP)
    robot, steps = curve.problem.manifold.robot, step_lengths(points)
    inside = robot.limit_distance(points).min() >= -_SLACK_RAD
    if not (worst <= 1e3 * ACCURACY and inside and steps.max() <= CHECK_STEP):
        return None
    return Candidate("policy", task.open, points, float(steps.sum()), points)
