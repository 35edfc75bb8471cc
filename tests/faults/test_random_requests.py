"""Requests at random against the planner: no exception but a typed one, and no path that an oracle
of its own calls wrong: PyBullet's shapes and its poses of the tool every 0.005 rad (0.02 in `make
test`), and limits, constraint, ends, velocities and accelerations by other formulas than the
planner's; of an arm that moves at first also the turn into its path.
"""

import json
import math
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from joblib import Parallel, delayed
from scipy.spatial.transform import Rotation

from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.constraints.constraint import Constraint, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.pipeline.code import code_digest, data_digest, digest
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import Status
from constraint_geodesics.text_files import write_text
from constraint_geodesics.trajectory import Trajectory
from tests import planner_fixtures as fixtures
from tests.faults import bad_calls, requests
from tests.faults.effort import ROOT, Effort, counting
from tests.faults.requests import A_SCENE, SEED, Request, request, scene_of
from tests.planner_fixtures import packaged_planner, turning
from tests.scene import judge as oracle
from tests.scene.judge import Judge

STEP_RAD = {"quick": 0.02, "faults": 0.005, "soak": 0.005}
"""Between configurations that the oracle looks at."""
DEEP_M = 1e-6
"""PyBullet's distances are off by less."""
OFF = 1e-4 + 1e-9
"""What a path may be off its constraint [rad or m]."""
SLACK = 1e-6
TURN_OFF, TURN_BEYOND = 1e-3, 1e-4
"""What an arm may be off its constraint [rad or m], and beyond a joint limit [rad], while it turns
into its path: as the documentation says."""
KEPT = ROOT / "reports" / "random_requests.json"
"""Where the figures of a run of hours are kept until it is done, so that it goes on where it was
ended: on another machine too, with the commit that it is added to.
"""
KEPT_EVERY = 20 * A_SCENE


@dataclass
class Figures:
    """What was asked, and what came of it."""

    requests: int = 0
    answered: int = 0
    refused: int = 0
    exceptions: int = 0
    wrongly_certified: int = 0
    configurations: int = 0
    solved_with_trees: int = 0
    solved_in_motion: int = 0
    seconds: float = 0.0
    statuses: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def add(self, other: "Figures") -> None:
        """Count what another has, too."""
        for name, own in vars(other).items():
            setattr(self, name, getattr(self, name) + own)


@pytest.mark.timeout(24 * 3600)  # `make soak` takes hours
def test_random_requests(effort: Effort) -> None:
    with counting("random_requests", effort) as row:
        figures = _asked(effort)
        row |= {name: own for name, own in vars(figures).items() if isinstance(own, int)}
        row |= {"solved": figures.statuses["solved"], "seconds": round(figures.seconds, 1)}
        assert not figures.wrong, "\n".join(figures.wrong[:20])
        assert figures.answered > 0.3 * figures.requests
        assert figures.statuses["solved"] > 0.1 * figures.requests
        assert figures.refused > 0.05 * figures.requests
        assert figures.configurations > 10 * figures.requests
        assert figures.solved_with_trees > 0.01 * figures.requests
        assert figures.solved_in_motion > 0.003 * figures.requests
    if effort.name == "soak":
        KEPT.unlink(missing_ok=True)  # it is counted: the next run is one of its own


def _asked(effort: Effort) -> Figures:
    """All requests: their scenes are answered side by side where they are many."""
    figures, began = _begun(effort), time.monotonic()
    before = figures.seconds
    blocks = range(figures.requests // A_SCENE, effort.requests // A_SCENE)
    workers = 1 if effort.name == "quick" else -1
    answered = Parallel(workers, return_as="generator")
    for own in answered(delayed(_block)(STEP_RAD[effort.name], block) for block in blocks):
        figures.add(own)
        figures.seconds = before + time.monotonic() - began
        if figures.requests % KEPT_EVERY == 0:
            _keep(effort, figures)
    return figures


def _block(step: float, block: int) -> Figures:
    """The requests of one scene."""
    planner, figures = packaged_planner(), Figures()
    first = planner.scene.now
    try:
        planner.scene.become(scene_of(planner, first, block))
        with Judge(planner.scene.now, {}) as judge:
            for number in range(block * A_SCENE, (block + 1) * A_SCENE):
                _ask(planner, request(planner, number), judge, figures, step)
    finally:
        planner.scene.become(first)
    return figures


@pytest.mark.parametrize("spoil", ["collision", "constraint", "limits", "end", "velocity", "turn"])
def test_the_oracle_sees_what_is_wrong(spoil: str) -> None:
    planner = packaged_planner()
    path, asked = _solved(planner)
    joints, times = path.joints.copy(), path.times.copy()
    if spoil == "collision":
        joints[len(joints) // 2] = np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])  # in the table
    elif spoil == "constraint":
        joints[1:-1, 4] += 0.01
    elif spoil == "limits":
        joints[1, 0] = 4.0
    elif spoil == "end":
        joints[-1] += 1e-4
    elif spoil == "velocity":
        times *= 0.5
    with Judge(planner.scene.now, {}) as judge:
        assert not _faults(planner, asked, path, judge, 0.005)[0]
        if spoil == "turn":  # to the side, so fast that the cup tilts before the path is reached
            aside = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
            asked = replace(asked, words=asked.words | {"start_velocity": aside})
            times[1:] += 0.1
        spoiled = replace(path, joints=joints, times=times)
        faults, _ = _faults(planner, asked, spoiled, judge, 0.005)
    assert any(spoil in fault for fault in faults), faults


def test_the_oracle_sees_a_constraint_that_was_not_asked() -> None:
    planner = packaged_planner()
    path, asked = _solved(planner)
    with Judge(planner.scene.now, {}) as judge:
        for constraint in ("slide", Constraint((0, 0, 0, 1, 1, 0)), Constraint((1,) * 6)):
            other = replace(asked, words=asked.words | {"constraint": constraint})
            faults, _ = _faults(planner, other, path, judge, 0.02)
            assert any("not the one that was asked" in fault for fault in faults), constraint


@pytest.mark.parametrize("kind", [Pose, GoalRegion, list])
def test_the_oracle_sees_an_end_that_is_no_goal(kind: type) -> None:
    """A path that stops before a pose, a region, or all of a list."""
    planner, seen = packaged_planner(), 0
    with Judge(planner.scene.now, {}) as judge:
        faults = partial(_end_faults, judge, planner.robot.tool_link)
        for number in range(2000):
            asked = request(planner, number)
            if asked.kind != "poses" or not isinstance(asked.words["goal"], kind):
                continue
            path = planner.plan(**asked.words)
            if path.status != "solved" or "scene" in asked.words:
                continue
            assert not faults(asked, path.joints)
            at_start = faults(asked, path.joints[:1])
            if kind is GoalRegion:  # where it ends a little off it may be in it still
                seen += any("the goal is off" in said for said in at_start)
            elif at_start:
                back = path.joints[-2] - path.joints[-1]
                short = path.joints.copy()
                short[-1] += 2e-3 * back / np.linalg.norm(back)
                seen += any("the goal is off" in said for said in faults(asked, short))
            if seen == 3:
                return
    raise AssertionError(f"seen {seen} times")


def _solved(planner: Planner) -> tuple[Trajectory, Request]:
    for number in range(1000):
        asked = request(planner, number)
        if asked.kind == "good" and asked.words["constraint"] == "level_cup":
            found = planner.plan(**asked.words)
            if found.status == "solved" and "scene" not in asked.words:
                return found, asked
    raise AssertionError("no path")


def _ask(planner: Planner, asked: Request, judge: Judge, figures: Figures, step: float) -> None:
    figures.requests += 1
    where = f"request {asked.number} ({asked.kind})"
    try:
        path = planner.plan(**asked.words)
    except Exception as error:
        own = type(error).__module__.startswith("constraint_geodesics")
        typed = own and isinstance(error, ValueError) and "\n" not in str(error)
        figures.refused += typed
        if not typed or asked.kind != "corrupt":
            figures.exceptions += not typed
            figures.wrong.append(f"{where}: {type(error).__name__}: {str(error)[:300]}")
        return
    figures.answered += 1
    figures.statuses[path.status] += 1
    faults = _answer_faults(path)
    if asked.kind == "corrupt":
        faults.append(f"a corrupt request is answered: {path.status}")
    if path.status == "solved":
        only = asked.words.get("scene")
        if only:
            with Judge(planner.scene.now.adding(*only), {}) as own_judge:
                more, looked = _faults(planner, asked, path, own_judge, step)
        else:
            more, looked = _faults(planner, asked, path, judge, step)
        figures.configurations += looked
        figures.solved_with_trees += getattr(asked.words.get("parts"), "tree", True)
        figures.solved_in_motion += asked.kind == "moving"
        figures.wrongly_certified += bool(more)
        faults += more
    figures.wrong += [f"{where}: {fault}" for fault in faults]


def _answer_faults(path: Trajectory) -> list[str]:
    """What an answer must say, whatever it is."""
    found, solved = [], path.status == "solved"
    if path.status not in get_args(Status):
        found.append(f"status {path.status}")
    if not path.explanation or "\n" in path.explanation or "nan" in path.explanation:
        found.append(f"explanation {path.explanation!r}")
    if solved != bool(len(path.joints)) or (solved and not path.certificate.valid):
        found.append(f"{path.status} with {len(path.joints)} rows")
    try:
        json.dumps(path.summary(), allow_nan=False)
    except ValueError:
        found.append("its summary is no JSON")
    return found


def _faults(
    planner: Planner, asked: Request, path: Trajectory, judge: Judge, step: float
) -> tuple[list[str], int]:
    """What is wrong with a path, and how many configurations were looked at."""
    robot, found, joints, times = planner.robot, list[str](), path.joints, path.times
    rows = _dense(joints, step)
    found += _row_faults(planner, path, judge, rows, beyond=SLACK, off=OFF)
    if not _asked_for(planner, asked, path, judge):
        found.append("constraint: not the one that was asked")
    found += _turn_faults(planner, asked, path, judge)
    found += _end_faults(judge, robot.tool_link, asked, joints)
    found += _motion_faults(planner, asked, joints, times)
    return found, len(rows)


def _row_faults(
    planner: Planner, path: Trajectory, judge: Judge, rows: np.ndarray, *, beyond: float, off: float
) -> list[str]:
    """What configurations touch, and where they are further than allowed beyond the joint limits
    [rad] or off the constraint [rad or m].
    """
    robot, found = planner.robot, list[str]()
    least, names = min((judge.deepest(row) for row in rows), key=lambda one: one[0])
    if least < -DEEP_M:
        found.append(f"collision of {names}: {least:.3g} m")
    passed = float(np.maximum(robot.lower - rows, rows - robot.upper).max())
    if passed > beyond:
        found.append(f"limits: beyond by {passed:.3g}")
    missed = _off(judge, robot.tool_link, path.constraint, rows)
    if missed > off:
        found.append(f"constraint: off by {missed:.3g}")
    return found


def _asked_for(planner: Planner, asked: Request, path: Trajectory, judge: Judge) -> bool:
    """Whether what the path is said to keep is what was asked; held where it starts, if the request
    does not say where.
    """
    said = asked.words["constraint"]
    meant, own = planner.constraints[said] if isinstance(said, str) else said, path.constraint
    if not meant.is_placed:
        (place,), (turn,) = judge.poses(path.joints[:1], planner.robot.tool_link)
        meant = meant.relative_to(Pose(place, turn))
    if (meant.axes, meant.tolerance) != (own.axes, own.tolerance):
        return False
    if not any(meant.axes):
        return True
    away = Rotation.from_matrix(own.reference.rotation @ meant.reference.rotation.T).magnitude()
    apart = np.abs(own.reference.position - meant.reference.position).max()
    return bool(max(apart, away) < SLACK)


def _turn_faults(planner: Planner, asked: Request, path: Trajectory, judge: Judge) -> list[str]:
    """Of an arm that moves at first."""
    begin = asked.words.get("start_velocity")
    if begin is None or not np.any(begin):
        return []
    rows = turning(path.joints, path.times, begin)
    allowed = {"beyond": TURN_BEYOND + SLACK, "off": TURN_OFF + SLACK}
    return [f"turn: {fault}" for fault in _row_faults(planner, path, judge, rows, **allowed)]


def _dense(joints: np.ndarray, step: float) -> np.ndarray:
    found = [joints[:1]]
    for first, last in pairwise(joints):
        steps = max(1, math.ceil(float(np.linalg.norm(last - first)) / step))
        found.append(first + np.linspace(0.0, 1.0, steps + 1)[1:, None] * (last - first))
    return np.concatenate(found)


def _off(judge: Judge, tool: str, constraint: Any, rows: np.ndarray) -> float:
    """By how much rows are off a constraint at most, by PyBullet's poses of the tool and SciPy's
    rotations.
    """
    axes = np.array(constraint.axes, bool)
    if not axes.any():
        return 0.0
    tolerance, reference = np.array(constraint.tolerance), constraint.reference
    places, turns = judge.poses(rows, tool)
    worst = float(
        np.max(
            np.abs(places - reference.position)[:, axes[:3]] - tolerance[:3][axes[:3]], initial=0.0
        )
    )
    held = np.flatnonzero(axes[3:])
    if not len(held):
        return worst
    away = Rotation.from_matrix(turns @ reference.rotation.T)
    angles = np.zeros((len(rows), 3))
    if len(held) == 3:
        angles = away.as_rotvec()
    elif len(held) == 2:
        axis = np.eye(3)[({0, 1, 2} - set(held.tolist())).pop()]
        turned = away.apply(axis)
        size = np.arctan2(np.linalg.norm(np.cross(axis, turned), axis=1), turned @ axis)
        across = np.cross(axis, turned)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        angles = size[:, None] * across / np.where(length > 0.0, length, 1.0)
    else:
        x = away.as_quat()
        angles[:, held[0]] = 2.0 * np.arctan2(x[:, held[0]], x[:, 3])
        angles = (angles + np.pi) % (2.0 * np.pi) - np.pi
    allowed = tolerance[3:][held]
    if len(set(allowed.tolist())) == 1:  # one cone
        beyond = np.linalg.norm(angles[:, held], axis=1) - allowed[0]
    else:
        beyond = (np.abs(angles[:, held]) - allowed).max(axis=1)
    return max(worst, float(beyond.max()))


def _end_faults(judge: Judge, tool: str, asked: Request, joints: np.ndarray) -> list[str]:
    found, words = [], asked.words
    moved = float(np.abs(joints[0] - words["start"]).max())
    if moved > (0.01 if words.get("snap") else SLACK):
        found.append(f"end: the start is off by {moved:.3g}")
    goals = words["goal"] if isinstance(words["goal"], list) else [words["goal"]]
    share, missed = min(_missed(judge, tool, goal, joints[-1]) for goal in goals)
    if share > 1.0:
        found.append(f"end: the goal is off by {missed:.3g}")
    return found


def _missed(judge: Judge, tool: str, goal: Any, q: np.ndarray) -> tuple[float, float]:
    """By how much a configuration misses a goal: as a share of what it may, and itself."""
    if isinstance(goal, GoalRegion):
        missed, most = _off(judge, tool, goal.region, q[None]), OFF
    elif isinstance(goal, Pose):
        (place,), (turn,) = judge.poses(q[None], tool)
        away = Rotation.from_matrix(turn @ goal.rotation.T).magnitude()
        missed, most = max(float(np.abs(place - goal.position).max()), float(away)), OFF
    else:
        missed, most = float(np.abs(q - goal).max()), SLACK
    return missed / most, missed


def _motion_faults(
    planner: Planner, asked: Request, joints: np.ndarray, times: np.ndarray
) -> list[str]:
    """Velocities of the lines and accelerations between them."""
    robot, words, settings = planner.robot, asked.words, planner.bundle.planner
    lasting = np.diff(times)[:, None]
    if not (lasting > 0.0).all():
        return ["velocity: times do not rise"]
    speeds = np.diff(joints, axis=0) / lasting
    most = words.get("velocity_scale", 1.0) * robot.velocity
    over = float((np.abs(speeds) / most).max())
    found = [f"velocity: {over:.6g} times its limit"] if over > 1.0 + SLACK else []
    begin = np.zeros(robot.dof)
    if words.get("start_velocity") is not None:
        begin = np.asarray(words["start_velocity"], float)
    whole = np.vstack([begin, speeds, np.zeros(robot.dof)])
    around = np.pad(lasting, ((1, 1), (0, 0)))
    rates = 2.0 * np.diff(whole, axis=0) / (around[:-1] + around[1:])
    allowed = words.get("acceleration_scale", 1.0) * settings.acceleration_rad_s2
    over = float(np.abs(rates).max() / allowed)
    if over > 1.0 + 1e-3:
        found.append(f"velocity: it changes {over:.6g} times as fast as it may")
    return found


def _begun(effort: Effort) -> Figures:
    """Figures of a run that was ended before, of this code."""
    if effort.name != "soak" or not KEPT.is_file():
        return Figures()
    about: dict[str, Any] = json.loads(KEPT.read_text())
    of = about.pop("of")
    about["statuses"] = Counter(about["statuses"])
    figures = Figures(**about)
    return figures if of == _of() and figures.requests < effort.requests else Figures()


def _keep(effort: Effort, figures: Figures) -> None:
    if effort.name == "soak":
        write_text(KEPT, json.dumps({"of": _of(), **vars(figures)}) + "\n")


def _of() -> list[Any]:
    """What the figures hang on: requests and oracle as well as the planner."""
    files = (__file__, requests.__file__, bad_calls.__file__, fixtures.__file__, oracle.__file__)
    asked = [digest(Path(file)) for file in files]
    return [SEED, *asked, data_digest(PACKAGED), code_digest("planner")]
