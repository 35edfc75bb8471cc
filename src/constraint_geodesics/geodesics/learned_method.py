"""The paper's system as a method of the planner: one learned manifold, the constraint's part of it,
and cubic curves that trained policies find there, alone or refined.

A query's ends are joined to the sub-manifold's graph (eq. 8); where they lie in different
components there is no path.  Otherwise every policy proposes its best latent curve (eqs. 9-15),
which is decoded and projected onto the constraint; the planner certifies it like any other.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float
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
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geodesics.problem import Ends, LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy, propose
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import jump_excess
from constraint_geodesics.params import GeodesicParams, RobotParams
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

FORMAT = 1
FOLDER = "learned"
"""Beside the planner's folder, or in it, as in the package."""
CARD, MANIFOLD, POLICIES, SUBMANIFOLDS = (
    "learned.json",
    "manifold.safetensors",
    "policies.safetensors",
    "submanifolds.safetensors",
)
KEPT = 32
"""Constraints whose problem is kept for the next query."""
_FIRST_POINTS = 65
_SLACK_RAD = 1e-9


@dataclass(frozen=True)
class LearnedFiles:
    """What the method is made of: the robot it was trained for, the policies' settings, the arrays
    of the networks (the policies' under `seed/name`), and the sub-manifolds' graphs by constraint.
    """

    robot: RobotParams
    policy: GeodesicParams
    manifold: Mapping[str, np.ndarray]
    policies: Mapping[str, np.ndarray]
    submanifolds: Mapping[str, Roadmap]

    def write(self, folder: Path) -> None:
        """Write all files."""
        card = {
            "robot": self.robot.model_dump(mode="json"),
            "policy": self.policy.model_dump(mode="json"),
        }
        arrays = {
            MANIFOLD: self.manifold,
            POLICIES: self.policies,
            SUBMANIFOLDS: roadmap_arrays(self.submanifolds),
        }
        write_files(folder / CARD, FORMAT, card, arrays)


def read_learned(folder: Path) -> LearnedFiles:
    """Read what `LearnedFiles.write` wrote.

    Raises BundleError if a file is missing, altered (its checksum differs), or of another format.
    """
    names = (MANIFOLD, POLICIES, SUBMANIFOLDS)
    card, arrays = read_files(folder / CARD, FORMAT, names)
    try:
        robot = RobotParams.model_validate(card["robot"])
        policy = GeodesicParams.model_validate(card["policy"])
    except (KeyError, ValidationError) as error:
        about = " ".join(str(error).split())[:200]
        raise BundleError(f"{folder / CARD}: not a learned method's card: {about}") from None
    manifold, policies, graphs = (arrays[name] for name in names)
    return LearnedFiles(robot, policy, manifold, policies, roadmaps_of(graphs))


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
    """The policies' curves as they are."""

    name = "learned"

    def __init__(self, files: LearnedFiles) -> None:
        self.files = files
        self.roadmaps: Mapping[str, Roadmap] | None = files.submanifolds
        learned = FrozenManifold(files.manifold)
        self.draw = lambda count, rng: learned.decode(learned.sample(count, rng))
        self._problems: dict[int, LearnedProblem] = {}

    @classmethod
    def open(cls, source: str | Path | None, bundle: Bundle) -> Self:
        """From the folder `learned` in the planner's folder, or beside it.

        Raises BundleError if its files are missing, altered, or of another robot.
        """
        folder = bundle_folder(source)
        inside = folder / FOLDER
        place = inside if inside.is_dir() else folder.parent / FOLDER
        files = read_learned(place)
        if files.robot != bundle.robot:
            raise BundleError(f"{place / CARD}: trained for another robot than the planner's")
        return cls(files)

    @cached_property
    def _networks(self) -> tuple[LearnedManifold, list[MeanPolicy]]:
        by_seed: dict[int, dict[str, np.ndarray]] = {}
        for address, values in self.files.policies.items():
            seed, name = address.split("/")
            by_seed.setdefault(int(seed), {})[name] = values
        policies = [MeanPolicy.from_arrays(by_seed[seed]) for seed in sorted(by_seed)]
        return LearnedManifold.from_arrays(self.files.manifold), policies

    def _problem(self, manifold: ConstraintManifold) -> LearnedProblem:
        key = id(manifold)  # the problem holds the manifold, so that its id stays its own
        if key not in self._problems:
            while len(self._problems) >= KEPT:
                self._problems.pop(next(iter(self._problems)))
            learned, settings = self._networks[0], self.files.policy
            curve = PinnedPolynomial(learned.dim, settings.degree)
            nobody, degree = np.empty((0, manifold.robot.dof)), settings.length_degree
            self._problems[key] = LearnedProblem(
                learned, manifold, curve, nobody, degree, True, 0.0
            )
        return self._problems[key]

    def curves(
        self,
        manifold: ConstraintManifold,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
    ) -> list[LatentCurve]:
        """The best curve that each policy meets on its way from the straight latent line, feasible
        ones first; under any constraint, seen in training or not.
        """
        problem, policies = self._problem(manifold), self._networks[1]
        ends = problem.ends(start[None], goal[None])
        found = propose(problem, policies, self.files.policy, ends)
        order = np.lexsort((found.cost[:, 0], ~found.feasible[:, 0]))
        return [LatentCurve(problem, ends, found.phi[k, 0]) for k in order]

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer]:
        """The policies' curves, feasible ones first; none where the sub-manifold's graph holds the
        ends to be unconnected.
        """
        answer = connection(task, start, goal)
        if answer.status != "not_connected":
            yield from self.sound(task, self.curves(task.manifold, start, goal))
        yield answer

    def sound(self, task: Task, curves: Sequence[LatentCurve]) -> list[Candidate]:
        """Curves that are continuous and within the limits, in their order."""
        found = (sampled(task, curve) for curve in curves)
        return [candidate for candidate in found if candidate is not None]

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """The other policies' curves, which may turn out shorter than the first."""
        for candidate in self.candidates(task, start, goal, parts):
            if isinstance(candidate, Candidate):
                yield candidate


class RefinedLearnedMethod(LearnedMethod):
    """The policies' curves, each relaxed by the planner's elastic band."""

    name = "learned+band"

    def sound(self, task: Task, curves: Sequence[LatentCurve]) -> list[Candidate]:
        """The shortest first."""
        t = np.linspace(0.0, 1.0, task.settings.segments + 1)
        found = (refined(task, "policy", curve.decoded(t)) for curve in curves)
        return sorted((c for c in found if c is not None), key=lambda c: c.length)


def sampled(task: Task, curve: LatentCurve) -> Candidate | None:
    """The curve through its points about CHECK_STEP apart; None where it jumps, leaves the
    constraint or the joint limits.
    """
    shares = np.linspace(0.0, 1.0, _FIRST_POINTS)
    points, left = curve.at(shares)
    longest = step_lengths(points).max()
    if np.isfinite(longest) and longest > CHECK_STEP:
        pieces = int(np.ceil((_FIRST_POINTS - 1) * longest / CHECK_STEP))
        shares = np.linspace(0.0, 1.0, min(pieces, 8 * _FIRST_POINTS) + 1)
        points, left = curve.at(shares)
    robot = curve.problem.manifold.robot
    inside = robot.limit_distance(points).min() >= -_SLACK_RAD
    if not (left <= 1e3 * ACCURACY and inside and jump_excess(points, shares) == 0.0):
        return None
    return Candidate("policy", task.open, points, float(step_lengths(points).sum()), points)
