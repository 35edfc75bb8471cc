"""The arm that parameters make of somebody's URDF: what is held, its tool's own frame, and the
links that may touch.

All readers of a robot take it from one file: the URDF of that arm alone, written into the user's
cache under a name that tells its content.
"""

import atexit
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path

from constraint_geodesics.params import RobotParams
from constraint_geodesics.progress import waiting
from constraint_geodesics.robot.arm_file import content_digest, write_arm
from constraint_geodesics.robot.description import Arm, arm_to, find_mesh, read_description
from constraint_geodesics.robot.kinematics import (
    RobotError,
    SerialRobot,
    load_robot,
    rotation_from_rpy,
    urdf_root,
)
from constraint_geodesics.scene import allowed_collisions
from constraint_geodesics.scene.allowed_collisions import (
    AllowedPair,
    OftenTouching,
    Sampled,
    allowed_by_sampling,
    allowed_by_srdf,
)
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.pieces import is_binary_stl, read_pieces, stl_as_obj
from constraint_geodesics.scene.urdf import find_urdf, has_pybullet
from constraint_geodesics.text_files import kept_json, write_text

ADJACENT, FOUND = "adjacent", "found"
"""What `RobotParams.may_touch` says where it names no SRDF."""
_AS_OBJ: Mapping[str, Callable[[Path], str]] = {".dae": as_obj, ".stl": stl_as_obj}
_FORMAT = "4"
"""Of the files in the cache; another one where they are made in another way."""


@dataclass(frozen=True)
class LoadedArm:
    """What was understood of a URDF, the robot that it became, pairs of its links that may touch,
    and what sampling showed of the others, where that found them.
    """

    arm: Arm
    robot: SerialRobot
    allowed: tuple[AllowedPair, ...]
    sampled: Sampled | None


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
    try:
        read_pieces(file)  # before PyBullet, which has no word for some faults of meshes
        allowed, sampled = _allowed(params.may_touch, arm, robot)
    except RobotError as error:  # the user knows the file that the arm was made of
        raise RobotError(str(error).replace(str(file), str(arm.description.file))) from None
    pairs = frozenset((first, second) for first, second, _ in allowed)
    continuous = frozenset(joint.name for joint in arm.moved if joint.kind == "continuous")
    return LoadedArm(arm, replace(robot, allowed=pairs, continuous=continuous), allowed, sampled)


@cache
def arms_folder() -> Path:
    """Where arms' files are kept: the user's cache, or where that can't be written a folder of this
    process's.
    """
    folder = user_cache_path("constraint_geodesics") / "arms" / _FORMAT
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        own = Path(tempfile.mkdtemp(prefix="arms-"))
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        return own


def _allowed(
    may_touch: str, arm: Arm, robot: SerialRobot
) -> tuple[tuple[AllowedPair, ...], Sampled | None]:
    if may_touch == ADJACENT:
        return (), None
    if may_touch != FOUND:
        return allowed_by_srdf(Path(may_touch), arm.description), None
    kept = robot.urdf.with_name(f"{robot.urdf.stem}-{_sampled_digest(robot)}.json")
    before = kept_json(kept)
    if before is not None:
        pairs, often, free = before
        found = tuple(AllowedPair(*pair) for pair in pairs)
        return found, Sampled(tuple(OftenTouching(*own) for own in often), free)
    if not has_pybullet():
        raise RobotError(
            f"{robot.urdf}: the links that may touch are found with PyBullet, which is not "
            "installed: name an SRDF (--srdf), or use Python 3.11"
        )
    with waiting(f"looking which links of {arm.description.name} touch, once for this arm"):
        found, sampled = allowed_by_sampling(robot)
    write_text(kept, json.dumps([found, *sampled]))
    return found, sampled


def _sampled_digest(robot: SerialRobot) -> str:
    """Of all that sampling depends on, beside the URDF."""
    own = allowed_collisions
    settings = (own.SAMPLES, own.ALWAYS, own.NEAR_M, own.OFTEN)
    parts = [np.stack([robot.lower, robot.upper]).tobytes().hex(), repr(settings)]
    return content_digest(" ".join([*parts, *mesh_digests(robot)]).encode())


def mesh_digests(robot: SerialRobot) -> list[str]:
    """Of the meshes that are collided, each once, in the URDF's order."""
    meshes = urdf_root(robot.urdf).iterfind("link/collision/geometry/mesh")
    names = dict.fromkeys(mesh.get("filename", "") for mesh in meshes)
    files = (find_mesh(name, robot.urdf) for name in names)
    return [content_digest(file.read_bytes()) for file in files if file is not None]


def _readable(mesh: Path) -> Path:
    """A mesh as OBJ or binary STL, which all readers take alike."""
    kind = mesh.suffix.lower()
    if kind not in _AS_OBJ or (kind == ".stl" and is_binary_stl(mesh)):
        return mesh
    written = arms_folder() / f"{mesh.stem}-{content_digest(mesh.read_bytes())}.obj"
    if not written.is_file():
        write_text(written, _AS_OBJ[kind](mesh))
    return written
