"""Rerun recordings of executed paths: the robot, the cup and its spheres over the time of the
execution.

The second part of recording.py; recordings of both kinds are read, compared and opened by the same
functions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float
from rerun.chunk import Chunk
from scipy.spatial.transform import Rotation

from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.palette import BLUE, VERMILION, planner_colour
from constraint_geodesics.recording import panels, recording
from constraint_geodesics.recording.colours import CARRIED, colours, rgb
from constraint_geodesics.recording.recording import About, Frames, moving, static
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.studies.cup import CupSettings, Execution, execution_name, inside

_EYE_M = np.array([0.25, -0.25, 0.15])
"""From where the cup is looked at, seen from its centre."""
_CUP, _TILT, _KEPT = (*CARRIED, 60), rgb(VERMILION), rgb(BLUE)


@dataclass(frozen=True)
class ExecutionRecord:
    """One execution and where it comes from; `kind` says what was executed, for example "planned
    path".
    """

    kind: str
    constraint: str
    query: int
    execution: Execution
    cup: CupSettings
    """What it was executed with."""
    kept: Constraint | None = None
    """The constraint itself, to be drawn."""


def record_execution(
    file: Path,
    record: ExecutionRecord,
    robot: SerialRobot,
    workcell: Sequence[Shape],
    *,
    meshes: bool = True,
) -> None:
    """Write the recording of one execution, its blueprint inside.

    meshes: as for `record_path`.
    Raises RecordingError if a mesh that is to be written is missing.
    """
    execution, cup = record.execution, record.cup
    frames = Frames.of(robot, execution.joints, execution.times)
    time = frames.time
    chunks = [
        *recording.scene_chunks(robot, workcell, frames, meshes=meshes),
        *recording.tool_chunks(frames, rgb(planner_colour(record.kind)), record.kept),
        *_cup_chunks(execution, cup, time),
        *_sphere_chunks(execution, cup, time),
        *_series_chunks(execution, cup, time),
        *recording.joint_chunks(robot, frames),
        recording.about_chunk(
            About(record.kind, record.constraint, query=record.query, executed=True)
        ),
        *recording.text_chunks(_status(record)),
    ]
    name = f"{record.constraint}, query {record.query}: {record.kind}, executed"
    own = f"{record.constraint}-{execution_name(record.query, record.kind)}-executed"
    blueprint = _blueprint(frames, execution)
    recording.write_recording(file, f"{own}-{recording.digest(frames)}", name, chunks, blueprint)


def in_cup(execution: Execution, cup: CupSettings) -> Float[np.ndarray, "F"]:
    """How many spheres have their centre in the cup, below its rim, at each frame."""
    frames = zip(execution.sphere_positions, execution.cup_pose, strict=True)
    return np.array([inside(centres, pose, cup).sum() for centres, pose in frames], dtype=float)


def tilt(execution: Execution) -> Float[np.ndarray, "F"]:
    """Angle of the cup's axis to the vertical [rad] at each frame."""
    axis = Rotation.from_quat(execution.cup_pose[:, 3:]).as_matrix()[:, :, 2]
    return np.asarray(np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2]))


def _cup_chunks(execution: Execution, cup: CupSettings, time: rr.TimeColumn) -> Iterator[Chunk]:
    """A cylinder one can look through.  The entity above it only moves, so that a view from there
    does not turn.
    """
    yield moving("cup", rr.Transform3D.columns(translation=execution.cup_pose[:, :3]), time)
    yield moving("cup/wall", rr.Transform3D.columns(quaternion=execution.cup_pose[:, 3:]), time)
    wall = rr.Cylinders3D(
        lengths=[cup.height_m],
        radii=[cup.inner_radius_m + cup.wall_m],
        colors=[_CUP],
        fill_mode="transparentfillmajorwireframe",
    )
    yield static("cup/wall", wall)


def _sphere_chunks(execution: Execution, cup: CupSettings, time: rr.TimeColumn) -> Iterator[Chunk]:
    own = colours(np.arange(execution.spheres))
    yield static("spheres", rr.Points3D.from_fields(colors=own, radii=[cup.sphere_radius_m]))
    columns = rr.Points3D.columns(positions=execution.sphere_positions.reshape(-1, 3))
    yield moving("spheres", columns.partition([execution.spheres] * len(execution.times)), time)


def _series_chunks(execution: Execution, cup: CupSettings, time: rr.TimeColumn) -> Iterator[Chunk]:
    for entity, name, colour, values in (
        ("cup_tilt", "tilt [deg]", _TILT, np.degrees(tilt(execution))),
        ("cup_spheres", "spheres", _KEPT, in_cup(execution, cup)),
    ):
        yield static(entity, rr.SeriesLines(names=[name], colors=[colour], widths=[2.0]))
        yield recording.scalars(entity, values, time)


def _status(record: ExecutionRecord) -> str:
    execution = record.execution
    error = np.degrees(execution.largest_tracking_error_rad)
    return (
        f"**{record.kind}**, constraint `{record.constraint}`, query {record.query}, "
        f"executed in simulation\n\n"
        f"- {execution.kept} of {execution.spheres} spheres stayed in the cup\n"
        f"- largest tilt of the cup {np.degrees(execution.largest_tilt_rad):.2f}°\n"
        f"- duration {execution.duration_s:.2f} s, largest tracking error {error:.4f}°"
    )


def _blueprint(frames: Frames, execution: Execution) -> Any:
    # it follows the cup but does not turn with it; the arm is left out, it would often hide the cup
    follow = rrb.SpatialInformation(target_frame="tf#/cup")
    shown = ("workcell", "cup", "spheres")
    cup = panels.space_view("Cup", shown, _EYE_M, np.zeros(3), spatial_information=follow)
    tilted, left = panels.cup_panels(execution.spheres, float(np.degrees(tilt(execution)).max()))
    more = rrb.Tabs(left, panels.range_panel(), active_tab=0)
    rows = [(cup, 1.6), (panels.status_panel(), 0.8), (tilted, 1.0), (more, 1.0)]
    scene = recording.scene_panel(frames, "cup", "spheres")
    return panels.arranged(scene, rows, recording.path_time(frames))
