"""Every planner of the benchmark by the name that params.yaml gives it: the one place that knows
how each is made.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.bundle import Bundle, read_bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    GridSubmanifold,
    load_submanifold,
)
from constraint_geodesics.params import BenchmarkParams, Params
from constraint_geodesics.peers.bayesian_optimisation import BayesianPlanner
from constraint_geodesics.peers.decoder_sampling import DecoderSampling
from constraint_geodesics.peers.elastic_band import BandAfter, MultiStartBand, StraightBand
from constraint_geodesics.peers.latent_geodesic import GradientGeodesic, StraightLatent
from constraint_geodesics.peers.latent_grid import GridSearch, LatentGraphSearch
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.restarts import Restarted
from constraint_geodesics.peers.trajectory_optimisation import TrajectoryOptimisation
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.candidates import ALL_PARTS, Parts

KEPT_ANSWERS = 16
"""Answers that a planner with a band after it is remembered for: more than it has seeds."""


OWN = ("algorithm", "simplify", "band", "restarts_s")
"""Settings of a sampling planner that are not BenchmarkParams'."""


class PeerError(ValueError):
    """A planner of the benchmark can't be made; the message is one line with its name."""


@dataclass(frozen=True)
class ThePlanner:
    """The planner that users call, or some of its parts, behind the interface of its peers."""

    name: str
    planner: Planner
    parts: Parts = ALL_PARTS
    budget_s: float | None = None

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:  # nothing in it is random
        """One query under the problem's constraint."""
        path = self.planner.plan(
            problem.start,
            problem.goal,
            problem.manifold.constraint,
            parts=self.parts,
            budget_s=self.budget_s,
        )
        explanation = "" if path.status == "solved" else path.explanation
        return Solution(path.status, path.joints, path.planning_time_s, 1, explanation)


@dataclass(frozen=True)
class Remembered:
    """A planner whose last answers are kept, so that a band after it shortens the very path that
    its own row shows.

    An answer holds the time it took, whoever asks for it again.
    """

    inner: PathPlanner
    _last: deque[tuple[PlanningProblem, int, Solution]] = field(
        default_factory=lambda: deque(maxlen=KEPT_ANSWERS)
    )

    @property
    def name(self) -> str:
        """The planner's."""
        return self.inner.name

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The planner's answer; for the same problem, as an object, and seed it is not asked
        again.
        """
        for asked, own_seed, answer in self._last:
            if asked is problem and own_seed == seed:
                return answer
        answer = self.inner.plan(problem, seed)
        self._last.append((problem, seed, answer))
        return answer


@dataclass(frozen=True)
class Wanted:
    """What a planner is made for: its name and settings, the scene, the constraint, and the run it
    takes parts from.
    """

    name: str
    settings: Mapping[str, Any]
    scene: Scene
    constraint: str
    manifold: ConstraintManifold
    params: Params
    layout: Layout
    opened: ExitStack
    shared: dict[str, Any]

    def remembered(
        self, settings: Mapping[str, Any], make: Callable[[], PathPlanner]
    ) -> Remembered:
        """One planner for all names that have these settings."""
        key = repr(sorted(settings.items()))
        if key not in self.shared:
            self.shared[key] = Remembered(make())
        found: Remembered = self.shared[key]
        return found

    def the_planner(self, make: Callable[[], Planner]) -> Planner:
        """One planner for all names that switch parts of it off."""
        if "planner" not in self.shared:
            self.shared["planner"] = make()
        found: Planner = self.shared["planner"]
        return found

    @property
    def searched(self) -> str:
        """Name of the manifold that the planner uses."""
        return self.params.geodesics.searched[0]

    @property
    def bundle(self) -> Bundle:
        """The planner's files."""
        return _bundle(self.layout.planner)

    def chart(self, manifold: str) -> LearnedManifold:
        """One of the learned manifolds."""
        return _chart(self.layout.manifold(manifold))


@dataclass(frozen=True)
class PeerBuilder:
    """Makes the benchmark's planners from one run's networks, graphs and parameters; picklable."""

    params: Params
    root: Path

    @contextmanager
    def __call__(
        self, names: Sequence[str], scene: Scene, constraint: str, manifold: ConstraintManifold
    ) -> Iterator[tuple[Mapping[str, PathPlanner], Mapping[str, float]]]:
        """The planners of these names for one scene and constraint, and the seconds that making
        each one took; names that share what they are made of share that time with the first of
        them.

        Raises PeerError if a name, kind or setting does not exist.
        """
        known = self.params.bench.planners
        with ExitStack() as opened:
            made: dict[str, PathPlanner] = {}
            took: dict[str, float] = {}
            shared: dict[str, Any] = {}
            for name in names:
                if name not in known:
                    raise PeerError(
                        f"bench.planners has no {name!r}: must be one of {', '.join(known)}"
                    )
                entry = known[name]
                began = time.perf_counter()
                wanted = Wanted(
                    name,
                    entry.settings,
                    scene,
                    constraint,
                    manifold,
                    self.params,
                    Layout(self.root),
                    opened,
                    shared,
                )
                made[name] = _made(entry.kind, wanted)
                took[name] = time.perf_counter() - began
            yield made, took


def _made(kind: str, wanted: Wanted) -> PathPlanner:
    if kind not in KINDS:
        raise PeerError(
            f"bench.planners.{wanted.name}: no kind {kind!r}: must be one of {', '.join(KINDS)}"
        )
    try:
        return KINDS[kind].make(wanted)
    except TypeError as error:
        raise PeerError(f"bench.planners.{wanted.name}.settings: {error}") from None


def _planner(wanted: Wanted) -> PathPlanner:
    settings = dict(wanted.settings)
    budget_s = settings.pop("budget_s", None)
    return ThePlanner(
        wanted.name, wanted.the_planner(lambda: _opened(wanted)), Parts(**settings), budget_s
    )


def _opened(wanted: Wanted) -> Planner:
    """The planner in the wanted scene, its graph and networks loaded."""
    within = wanted.bundle.workcell.including(*wanted.scene.workcell)
    planner = wanted.opened.enter_context(
        Planner(replace(wanted.bundle, workcell=within), "the pipeline's outputs")
    )
    constraint = wanted.manifold.constraint
    planner.prepare(constraint)
    nodes, trees = planner.nodes(constraint), Parts(straight=False, graph=False)
    planner.plan(nodes[0], nodes[-1], constraint, parts=trees)  # loads the trees' compiled code
    return planner


def _ompl(wanted: Wanted) -> PathPlanner:
    own: dict[str, Any] = {
        "algorithm": "birrt",
        "simplify": True,
        "band": False,
        "restarts_s": None,
    }
    own |= dict(wanted.settings)
    changed = {name: own[name] for name in own if name not in OWN}
    unknown = set(changed) - set(type(wanted.params.benchmark).model_fields)
    if unknown:
        raise TypeError(f"there is no setting {', '.join(sorted(unknown))}")
    settings = wanted.params.benchmark.model_copy(update=changed)
    spacing = wanted.params.judge.row_spacing_rad

    def make() -> PathPlanner:
        return SamplingPlanner(own["algorithm"], settings, own["simplify"], spacing)

    if own["restarts_s"] is not None:
        return Restarted(BandAfter(make()) if own["band"] else make(), own["restarts_s"])
    made = wanted.remembered(own | {"band": False}, make)
    return BandAfter(made) if own["band"] else made


def _many_bands(wanted: Wanted) -> PathPlanner:
    settings = dict(wanted.settings)
    restarts_s = settings.pop("restarts_s", None)
    made = _bands(wanted, settings)
    return made if restarts_s is None else Restarted(made, restarts_s)


def _bands(wanted: Wanted, settings: Mapping[str, Any]) -> MultiStartBand:
    roadmap = wanted.bundle.roadmaps.get(wanted.constraint)
    if roadmap is None or not len(roadmap.joints):
        return MultiStartBand(**settings)
    nodes = roadmap.joints

    def configurations(
        _: ConstraintManifold, count: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "count D"]:
        return nodes[rng.integers(len(nodes), size=count)]

    return MultiStartBand(configurations=configurations, **settings)


def _grid(wanted: Wanted) -> PathPlanner:
    settings = {"manifold": "paper"} | dict(wanted.settings)
    on = settings.pop("manifold")
    found = load_submanifold(wanted.layout.submanifold(on, wanted.constraint))
    if not isinstance(found, GridSubmanifold):
        raise TypeError(f"manifold = {on!r} has no grid: only one of two dimensions has")
    return GridSearch(wanted.chart(on), wanted.manifold.constraint, found, **settings)


def _latent_graph(wanted: Wanted) -> PathPlanner:
    found = load_submanifold(wanted.layout.submanifold(wanted.searched, wanted.constraint))
    if not isinstance(found, GraphSubmanifold):
        raise TypeError(f"the manifold {wanted.searched!r} has a grid, not a graph")
    return LatentGraphSearch(
        wanted.chart(wanted.searched), wanted.manifold.constraint, found, **wanted.settings
    )


def _decoded(wanted: Wanted) -> PathPlanner:
    settings = {"band": False} | dict(wanted.settings)
    band = settings.pop("band")
    own = {
        name: settings.pop(name) for name in list(settings) if name in BenchmarkParams.model_fields
    }
    benchmark = wanted.params.benchmark.model_copy(update=own)
    made = wanted.remembered(
        settings | own | {"kind": "decoder_sampling"},
        lambda: DecoderSampling(_frozen(wanted), benchmark, **settings),
    )
    return BandAfter(made) if band else made


def _frozen(wanted: Wanted) -> FrozenManifold:
    return FrozenManifold.load(wanted.layout.manifold(wanted.searched))


def _bayesian(wanted: Wanted) -> PathPlanner:
    settings = dict(wanted.settings)
    on = settings.pop("manifold", None)
    return BayesianPlanner(None if on is None else wanted.chart(on), **settings)


@dataclass(frozen=True)
class Kind:
    """How a planner of one kind is made, and the package's modules that hold it, without those that
    they import.
    """

    make: Callable[[Wanted], PathPlanner]
    modules: tuple[str, ...]


KINDS = {
    "planner": Kind(_planner, ("planner",)),
    "ompl": Kind(_ompl, ("peers.ompl", "peers.elastic_band", "peers.restarts")),
    "straight_band": Kind(lambda wanted: StraightBand(**wanted.settings), ("peers.elastic_band",)),
    "many_bands": Kind(_many_bands, ("peers.elastic_band", "peers.restarts")),
    "trajectory_optimisation": Kind(
        lambda wanted: TrajectoryOptimisation(**wanted.settings), ("peers.trajectory_optimisation",)
    ),
    "gradient_geodesic": Kind(
        lambda wanted: GradientGeodesic(wanted.chart(wanted.searched), **wanted.settings),
        ("peers.latent_geodesic",),
    ),
    "straight_latent": Kind(
        lambda wanted: StraightLatent(wanted.chart(wanted.searched), **wanted.settings),
        ("peers.latent_geodesic",),
    ),
    "latent_grid": Kind(_grid, ("peers.latent_grid",)),
    "latent_graph": Kind(_latent_graph, ("peers.latent_grid",)),
    "decoder_sampling": Kind(
        _decoded, ("peers.decoder_sampling", "peers.elastic_band", "learning.inference")
    ),
    "bayesian_optimisation": Kind(_bayesian, ("peers.bayesian_optimisation",)),
}
"""What `kind` may be in params.yaml."""


@lru_cache(maxsize=4)
def _bundle(folder: Path) -> Bundle:
    return read_bundle(folder)


@lru_cache(maxsize=4)
def _chart(folder: Path) -> LearnedManifold:
    return LearnedManifold.load(folder)
