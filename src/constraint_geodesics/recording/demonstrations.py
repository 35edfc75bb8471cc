"""The Rerun recording of demonstrations and of what they keep to: the arm along one of them, all of
them, and configurations that keep the identified constraint beside them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold, Series
from constraint_geodesics.identification.identify import Identified
from constraint_geodesics.recording import panels, recording
from constraint_geodesics.recording.colours import OTHER
from constraint_geodesics.recording.recording import About, Frames, static
from constraint_geodesics.recording.shown import ENTITIES, shown_drawings
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Shape

FRAMES = 240
"""Of the demonstration that the arm moves along, at most."""


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
    frames = Frames.of(robot, joints, recording.paced(robot, joints))
    series: list[Series] = []
    if found.constraint is not None:
        kept = ConstraintManifold(robot, found.constraint)
        series = recording.constraint_series(kept, joints)
    chunks = [
        *recording.scene_chunks(robot, workcell, frames, meshes=True),
        *recording.tool_chunks(frames, OTHER, found.constraint),
        *(static(*own) for own in shown_drawings(robot, shown, found.supported)),
        *recording.series_chunks(series, frames),
        *recording.joint_chunks(robot, frames),
        recording.about_chunk(About("demonstrations")),
        *recording.text_chunks(_status(found)),
    ]
    rows = [(panels.status_panel(), 1.2)]
    rows += [(panel, 1.0) for panel in recording.constraint_panel(series, [])]
    rows.append((panels.joint_panel(), 1.2))
    blueprint = panels.arranged(
        recording.scene_panel(frames, *ENTITIES), rows, recording.path_time(frames)
    )
    name = f"demonstrations-{recording.digest(frames)}"
    recording.write_recording(file, name, "demonstrations", chunks, blueprint)


def _status(found: Identified) -> str:
    lines = [f"- {words}" for words in found.relations] or [f"- {found.explanation}"]
    lines += [f"- {found.missing}"] if found.missing and found.relations else []
    lines += [f"- {found.support.words}"] if found.support is not None else []
    about = (
        f"{found.rows} rows of {found.demonstrations} demonstrations, {found.dropped} wrong rows "
        f"left out. Blue: where the tip may be beside them."
    )
    return "**What the demonstrations keep to**\n\n" + "\n".join(lines) + f"\n\n{about}"
