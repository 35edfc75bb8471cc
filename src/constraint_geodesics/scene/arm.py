"""The arm that parameters make of somebody's URDF: what is held, its tool's own frame, and the
links that may touch.

All readers of a robot take it from one file: the URDF of that arm alone, written into the user's
cache under a name that tells its content.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path

from constraint_geodesics.params import RobotParams
from constraint_geodesics.robot.arm_file import digest_of, write_arm, write_file
from constraint_geodesics.robot.description import Arm, arm_to, read_description
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot, rotation_from_rpy
from constraint_geodesics.scene.allowed_collisions import (
    SAMPLES,
    AllowedPair,
    allowed_by_sampling,
    allowed_by_srdf,
)
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.urdf import find_urdf

ADJACENT, FOUND = "adjacent", "found"
"""What `RobotParams.may_touch` says where it names no SRDF."""


@dataclass(frozen=True)
class LoadedArm:
    """What was understood of a URDF, the robot that it became, and pairs of its links that may
    touch.
    """

    arm: Arm
    robot: SerialRobot
    allowed: tuple[AllowedPair, ...]


def load_arm(params: RobotParams) -> LoadedArm:
    """Raises RobotError, one line with the mend, where no arm can be made of it."""
    arm = arm_to(read_description(find_urdf(params.urdf)), params.tool_link, params.hold)
    tool, folder = None, arms_folder()
    if params.tool is not None:
        tool = np.eye(4)
        tool[:3, :3] = rotation_from_rpy(np.array(params.tool.rpy_rad))
        tool[:3, 3] = params.tool.position_m
    file, link = write_arm(arm, folder, tool, _readable)
    robot = load_robot(file, link, params.limits_rad)
    allowed = _allowed(params.may_touch, arm, robot)
    pairs = frozenset((first, second) for first, second, _ in allowed)
    continuous = frozenset(joint.name for joint in arm.moved if joint.kind == "continuous")
    return LoadedArm(arm, replace(robot, allowed=pairs, continuous=continuous), allowed)


@cache
def arms_folder() -> Path:
    """Where arms' files are kept: the user's cache, or where that can't be written a folder of this
    process's.
    """
    folder = user_cache_path("constraint_geodesics") / "arms"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="arms-"))


def _allowed(may_touch: str, arm: Arm, robot: SerialRobot) -> tuple[AllowedPair, ...]:
    if may_touch == ADJACENT:
        return ()
    if may_touch != FOUND:
        return allowed_by_srdf(Path(may_touch), arm.description)
    limits = digest_of(np.stack([robot.lower, robot.upper]).tobytes())
    known = robot.urdf.with_name(f"{robot.urdf.stem}-{limits}-{SAMPLES}.json")
    if known.is_file():
        return tuple(AllowedPair(*pair) for pair in json.loads(known.read_text()))
    found = allowed_by_sampling(robot)
    write_file(known, json.dumps(found))
    return found


def _readable(mesh: Path) -> Path:
    """A mesh as OBJ or STL, which all readers take alike."""
    if mesh.suffix.lower() != ".dae":
        return mesh
    written = arms_folder() / f"{mesh.stem}-{digest_of(mesh.read_bytes())}.obj"
    if not written.is_file():
        write_file(written, as_obj(mesh))
    return written
