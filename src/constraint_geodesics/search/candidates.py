"""The project's own planner: proposals of a curve, the shortest of which is refined by an elastic
band.

Proposals are tried in the order of what they cost: the straight joint line, bends of it round what
it leads through, the way over the constraint's graph, two trees grown towards each other.  Each is
relaxed by Newton's method on the exact constraint; one that is continuous, within the limits and
clear of the workcell's shapes and of the arm itself is drawn as rows so close together that the
straight lines between them keep the constraint, and goes to the caller, who has it certified.
Curves of another kind come from a method of their own (methods.py), through `refined` or not.
"""

import itertools
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.problem import Status
from constraint_geodesics.scene.clearance import ClearanceModel, path_stays_clear
from constraint_geodesics.search.band import PROJECTION, BandSettings
from constraint_geodesics.search.curve_kernels import relaxed_curve, rows_along
from constraint_geodesics.search.roadmap import (
    Joined,
    Roadmap,
    join,
    nearest,
    points_along,
    resample,
    shortest_way,
)
from constraint_geodesics.search.space import Space, space_of
from constraint_geodesics.search.tree import TreeSettings, tree_way
from constraint_geodesics.search.ways_round import SIDES, bent_round

Source = Literal["straight", "policy", "graph", "tree", "bend"]

ROW_SAFETY = 0.95
"""Share of the allowed violation between two rows that their distance is chosen for."""
ALMOST = 1.1
"""A way that is no longer than so many times the straight distance, or the line relaxed as if
nothing were there, is short enough.
"""
FEW = 2
"""Nodes of a way that is pushed clear of something, as a multiple of a band's: with more an
iteration costs more, and the path gets no shorter.
"""
WIDER, AGAIN = (2.0, 4.0), 10
"""Margins of a band that still clips something, as multiples of the first; iterations with each."""
FIRST, SHALLOW_M = 10, 0.01
"""Iterations after which a bent band is looked at; one that clips nothing deeper [m] is pushed on
at once.
"""
FINER, WITH_FINER = 3.0, 6
"""Margin of a bent band with twice the nodes, as a multiple of the first; iterations with it."""
NEARLY_STRAIGHT, FAR_ROUND = 1.02, 1.25
"""A way no longer than so many times the straight distance is relaxed no further; one that is
longer than so many is left for later where it clips something.
"""
PARTLY_RELAXED = (3, 1, 0)
"""Iterations of a band that must stay near the graph."""
TREES = 4
"""Pairs of trees that are grown where all else failed."""
TREES_APART = 2
"""Where the graph holds the ends to be unconnected, which it hardly ever errs in."""
PATIENT = TreeSettings(iterations=4000, nodes=20_000)
"""Of one more pair, the last."""
TIRELESS = TreeSettings(iterations=16_000, nodes=80_000)
"""Of each pair where there is a budget."""
NARROW_M = 0.0005
"""What is kept clear where no way with the settings' clearance was found [m]: a few times what the
certificate asks for.
"""
BENDS = 4
"""Bent lines that are tried for each pair of trees, where a path is to be improved: they cost less.
"""


@dataclass(frozen=True)
class Parts:
    """Which parts of the planner are switched on; all of them but for an ablation."""

    straight: bool = True
    graph: bool = True
    refinement: bool = True
    tree: bool = True


ALL_PARTS = Parts()


@dataclass(frozen=True)
class Task:
    """One constraint, prepared: the space of its configurations with and without the clearance of
    what may meet, its graph.

    roadmap: the graph, made when it is first asked for; None where there is none.
    """

    manifold: ConstraintManifold
    clearance: ClearanceModel
    roadmap: Callable[[], Roadmap | None]
    settings: BandSettings = field(default_factory=BandSettings)

    def __post_init__(self) -> None:
        margin = self.settings.clearance_m
        object.__setattr__(self, "clear", space_of(self.manifold, self.clearance, margin))
        object.__setattr__(self, "open", space_of(self.manifold))

    @cached_property
    def narrow(self) -> "Task":
        """The same with hardly any clearance, for passages that are narrower."""
        least = min(NARROW_M, self.settings.clearance_m)
        return replace(self, settings=replace(self.settings, clearance_m=least))

    clear: Space = field(init=False, repr=False)
    open: Space = field(init=False, repr=False)


@dataclass(frozen=True)
class Candidate:
    """A curve that looks sound: where it came from, the space that it is in, its points about
    CHECK_STEP apart and their length [rad]; the nodes of its band, the iterations that took,
    whether it was pushed clear of what may meet, and the other ways that were found with it.
    """

    source: Source
    space: Space
    points: Float[np.ndarray, "T D"]
    length: float
    nodes: Float[np.ndarray, "n D"]
    iterations: int = 0
    pushed: bool = False
    others: tuple["Candidate", ...] = ()


@dataclass(frozen=True)
class Answer:
    """What `candidates` ended with where nothing was found, and how the ends are joined to the
    graph.  explanation: where the status alone does not say it.
    """

    status: Status
    at_start: Joined | None = None
    at_goal: Joined | None = None
    explanation: str = ""

    @property
    def is_open(self) -> bool:
        """Whether more tries may find what these did not."""
        return self.status == "not_found" and not self.explanation


def candidates(
    task: Task,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    parts: Parts = ALL_PARTS,
) -> Iterator[Candidate | Answer | None]:
    """Sound curves from the cheapest proposals to the dearest, of one kind the shortest first; None
    where dearer ones begin, and an Answer at the end.

    Where the straight line touches something it is bent round that to either side, and where these
    ways are long the graph is asked for one.  Trees come last.
    """
    blocked = None
    ways: Iterator[Candidate | None] = iter(())
    if parts.straight:
        share = _shares(task.settings.segments)
        line = (1.0 - share) * start + share * goal
        found = _relaxed(task, "straight", line, _settings(task, parts.refinement))
        if found is not None and _is_clear(task, found.points):
            yield found
        else:
            blocked = found
    yield None
    answer, known = Answer("not_found"), list[Candidate]()
    if blocked is not None and parts.refinement:
        straight = float(np.linalg.norm(goal - start))
        ways = round_it(task, "bend", blocked.nodes)
        for one in ways:
            if one is None:
                break
            known.append(one)
            if one.length <= ALMOST * straight:
                break
        shortest = min((one.length for one in known), default=np.inf)
        if not parts.graph or shortest <= ALMOST * blocked.length:
            yield from _shortest_first(known)
            known = []
    if parts.graph:
        clear = blocked is not None
        answer = yield from _over_graph(task, start, goal, parts.refinement, known, clear)
        yield None
    yield from ways
    if parts.tree:
        apart = answer.status == "not_connected"
        for seed in range(TREES_APART if apart else TREES):
            yield None
            yield from _over_tree(task, start, goal, parts.refinement, seed)
        last = ((0, None), (1, None), (TREES, None if apart else PATIENT))
        for seed, settings in last if _is_wide(task) else last[2:]:
            yield None
            yield from _over_tree(task.narrow, start, goal, parts.refinement, seed, settings)
    yield answer


def round_it(
    task: Task, source: Source, nodes: Float[np.ndarray, "n D"]
) -> Iterator[Candidate | None]:
    """The ways round what a line of nodes leads through, to one side of it and to the other; None
    where those begin that are dearer and seldom come to anything.

    Few bands that clip something after the first iterations are clear after many: one that hardly
    does is pushed on with a wider margin at once, the others once both sides have been looked at,
    with more nodes as well.
    """
    direct = float(np.linalg.norm(nodes[-1] - nodes[0]))
    first = replace(task.settings, iterations=min(FIRST, task.settings.iterations))
    near, far = list[Candidate](), list[Candidate]()
    for side in SIDES:
        bent = bent_round(task.open, task.clear, nodes, side, PROJECTION)
        band = None if bent is None else _relaxed(task, source, bent, first, clear=True)
        if band is None:
            continue
        if _is_clear(task, band.points):
            yield _relaxed_on(task, band, direct)
        elif band.length > FAR_ROUND * direct:
            far.append(band)
        else:
            pushed = None
            if _depth(task, band.points) <= SHALLOW_M:
                again = replace(task.settings, iterations=AGAIN)
                pushed = _relaxed(task, source, band.nodes, again, clear=True, wider=WIDER[0])
            if pushed is not None and _is_clear(task, pushed.points):
                yield pushed
            else:
                near.append(pushed or band)
    for band in sorted(near, key=lambda one: one.length):
        finer = _finer(task, band)
        if finer is not None:
            yield finer
    yield None
    for band in sorted(far, key=lambda one: one.length):
        widened = _widened(task, band, task.settings)
        if widened is not None:
            yield widened


def _relaxed_on(task: Task, band: Candidate, direct: float) -> Candidate:
    """A clear band after the iterations that it has left, where they can gain something; as it is
    where it clips something then.  direct: the straight distance of its ends [rad].
    """
    left = task.settings.iterations - FIRST
    if band.iterations < FIRST or left <= 0 or band.length <= NEARLY_STRAIGHT * direct:
        return band
    settings = replace(task.settings, iterations=left)
    further = _relaxed(task, band.source, band.nodes, settings, clear=True)
    return further if further is not None and _is_clear(task, further.points) else band


def _pushed_finer(task: Task, source: Source, nodes: Float[np.ndarray, "n D"]) -> Candidate | None:
    """The curve through a band that is pushed clear of what may meet, with more nodes where it
    clips something.
    """
    band = _relaxed(task, source, nodes, task.settings, clear=True)
    if band is None or _is_clear(task, band.points):
        return band
    return _finer(task, band)


def _finer(task: Task, clipping: Candidate) -> Candidate | None:
    """A band that clips something pushed on with twice the nodes; None where it still does."""
    settings = replace(task.settings, iterations=WITH_FINER)
    nodes = _halved(clipping.nodes)
    finer = _relaxed(task, clipping.source, nodes, settings, clear=True, wider=FINER)
    return finer if finer is not None and _is_clear(task, finer.points) else None


def _depth(task: Task, points: Float[np.ndarray, "n D"]) -> float:
    """How deep bodies overlap at points of a curve [m]; 0 where they do between these alone."""
    return -float(task.clearance.clearance(task.manifold.robot, points, 0.0).min())


def _shortest_first(found: Iterable[Candidate]) -> Iterator[Candidate]:
    """Each with those that are longer."""
    rest = sorted(found, key=lambda one: one.length)
    while rest:
        best, *rest = rest
        yield replace(best, others=tuple(rest))


def improvements(
    task: Task,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    parts: Parts = ALL_PARTS,
) -> Iterator[Candidate | None]:
    """Further curves, for as long as the caller has time: the straight line pushed out of what it
    leads through, lines bent past configurations of the graph, and now and then the way of new
    trees, all relaxed; None for one that is not sound.

    Which is tried when depends on nothing but the query.
    """
    rng, t = np.random.default_rng(0), _shares(task.settings.segments)
    line = (1.0 - t) * start + t * goal
    roadmap = task.roadmap() if parts.graph else None
    nodes = np.empty((0, len(start))) if roadmap is None else roadmap.joints
    seed = TREES
    if parts.straight:
        yield refined(task, "straight", line, clear=True)
    while parts.tree or len(nodes):
        for _ in range(BENDS if len(nodes) else 0):
            bend = rng.uniform() * (nodes[rng.integers(len(nodes))] - 0.5 * (start + goal))
            bent = line + 4.0 * t * (1.0 - t) * bend
            bent[0], bent[-1] = start, goal
            yield refined(task, "bend", bent)
        if parts.tree:
            yield next(_over_tree(task, start, goal, refine=True, seed=seed), None)
        seed += 1


def further(
    task: Task,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    parts: Parts = ALL_PARTS,
) -> Iterator[Iterator[Candidate]]:
    """Where no candidate came to a path, for as long as the caller has time: the curves over the
    way of each of ever more pairs of trees, grown by turns with the settings' clearance and with
    less.
    """
    tasks = (task, task.narrow) if _is_wide(task) else (task,)
    for seed in itertools.count(TREES + 1) if parts.tree else ():
        for one in tasks:
            yield _over_tree(one, start, goal, parts.refinement, seed, TIRELESS)


def _is_wide(task: Task) -> bool:
    """Whether less clearance opens further passages."""
    return task.settings.clearance_m > 2.0 * NARROW_M


def _over_graph(
    task: Task,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    refine: bool,
    others: Sequence[Candidate],
    clear: bool,
) -> Generator[Candidate, None, Answer]:
    """The relaxed way over the graph, and other ways that are known; where there is none, returns
    `connection`.  clear: whether it is to be pushed clear of something at once.
    """
    roadmap, answer, corners = task.roadmap(), Answer("not_found"), None
    if roadmap is not None:
        ends = nearest(roadmap, start), nearest(roadmap, goal)
        corners = shortest_way(roadmap, start, goal, *ends, task.clear)
        if corners is None:
            answer = connection(task, start, goal)
            corners = _joined_way(task, roadmap, start, goal, answer)
    over = iter(()) if corners is None else along(task, "graph", corners, refine, clear)
    first = next(over, None)
    yield from _shortest_first(others if first is None else (*others, first))
    yield from over
    return answer


def _joined_way(
    task: Task,
    roadmap: Roadmap,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    joined: Answer,
) -> Float[np.ndarray, "k D"] | None:
    """The way over the graph where more nodes were looked at for an edge to the ends."""
    if joined.status == "not_connected":
        return None
    assert joined.at_start is not None
    assert joined.at_goal is not None
    return shortest_way(roadmap, start, goal, joined.at_start, joined.at_goal, task.clear)


def connection(task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]) -> Answer:
    """How the ends are joined to the graph: "not_connected" where its components keep them apart,
    else "not_found".
    """
    roadmap = task.roadmap()
    if roadmap is None:
        return Answer("not_found")
    at_start, at_goal = join(roadmap, task.clear, start), join(roadmap, task.clear, goal)
    components = at_start.components(roadmap), at_goal.components(roadmap)
    apart = all(components) and not (components[0] & components[1])
    return Answer("not_connected" if apart else "not_found", at_start, at_goal)


def _over_tree(
    task: Task,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    refine: bool,
    seed: int,
    settings: TreeSettings | None = None,
) -> Iterator[Candidate]:
    corners = tree_way(task.clear, start, goal, seed, settings)
    if corners is not None:
        yield from along(task, "tree", corners, refine, clear=True)


def along(
    task: Task, source: Source, corners: Float[np.ndarray, "k D"], refine: bool, clear: bool
) -> Iterator[Candidate]:
    """The relaxed way over a graph or tree, with more nodes where fewer jump; where there is
    something on the way pushed clear of it, from few points, then from all at which its edges were
    looked at, then with no line moved into anything, and then less and less relaxed.
    """
    segments = task.settings.segments
    if refine and not clear:
        found = None
        for pieces in (segments, 2 * segments, 4 * segments):
            found = _relaxed(task, source, resample(corners, pieces + 1), task.settings)
            if found is not None:
                break
        if found is not None and _is_clear(task, found.points):
            yield found
    if refine:
        points = points_along(task.clear, corners)
        if len(points) > FEW * segments:
            few = _pushed_finer(task, source, resample(points, FEW * segments))
            if few is not None:
                yield few
        found = _pushed(task, source, points, task.settings)
        if found is None:
            found = _relaxed(task, source, points, task.settings, clear=True, guarded=True)
            found = found if found is not None and _is_clear(task, found.points) else None
        if found is not None:
            yield found
    nodes = resample(corners, 4 * segments + 1)
    yield from less_and_less_relaxed(task, source, nodes, clear, PARTLY_RELAXED if refine else (0,))


def less_and_less_relaxed(
    task: Task,
    source: Source,
    nodes: Float[np.ndarray, "n D"],
    clear: bool = False,
    iterations: Iterable[int] = PARTLY_RELAXED,
) -> Iterator[Candidate]:
    """Sound curves of a band that must stay near where it began."""
    for most in iterations:
        partly = replace(task, settings=replace(task.settings, iterations=most))
        found = refined(partly, source, nodes, clear=clear)
        if found is not None:
            yield found


def refined(
    task: Task,
    source: Source,
    nodes: Float[np.ndarray, "n D"],
    refine: bool = True,
    clear: bool = False,
) -> Candidate | None:
    """The curve through the relaxed nodes; None if it jumps, leaves the limits or meets something.

    Most curves meet nothing: they are relaxed as if nothing were there, and again with it only
    where they do.  clear: keep it clear of what may meet at once.
    """
    settings = _settings(task, refine)
    if not clear:
        found = _relaxed(task, source, nodes, settings)
        if found is not None and _is_clear(task, found.points):
            return found
        if found is None and source not in ("graph", "tree"):
            return None
    return _pushed(task, source, nodes, settings)


def _pushed(
    task: Task, source: Source, nodes: Float[np.ndarray, "n D"], settings: BandSettings
) -> Candidate | None:
    """The curve through a band that is pushed clear of what may meet."""
    found = _relaxed(task, source, nodes, settings, clear=True)
    if found is None or _is_clear(task, found.points):
        return found
    unrefined = settings.iterations < task.settings.iterations
    return None if unrefined else _widened(task, found, settings)


def _widened(task: Task, clipping: Candidate, settings: BandSettings) -> Candidate | None:
    """The curve through a band that clips something between the places that are looked at, pushed
    on with a wider margin, and then with more nodes too.
    """
    settings, nodes = replace(settings, iterations=AGAIN), clipping.nodes
    for wider in WIDER:
        found = _relaxed(task, clipping.source, nodes, settings, clear=True, wider=wider)
        if found is None or _is_clear(task, found.points):
            return found
        nodes = _halved(found.nodes)
    return None


def _halved(nodes: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "m D"]:
    """With a node in the middle of every line."""
    finer = np.empty((2 * len(nodes) - 1, nodes.shape[1]))
    finer[::2], finer[1::2] = nodes, 0.5 * (nodes[1:] + nodes[:-1])
    return finer


@cache
def _shares(segments: int) -> Float[np.ndarray, "n 1"]:
    return np.linspace(0.0, 1.0, segments + 1)[:, None]


def _settings(task: Task, refine: bool) -> BandSettings:
    return task.settings if refine else replace(task.settings, iterations=0)


def _relaxed(
    task: Task,
    source: Source,
    nodes: Float[np.ndarray, "n D"],
    settings: BandSettings,
    clear: bool = False,
    guarded: bool = False,
    wider: float = 1.0,
) -> Candidate | None:
    """The curve through relaxed nodes, whether or not it meets something; None if its points leave
    the constraint or the limits, or jump.
    """
    around = task.clear if clear else task.open
    # what is not relaxed is projected out of what it overlaps
    space = task.open if settings.iterations else around
    sound, relaxed, points, length, iterations = relaxed_curve(
        space, around, np.ascontiguousarray(nodes), settings.steps(guarded, wider), PROJECTION
    )
    if not sound:
        return None
    return Candidate(source, space, points, length, relaxed, iterations, clear)


def _is_clear(task: Task, points: Float[np.ndarray, "n D"]) -> bool:
    model = task.clearance.arrays
    return not model.top or path_stays_clear(task.manifold.robot.chain, model, points)


def rows_of(candidate: Candidate, violation: float) -> Float[np.ndarray, "T D"]:
    """Rows along the candidate so close that straight joint lines between them leave the constraint
    by less than `violation` [rad or m] halfway.
    """
    rows: np.ndarray = rows_along(
        candidate.space, candidate.points, ROW_SAFETY * violation, PROJECTION
    )
    return rows
