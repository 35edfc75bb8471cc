"""Rerun recordings of episodes among unknown obstacles, in seconds: an obstacle is a shadow until
it is seen, the path that is followed changes with every answer, and the old ones stay in grey.

`record_episode` writes a file; `LiveEpisode` draws the same in a viewer while it happens.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from jaxtyping import Float
from rerun.chunk import Chunk
from rerun.urdf import UrdfTree

from constraint_geodesics.certification.certifier import Limits
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Series
from constraint_geodesics.palette import BLUE, VERMILION
from constraint_geodesics.recording import panels, recording
from constraint_geodesics.recording.colours import INK, OTHER, Colour, rgb
from constraint_geodesics.recording.recording import TIME, About, Frames, static
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape

RATE_HZ = 50.0
"""Of the frames."""
LINE_POINTS = 60
"""Of the tool's line on a path."""
_SHADOW, _SEEN = (*OTHER, 40), rgb(VERMILION)
_NOW, _OLD = rgb(BLUE), OTHER
_WIDTH = rr.Radius.ui_points(2.0)


class Stretch(NamedTuple):
    """A motion that is followed from a time [s] on: its own times (T,) [s] and waypoints (T, D)
    [rad].
    """

    begins_s: float
    times: Float[np.ndarray, "T"]
    joints: Float[np.ndarray, "T D"]


@dataclass(frozen=True)
class EpisodeRecord:
    """An episode with one controller.  scene: what was known at first.  seen_s: when an obstacle
    was seen, by its name; those that never were are missing.  over_s: when it ended; text: how, in
    markdown.  kept: the constraint itself, to be drawn.
    """

    controller: str
    constraint: str
    number: int
    scene: Scene
    obstacles: Sequence[Shape]
    seen_s: dict[str, float]
    stretches: Sequence[Stretch]
    over_s: float
    text: str
    kept: Constraint | None = None

    def joints(self, at_s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n D"]:
        """Configurations [rad] at times [s]."""
        begins = np.array([one.begins_s for one in self.stretches])
        # a recording keeps a time to the microsecond: where a stretch begins it is that stretch's
        owner = np.maximum(np.searchsorted(begins, at_s + 1e-6, side="right") - 1, 0)
        rows = []
        for moment, k in zip(at_s, owner, strict=True):
            begin, times, joints = self.stretches[k]
            rows.append([np.interp(moment - begin, times, column) for column in joints.T])
        return np.array(rows)


def record_episode(file: Path, record: EpisodeRecord, *, meshes: bool = True) -> None:
    """Write the recording of an episode, its blueprint inside.

    meshes: as for `record_path`.
    Raises RecordingError if a mesh that is to be written is missing.
    """
    robot, scene = record.scene.robot, record.scene
    at_s = np.append(np.arange(0.0, record.over_s, 1.0 / RATE_HZ), record.over_s)
    joints = record.joints(at_s)
    frames = Frames.of(robot, joints, at_s)
    shares = _shares(_manifold(scene, record.kept), joints)
    chunks = [
        *recording.scene_chunks(
            robot, scene.workcell, frames, meshes=meshes, attached=scene.attached
        ),
        *recording.tool_chunks(frames, INK, record.kept),
        *(static(_shadow(shape), _drawn(shape, _SHADOW)) for shape in record.obstacles),
        *_obstacle_chunks(record),
        *_path_chunks(record),
        *recording.share_chunks(shares, frames),
        *recording.joint_chunks(robot, frames),
        recording.about_chunk(
            About(record.controller, record.constraint, query=record.number, executed=True)
        ),
        *recording.text_chunks(record.text),
    ]
    name = f"{record.constraint}, episode {record.number}: {record.controller}"
    own = f"{record.constraint}-episode{record.number}-{recording.digest(frames)}"
    recording.write_recording(file, own, name, chunks, _blueprint(frames, shares))


def _obstacle_chunks(record: EpisodeRecord) -> Iterator[Chunk]:
    for shape in record.obstacles:
        if shape.name in record.seen_s:
            yield _at(_solid(shape), _drawn(shape, _SEEN), record.seen_s[shape.name])


def _path_chunks(record: EpisodeRecord) -> Iterator[Chunk]:
    """The tool's line on the path that is followed, and from the next answer on on the old one."""
    for k, stretch in enumerate(record.stretches):
        line = _line(record.scene, stretch)
        yield _at("tool/plan", _strip(line, _NOW), stretch.begins_s)
        if k + 1 < len(record.stretches):
            yield _at(f"tool/ways/{k}", _strip(line, _OLD), record.stretches[k + 1].begins_s)


def _at(entity: str, archetype: Any, at_s: float) -> Chunk:
    """What an entity has from a time [s] on."""
    batches = archetype.as_component_batches()
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [rr.TimeColumn(TIME, duration=[at_s])], columns)


def _line(scene: Scene, stretch: Stretch) -> Float[np.ndarray, "n 3"]:
    at_s = np.linspace(0.0, stretch.times[-1], LINE_POINTS)
    columns = [np.interp(at_s, stretch.times, column) for column in stretch.joints.T]
    return np.asarray(scene.robot.forward(np.stack(columns, axis=1))[0])


def _strip(line: Float[np.ndarray, "n 3"], colour: Colour) -> Any:
    return rr.LineStrips3D([line], colors=[colour], radii=[_WIDTH])


def _drawn(shape: Shape, colour: tuple[int, ...]) -> Any:
    fill = "solid" if len(colour) == 3 else "transparentfillmajorwireframe"
    style = {"colors": [colour], "fill_mode": fill, "labels": [shape.name], "show_labels": False}
    return shape.drawn(rr, style)


def _shadow(shape: Shape) -> str:
    return str(rr.new_entity_path(["hidden", shape.name]))


def _solid(shape: Shape) -> str:
    return str(rr.new_entity_path(["workcell", shape.name]))


def _manifold(scene: Scene, kept: Constraint | None) -> ConstraintManifold | None:
    return None if kept is None else ConstraintManifold(scene.robot, kept)


def _shares(manifold: ConstraintManifold | None, joints: Float[np.ndarray, "n D"]) -> list[Series]:
    """Of the constraint's limits, where there is a constraint."""
    if manifold is None:
        return []
    return recording.share_series(manifold, joints, Limits.violation_tolerance)


def _blueprint(frames: Frames, shares: Sequence[Series]) -> Any:
    rows = [(panels.status_panel(), 1.0)]
    rows += [(panel, 1.0) for panel in recording.constraint_panel([], shares)]
    rows.append((panels.joint_panel(), 1.2))
    # an episode is watched as fast as it happened
    time = panels.time_panel(TIME, max(frames.duration_s, panels.SHORT_S))
    return panels.arranged(recording.scene_panel(frames, "hidden"), rows, time)


class LiveEpisode:
    """Draws an episode into a stream while it happens; its scene and obstacles at once."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        scene: Scene,
        obstacles: Sequence[Shape],
        first: Stretch,
        kept: Constraint | None = None,
    ) -> None:
        self._stream, self._scene, self._followed, self._old = stream, scene, first, 0
        robot, self._manifold = scene.robot, _manifold(scene, kept)
        tree = UrdfTree.from_file_path(robot.urdf)
        self._joints = [joint for joint in tree.joints() if joint.name in robot.joint_names]
        planned = Frames.of(robot, first.joints, first.times)
        stream.send_blueprint(_blueprint(planned, _shares(self._manifold, first.joints)))
        begin = Frames.of(robot, first.joints[:1], np.zeros(1))
        chunks = [
            *recording.scene_chunks(
                robot, scene.workcell, begin, meshes=True, attached=scene.attached
            ),
            *recording.tool_axes(planned, kept),
            *recording.tool_moves(begin),
            *recording.share_chunks(_shares(self._manifold, begin.joints), begin),
            *recording.joint_chunks(robot, begin),
            *(static(_shadow(shape), _drawn(shape, _SHADOW)) for shape in obstacles),
            *recording.text_chunks(""),
        ]
        rr.send_chunks(chunks, recording=stream)
        self.follows(first)

    def moves(self, at_s: float, joints: Float[np.ndarray, "D"]) -> None:
        """The arm is at a configuration [rad] at a time [s]."""
        robot = self._scene.robot
        self._stream.set_time(TIME, duration=at_s)
        for joint in self._joints:
            value = float(joints[robot.joint_names.index(joint.name)])
            entity = str(rr.new_entity_path(["transforms", joint.name]))
            self._stream.log(entity, joint.compute_transform(value, clamp=False))
        now = Frames.of(robot, joints[None], np.array([at_s]))
        shares = _shares(self._manifold, now.joints)
        moved = [*recording.tool_moves(now), *recording.share_moves(shares, now)]
        rr.send_chunks(moved, recording=self._stream)
        share = recording.range_share(joints[None], robot.lower, robot.upper)[0]
        self._stream.log("joints", rr.Scalars(joints))
        self._stream.log("joint_range", rr.Scalars([*share, 1.0, -1.0]))

    def sees(self, at_s: float, shape: Shape) -> None:
        """An obstacle is known from a time [s] on."""
        rr.send_chunks([_at(_solid(shape), _drawn(shape, _SEEN), at_s)], recording=self._stream)

    def follows(self, stretch: Stretch) -> None:
        """The arm follows another motion."""
        before, begins_s = self._followed, stretch.begins_s
        if stretch is not before:
            old = _strip(_line(self._scene, before), _OLD)
            chunk = _at(f"tool/ways/{self._old}", old, begins_s)
            rr.send_chunks([chunk], recording=self._stream)
            self._old += 1
        self._followed = stretch
        line = _strip(_line(self._scene, stretch), _NOW)
        rr.send_chunks([_at("tool/plan", line, begins_s)], recording=self._stream)

    def says(self, text: str) -> None:
        """The status, in markdown."""
        rr.send_chunks(recording.text_chunks(text)[:1], recording=self._stream)
