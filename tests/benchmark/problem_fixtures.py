"""A small file of problems, written as MotionBenchMaker's are converted."""

import gzip
import json
from pathlib import Path
from typing import Any

READY = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
TURNED = [0.9, -0.5, 0.1, -2.1, 0.2, 1.7, 0.6]
JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
LYING = [0.0, 0.7071067811865476, 0.0, 0.7071067811865476]
"""A quarter of a turn about y: z becomes x."""
OPEN_M = 0.065
"""What the fingers are held at: beyond the limits of pybullet_data's Panda."""


def shape(
    name: str, kind: str, dimensions: list[float], position: list[float], turn: list[float]
) -> dict[str, Any]:
    return {
        "name": name,
        "type": kind,
        "dimensions": dimensions,
        "position": position,
        "orientation_xyzw": turn,
    }


def problem(*shapes: dict[str, Any], start=READY, goal=TURNED, open_m=OPEN_M) -> dict[str, Any]:
    held = {"panda_finger_joint1": open_m, "panda_finger_joint2": open_m}
    return {"start": start, "goal": goal, "held": held, "shapes": list(shapes)}


def post(x: float, y: float) -> dict[str, Any]:
    return shape("post", "cylinder", [0.8, 0.03], [x, y, 0.4], UPRIGHT)


def small_file() -> dict[str, Any]:
    """Two scenes, of two problems and one."""
    crate = shape("crate", "box", [0.2, 0.3, 0.4], [0.7, 0.5, 0.2], UPRIGHT)
    scenes = {
        "posts": [problem(post(0.5, 0.25)), problem(post(-0.5, -0.3), start=TURNED, goal=READY)],
        "crate": [problem(crate)],
    }
    return {"robot": "panda", "joints": JOINTS, "scenes": scenes}


def written(content: Any, file: Path) -> Path:
    """As JSON, gzipped where the name says so."""
    raw = json.dumps(content).encode()
    file.write_bytes(gzip.compress(raw) if file.suffix == ".gz" else raw)
    return file


MOVEIT_SCENE = """
robot_model_name: panda
robot_state:
  joint_state:
    name: [panda_finger_joint1, panda_finger_joint2]
    position: [0.065, 0.065]
world:
  collision_objects:
    - id: crate
      primitives: [{type: box, dimensions: [0.2, 0.3, 0.4]}]
      primitive_poses: [{position: [0.7, 0.5, 0.2], orientation: [0, 0, 0, 1]}]
"""
MOVEIT_REQUEST = """
start_state:
  joint_state: {{name: {joints}, position: {start}}}
goal_constraints:
  - joint_constraints:
{goals}
"""


def moveit_pair(folder: Path, number: str, more: str = "") -> None:
    """A planning scene and its request, named with that number; more: of the request."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"scene{number}.yaml").write_text(MOVEIT_SCENE)
    goals = "\n".join(
        f"      - {{joint_name: {name}, position: {value}}}"
        for name, value in zip(JOINTS, TURNED, strict=True)
    )
    text = MOVEIT_REQUEST.format(joints=JOINTS, start=READY, goals=goals)
    (folder / f"request{number}.yaml").write_text(text + more)
