"""What is prepared once for each constraint and kept for the next query: its space and roadmap."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.certification.collisions import MARGIN_M, CollisionCheck
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.geometry.graph import components
from constraint_geodesics.params import PlannerParams
from constraint_geodesics.progress import saying_late
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.attached import is_unchanged
from constraint_geodesics.scene.clearance import ClearanceModel, Clearances
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings, project
from constraint_geodesics.search.candidates import ALL_PARTS, NARROW_M, Parts, Task
from constraint_geodesics.search.roadmap import EDGE_STEP, Roadmap, build_roadmap
from constraint_geodesics.search.space import Space

KEPT_TASKS = 64
"""Constraints without a name that are remembered, with their roadmaps."""
_ROUNDS = 20
_DRAWN = 400
"""Configurations whose median clearance is the typical one."""


class Freedom(Protocol):
    """Says which configurations are free: the certificate's check of collisions, or PyBullet."""

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Which of n configurations touch nothing."""
        ...


Draw = Callable[[int, np.random.Generator], Float[np.ndarray, "n D"]]
"""Configurations [rad], on the constraint or not."""


@dataclass(frozen=True)
class Query:
    """One query while it is planned.  goal: one configuration of it.  began: on
    `time.perf_counter`.  scales: the shares of the velocity and acceleration limits that are used.
    snapped_rad: how far the start was moved.  looked_at: the goal's configurations, the nearest
    first.  regions: of the goals that have one.  start_velocity: [rad/s]; None at rest.
    """

    task: Task
    name: str
    start: Float[np.ndarray, "D"]
    goal: Float[np.ndarray, "D"]
    began: float
    parts: Parts = ALL_PARTS
    scales: tuple[float, float] = (1.0, 1.0)
    snapped_rad: float = 0.0
    looked_at: Float[np.ndarray, "n D"] | None = None
    regions: tuple[Constraint, ...] = ()
    start_velocity: Float[np.ndarray, "D"] | None = None


class _Apart:
    """Freedom by a model of clearance."""

    def __init__(self, robot: SerialRobot, model: ClearanceModel) -> None:
        self._robot, self._model = robot, model

    def free(self, q: Float[np.ndarray, "n D"]) -> Bool[np.ndarray, "n"]:
        """Where all that may meet is further apart than the certificate's margin."""
        return self._model.clearance(self._robot, q, MARGIN_M) >= MARGIN_M


class Preparation:
    """The tasks of a scene by constraint, each with its roadmap: given, or made when it is asked
    for.

    Roadmaps are made among the shapes that are there at first: what comes later is looked at where
    a way leads.  Once one of the first is gone, or more of them may touch, they are made anew.
    """

    def __init__(
        self,
        scene: Scene,
        checks: CollisionCheck,
        settings: PlannerParams,
        draw: Draw | None = None,
    ) -> None:
        self.scene, self.checks, self.settings = scene, checks, settings
        self.draw = draw or scene.robot.sample
        self._clearances = Clearances(scene, checks.apart)
        self._clearance = self._first_clearance = self._clearances.model()
        self._pairs = self._clearances.pairs(checks.apart, ())
        self.band = self._band()
        self._tasks: dict[tuple, Task] = {}
        self._roadmaps: dict[tuple, Roadmap | None] = {}
        self._named: Mapping[str, Constraint] = {}

    @contextmanager
    def changing(self, scene: Scene) -> Iterator[None]:
        """Follow the scene, once the checks have, which is what happens within; where they, or
        this, can't, all is as it was.
        """
        before = self._clearances.state
        try:
            self._clearances.change(scene)
            yield
        except BaseException:
            self._clearances.restore(before)
            raise
        # made first and kept last, so that an interrupt leaves nothing half done
        clearance = self._clearances.model(self.checks.apart)
        around = {shape.name: shape for shape in scene.workcell}
        left = tuple(
            own
            for own in self.scene.workcell
            if own.name in around and is_unchanged(around[own.name], own)
        )
        held = tuple(
            own
            for own in self.scene.attached
            if any(is_unchanged(one, own) for one in scene.attached)
        )
        first = replace(self.scene, workcell=left, attached=held, allowed=scene.allowed)
        is_changed = (left, held) != (self.scene.workcell, self.scene.attached)
        if is_changed or scene.allowed != self.scene.allowed:  # which may allow what never met
            later, apart = set(scene.names) - set(first.names), self.checks.apart
            pairs = self._clearances.pairs(apart, later)
            if is_changed or pairs != self._pairs:
                without = self._clearances.model(apart, later)
                self._first_clearance, self._pairs, self._roadmaps = without, pairs, {}
        self.scene, self._clearance = first, clearance

    def _band(self) -> BandSettings:
        """With the clearance that this arm can keep."""
        band, share = band_settings(self.settings), self.settings.clearance_share
        if share is None:
            return band
        drawn = self.scene.robot.sample(_DRAWN, np.random.default_rng(self.settings.seed))
        apart = self._clearance.clearance(self.scene.robot, drawn)
        if not (apart > 0.0).any():
            return band
        least = max(share * float(np.median(apart[apart > 0.0])), NARROW_M)
        return replace(band, clearance_m=min(least, band.clearance_m))

    def supply(
        self, constraints: Mapping[str, Constraint], roadmaps: Mapping[str, Roadmap]
    ) -> None:
        """Constraints that are never forgotten, later ones of this mapping too, and the roadmaps
        that exist already.
        """
        self._named = constraints
        for name, roadmap in roadmaps.items():
            # the nodes are written in single precision, which may lie beyond a limit
            inside = np.clip(roadmap.joints, self.scene.robot.lower, self.scene.robot.upper)
            self._roadmaps[constraints[name].key] = replace(roadmap, joints=inside)

    def task(self, constraint: Constraint) -> Task:
        """The constraint, prepared; its roadmap is made when it is first asked for."""
        key = constraint.key
        if key not in self._tasks:
            if len(self._tasks) >= KEPT_TASKS + len(self._named):
                named = {own.key for own in self._named.values()}
                oldest = next(other for other in self._tasks if other not in named)
                del self._tasks[oldest]
                self._roadmaps.pop(oldest, None)
            manifold = ConstraintManifold(self.scene.robot, constraint)
            roadmap = partial(self._roadmap, key, manifold)
            self._tasks[key] = Task(manifold, self._clearance, roadmap, self.band)
        known = self._tasks.pop(key)  # what was asked for last is forgotten last
        if known.clearance is not self._clearance:
            known = replace(known, clearance=self._clearance)
        kept = known.manifold.constraint
        if kept is not constraint and kept.caveat != constraint.caveat:  # no key holds words
            known = replace(known, manifold=ConstraintManifold(self.scene.robot, constraint))
        self._tasks[key] = known
        return known

    def task_without_delay(self, constraint: Constraint) -> Task:
        """The same, without a roadmap where that would have to be made."""
        task = self.task(constraint)
        return task if constraint.key in self._roadmaps else replace(task, roadmap=lambda: None)

    def _roadmap(self, key: tuple, manifold: ConstraintManifold) -> Roadmap | None:
        if key not in self._roadmaps:
            settings = self.settings
            rng = np.random.default_rng(settings.seed)
            first = self._first_clearance
            freedom, count = _Apart(self.scene.robot, first), settings.roadmap_nodes
            with saying_late("making the roadmap"):
                nodes = free_configurations(manifold, freedom, self.draw, count, rng)
                space, made = replace(self._tasks[key], clearance=first).clear, None
                if len(nodes) > 1:
                    made = build_roadmap(space, nodes, settings.roadmap_neighbours)
            self._roadmaps[key] = made
        return self._roadmaps[key]


def named_roadmaps(
    scene: Scene, constraints: Mapping[str, Constraint], settings: PlannerParams
) -> dict[str, Roadmap]:
    """Checked roadmaps of constraints, from uniform samples projected onto each; none for one that
    hardly any configuration keeps.
    """
    found = {}
    with scene.world() as world, Certifier(scene) as certifier:
        preparation = Preparation(scene, certifier.collisions, settings)
        for name, constraint in constraints.items():
            task, rng = preparation.task(constraint), np.random.default_rng(settings.seed)
            count, draw = settings.roadmap_nodes, scene.robot.sample
            nodes = free_configurations(task.manifold, world, draw, count, rng)
            if len(nodes) > 1:
                found[name] = checked_roadmap(task, world, nodes, settings.roadmap_neighbours)
    return found


def checked_roadmap(
    task: Task, world: World, nodes: Float[np.ndarray, "n D"], neighbours: int
) -> Roadmap:
    """The roadmap over these configurations whose edges PyBullet finds free of collision as well,
    those of the arm with itself among them.
    """
    roadmap = build_roadmap(task.clear, nodes, neighbours)
    points, edge = edge_points(task.clear, roadmap)
    touched = np.zeros(len(roadmap.edges), bool)
    np.logical_or.at(touched, edge, ~world.free(points))
    edges, lengths = roadmap.edges[~touched], roadmap.lengths[~touched]
    return Roadmap(nodes, edges, lengths, components(len(nodes), edges))


def edge_points(
    space: Space, roadmap: Roadmap
) -> tuple[Float[np.ndarray, "m D"], Int[np.ndarray, "m"]]:
    """Points on the constraint between the ends of every edge, at most EDGE_STEP apart [rad], and
    the edge that each belongs to.
    """
    first, last = roadmap.joints[roadmap.edges[:, 0]], roadmap.joints[roadmap.edges[:, 1]]
    pieces = np.ceil(np.linalg.norm(last - first, axis=1) / EDGE_STEP).astype(int) + 1
    edge = np.repeat(np.arange(len(pieces)), pieces - 1)
    inner = np.arange(len(edge)) - np.repeat(np.cumsum(pieces - 1) - (pieces - 1), pieces - 1) + 1
    share = (inner / pieces[edge])[:, None]
    points = (1.0 - share) * first[edge] + share * last[edge]
    project(space, points)
    return points, edge


def free_configurations(
    manifold: ConstraintManifold, freedom: Freedom, draw: Draw, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n D"]:
    """Configurations on the constraint, within the limits and free of collision: drawn, then
    projected; fewer than `count` if there are few.
    """
    robot = manifold.robot
    kept, found = [np.empty((0, robot.dof))], 0
    for _ in range(_ROUNDS):
        drawn = draw(2 * count, rng)
        share = rng.uniform(size=len(drawn)) ** (1.0 / max(manifold.rows.held.sum(), 1))
        result = retract(manifold, drawn, Retraction(), band=share)
        good = result.joints[result.converged & (robot.limit_distance(result.joints) >= 0.0)]
        good = good[: count - found]
        kept.append(good[freedom.free(good)])
        found += len(kept[-1])
        if found >= count:
            break
    return np.concatenate(kept)


def band_settings(settings: PlannerParams) -> BandSettings:
    """The band's part of the planner's settings."""
    return BandSettings(**{own.name: getattr(settings, own.name) for own in fields(BandSettings)})
