"""The Rerun recording of demonstrations and of what they keep to: the arm along one of them, all of
them, and configurations that keep the identified constraint beside them.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float
from rerun.chunk import Chunk
from scipy.spatial import KDTree

from constraint_geodesics import palette
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.identification.identify import Identified
from constraint_geodesics.recording import recording
from constraint_geodesics.recording.recording import About, Frames, static
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Shape

FRAMES = 240
"""Of the demonstration that the arm moves along, at most."""
BESIDE_RAD, NEAR_M, POINTS = 0.15, 0.05, 3000
"""How far from the rows configurations of the identified set are drawn, how near a demonstrated
place they end, and how many.
"""
_SHOWN, _SET = recording.rgb(palette.GREY), recording.rgb(palette.BLUE)
_POINT, _LINE = rr.Radius.ui_points(2.0), rr.Radius.ui_points(1.5)


def record_demonstrations(
    file: Path,
    shown: Sequence[Float[np.ndarray, "T D"]],
    found: Identified,
    robot: SerialRobot,
    workcell: Sequence[Shape],
) -> None:
    """Write the recording, its blueprint inside.

    shown: demonstrations [rad].  Raises RecordingError if a mesh is missing.
    """
    longest = max(shown, key=len)
    joints = longest[np.unique(np.linspace(0, len(longest) - 1, FRAMES).astype(int))]
    time = rr.TimeColumn(recording.TIMELINE, sequence=range(len(joints)))
    frames = Frames(joints, robot.forward(joints)[0], None, time)
    chunks = [
        *recording.scene_chunks(robot, workcell, frames, meshes=True),
        *recording.tool_chunks(frames, _SHOWN),
        *_drawn(shown, found, robot),
        *recording.joint_chunks(robot, frames),
        recording.about_chunk(About("demonstrations")),
        *recording.text_chunks(_status(found)),
    ]
    blueprint = recording.arranged(
        recording.scene_panel(frames, "demonstrations", "identified"),
        recording.joint_panel(),
        recording.time_panel(timeline=recording.TIMELINE, fps=30.0),
    )
    name = f"demonstrations-{recording.digest(frames)}"
    recording.write_recording(file, name, "demonstrations", chunks, blueprint)


def _drawn(
    shown: Sequence[Float[np.ndarray, "T D"]], found: Identified, robot: SerialRobot
) -> Iterator[Chunk]:
    tips = [robot.forward(rows)[0] for rows in shown]
    many: Any = (
        rr.LineStrips3D(tips, colors=[_SHOWN], radii=[_LINE])
        if len(tips) > 1
        else rr.Points3D(tips[0], colors=[_SHOWN], radii=[_POINT])
    )
    yield static("demonstrations", many)
    if found.constraint is None:
        return
    rng, rows = np.random.default_rng(0), np.concatenate(shown)
    near = rows[rng.integers(len(rows), size=POINTS)]
    near = near + BESIDE_RAD * rng.normal(size=near.shape)
    kept = retract(ConstraintManifold(robot, found.supported or found.constraint), near)
    places = robot.forward(kept.joints[kept.converged])[0]
    away = np.asarray(KDTree(np.concatenate(tips)).query(places)[0])
    yield static("identified", rr.Points3D(places[away < NEAR_M], colors=[_SET], radii=[_POINT]))


def _status(found: Identified) -> str:
    lines = [f"- {words}" for words in found.relations] or [f"- {found.explanation}"]
    lines += [f"- {found.missing}"] if found.missing and found.relations else []
    lines += [f"- {found.support.words}"] if found.support is not None else []
    about = (
        f"{found.rows} rows of {found.demonstrations} demonstrations, {found.dropped} wrong rows "
        f"left out. Blue: where the tip may be beside them."
    )
    return "**What the demonstrations keep to**\n\n" + "\n".join(lines) + f"\n\n{about}"
