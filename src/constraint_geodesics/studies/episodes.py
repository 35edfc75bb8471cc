"""Episodes in simulation: an arm follows a certified path among obstacles that it does not know,
sees them when they are near, and answers while it moves.

The control looks every TICK_S.  An obstacle is seen once its surface is within the sensing radius
of the arm or of what it carries.  The answer is asked for from the state of the arm LATENCY_S
later, and the arm goes on along its old path until then.  The time that the answer takes is
measured: where it comes later than LATENCY_S, the arm takes the stop on its path from that state
instead, and the late answer is dropped, once it is there.  What comes near meanwhile is seen at
the next tick after the answer.  An arm that stops plans from where it will rest, and the clock goes
on while it does: from its last answer on, since where it comes to rest is known by then.

An obstacle appears beyond the braking distance where the arm, had it only braked from the state
that the answer begins in, would have touched nothing that it knows, by PyBullet: no contact is
excused there, and a motion that can't brake is no excuse.  Inside it no stop avoids the obstacle,
and what counts is how slow the arm is at the contact.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.geometry.braking import State
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PlannerError
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import BodyKey, World
from constraint_geodesics.search.band import step_lengths
from constraint_geodesics.studies.cup import carried_cup
from constraint_geodesics.trajectory import Trajectory

TICK_S, LATENCY_S = 0.02, 0.06
"""Of the control: how often it looks, and after how long an answer begins."""
LONGEST_S = 20.0
"""Of an episode."""
TRIES = 3
"""Plans from rest, one after another, before the arm gives up."""
SENSING_M = (0.2, 0.3, 0.45)
"""Sensing radii, by turns."""
ANSWER_S = 0.5 * LATENCY_S
"""After which a replan begins no other path."""
LOOKED_AT_RAD = 0.005
"""Distance of the configurations at which PyBullet is asked, as everywhere; the benchmark's module
that says so for all others brings libraries that the demo does without.
"""
SHORTEST_RAD = 1.0
"""Of the paths that obstacles are put on."""
MOST, ON_THE_WAY = 3, 0.7
"""Obstacles of an episode, and the share of them that is put on the path."""
OFF_M, BESIDE_M = 0.03, (0.15, 0.35)
"""How far an obstacle's middle is from a link of the arm on its path: the standard deviation of one
on the way, and the range of the others.
"""
DRAWS = 2000
"""Queries that are looked at for an episode, at most."""
MIDDLE = (0.2, 0.9)
"""Shares of the motion at which obstacles are put."""
RADII_M, EDGES_M = (0.04, 0.09), (0.06, 0.18)
_ASIDE_RAD = 1e-4
"""Half the step of the difference that a tool's speed is measured by."""


@dataclass(frozen=True, eq=False)
class Episode:
    """A certified path in the scene that is known, `first.scene`, and the obstacles that are not.

    sensing_m: from so far away they are seen.  links: of the arm, all of them sense.
    """

    number: int
    first: Trajectory
    obstacles: tuple[Shape, ...]
    sensing_m: float
    links: tuple[str, ...]

    @property
    def goal(self) -> Float[np.ndarray, "D"]:
        """The configuration to reach [rad]."""
        return self.first.joints[-1]

    @property
    def everything(self) -> Scene:
        """The scene with all obstacles."""
        return self.first.scene.adding(*self.obstacles)


class Moved(NamedTuple):
    """Where the arm is at a tick: the time [s] and the configuration [rad]."""

    at_s: float
    joints: Float[np.ndarray, "D"]


class Seen(NamedTuple):
    """An obstacle that comes within the sensing radius, at a time [s] and a distance [m]."""

    at_s: float
    obstacle: Shape
    distance_m: float


class Answered(NamedTuple):
    """What the arm does from a time [s] on.

    asked_s: when it was asked for.  spent_s: what the computation took, the change of the scene
    included.  path: the new motion; None where the arm goes on as it does.  late: the answer came
    after its time, and the arm brakes.  moving: it was asked while the arm moved.  can_stop: a stop
    touches nothing of what was seen.
    """

    asked_s: float
    begins_s: float
    spent_s: float
    path: Trajectory | None
    late: bool
    moving: bool
    can_stop: bool

    @property
    def words(self) -> str:
        """For people."""
        took = f"in {1e3 * self.spent_s:.0f} ms"
        if self.late:
            return f"{'goes on' if self.path is None else 'stops'}, as the answer came {took}"
        if self.path is None:
            return f"goes on, decided {took}"
        if self.path.status != "solved":
            return f"{'stops' if self.moving else self.path.status}, decided {took}"
        told = {"rest": "still clear, decided", "bend": "repaired"}
        return f"{told.get(self.path.source, f'new path ({self.path.source})')} {took}"


Happening = Moved | Seen | Answered


class Leg(NamedTuple):
    """A motion that is executed from a time [s] on, until the next one begins."""

    begins_s: float
    path: Trajectory


class Controller(Protocol):
    """Who answers for the arm, in the scene as far as it is known."""

    def see(self, obstacles: Sequence[Shape]) -> None:
        """There are more obstacles."""
        ...

    def moving(self, path: Trajectory, at_s: float) -> Trajectory | None:
        """The motion from the state of a path at a time [s]; None to go on along it."""
        ...

    def resting(self, path: Trajectory) -> Trajectory:
        """From the end of a path, where the arm rests, to what was wanted."""
        ...


@dataclass(frozen=True)
class Replanner:
    """`planner.replan`, while the arm moves and when it rests."""

    planner: Planner

    def see(self, obstacles: Sequence[Shape]) -> None:
        """Into the planner's scene."""
        self.planner.scene.add(*obstacles)

    def moving(self, path: Trajectory, at_s: float) -> Trajectory | None:
        """What is left, a path round what is new, or a stop."""
        return self.planner.replan(path, at_s, limit_s=ANSWER_S)

    def resting(self, path: Trajectory) -> Trajectory:
        """With trees, if need be."""
        return self.planner.replan(path, float(path.times[-1]))


# One episode


def run(episode: Episode, controller: Controller) -> Iterator[Happening]:
    """What happens, in the order of time, until the arm is at its goal, touches something, or gives
    up, or LONGEST_S are over.  The controller's scene must be that of the episode's first path.
    """
    with episode.everything.world() as world:
        yield from _Simulation(episode, controller, _Eyes(episode, world)).happenings()


class _Eyes:
    """What of an episode's obstacles is not seen yet, by PyBullet's distances in a world that has
    all of them.
    """

    def __init__(self, episode: Episode, world: World) -> None:
        self.hidden, self.world, self.most_m = list(episode.obstacles), world, episode.sensing_m
        attached = (BodyKey(one.name, True) for one in episode.first.scene.attached)
        self.bodies = [*(BodyKey(name, False) for name in episode.links), *attached]

    def look(self, q: Float[np.ndarray, "D"], now_s: float) -> list[Seen]:
        """What comes into sight at a configuration [rad]."""
        found = []
        for obstacle in tuple(self.hidden):
            key = BodyKey(obstacle.name, True)
            away = min(self.world.distance(q, body, key, self.most_m) for body in self.bodies)
            if away <= self.most_m:
                self.hidden.remove(obstacle)
                found.append(Seen(now_s, obstacle, float(away)))
        return found


class _Simulation:
    """The clock, the motion that is followed, what is known, and since when the control has had
    nothing to answer [s].
    """

    def __init__(self, episode: Episode, controller: Controller, eyes: _Eyes) -> None:
        self.controller, self.eyes, self.goal = controller, eyes, episode.goal
        self.leg, self.tick, self.failed = Leg(0.0, episode.first), 0, 0
        self.known, self.idle_s = episode.first.scene, 0.0

    @property
    def now_s(self) -> float:
        return self.tick * TICK_S

    def at(self, clock_s: float) -> float:
        """A time of the clock on the leg [s]: the arm rests at its end."""
        return min(max(clock_s - self.leg.begins_s, 0.0), float(self.leg.path.times[-1]))

    def happenings(self) -> Iterator[Happening]:
        while self.now_s <= LONGEST_S:
            path, at_s, moved = self.leg.path, self.at(self.now_s), self._moved()
            yield moved
            if not self.eyes.world.is_free(moved.joints):
                return
            seen = self.eyes.look(moved.joints, self.now_s)
            yield from seen
            if seen:
                yield from self._answered([one.obstacle for one in seen])
            elif at_s < path.times[-1]:
                self.tick += 1
            elif np.array_equal(path.joints[-1], self.goal) or self.failed == TRIES:
                return
            else:
                yield from self._from_rest()

    def _answered(self, news: Sequence[Shape]) -> Iterator[Happening]:
        """The answer to new obstacles, while the old motion goes on for LATENCY_S; an arm that
        rests by then is asked for later.
        """
        path, asked_s = self.leg.path, self.now_s
        begins_s = asked_s + LATENCY_S
        at_s = self.at(begins_s)
        moving = bool(path.state(at_s).velocity.any())
        self.known = self.known.adding(*news)
        can_stop = self._can_stop(self.at(asked_s), at_s)
        began = time.perf_counter()
        self.controller.see(news)
        found = self.controller.moving(path, at_s) if moving else None
        spent = time.perf_counter() - began
        late = moving and spent > LATENCY_S
        if late:
            found = stop_on(path, at_s)
        self.idle_s = asked_s + spent
        yield from self._waiting(begins_s)
        self.failed = 0
        answer = Answered(asked_s, self.now_s, spent, found, late, moving, can_stop)
        yield self._followed(answer)
        if self.idle_s > self.now_s:  # busy with an answer that is too late
            yield self._moved()
            yield from self._waiting(self.idle_s)

    def _from_rest(self) -> Iterator[Happening]:
        asked_s, began = self.now_s, time.perf_counter()
        found = self.controller.resting(self.leg.path)
        spent = time.perf_counter() - began
        self.idle_s = max(self.idle_s + spent, asked_s)
        yield from self._waiting(self.idle_s)
        self.failed += found.status != "solved"
        yield self._followed(Answered(asked_s, self.now_s, spent, found, False, False, True))

    def _followed(self, answer: Answered) -> Answered:
        if answer.path is not None and len(answer.path.joints):
            self.leg = Leg(answer.begins_s, answer.path)
        return answer

    def _waiting(self, until_s: float) -> Iterator[Moved]:
        """The old motion goes on to the first tick from a time of the clock [s] on."""
        until = int(np.ceil(until_s / TICK_S - 1e-6))
        while self.tick < until - 1:
            self.tick += 1
            yield self._moved()
        self.tick = max(self.tick, until)

    def _moved(self) -> Moved:
        return Moved(self.now_s, self.leg.path.state(self.at(self.now_s)).configuration)

    def _can_stop(self, from_s: float, at_s: float) -> bool:
        """Whether going on until `at_s` and braking then touches nothing that is known."""
        stop, path = stop_on(self.leg.path, at_s), self.leg.path
        if stop is None:
            return True
        rows = _between(path, from_s, at_s)[1]
        with self.known.world() as world:
            looked_at = densify(np.vstack([rows, stop.joints]), LOOKED_AT_RAD)
            return world.first_collision(looked_at) is None


def stop_on(path: Trajectory, at_s: float) -> Trajectory | None:
    """The hardest stop on a path; None where it can't stop any more."""
    try:
        return path.stop(at_s)
    except PlannerError:
        return None


def _between(
    path: Trajectory, from_s: float, to_s: float
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n D"]]:
    """Times [s] and configurations [rad] of a part of a motion: its ends and the waypoints
    between.
    """
    inner = path.times[(path.times > from_s) & (path.times < to_s)]
    ends = [path.state(at_s).configuration for at_s in (from_s, to_s)]
    rows = path.joints[np.searchsorted(path.times, inner)]
    return np.array([from_s, *inner, to_s]), np.vstack([ends[0], rows, ends[1]])


# What became of it


class Contact(NamedTuple):
    """The first configuration of a motion that touches something: when [s], and how fast the joints
    [rad/s] and the tool [m/s] are.
    """

    at_s: float
    joint_speed_rad_s: float
    tool_speed_m_s: float


Outcome = Literal["reached", "contact", "no path", "time over"]


@dataclass(frozen=True)
class Report:
    """An episode that is over: outcome, how long it took [s], the contact if there was one, the
    answers and what was seen until then, and the motions that were executed.
    """

    outcome: Outcome
    duration_s: float
    contact: Contact | None
    answers: tuple[Answered, ...]
    seen: tuple[Seen, ...]
    legs: tuple[Leg, ...]

    @property
    def beyond(self) -> bool:
        """Whether every obstacle appeared beyond the braking distance."""
        return all(answer.can_stop for answer in self.answers)

    def leg(self, at_s: float) -> Leg:
        """The motion that is executed at a time [s]."""
        return next(one for one in reversed(self.legs) if one.begins_s <= at_s or one.begins_s == 0)

    def state(self, at_s: float) -> State:
        """Of the arm at a time [s]."""
        leg = self.leg(at_s)
        return leg.path.state(min(max(at_s - leg.begins_s, 0.0), float(leg.path.times[-1])))


def report(episode: Episode, happenings: Sequence[Happening]) -> Report:
    """What became of an episode, contacts judged by PyBullet in a world of its own with all
    obstacles, known or not, every LOOKED_AT_RAD.
    """
    answers = [one for one in happenings if isinstance(one, Answered)]
    seen = [one for one in happenings if isinstance(one, Seen)]
    legs = [Leg(0.0, episode.first)]
    legs += [Leg(a.begins_s, a.path) for a in answers if a.path is not None and len(a.path.joints)]
    last = next(one for one in reversed(happenings) if isinstance(one, Moved))
    over_s = max([last.at_s, *(answer.begins_s for answer in answers)])
    contact = _contact(episode, legs, over_s)
    if contact is not None:
        over_s = contact.at_s
        answers = [one for one in answers if one.asked_s <= over_s]
        seen = [one for one in seen if one.at_s <= over_s]
        outcome: Outcome = "contact"
    elif np.array_equal(last.joints, episode.goal):
        outcome = "reached"
    else:
        outcome = "time over" if over_s > LONGEST_S else "no path"
    return Report(outcome, over_s, contact, tuple(answers), tuple(seen), tuple(legs))


def _contact(episode: Episode, legs: Sequence[Leg], over_s: float) -> Contact | None:
    ends = [leg.begins_s for leg in legs[1:]] + [over_s]
    with episode.everything.world() as world:
        for (begins_s, path), end_s in zip(legs, ends, strict=True):
            to_s = min(end_s - begins_s, float(path.times[-1]))
            times, rows = _dense(*_between(path, 0.0, max(to_s, 0.0)))
            touching = world.first_collision(rows)
            if touching is not None:
                at_s = float(times[touching])
                return _as_contact(episode.first.scene, path, at_s, begins_s + at_s)
    return None


def _dense(
    times: Float[np.ndarray, "n"], rows: Float[np.ndarray, "n D"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m D"]]:
    """The same motion at configurations at most LOOKED_AT_RAD apart."""
    pieces = np.maximum(np.ceil(step_lengths(rows) / LOOKED_AT_RAD).astype(int), 1)
    at = [k + np.arange(n) / n for k, n in enumerate(pieces)]
    shares = np.append(np.concatenate(at), len(pieces))
    grid = np.arange(len(times))
    columns = [np.interp(shares, grid, column) for column in rows.T]
    return np.interp(shares, grid, times), np.stack(columns, axis=1)


def _as_contact(scene: Scene, path: Trajectory, at_s: float, clock_s: float) -> Contact:
    state = path.state(at_s)
    speed = float(np.linalg.norm(state.velocity))
    tool = 0.0
    if speed > 0.0:
        aside = _ASIDE_RAD * state.velocity / speed
        ends = scene.robot.forward(state.configuration + np.stack([-aside, aside]))[0]
        tool = float(np.linalg.norm(ends[1] - ends[0])) * speed / (2.0 * _ASIDE_RAD)
    return Contact(clock_s, speed, tool)


# Drawing


@contextmanager
def carrying(planner: Planner, constraint: str) -> Iterator[None]:
    """With a cup in the tool where the constraint keeps one upright; and without what is seen
    within, afterwards.
    """
    before = planner.scene.now
    attach_cup(planner, constraint)
    try:
        yield
    finally:
        planner.scene.become(before)


def attach_cup(planner: Planner, constraint: str) -> None:
    """Put a cup into the tool where the constraint keeps one upright."""
    axis = planner.constraints[constraint].level_axis
    if axis is not None:
        planner.scene.attach(carried_cup(axis), link=planner.robot.tool_link)


def drawn(
    planner: Planner,
    constraint: str,
    number: int,
    seed: int,
    ends: Float[np.ndarray, "n D"] | None = None,
) -> Episode:
    """A query between two of these ends [rad], by default configurations of the constraint's
    roadmap, and one to MOST spheres and boxes: one at least is on the path, none is seen at its
    start, start and goal touch none.
    """
    rng = np.random.default_rng([seed, number])
    known = planner.nodes(constraint) if ends is None else ends
    sensing_m = SENSING_M[number % len(SENSING_M)]
    for _ in range(DRAWS if len(known) else 0):
        start, goal = known[rng.integers(len(known), size=2)]
        path = planner.plan(start, goal, constraint)
        if path.status != "solved" or path.length_rad < SHORTEST_RAD:
            continue
        count = int(rng.integers(1, MOST + 1))
        obstacles = tuple(_obstacle(path, k, rng) for k in range(count))
        episode = Episode(number, path, obstacles, sensing_m, tuple(planner.scene.links))
        if _is_fit(episode):
            return episode
    raise PlannerError(f"no path under {constraint} was found that an obstacle could be put on")


def _obstacle(path: Trajectory, k: int, rng: np.random.Generator) -> Shape:
    robot = path.scene.robot
    place = path.state(rng.uniform(*MIDDLE) * float(path.times[-1])).configuration
    ends = robot.skeleton(place)[3:]
    middle = ends[rng.integers(len(ends))]
    if rng.uniform() < ON_THE_WAY:
        middle = middle + OFF_M * rng.normal(size=3)
    else:
        aside = rng.normal(size=3)
        middle = middle + rng.uniform(*BESIDE_M) * aside / np.linalg.norm(aside)
    x, y, z = middle.tolist()
    if rng.uniform() < 0.5:
        return Sphere(f"sphere {k}", (x, y, z), float(rng.uniform(*RADII_M)))
    roll, pitch, yaw = rng.uniform(-np.pi, np.pi, 3).tolist()
    edges = tuple(rng.uniform(*EDGES_M, 3).tolist())
    return Box(f"box {k}", (x, y, z), edges, rpy_rad=(roll, pitch, yaw))


def _is_fit(episode: Episode) -> bool:
    path = episode.first
    with episode.everything.world() as world:
        if _Eyes(episode, world).look(path.joints[0], 0.0):
            return False
        if not world.free(path.joints[[0, -1]]).all():
            return False
        return world.first_collision(densify(path.joints, 10.0 * LOOKED_AT_RAD)) is not None
