"""Planning problems as others write them, to hold planners against each other on:
MotionBenchMaker's as one file of JSON, and MoveIt's planning scenes with their motion requests.

MotionBenchMaker [Chamzas et al. 2022] gives MoveIt's messages; one file of JSON holds the same:

{"robot": "panda", "joints": ["panda_joint1", …],
 "scenes": {"box": [{"start": [rad], "goal": [rad], "held": {"panda_finger_joint1": 0.04},
   "shapes": [{"name": "lid", "type": "box", "dimensions": [x, y, z], "position": [x, y, z],
               "orientation_xyzw": [x, y, z, w]}]}]}}

Dimensions are MoveIt's: a box's edge lengths, a cylinder's length along z and its radius, a
sphere's radius [m]; poses are in the base frame.  In place of "robot" stand "urdf" and "tool_link".
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from constraint_geodesics.benchmark.arm_source import ArmSource, UrdfArm, opened
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.fields import Finite
from constraint_geodesics.moveit import (
    MoveitError,
    add_moveit_scene,
    joints_named,
    read_moveit_request,
    robot_named,
    shape_of_record,
)
from constraint_geodesics.params import one_line
from constraint_geodesics.robot.arm_file import content_digest
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene.arm import mesh_digests
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.names import require_names
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene, SceneError
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.text_files import parse_json, read_content, unpacked

NOTHING_HELD = Constraint((0,) * 6)
FREE = "free"
"""Name of the constraint that holds nothing."""
OF_REQUEST = "held orientation"
"""Name of what MoveIt's requests hold."""
ROBOTS = {"panda": ("franka_panda/panda.urdf", "panda_hand")}
"""URDF in pybullet_data and tool link, by the names that files have for robots."""
_YAML = (".yaml", ".yml")


class ProblemFileError(ValueError):
    """A file of problems can't be used; the message is one line with the file and the entry."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Two ends [rad] of an arm in a scene of its own, and what is held on the way.

    group: the scene's kind, which results are told apart by; number: which of its problems it is.
    """

    group: str
    number: int
    arm: ArmSource
    scene: Scene
    start: Float[np.ndarray, "D"]
    goal: Float[np.ndarray, "D"]
    constraint: Constraint = NOTHING_HELD
    constraint_name: str = FREE


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _ShapeRecord(_Record):
    name: Annotated[str, Field(min_length=1)]
    type: str
    dimensions: Annotated[list[Finite], Field(min_length=1)]
    position: Annotated[list[Finite], Field(min_length=3, max_length=3)]
    orientation_xyzw: Annotated[list[Finite], Field(min_length=4, max_length=4)]


class _ProblemRecord(_Record):
    start: list[Finite]
    goal: list[Finite]
    held: dict[str, Finite] = {}
    shapes: list[_ShapeRecord]


class _FileRecord(_Record):
    robot: str | None = None
    urdf: str | None = None
    tool_link: str | None = None
    joints: Annotated[list[str], Field(min_length=1)]
    scenes: Annotated[dict[str, list[_ProblemRecord]], Field(min_length=1)]


def read_problems(file: Path, given: UrdfArm | None = None) -> list[Problem]:
    """The problems of a file of JSON, gzipped or not; of a planning scene of MoveIt, whose request
    lies beside it; or of all of those in a folder and its folders, each of which is a group, named
    by its path in the folder.

    given: the arm, where the file is not to say it; values of its own of held joints come before
    the file's.  Raises ProblemFileError, one line, for what can't be used.
    """
    if file.is_dir() or file.suffix.lower() in _YAML:
        return _moveit_problems(file, given)
    return list(_record_problems(file, _read(file), given))


def every(problems: Sequence[Problem], step: int) -> list[Problem]:
    """Each step-th problem of each group, the first one on."""
    found = []
    for _, own in groupby(problems, key=lambda problem: problem.group):
        found += list(own)[::step]
    return found


def require_different(problems: Sequence[Problem]) -> None:
    """That no two of them have one group, number and constraint, which results are told apart by.

    Raises ProblemFileError.
    """
    seen = set()
    for own in problems:
        key = own.group, own.number, own.constraint_name
        if key in seen:
            line = f"two problems are number {own.number} of {own.group!r}: give one another name"
            raise ProblemFileError(line)
        seen.add(key)


def _read(file: Path) -> _FileRecord:
    try:
        return _FileRecord.model_validate(parse_json(unpacked(read_content(file), file)))
    except OSError as error:
        raise ProblemFileError(f"{file}: {error.strerror}") from None
    except ValidationError as error:
        raise ProblemFileError(f"{file}: {one_line(error)}") from None
    except ValueError as error:
        what = " ".join(str(error).split())
        raise ProblemFileError(f"{file}: neither JSON nor MoveIt's YAML: {what}") from None


def _record_problems(file: Path, record: _FileRecord, given: UrdfArm | None) -> Iterator[Problem]:
    try:
        arm = given or _arm_named(record)
        for group, problems in record.scenes.items():
            if not problems:
                raise ProblemFileError(f"scenes.{group}: has no problems")
            for number, own in enumerate(problems):
                where = f"scenes.{group}[{number}]"
                held = {**own.held, **dict(arm.held)}
                with_held = replace(arm, held=tuple(sorted(held.items())))
                robot, order = _robot(with_held, tuple(record.joints))
                start, goal = (
                    _configuration(getattr(own, end), order, f"{where}.{end}")
                    for end in ("start", "goal")
                )
                scene = _scene(with_held, robot, own.shapes, where)
                yield Problem(group, number, with_held, scene, start, goal)
    except ProblemFileError as error:
        raise ProblemFileError(f"{file}: {error}") from None
    except (MoveitError, RobotError) as error:
        raise ProblemFileError(f"{file}: {error}") from None


def _scene(arm: UrdfArm, robot: SerialRobot, records: Sequence[_ShapeRecord], where: str) -> Scene:
    """The shapes around the arm.  where: the problem, for errors."""
    scene, links = Scene(robot), opened(arm).scene.links
    for k, record in enumerate(records):
        place = f"{where}.shapes[{k}]"
        shape = shape_of_record(record.model_dump(), place)
        try:
            scene = scene.adding(shape)
            require_names(links, (shape,), (), ())
        except SceneError as error:
            raise ProblemFileError(f"{place}: {error}") from None
    return scene


def _arm_named(record: _FileRecord) -> UrdfArm:
    if record.urdf is not None and record.tool_link is not None:
        return UrdfArm(record.urdf, record.tool_link)
    if record.urdf is not None or record.tool_link is not None:
        missing = "tool_link" if record.tool_link is None else "urdf"
        raise ProblemFileError(f"{missing} is missing: urdf and tool_link go together")
    return arm_of(record.robot, "robot")


def arm_of(robot: str | None, where: str) -> UrdfArm:
    """The arm that a file means by a robot's name."""
    if robot not in ROBOTS:
        known = ", ".join(ROBOTS)
        raise ProblemFileError(
            f"{where}={robot!r}: known are {known}: say which with --urdf and --tool-link"
        )
    return UrdfArm(*ROBOTS[robot])


def _robot(arm: UrdfArm, joints: tuple[str, ...]) -> tuple[SerialRobot, list[int]]:
    """The arm's robot, and where its joints stand among these names."""
    names = arm.joint_names
    if set(names) != set(joints) or len(joints) != len(names):
        raise ProblemFileError(
            f"joints={list(joints)}: those of {arm.urdf} to {arm.tool_link} are {', '.join(names)}"
        )
    return opened(arm).robot, [joints.index(name) for name in names]


def _configuration(
    values: Sequence[float], order: Sequence[int], where: str
) -> Float[np.ndarray, "D"]:
    if len(values) != len(order):
        raise ProblemFileError(f"{where}: {len(values)} numbers for {len(order)} joints")
    return np.array(values, float)[list(order)]


def _moveit_problems(path: Path, given: UrdfArm | None) -> list[Problem]:
    found = []
    for folder, grouped in groupby(_pairs(path), key=lambda pair: pair[0].parent):
        own = list(grouped)
        # below the given folder its path tells it from others of the same name
        below = path.is_dir() and folder != path
        group = folder.relative_to(path).as_posix() if below else folder.resolve().name
        numbers = _numbers([scene.stem for scene, _ in own])
        for (scene, request), number in zip(own, numbers, strict=True):
            found.append(_moveit_problem(scene, request, given, group, number))
    try:
        require_different(found)
    except ProblemFileError as error:
        raise ProblemFileError(f"{path}: {error}") from None
    return found


def _numbers(names: Sequence[str]) -> Sequence[int]:
    """The last number in each name; their places where these are not all there and different."""
    digits = [re.findall(r"\d+", name)[-1:] for name in names]
    numbers = [int(number) for own in digits for number in own]
    return numbers if len(set(numbers)) == len(names) else range(len(names))


def _pairs(path: Path) -> list[tuple[Path, Path]]:
    """Planning scenes with their requests, folder by folder, by their names."""
    found = []
    files = [path]
    if path.is_dir():
        files = sorted(path.rglob("*"), key=lambda file: (file.parent, file.name))
    for scene in files:
        if scene.suffix.lower() not in _YAML or "scene" not in scene.stem:
            continue
        request = scene.with_name(scene.name.replace("scene", "request"))
        if not request.is_file():
            raise ProblemFileError(f"{scene}: has no request beside it: {request.name}")
        found.append((scene, request))
    if not found:
        what = "must be scene….yaml with request….yaml beside it"
        raise ProblemFileError(f"{path}: has no planning scenes of MoveIt: {what}")
    return found


def _moveit_problem(
    scene_file: Path, request_file: Path, given: UrdfArm | None, group: str, number: int
) -> Problem:
    try:
        joints = joints_named(scene_file, request_file)
        arm = given or arm_of(robot_named(scene_file), f"{scene_file}: robot_model_name")
        held = {name: joints[name] for name in arm.others if name in joints}
        arm = replace(arm, held=tuple(sorted({**held, **dict(arm.held)}.items())))
        planner = opened(arm)
        empty = Scene(planner.robot)
        planner.scene.become(empty)  # whatever was asked before
        try:
            state = add_moveit_scene(scene_file, planner.scene)
            request = read_moveit_request(request_file, planner, state)
            scene = planner.scene.now
        finally:
            planner.scene.become(empty)
    except SceneError as error:
        raise ProblemFileError(f"{scene_file}: {error}") from None
    except (MoveitError, RobotError) as error:
        raise ProblemFileError(str(error)) from None
    goal = request.goals[0]
    if len(request.goals) > 1 or not isinstance(goal, list):
        what = "goal_constraints: must be one set of joint values, which all planners go to"
        raise ProblemFileError(f"{request_file}: {what}")
    name = FREE if request.constraint.is_free else OF_REQUEST
    ends = np.array(request.start, float), np.array(goal, float)
    return Problem(group, number, arm, scene, *ends, request.constraint, name)


def _content(shape: Shape) -> bytes:
    """What is no part of a shape's text."""
    if isinstance(shape, PointCloud):
        return shape.points_m.array.tobytes()
    return Path(shape.file).read_bytes() if isinstance(shape, Mesh) else b""


def told(problem: Problem) -> Mapping[str, Any]:
    """All that an answer to a problem depends on, but the arm's files (`told_of_arm`), for a
    fingerprint.
    """
    scene = problem.scene
    return {
        "arm": repr(problem.arm),
        "shapes": [repr(shape) for shape in scene.workcell],
        "contents": [_content(shape) for shape in scene.workcell],
        "attached": [repr(one) for one in scene.attached],
        "allowed": sorted(map(list, scene.allowed)),
        "ends": [problem.start.tolist(), problem.goal.tolist()],
        "constraint": repr(problem.constraint),
    }


def told_of_arm(robot: SerialRobot) -> Mapping[str, Any]:
    """What answers depend on in the arm's files: its URDF, the meshes that are collided, and the
    links that may touch, whoever says so.
    """
    return {
        "urdf": content_digest(robot.urdf.read_bytes()),
        "meshes": mesh_digests(robot),
        "allowed": sorted(map(list, robot.allowed)),
    }
