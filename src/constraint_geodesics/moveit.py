"""MoveIt's planning scenes and motion requests, as YAML of its messages moveit_msgs/PlanningScene
and moveit_msgs/MotionPlanRequest.

What bounds a motion and has no counterpart here is refused by its name, never left out: cones,
planes, octomaps with something in them, other path constraints than an orientation's, links other
than the tool's.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from constraint_geodesics.constraints.constraint import Constraint, Pose
from constraint_geodesics.errors import ParamsError
from constraint_geodesics.goals.goal import Wanted
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.params import read_yaml
from constraint_geodesics.planner import SLOWEST, Planner, SceneError
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene.arm import arms_folder
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.planning_scene import PlanningScene
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape, ShapeError
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.text_files import write_text
from constraint_geodesics.values import LARGEST, shown

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_KINDS = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone", 5: "prism"}
"""Of shape_msgs/SolidPrimitive, whose names some files write in place of the numbers."""
_ADD = (None, 0, "add", "ADD", "\0", b"\0")
"""How files write that an object is added."""
_WORLD = ("", "world")
"""Names of the base frame beside those of its links."""
_SAME = 1e-9
_ELSEWHERE = 1e-6
"""What entries of poses may differ by."""
_ALONG = 1e-5
"""What entries of axes' directions may differ by: a turn that is written as 1.5708 is a quarter."""
_TILTS = ([True, False, False], [False, False, True])
"""What may be free of Euler angles: x, or z, alone."""
_ROTATION_VECTOR = 1
"""Of moveit_msgs/OrientationConstraint's ways to bound a rotation."""
_FREE_RAD = 3.1
"""A tolerance from which on an angle is free, as files mean it that write 3.14."""
_WIDEST_RAD = 0.5 * math.pi
"""Turns up to which none of their Euler angles is larger than the whole."""


class MoveitError(ValueError):
    """A file that is none of MoveIt's, or says what can't be kept; one line with the entry."""


@dataclass(frozen=True)
class MoveitRequest:
    """What `Planner.plan` takes, as a request says it."""

    start: list[float]
    goals: list[Wanted]
    constraint: Constraint
    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0


def add_moveit_scene(file: Path, scene: PlanningScene) -> dict[str, float]:
    """Add a planning scene's objects, attached ones and allowed collisions to a planner's scene,
    all or nothing; returns the values of joints [rad or m] that it names.

    Raises MoveitError, one line.
    """
    raw = _read(file)
    try:
        if not raw.keys() & {"world", "robot_state", "allowed_collision_matrix"}:
            raise MoveitError("no planning scene of MoveIt: has neither world nor robot_state")
        world, state = _entry(raw, "world", {}), _entry(raw, "robot_state", {})
        if _entry(_entry(world, "octomap", {}), "octomap", {}).get("data"):
            raise MoveitError("world.octomap: give its points as a point_cloud in a scene's file")
        for entry, neutral in (("link_padding", ("padding", 0.0)), ("link_scale", ("scale", 1.0))):
            for own in _list(raw, entry):
                if float(own[neutral[0]]) != neutral[1]:
                    raise MoveitError(f"{entry}: links are taken as they are: {own}")
        _require_none(state, "robot_state.multi_dof_joint_state", "joint_names")
        _require_at_base(raw, scene)
        joints = _joint_state(_entry(state, "joint_state", {}), "robot_state")
        scene.change(lambda now: _added(now, raw, scene, _configuration(joints, scene.robot)))
    except (MoveitError, RobotError, SceneError, ShapeError) as error:
        raise MoveitError(f"{file}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise MoveitError(f"{file}: no planning scene of MoveIt: {_said(error)}") from None
    return joints


def _added(now: Scene, raw: Any, scene: PlanningScene, q: np.ndarray | None) -> Scene:
    """The scene with a file's objects.  q: the arm's configuration, where the file says it."""
    named, there = dict[str, list[str]](), now.names
    world, state = _entry(raw, "world", {}), _entry(raw, "robot_state", {})
    for number, own in enumerate(_list(world, "collision_objects")):
        where = f"world.collision_objects[{number}]"
        with _naming(where):
            shapes = _shapes(own, where, lambda frame: _fixed(scene, frame))
            named[str(own["id"])] = [shape.name for shape in shapes]
            now = now.adding(*shapes)
    for number, own in enumerate(_list(state, "attached_collision_objects")):
        where = f"robot_state.attached_collision_objects[{number}]"
        with _naming(where):
            name, parts = str(own["object"]["id"]), _held(own, where, scene, q)
            around = named.pop(name, [])
            _require_free(parts, around, now, where)
            now = now.removing(*(part for part in around if part != name))
            named[name] = [held.name for held in parts]
            for held in parts:
                now = now.attaching(held)
    known = {*scene.links, *there, *named}
    with _naming("allowed_collision_matrix"):
        for first, second in _allowed(_entry(raw, "allowed_collision_matrix", {}), known):
            for a in named.get(first, [first]):
                for b in named.get(second, [second]):
                    now = now.allowing(a, b)
    return now


def read_moveit_request(
    file: Path, planner: Planner, state: Mapping[str, float] | None = None
) -> MoveitRequest:
    """A motion request for a planner's arm.  state: of joints, where the request names none.

    Raises MoveitError, one line.
    """
    raw, robot = _read(file), planner.robot
    try:
        state_given = _entry(raw, "start_state", {})
        given = _joint_state(_entry(state_given, "joint_state", {}), "start_state")
        _require_none(state_given, "start_state.multi_dof_joint_state", "joint_names")
        _require_none(raw, "start_state", "attached_collision_objects")
        _require_none(raw, "trajectory_constraints", "constraints")
        if float(raw.get("max_cartesian_speed") or 0.0) > 0.0:
            raise MoveitError("max_cartesian_speed: speeds are limited joint by joint alone")
        start = _named_joints({**(state or {}), **given}, robot, "start_state")
        goals = []
        for number, own in enumerate(_list(raw, "goal_constraints")):
            where = f"goal_constraints[{number}]"
            with _naming(where):
                goals.append(_goal(own, planner.scene, where))
        if not goals:
            raise MoveitError("goal_constraints: there is none")
        with _naming("path_constraints"):
            constraint = _path_constraint(_entry(raw, "path_constraints", {}), planner.scene)
        scales = [_scale(raw, what) for what in ("velocity", "acceleration")]
    except MoveitError as error:
        raise MoveitError(f"{file}: {error}") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise MoveitError(f"{file}: no motion request of MoveIt: {_said(error)}") from None
    return MoveitRequest(start, goals, constraint, *scales)


def joints_named(scene_file: Path, request_file: Path) -> dict[str, float]:
    """Values of joints [rad or m] that a planning scene and a request name, the request's before
    the scene's, whether they are planned or not.  Raises MoveitError, one line.
    """
    found = dict[str, float]()
    for file, entry in ((scene_file, "robot_state"), (request_file, "start_state")):
        raw = _read(file)
        try:
            found |= _joint_state(_entry(_entry(raw, entry, {}), "joint_state", {}), entry)
        except MoveitError as error:
            raise MoveitError(f"{file}: {error}") from None
        except (AttributeError, TypeError, ValueError) as error:
            raise MoveitError(f"{file}: {entry}: no state of joints: {_said(error)}") from None
    return found


def robot_named(scene_file: Path) -> str | None:
    """The name that a planning scene has for its robot."""
    name = _read(scene_file).get("robot_model_name")
    return None if name is None else str(name)


def shape_of_record(raw: Mapping[str, Any], where: str) -> Shape:
    """A primitive with a pose of its own in the base frame: a name, type and dimensions as in
    MoveIt, position [m] and orientation_xyzw.  where: the entry, for errors.  Raises MoveitError.
    """
    with _naming(where):
        pose = _pose({"position": raw["position"], "orientation": raw["orientation_xyzw"]})
    return _primitive(raw, str(raw["name"]), Placement.of_matrix(pose), where)


def _read(file: Path) -> dict[str, Any]:
    try:
        raw = read_yaml(file)
    except ParamsError as error:
        raise MoveitError(str(error)) from None
    if not isinstance(raw, dict):
        raise MoveitError(f"{file}: nothing of MoveIt: must be entries by name")
    return raw


@contextmanager
def _naming(where: str) -> Iterator[None]:
    """The entry in faults that do not begin with it."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        known = isinstance(error, MoveitError) and str(error).startswith(where)
        said = str(error) if known else f"{where}: {_said(error)}"
        raise MoveitError(said) from None


def _said(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error).splitlines()[0]


def _entry(raw: Any, name: str, default: Any) -> Any:
    if not isinstance(raw, dict):
        raise MoveitError(f"{shown(raw)}: must be entries by name")
    found = raw.get(name)
    if found is None:
        return default
    if isinstance(default, dict) and not isinstance(found, dict):
        raise MoveitError(f"{name} = {shown(found)}: must be entries by name")
    return found


def _list(raw: Any, name: str) -> list[Any]:
    found = _entry(raw, name, [])
    if not isinstance(found, list):
        raise MoveitError(f"{name}: must be a list")
    return found


def _require_none(raw: Any, path: str, name: str) -> None:
    """That nothing is said there which would be left out."""
    if _list(_entry(raw, path.split(".")[-1], {}), name):
        raise MoveitError(f"{path}.{name}: is not taken over: leave it out")


def _numbers(raw: Any, names: str) -> list[float]:
    """Of a dictionary, or of a list in that order."""
    found = [raw[name] for name in names] if isinstance(raw, dict) else raw
    values = [float(value) for value in found if not isinstance(found, str)]
    if len(values) != len(names) or not all(map(math.isfinite, values)):
        raise MoveitError(f"{raw}: must be {len(names)} finite numbers")
    return values


def _turn(raw: Any) -> Float[np.ndarray, "3 3"]:
    quaternion = np.array(_numbers(raw, "xyzw"))
    if not np.linalg.norm(quaternion) > _SAME:
        raise MoveitError(f"{raw}: no orientation: all four numbers are 0")
    found: Float[np.ndarray, "3 3"] = Rotation.from_quat(quaternion).as_matrix()
    return found


def _pose(raw: Any) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    if raw:
        pose[:3, :3], pose[:3, 3] = _turn(raw["orientation"]), _numbers(raw["position"], "xyz")
    return pose


def _scale(raw: Any, what: str) -> float:
    """The share of a limit that is used; 0 means the whole, as in MoveIt."""
    entry = f"max_{what}_scaling_factor"
    scale = float(raw.get(entry) or 1.0)
    if not SLOWEST <= scale <= 1.0:
        raise MoveitError(f"{entry}: {scale:g}: must be 0, or at least {SLOWEST:g} and at most 1")
    return scale


def _joint_state(raw: Any, where: str) -> dict[str, float]:
    names, values = _list(raw, "name"), _list(raw, "position")
    if len(names) != len(values):
        raise MoveitError(f"{where}.joint_state: {len(names)} names, {len(values)} positions")
    if any(float(value) != 0.0 for value in _list(raw, "velocity")):
        raise MoveitError(f"{where}.joint_state.velocity: motions begin at rest")
    found = {str(name): float(value) for name, value in zip(names, values, strict=True)}
    return _all_finite(found, f"{where}.joint_state")


def _all_finite(joints: dict[str, float], where: str) -> dict[str, float]:
    for name, value in joints.items():
        if not abs(value) <= LARGEST:
            raise MoveitError(f"{where}: {name} is {value}: must be finite")
    return joints


def _configuration(joints: Mapping[str, float], robot: SerialRobot) -> np.ndarray | None:
    """The arm's, if all its joints are named."""
    if not set(robot.joint_names) <= joints.keys():
        return None
    return np.array([joints[name] for name in robot.joint_names])


def _named_joints(joints: Mapping[str, float], robot: SerialRobot, where: str) -> list[float]:
    if missing := [name for name in robot.joint_names if name not in joints]:
        raise MoveitError(f"{where}: has no value for {', '.join(missing)}")
    return [joints[name] for name in robot.joint_names]


def _fixed(scene: PlanningScene, frame: str) -> Float[np.ndarray, "4 4"]:
    """The pose of a frame that does not move."""
    if frame not in scene.links:
        if frame in _WORLD:
            return np.eye(4)
        raise MoveitError(f"frame {frame!r}: is no link of the robot: write poses in its base")
    robot = scene.robot
    poses = [scene.link_pose(q, frame) for q in robot.sample(2, np.random.default_rng(0))]
    if np.abs(poses[0] - poses[1]).max() > _SAME:
        raise MoveitError(f"frame {frame!r}: moves with the arm: write poses in its base")
    return poses[0]


def _require_at_base(raw: Any, scene: PlanningScene) -> None:
    """That a scene's transforms say of the world what is taken for granted: it is the base."""
    for number, own in enumerate(_list(raw, "fixed_frame_transforms")):
        parent = str(_entry(_entry(own, "header", {}), "frame_id", ""))
        child = str(_entry(own, "child_frame_id", ""))
        if not (child in _WORLD or (parent in _WORLD and child in scene.links)):
            continue
        given, expected = _entry(own, "transform", {}), np.eye(4)
        with _naming(f"fixed_frame_transforms[{number}]"):
            if given:
                given = {"position": given["translation"], "orientation": given["rotation"]}
            if parent in _WORLD or parent in scene.links:
                expected = np.linalg.inv(_fixed(scene, parent)) @ _fixed(scene, child)
            pose = _pose(given)
        if np.abs(pose - expected).max() > _ELSEWHERE:
            raise MoveitError(
                f"fixed_frame_transforms: {child!r} in {parent!r} is elsewhere: the world is taken "
                "to be the robot's base: write poses in a link's frame"
            )


def _shapes(
    raw: Any, where: str, frame_of: Callable[[str], Float[np.ndarray, "4 4"]]
) -> list[Shape]:
    """The shapes of a collision object."""
    name = str(raw["id"])
    if raw.get("operation") not in _ADD:
        raise MoveitError(f"{where}: operation {raw['operation']!r}: objects are added alone")
    frame = str(_entry(_entry(raw, "header", {}), "frame_id", ""))
    pose = frame_of(frame) @ _pose(raw.get("pose"))
    if _list(raw, "planes"):
        raise MoveitError(f"{where}: {name!r} has a plane, which has no end: write it as a box")
    found: list[Shape] = []

    def named() -> str:
        return f"{name}_{len(found) + 1}" if found else name

    for own, place in _with_poses(raw, "primitives", "primitive_poses", where):
        at = Placement.of_matrix(pose @ _pose(place))
        found.append(_primitive(own, named(), at, where))
    for own, place in _with_poses(raw, "meshes", "mesh_poses", where):
        at = Placement.of_matrix(pose @ _pose(place))
        found.append(_mesh(own, named(), at, where))
    if not found:
        raise MoveitError(f"{where}: {name!r} has neither primitives nor meshes")
    return found


def _with_poses(raw: Any, shapes: str, poses: str, where: str) -> Iterator[tuple[Any, Any]]:
    own, places = _list(raw, shapes), _list(raw, poses)
    if len(own) != len(places):
        raise MoveitError(f"{where}: {len(own)} {shapes}, {len(places)} {poses}")
    return zip(own, places, strict=True)


def _primitive(raw: Any, name: str, at: Placement, where: str) -> Shape:
    kind, given = raw["type"], raw["dimensions"]
    sizes = [float(x) for x in (_list(raw, "dimensions") if isinstance(given, str) else given)]
    kind = _KINDS.get(kind, str(kind)) if isinstance(kind, int) else str(kind).lower()
    counts = {"box": 3, "sphere": 1, "cylinder": 2}
    if kind not in counts:
        raise MoveitError(f"{where}: {name!r} is a {kind}: must be one of {', '.join(counts)}")
    if len(sizes) < counts[kind] or not all(0.0 < x < math.inf for x in sizes[: counts[kind]]):
        what = f"{counts[kind]} positive numbers"
        raise MoveitError(f"{where}: {name!r}: dimensions {sizes}: must be {what}")
    if kind == "box":
        return Box(name, at.position_m, (sizes[0], sizes[1], sizes[2]), rpy_rad=at.rpy_rad)
    if kind == "sphere":
        return Sphere(name, at.position_m, sizes[0])
    return Cylinder(name, at, sizes[0], sizes[1])


def _mesh(raw: Any, name: str, at: Placement, where: str) -> Mesh:
    """An inline mesh, whose faults are told by the name of its object: it has no file that a user
    knows.
    """
    file = None
    try:
        file = _mesh_file(raw)
        found = Mesh(name, file, at)
        found.pieces()
    except (MoveitError, RobotError) as error:
        text = str(error).removeprefix(f"{file}: ")
        raise MoveitError(f"{where}: {name!r}: {text}") from None
    return found


def _mesh_file(raw: Any) -> Path:
    """An inline mesh as a file of the user's cache, named by its content."""
    lines = ["v " + " ".join(map(repr, _numbers(own, "xyz"))) for own in raw["vertices"]]
    count = len(lines)
    for own in raw["triangles"]:
        indices = own["vertex_indices"] if isinstance(own, dict) else own
        if not all(isinstance(k, int) and 0 <= k < count for k in indices):
            raise MoveitError("no mesh: a face with a corner that is not there")
        lines.append("f " + " ".join(str(k + 1) for k in indices))
    text = "\n".join(lines) + "\n"
    file = arms_folder() / f"mesh-{sha256(text.encode()).hexdigest()[:16]}.obj"
    if not file.is_file():
        write_text(file, text)
    return file


def _require_free(
    parts: Sequence[Attached], own: Collection[str], scene: Scene, where: str
) -> None:
    """That an attached object takes no place but that of the file's own object in the world, or of
    the same shape where that stands.
    """
    there = {shape.name: shape for shape in scene.workcell}
    for held in parts:
        taken = held.name in scene.names and held.name not in own
        if taken and not (held.name in there and there[held.name].is_like(held.shape)):
            raise MoveitError(
                f"{where}: its part {held.name!r} is called as another object: rename it"
            )


def _held(raw: Any, where: str, scene: PlanningScene, q: np.ndarray | None) -> list[Attached]:
    """An attached object's shapes, in their link's frame."""
    link = str(raw["link_name"])

    def into_link(frame: str) -> Float[np.ndarray, "4 4"]:
        if frame == link:
            return np.eye(4)
        if q is None:
            raise MoveitError(f"{where}: is in the frame {frame!r}, and no joint_state says where")
        there = scene.link_pose(q, frame) if frame in scene.links else _fixed(scene, frame)
        own: Float[np.ndarray, "4 4"] = np.linalg.inv(scene.link_pose(q, link)) @ there
        return own

    shapes = _shapes(raw["object"], where, into_link)
    names = [shape.name for shape in shapes]
    touching = [str(other) for other in _list(raw, "touch_links")]
    return [Attached(shape, link, (*touching, *_others(names, shape.name))) for shape in shapes]


def _others(names: Sequence[str], own: str) -> list[str]:
    """The other parts of one object, which may touch it."""
    return [name for name in names if name != own]


def _flag(value: Any) -> bool:
    """Of the matrix; texts, as YAML 1.2 reads `no` and `off`, are none."""
    if value not in (True, False):
        raise MoveitError(f"allowed_collision_matrix: {value!r}: must be true or false")
    return bool(value)


def _allowed(raw: Any, known: set[str]) -> Iterator[tuple[str, str]]:
    """Pairs of what is known that may touch."""
    where = "allowed_collision_matrix"
    names, rows = [str(name) for name in _list(raw, "entry_names")], _list(raw, "entry_values")
    if len(names) != len(rows):
        raise MoveitError(f"{where}: {len(names)} names, {len(rows)} rows")
    said = dict[frozenset[str], bool]()
    for name, row in zip(names, rows, strict=True):
        enabled = row["enabled"] if isinstance(row, dict) else row
        if len(enabled) != len(names):
            raise MoveitError(f"{where}: the row of {name!r} has not {len(names)} values")
        for other, value in zip(names, enabled, strict=True):
            if other != name:  # where the two halves disagree, both must allow it
                pair = frozenset((name, other))
                said[pair] = _flag(value) and said.get(pair, True)
    names, values = _list(raw, "default_entry_names"), _list(raw, "default_entry_values")
    if len(names) != len(values):
        raise MoveitError(f"{where}: {len(names)} default names, {len(values)} values")
    defaults = {str(name): _flag(value) for name, value in zip(names, values, strict=True)}
    for name in defaults:
        for other in known - {name}:
            # of two defaults, both must allow it
            said.setdefault(frozenset((name, other)), defaults[name] and defaults.get(other, True))
    for pair, value in sorted(said.items(), key=lambda one: sorted(one[0])):
        if value and pair <= known:
            first, second = sorted(pair)
            yield first, second


def _goal(raw: Any, scene: PlanningScene, where: str) -> Wanted:
    """Joint values, or a pose of the tool with what may be off."""
    robot = scene.robot
    if joints := _list(raw, "joint_constraints"):
        for other in ("position_constraints", "orientation_constraints", "visibility_constraints"):
            if _list(raw, other):
                raise MoveitError(f"{where}.{other}: goes without joint_constraints")
        values = {str(own["joint_name"]): float(own["position"]) for own in joints}
        _all_finite(values, where)
        if unknown := sorted(values.keys() - set(robot.joint_names)):
            raise MoveitError(f"{where}: {', '.join(unknown)} is no joint that is planned")
        return _named_joints(values, robot, where)
    positions, turns = _list(raw, "position_constraints"), _list(raw, "orientation_constraints")
    if len(positions) != 1 or len(turns) > 1 or _list(raw, "visibility_constraints"):
        raise MoveitError(f"{where}: must be joints, or one position and at most one orientation")
    own = positions[0]
    _require_tool(own, robot, where)
    if any(_numbers(_entry(own, "target_point_offset", [0, 0, 0]), "xyz")):
        raise MoveitError(f"{where}: target_point_offset: give the tool a frame of its own")
    region = own["constraint_region"]
    if len(_list(region, "primitives")) != 1 or _list(region, "meshes"):
        raise MoveitError(f"{where}: constraint_region: must be one box or sphere")
    centre = _frame_of(own, scene) @ _pose(region["primitive_poses"][0])
    shape = _primitive(region["primitives"][0], "region", Placement.of_matrix(centre), where)
    if isinstance(shape, Sphere):
        widths = [shape.radius_m / math.sqrt(3.0)] * 3
    elif isinstance(shape, Box):
        widths = _along_base(np.multiply(0.5, shape.size_m), centre[:3, :3])
    else:
        raise MoveitError(f"{where}: constraint_region: must be one box or sphere")
    turn, angles = np.eye(3), [math.inf] * 3
    if turns:
        _require_tool(turns[0], robot, where)
        turn, angles = _orientation(turns[0], scene, where)
    free = [AXES[3 + k] for k in range(3) if angles[k] == math.inf]
    tolerance = (*widths, *(0.0 if angle == math.inf else angle for angle in angles))
    return GoalRegion(Pose(centre[:3, 3], turn), free, tolerance)


def _along_base(half: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3 3"]) -> list[float]:
    """Half edges along the base's axes of a box within a turned one: those of the same box where it
    is turned by right angles, else of the largest cube in its ball.
    """
    if _along(turn).all():
        own: list[float] = (np.abs(turn.round()) @ half).tolist()
        return own
    return [float(half.min()) / math.sqrt(3.0)] * 3


def _along(turn: Float[np.ndarray, "3 3"]) -> Bool[np.ndarray, "3"]:
    """Which axes of a rotation are along one of the base's."""
    entries = np.abs(turn)
    found: Bool[np.ndarray, "3"] = np.abs(entries - entries.round()).max(axis=0) < _ALONG
    return found


def _frame_of(raw: Any, scene: PlanningScene) -> Float[np.ndarray, "4 4"]:
    """The pose of a header's frame, which must not move."""
    return _fixed(scene, str(_entry(_entry(raw, "header", {}), "frame_id", "")))


def _orientation(
    raw: Any, scene: PlanningScene, where: str
) -> tuple[Float[np.ndarray, "3 3"], list[float]]:
    """A rotation, and how far it may be off about the base's axes [rad]: inf for an axis that is
    free.

    MoveIt's tolerances are about the axes of the rotation itself, and bound Euler angles x, y, z in
    turn unless `parameterization` is 1.  The least of them as a cone, of a quarter turn at most,
    lies within if none, or x or z alone, is free; rotation vectors lie within if none or two are.
    Others are refused.
    """
    turn = _frame_of(raw, scene)[:3, :3] @ _turn(raw["orientation"])
    given = [float(raw[f"absolute_{axis}_axis_tolerance"]) for axis in "xyz"]
    if not all(value >= 0.0 for value in given):
        raise MoveitError(f"{where}: tolerances of an orientation are {given}: must be 0 or more")
    free = [value >= _FREE_RAD for value in given]
    if all(free):
        return turn, [math.inf] * 3
    vectors = raw.get("parameterization") == _ROTATION_VECTOR
    kept = sum(free) != 1 if vectors else not any(free) or free in _TILTS
    if not kept:
        names = ", ".join(axis for axis, is_free in zip("xyz", free, strict=True) if is_free)
        raise MoveitError(f"{where}: free about {names}: no constraint here lies within that")
    least = min(value for value, is_free in zip(given, free, strict=True) if not is_free)
    if not vectors:
        least = min(least, _WIDEST_RAD)
    bases, aligned = np.abs(turn).argmax(axis=0).tolist(), _along(turn)
    found = [least] * 3
    for axis in range(3):
        if free[axis] and not aligned[axis]:
            raise MoveitError(
                f"{where}: the {'xyz'[axis]} axis is free, and is along no axis of the base: no "
                "constraint here says that"
            )
        if free[axis]:
            found[bases[axis]] = math.inf
        elif vectors and aligned.all():
            found[bases[axis]] = given[axis]
    return turn, found


def _path_constraint(raw: Any, scene: PlanningScene) -> Constraint:
    """Nothing, or the orientation that is held."""
    where = "path_constraints"
    for other in ("joint_constraints", "position_constraints", "visibility_constraints"):
        if _list(raw, other):
            raise MoveitError(f"{where}.{other}: must be one of orientation alone")
    turns = _list(raw, "orientation_constraints")
    if not turns:
        return Constraint((0,) * 6)
    if len(turns) > 1:
        raise MoveitError(f"{where}: {len(turns)} orientations: must be one")
    _require_tool(turns[0], scene.robot, where)
    turn, angles = _orientation(turns[0], scene, where)
    held = tuple(int(angle != math.inf) for angle in angles)
    widths = (0.0, 0.0, 0.0, *(angle if angle != math.inf else 0.0 for angle in angles))
    return Constraint((0, 0, 0, *held), widths, Pose(np.zeros(3), turn))


def _require_tool(raw: Any, robot: SerialRobot, where: str) -> None:
    if (link := str(_entry(raw, "link_name", ""))) not in ("", robot.tool_link):
        raise MoveitError(f"{where}: of link {link!r}: must be of the tool's, {robot.tool_link!r}")
