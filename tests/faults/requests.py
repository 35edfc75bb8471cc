"""Requests at random: good ones, at the limits, degenerate and corrupt, in scenes that change."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from constraint_geodesics.constraints.constraint import Constraint, Pose
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.candidates import Parts
from tests.faults.bad_calls import NO_CONFIGURATION, NO_NAME, NO_NUMBER
from tests.planner_fixtures import NAMES, nodes_of

SEED = 2121
A_SCENE = 25
"""Requests in one scene."""
OTHERS = {
    "as it starts": Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.05, 0.05, 0)),
    "a box": Constraint((1, 1, 1, 0, 0, 0), (0.2, 0.2, 0.1, 0, 0, 0)),
    "nothing": Constraint((0,) * 6),
    "all": Constraint((1,) * 6),
    "a turn": Constraint((0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0.3)),
}
"""Held as they are where a path starts."""
TREES = 0.05
"""Share of requests that may grow trees, which takes seconds where there is no way."""


@dataclass(frozen=True)
class Request:
    """What is asked: the words of `Planner.plan`, and whether they are sound."""

    number: int
    kind: str
    words: dict[str, Any]


def scene_of(planner: Planner, first: Scene, block: int) -> Scene:
    """A scene of a few shapes beside those that were there at first, one of them carried at
    times.
    """
    rng = np.random.default_rng((SEED, 0, block))
    found = first
    for k in range(int(rng.integers(0, 4))):
        found = found.adding(_shape(f"own{k}", rng))
    if rng.random() < 0.3:
        at = Placement((0.0, 0.0, 0.06))
        load = Cylinder("load", at, 0.08, float(rng.uniform(0.01, 0.05)))
        planner.scene.become(found)
        planner.scene.attach(load, planner.robot.tool_link, ["link5"])
        found = planner.scene.now
    return found


def request(planner: Planner, number: int) -> Request:
    """The request of a number, always the same."""
    rng = np.random.default_rng((SEED, 1, number))
    kinds = tuple(_KINDS)
    kind = kinds[int(rng.choice(len(kinds), p=[share for share, _ in _KINDS.values()]))]
    return Request(number, kind, _KINDS[kind][1](planner, rng))


def _shape(name: str, rng: np.random.Generator) -> Shape:
    turn, out = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.8)
    x, y, z = (
        float(value) for value in (out * np.cos(turn), out * np.sin(turn), rng.uniform(0.05, 0.9))
    )
    size = float(10.0 ** rng.uniform(-2.0, -0.8))
    kind = int(rng.integers(4))
    if kind == 0:
        edges = (size, 0.5 * size, float(rng.uniform(0.01, 0.4)))
        return Box(name, (x, y, z), edges, rpy_rad=tuple(rng.uniform(-3, 3, 3).tolist()))
    if kind == 1:
        return Sphere(name, (x, y, z), size)
    if kind == 2:
        end = tuple((np.array([x, y, z]) + rng.uniform(-0.3, 0.3, 3)).tolist())
        return Capsule(name, (x, y, z), end, 0.3 * size)
    return Cylinder(name, Placement((x, y, z), tuple(rng.uniform(-3, 3, 3).tolist())), 0.3, size)


def _ends(rng: np.random.Generator) -> tuple[Any, np.ndarray, np.ndarray]:
    """A constraint and two configurations on it."""
    name = NAMES[int(rng.integers(len(NAMES)))]
    joints, _ = nodes_of(name)
    a, b = rng.choice(len(joints), 2, replace=False)
    return name, joints[a], joints[b]


def _good(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    constraint, start, goal = _ends(rng)
    found: dict[str, Any] = {"start": start, "goal": goal, "constraint": constraint}
    found["parts"] = Parts(tree=bool(rng.random() < TREES))
    if rng.random() < 0.1:
        found["velocity_scale"] = float(rng.uniform(0.01, 1.0))
        found["acceleration_scale"] = float(rng.uniform(0.01, 1.0))
    if rng.random() < 0.1:
        found["scene"] = [_shape("only", rng)]
    if rng.random() < 0.03:
        found["budget_s"] = float(rng.uniform(0.001, 0.2))
    return found


def _at_limits(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    """Joints at a limit, or a rounding within it or beyond."""
    found, robot = _good(planner, rng), planner.robot
    found["constraint"] = "free"
    for end in ("start", "goal"):
        q, joint = found[end].copy(), int(rng.integers(robot.dof))
        side = robot.lower if rng.random() < 0.5 else robot.upper
        q[joint] = side[joint] + float(rng.choice([0.0, 0.0, 1e-12, -1e-12, 1e-7, -1e-7]))
        found[end] = q
    return found


def _degenerate(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    """Ends that are all but one, or off by whole turns, or off the constraint by a little."""
    found, robot = _good(planner, rng), planner.robot
    start, kind = found["start"], int(rng.integers(5))
    if kind == 0:
        found["goal"] = start.copy()
    elif kind == 1:
        found["goal"] = start + 10.0 ** rng.uniform(-16, -3) * rng.normal(size=robot.dof)
    elif kind == 2:
        turns = np.zeros(robot.dof)
        turns[int(rng.integers(robot.dof))] = 2.0 * math.pi * rng.choice([-1.0, 1.0])
        found["goal"] = start + turns
    elif kind == 3:
        away = 10.0 ** rng.uniform(-12, -1) * rng.normal(size=robot.dof)
        found |= {"start": start + away, "snap": bool(rng.random() < 0.5)}
    else:
        found |= {"start": np.zeros(robot.dof), "goal": np.zeros(robot.dof), "constraint": "free"}
    return found


def _anywhere(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    """Configurations that keep nothing, under constraints held where the path starts."""
    found, robot = _good(planner, rng), planner.robot
    other = list(OTHERS)[int(rng.integers(len(OTHERS)))]
    found["constraint"] = OTHERS[other]
    found["parts"] = Parts(graph=False, tree=False)  # each start would have a graph of its own
    if rng.random() < 0.3:
        found["start"], found["goal"] = robot.sample(2, rng)
    else:
        found["goal"] = found["start"] + 0.2 * rng.normal(size=robot.dof)
    return found


def _poses(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    found, robot = _good(planner, rng), planner.robot
    pose: Any = Pose(*robot.forward(found["goal"]))
    kind = int(rng.integers(4))
    if kind == 1:
        axes = ["x", "y", "z", "roll", "pitch", "yaw"]
        free = [axis for axis in axes if rng.random() < 0.3]
        width = [0.0 if axis in free else float(rng.uniform(0, 0.2)) for axis in axes]
        pose = GoalRegion(pose, free, width)
    elif kind == 2:
        pose = Pose(rng.uniform(-1.5, 1.5, 3), pose.rotation)
    elif kind == 3:
        pose = [found["goal"], pose, _ends(rng)[2]]
    return found | {"goal": pose}


def _moving(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    found, robot = _good(planner, rng), planner.robot
    towards = found["goal"] - found["start"]
    speed = 10.0 ** rng.uniform(-12, 1)
    if rng.random() < 0.5:
        towards = rng.normal(size=robot.dof)
    found["start_velocity"] = speed * towards / np.linalg.norm(towards)
    return found


def _corrupt(planner: Planner, rng: np.random.Generator) -> dict[str, Any]:
    """A good request with one word that is none."""
    found = _good(planner, rng)
    bad: dict[str, list[Any]] = {
        "start": NO_CONFIGURATION,
        "goal": NO_CONFIGURATION,
        "start_velocity": NO_CONFIGURATION,
        "constraint": NO_NAME,
        "budget_s": NO_NUMBER,
        "velocity_scale": NO_NUMBER,
        "acceleration_scale": NO_NUMBER,
        "scene": [5, [None], ["box"], [_shape("table", rng)], [_shape("link6", rng)]],
    }
    name = list(bad)[int(rng.integers(len(bad)))]
    return found | {name: bad[name][int(rng.integers(len(bad[name])))]}


Maker = Callable[[Planner, np.random.Generator], dict[str, Any]]
_KINDS: dict[str, tuple[float, Maker]] = {
    "good": (0.38, _good),
    "at limits": (0.1, _at_limits),
    "degenerate": (0.14, _degenerate),
    "anywhere": (0.1, _anywhere),
    "poses": (0.08, _poses),
    "moving": (0.06, _moving),
    "corrupt": (0.14, _corrupt),
}
"""Shares of what is asked, and who makes it."""
