"""Calls of the Python API with arguments that are none: of a wrong type, shape or size, not finite,
beyond all bounds, unknown.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from constraint_geodesics.constraints.constraint import Constraint, Pose, constraint_from_json
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.identification.files import load_constraint
from constraint_geodesics.identification.identify import identify
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.trajectory import Trajectory
from tests.faults.bad_input import Bad
from tests.planner_fixtures import pairs_of

NAN, INF = math.nan, math.inf
LEVEL = (0, 0, 0, 1, 1, 0)
NO_CONFIGURATION: list[Any] = [
    *("x", "0 0 0 0 0 0", (0,) * 5, (0,) * 7, [NAN] * 6, [INF] * 6, [None] * 6, ["0.1"] * 6),
    *(np.array([None] * 6), np.array([1j] * 6), np.zeros((6, 1)), 5, {}, [1e300] * 6, [1e12] * 6),
    *(np.zeros(6, bool), np.array(["2020-01-01"] * 6, "datetime64[D]"), object(), set(range(6))),
    *(np.ma.masked_all(6), [0, 0, 0, 0, 0, "x"], [10**400] * 6, [True] * 6, [[0], 0, 0, 0, 0, 0]),
]
NO_NUMBER: list[Any] = ["1", "x", NAN, INF, -1, [1], np.array([1, 2]), 1j, {}, object()]
NO_TRIPLE: list[Any] = [
    *(None, "x", 5, (0, 0), (0, 0, 0, 0), (NAN, 0, 0), (INF, 0, 0), ("1", "2", "3"), [[0, 0, 0]]),
    *((None,) * 3, (1j, 0, 0), {}, object(), (1e300, 0, 0), (True, False, True)),
]
NO_SIZE: list[Any] = [None, "0.1", 0, -1, NAN, INF, (1,), [1, 2], 1j, {}, 1e300, True]
NO_NAME: list[Any] = [None, 5, [], {}, ("table",)]
Call = Callable[[Any], object]


def cases(planner: Planner) -> Iterator[Bad]:
    """For a planner whose scene they leave as it is."""
    yield from _constraints()
    yield from _shapes()
    yield from _scenes(planner)
    start, goal = pairs_of("level_cup", 1, 0)[0]
    path = planner.plan(start, goal, "level_cup")
    yield from _plans(planner, start, goal)
    yield from _motions(planner, path)
    yield from _rest(planner, path, np.linspace(start, goal, 30))


def _each(name: str, call: Call, values: list[Any], *said: str) -> Iterator[Bad]:
    """The call with each value."""
    for value in values:
        text = " ".join(repr(value).split())[:40]
        yield Bad(f"{name}={text}", lambda call=call, value=value: call(value), said)


def _constraints() -> Iterator[Bad]:
    pose = Pose.from_rpy((0.4, 0.0, 0.3), (0.0, 0.0, 0.0))
    six: list[Any] = [None, 5, "level", (), (0,) * 5, ("1",) * 6, (None,) * 6, {"x": 1}, object()]
    yield from _each("axes", Constraint, [*six, (2,) * 6, (0.5,) * 6, (NAN,) * 6], "axes")
    ragged: list[Any] = [[[0]] * 6, np.zeros((6, 2)), (1j,) * 6, b"000110"]
    yield from _each("axes", Constraint, ragged, "axes")
    alone: list[Any] = [(0, 0, 0, x, 0, 0) for x in ("0.1", None, NAN, INF, -1, 1e300, [1], 1j)]
    widths = [None, "0.1", 0.1, (0,) * 5, (1, 0, 0, 0, 0, 0), {}, *alone]
    yield from _each("tolerance", lambda x: Constraint(LEVEL, x), widths, "tolerance")
    none: list[Any] = ["x", 5, (0, 0, 0), np.eye(4), [pose], {}, Placement(), object()]
    yield from _each("reference", lambda x: Constraint(LEVEL, reference=x), none, "reference")
    yield from _each("relative_to", Constraint(LEVEL).relative_to, [None, *none], "pose = ")
    yield from _each("position", lambda x: Pose(x, np.eye(3)), NO_TRIPLE, "position")
    yield from _each("position_m", lambda x: Pose.from_rpy(x, (0, 0, 0)), NO_TRIPLE, "position_m")
    yield from _each("rpy_rad", lambda x: Pose.from_rpy((0, 0, 0), x), NO_TRIPLE, "rpy_rad")
    turns: list[Any] = [None, "x", np.zeros((3, 3)), np.eye(4), 2 * np.eye(3), -np.eye(3), object()]
    turns += [np.full((3, 3), NAN), [["a"] * 3] * 3]
    yield from _each("rotation", lambda x: Pose((0, 0, 0), x), turns, "rotation")
    yield from _each("region", GoalRegion, [None, "x", (0,) * 6, Placement()], "pose = ")
    free: list[Any] = [None, 5, "q", "x y", ["x", "q"], [5], [None], NAN]
    yield from _each("free", lambda x: GoalRegion(pose, x), free, "free = ")
    wide: list[Any] = [None, 5, "0", ["a"] * 6, (0,) * 5, (NAN,) * 6, (-1,) * 6, (INF,) * 6, {}]
    yield from _each("widths", lambda x: GoalRegion(pose, (), x), wide, "tolerance")
    kinds: list[Any] = [{"kind": kind} for kind in ("os", 5, "../x", "kernels", "__init__", "")]
    yield from _each("kind", constraint_from_json, kinds, "kind = ")
    entries: list[Any] = [None, "x", [], 5, {"axes": 5}, {"kind": "polynomial"}, {"kind": "both"}]
    entries += [{"kind": "spline"}, {"kind": "functions"}]
    entries += [{"axes": LEVEL, "tolerance": [0] * 6, "reference": 5}]
    yield from _each("JSON", constraint_from_json, entries)


def _shapes() -> Iterator[Bad]:
    for name, call in (
        ("centre_m", lambda x: Box("n", x, (1, 1, 1))),
        ("rpy_rad", lambda x: Box("n", (0, 0, 0), (1, 1, 1), rpy_rad=x)),
        ("size_m", lambda x: Box("n", (0, 0, 0), x)),
        ("centre_m", lambda x: Sphere("n", x, 0.1)),
        ("from_m", lambda x: Capsule("n", x, (1, 1, 1), 0.1)),
        ("to_m", lambda x: Capsule("n", (1, 1, 1), x, 0.1)),
        ("position_m", Placement),
        ("rpy_rad", lambda x: Placement(rpy_rad=x)),
    ):
        yield from _each(name, call, NO_TRIPLE, name)
    sizes: list[Any] = [(0, 0, 0), (-1, 1, 1), (1, 1, NAN)]
    yield from _each("size_m", lambda x: Box("n", (0, 0, 0), x), sizes, "size_m")
    at = Placement()
    for name, call in (
        ("radius_m", lambda x: Sphere("n", (0, 0, 0), x)),
        ("radius_m", lambda x: Cylinder("n", at, 0.1, x)),
        ("length_m", lambda x: Cylinder("n", at, x, 0.1)),
        ("radius_m", lambda x: Capsule("n", (0, 0, 0), (0, 0, 1), x)),
        ("radius_m", lambda x: PointCloud("n", [[0, 0, 0]], x)),
        ("scale", lambda x: Mesh("n", "part.obj", scale=x)),
    ):
        yield from _each(name, call, NO_SIZE, name)
    yield from _each("name", lambda x: Box(x, (0, 0, 0), (1, 1, 1)), [*NO_NAME, ""], "name = ")
    links: list[Any] = [None, 5, "link6", [5], {"link6": 1}]
    call = lambda x: Box("n", (0, 0, 0), (1, 1, 1), x)  # noqa: E731
    yield from _each("exempt_links", call, links, "exempt_links")
    poses: list[Any] = [None, "x", 5, np.eye(4), (0, 0, 0)]
    yield from _each("pose", lambda x: Cylinder("n", x, 1, 1), poses, "no pose")
    points: list[Any] = [None, "x", 5, [], [[1, 2]], [[NAN, 0, 0]], [[1, 2, 3], [4, 5]], {}]
    points += [np.zeros((20_000, 3)), [["a"] * 3], [[1e300, 0, 0]]]
    yield from _each("points_m", lambda x: PointCloud("n", x, 0.01), points, "points")
    files: list[Any] = [None, 5, NAN, "", b"x"]
    yield from _each("file", lambda x: Mesh("n", x), files, "file = ")
    yield from _each("urdf", lambda x: Body("n", x), files, "urdf = ")


def _scenes(planner: Planner) -> Iterator[Bad]:
    scene, box = planner.scene, Box("n", (0, 0, 1), (0.1, 0.1, 0.1))
    no_mesh: list[Any] = ["no.stl", "/dev/null", "/dev/zero", "/tmp"]
    yield from _each("mesh", lambda x: scene.add(Mesh("n", x)), no_mesh, "mesh")
    yield from _each("body", lambda x: scene.add(Body("n", x)), no_mesh, "URDF")
    yield from _each("link", lambda x: scene.attach(box, x), [*NO_NAME, "hand", "table"], "link")
    touching: list[Any] = [None, "link5", 5, ["hand"], [5], {}, [None]]
    yield from _each("touching", lambda x: scene.attach(box, "link6", x), touching)
    none: list[Any] = [None, 5, "box", {}, Box, [box]]
    yield from _each("attach", lambda x: scene.attach(x, "link6"), none, "shape")
    yield from _each("add", scene.add, none, "shape")
    taken: list[Any] = [Box(name, (2, 2, 2), (0.1, 0.1, 0.1)) for name in ("table", "link6")]
    yield from _each("name", scene.add, taken)
    names = [*NO_NAME, "nothing", NAN]
    yield from _each("remove", scene.remove, names, "shape")
    yield from _each("detach", scene.detach, names, "attached")
    yield from _each("move", lambda x: scene.move(x, Placement()), names, "shape")
    yield from _each("pose", lambda x: scene.move("table", x), [None, "x", 5, (0, 0, 0)], "no pose")
    yield from _each("allow", lambda x: scene.allow(x, "table"), names, "link")
    yield from _each("become", scene.become, [None, 5, {}, scene], "scene = ")
    q = np.zeros(6)
    yield from _each("link_pose", lambda x: scene.link_pose(q, x), names, "link")
    yield from _each("q", lambda x: scene.link_pose(x, "link6"), [None, *NO_CONFIGURATION], "q")


def _plans(planner: Planner, start: np.ndarray, goal: np.ndarray) -> Iterator[Bad]:
    def plan(*asked: Any, **more: Any) -> object:
        return planner.plan(*asked, **more)

    every = [None, *NO_CONFIGURATION]
    yield from _each("start", lambda x: plan(x, goal, "free"), every, "start")
    yield from _each("goal", lambda x: plan(start, x, "free"), every, "goal")
    many: list[Any] = [[], [[]], [None], [start, None], [start, "x"], GoalRegion, Pose, {"a": 1}]
    many += [np.zeros((0, 6)), np.zeros((2, 5)), iter([start]), Placement(), Constraint(LEVEL)]
    yield from _each("goals", lambda x: plan(start, x, "free"), many, "goal")
    moving = lambda x: plan(start, goal, "free", start_velocity=x)  # noqa: E731
    yield from _each("start_velocity", moving, NO_CONFIGURATION, "start_velocity")
    names = [*NO_NAME, "nope", "", "free ", NAN, Constraint]
    yield from _each("constraint", lambda x: plan(start, goal, x), names, "constraint", "free")
    yield from _each("nodes", planner.nodes, names, "constraint")
    yield from _each("project", lambda x: planner.project(start, x), names, "constraint")
    yield from _each("q", lambda x: planner.project(x, "free"), every, "q")
    for name, values in (
        ("budget_s", [*NO_NUMBER, 0, True, 1e300]),
        ("velocity_scale", [None, *NO_NUMBER, 0, 2, True, 1e-300]),
        ("acceleration_scale", [None, *NO_NUMBER, 0, 2, True, 1e-300]),
        ("snap", [None, "yes", 5, NAN, []]),
        ("parts", [None, "all", 5, (), {}]),
        ("scene", [None, "x", 5, [None], ["box"], {"b": 1}, NAN, planner.scene, Box]),
    ):
        call = lambda x, name=name: plan(start, goal, "free", **{name: x})  # noqa: E731
        yield from _each(name, call, values, *(() if name == "scene" else (name,)))
    rows: list[Any] = [None, "x", [], [start[:5]], [[NAN] * 6], start, [None], [["x"] * 6], {}]
    yield from _each("starts", lambda x: planner.plan_batch(x, [goal], "free"), rows, "starts")
    yield from _each("goals", lambda x: planner.plan_batch([start], x, "free"), rows, "goals")
    batch = lambda x: planner.plan_batch([start], [goal], "free", progress=x)  # noqa: E731
    yield from _each("progress", batch, [5, "x"], "progress")
    poses: list[Any] = [None, "x", (0,) * 6, np.eye(4), Placement(), {}, Pose]
    yield from _each("pose", planner.ik, poses, "pose = ")


def _motions(planner: Planner, path: Trajectory) -> Iterator[Bad]:
    times = [None, *NO_NUMBER, 1e300, True]
    yield from _each("at_s", lambda x: planner.replan(path, x), times, "at_s")
    yield from _each("at_s", path.state, times, "at_s")
    yield from _each("at_s", path.stop, times, "at_s")
    limits = [*NO_NUMBER, 0, True]
    yield from _each("limit_s", lambda x: planner.replan(path, 0.1, limit_s=x), limits, "limit_s")
    none: list[Any] = [None, 5, "x", path.joints, object()]
    yield from _each("trajectory", lambda x: planner.replan(x, 0.1), none, "trajectory")
    shares = [x for x in NO_NUMBER if not (isinstance(x, list) and x == [1])]
    yield from _each("s", path.at, [None, *shares, 2.0, [[0.5]]], "s = ")
    frames: list[Any] = [None, "x", NAN, -1, 1, [], True, 10**9]
    yield from _each("frames", lambda x: path.record("x.rrd", x), frames, "frames")
    yield from _each("draw", path.draw, [None, 5, NAN, "", b"x"], "file = ")
    yield from _each("constraint", load_constraint, [None, 5, NAN, "", b"x"], "file = ")
    yield from _each("save", path.save, [None, 5, NAN, "", b"x"], "file = ")


def _rest(planner: Planner, path: Trajectory, rows: np.ndarray) -> Iterator[Bad]:
    robot, certifier = planner.robot, planner._certifier
    files: list[Any] = [None, 5, NAN, "", b"x", "no.csv", "/dev/zero", "/dev/null", "/tmp"]
    yield from _each("check", planner.check, files)
    sources: list[Any] = [5, NAN, "", b"x", "no", "/dev/null", "/tmp"]
    yield from _each("load", Planner.load, sources)
    methods: list[Any] = [None, 5, "x", [], "Planner", ""]
    yield from _each("method", lambda x: Planner.load(method=x), methods, "method")
    level: list[Any] = [None, "level_cup", 5]
    yield from _each("certify", lambda x: certifier.certify(path.joints, x), level, "constraint = ")
    shown: list[Any] = [None, "x", 5, [], {}, np.zeros((30, 6)), np.zeros((30, 5)), object()]
    shown += [np.zeros((0, 6)), np.full((30, 6), NAN), [rows, None], [["a"] * 6] * 20, 57 * rows]
    shown += [[rows, np.zeros((3, 5))], rows.astype(complex), np.zeros((2, 2, 2, 6)), "no.csv"]
    shown += [np.full((30, 6), 1e300), "/dev/zero", "/dev/null", "/tmp", "no.parquet"]
    yield from _each("identify", lambda x: identify(x, robot), shown)
    yield from _each("robot", lambda x: identify(rows, x), [None, "x", 5, planner], "robot = ")
    urdf, link = "kuka_iiwa/model.urdf", "lbr_iiwa_link_7"

    def arm(*words: Any, **more: Any) -> object:
        return Planner.from_urdf(*words, **more)

    yield from _each("urdf", lambda x: arm(x, link), [None, 5, "", NAN, "no.urdf", "/dev/zero"])
    yield from _each("tool_link", lambda x: arm(urdf, x), [None, 5, "", "hand", [], {}], "link")
    srdfs: list[Any] = [5, "", NAN, "no.srdf", [], "/dev/zero", "/dev/null", "/tmp"]
    yield from _each("srdf", lambda x: arm(urdf, link, x), srdfs)
    tools: list[Any] = [5, "", NAN, (0,) * 6, {}, Placement()]
    yield from _each("tool", lambda x: arm(urdf, link, tool=x), tools, "tool = ")
    joint = "lbr_iiwa_joint_1"
    held: list[Any] = [{joint: x} for x in (NAN, INF, "0.1", 99, None, True, [0.1])]
    holds = [5, "x", NAN, ["a"], [(joint, 0.1)], {"elbow": 0}, {5: 0}, *held]
    yield from _each("hold", lambda x: arm(urdf, link, hold=x), holds)
    around: list[Any] = [None, 5, "x", [5], [None], {}]
    yield from _each("workcell", lambda x: arm(urdf, link, workcell=x), around)
    settings: list[Any] = [5, "x", {}, {"seed": 1}, []]
    yield from _each("settings", lambda x: arm(urdf, link, settings=x), settings, "settings = ")
