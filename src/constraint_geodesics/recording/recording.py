"""Rerun recordings: one file a path, with the robot moving, what the constraint says and the curve
in latent space.

execution_recording.py records executions with the functions further down that have no underscore,
overlay.py puts recordings together, and viewer.py opens them.  A recording holds no wall-clock
time, so that equal paths give equal recordings.
"""

import contextlib
import hashlib
import math
import os
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from jaxtyping import Float, Shaped
from rerun.chunk import Chunk, RrdReader
from rerun.urdf import UrdfTree
from scipy.spatial.transform import Rotation

from constraint_geodesics import palette
from constraint_geodesics.certification.certifier import Limits
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Series
from constraint_geodesics.formats import NUMBER, RECORDING, FormatError
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.params import PlannerParams
from constraint_geodesics.recording import panels
from constraint_geodesics.recording.colours import (
    AXES,
    CARRIED,
    GROUND,
    INK,
    LIMIT,
    OTHER,
    colours,
    rgb,
)
from constraint_geodesics.recording.goal import GoalView, goal_drawings
from constraint_geodesics.recording.kept import AXIS_M, FRAME, PLACE, kept_drawings
from constraint_geodesics.recording.shown import ENTITIES, shown_drawings
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.urdf import urdf_name
from constraint_geodesics.text_files import write_bytes

APPLICATION = "constraint_geodesics"
TIME = "time"
"""The timeline, in seconds from the start of the path."""
ABOUT = "about"
"""The entity that says where a recording comes from."""
SHARE = "share"
"""What the constraint bounds, as shares of what the judge grants [%]."""
_IN_UNIT = {"mm": 1e3, "deg": math.degrees(1.0)}
"""Units that series are drawn in, of a metre and of a radian."""
_APART = 1e-6
"""Rows that are closer than this share of a path take no time."""

ROOT_FRAME = "tf#/"
"""Rerun's name for the frame of the root entity."""


_START, _GOAL, _NOW = (rgb(own) for own in (palette.START, palette.GOAL, palette.BLUE))
_WIDTH, _THIN, _POINT, _END = (rr.Radius.ui_points(size) for size in (2.0, 0.8, 5.0, 7.0))
"""Of lines, of those of other ways, moving points and a path's ends, in points of the screen."""
_ENVIRONMENT = threading.Lock()
_OLD_ID = re.compile(
    r"(?P<constraint>.+)-query(?P<query>\d+)-(?P<planner>.+?)"
    r"(-seed(?P<seed>\d+)|-(?P<executed>executed))$"
)


class RecordingError(ValueError):
    """A path can't be recorded or a recording can't be read; the message names the file and what is
    wrong with it.
    """


@dataclass(frozen=True)
class LatentView:
    """What the latent panel shows: the sub-manifold in one plane, and the curve on it.

    values: integers are the components' indices (negative: in none), floats are values of the
    inclusion map.
    """

    points: Float[np.ndarray, "n 2"]
    values: Shaped[np.ndarray, "n"]
    curve: Float[np.ndarray, "T 2"]
    axis_names: tuple[str, str]


@dataclass(frozen=True)
class PathRecord:
    """One path and where it comes from; `text` is its status in markdown."""

    planner: str
    constraint: str
    query: int | None
    """None where it is of no set of queries; nor has it a seed then."""
    seed: int | None
    joints: Float[np.ndarray, "T D"]
    """Configurations along the path [rad or m], the latent curve's points in the same order."""
    text: str
    latent: LatentView | None = None
    times: Float[np.ndarray, "T"] | None = None
    """When the arm is there [s], from 0; None where nobody said: as fast as the arm's limits
    allow.
    """
    scene: str = ""
    """What stands round the robot besides its workcell, where that has a name."""
    tolerance: float = Limits.violation_tolerance
    """What the judge grants a violation [rad or m]."""
    goal: GoalView | None = None
    """What was asked to reach, where it is more than the last configuration."""
    demonstrations: Sequence[Float[np.ndarray, "T D"]] = ()
    """What the constraint was found in [rad or m], if it was."""
    ways: Sequence[Float[np.ndarray, "T D"]] = ()
    """Others that were found [rad or m]."""
    meshes: bool = True
    """Whether the file holds the meshes of robot and bodies, to be opened anywhere; without them it
    is a tenth as large and names the URDFs that `geodesics replay` adds them from.
    """

    @property
    def name(self) -> str:
        """For people; two paths may share it."""
        if self.query is None:
            return f"{self.constraint}-{self.planner}"
        return f"{self.constraint}-query{self.query}-{self.planner}-seed{self.seed}"

    @property
    def title(self) -> str:
        """What a viewer shows of it."""
        if self.query is None:
            return f"{self.constraint}: {self.planner}"
        return f"{self.constraint}, query {self.query}: {self.planner}, seed {self.seed}"


@dataclass(frozen=True)
class About:
    """Where a recording comes from; what it does not say is "" or None."""

    planner: str = ""
    """Or what was executed."""
    constraint: str = ""
    scene: str = ""
    query: int | None = None
    seed: int | None = None
    executed: bool = False


@dataclass(frozen=True)
class RecordingSummary:
    """What a recording holds, as read back from its file."""

    application_id: str
    recording_id: str
    entity_paths: tuple[str, ...]
    meshes: int
    """Number of meshes: the robot's visual ones and those of the workcell's bodies."""
    joints: Float[np.ndarray, "frames D"]
    """Joint positions [rad or m] over the timeline."""
    times: Float[np.ndarray, "frames"] | None
    """Of the frames [s]; None in a recording from before there were times."""
    tool_ends: Float[np.ndarray, "2 3"]
    """First and last point of the tool's trace in the base frame [m]."""
    has_blueprint: bool
    about: About


@dataclass(frozen=True)
class Frames:
    """A path as it is shown: times [s], joints [rad or m], pose of the tool in the base frame [m],
    points of the arm [m] and latent point of each frame.
    """

    at_s: Float[np.ndarray, "frames"]
    joints: Float[np.ndarray, "frames D"]
    tool: Float[np.ndarray, "frames 3"]
    turn: Float[np.ndarray, "frames 3 3"]
    arm: Float[np.ndarray, "frames n 3"]
    curve: Float[np.ndarray, "frames 2"] | None = None

    @classmethod
    def of(
        cls,
        robot: SerialRobot,
        joints: Float[np.ndarray, "frames D"],
        at_s: Float[np.ndarray, "frames"],
        curve: Float[np.ndarray, "frames 2"] | None = None,
    ) -> "Frames":
        """Those of a robot's configurations."""
        return cls(at_s, joints, *robot.forward(joints), robot.skeleton(joints), curve)

    @property
    def time(self) -> rr.TimeColumn:
        """The timeline, with one entry a frame."""
        return rr.TimeColumn(TIME, duration=np.asarray(self.at_s, float).tolist())

    @property
    def duration_s(self) -> float:
        """Until the last frame."""
        return float(self.at_s[-1])


def record_path(
    file: Path,
    path: PathRecord,
    manifold: ConstraintManifold,
    workcell: Sequence[Shape],
    *,
    frames: int,
    attached: Sequence[Attached] = (),
) -> None:
    """Write the recording of one path at so many frames, its blueprint inside.  attached: what the
    robot carries.

    Raises RecordingError if the path is not one of the manifold's robot or a mesh that is to be
    written is missing.
    """
    robot, sampled = manifold.robot, sample(path, manifold, frames)
    series = constraint_series(manifold, sampled.joints)
    shares = share_series(manifold, sampled.joints, path.tolerance)
    chunks = [
        *scene_chunks(robot, workcell, sampled, meshes=path.meshes, attached=attached),
        *tool_chunks(sampled, rgb(palette.planner_colour(path.planner)), manifold.constraint),
        *_way_chunks(robot, path.ways),
        *(static(*drawing) for drawing in goal_drawings(robot, path.goal)),
        *(
            static(*drawing)
            for drawing in shown_drawings(robot, path.demonstrations, manifold.constraint)
        ),
        *series_chunks(series, sampled),
        *share_chunks(shares, sampled),
        *joint_chunks(robot, sampled),
        *_latent_chunks(path.latent, sampled),
        about_chunk(About(path.planner, path.constraint, path.scene, path.query, path.seed)),
        *text_chunks(path.text),
    ]
    blueprint = _blueprint(path, sampled, series, shares)
    write_recording(file, f"{path.name}-{digest(sampled)}", path.title, chunks, blueprint)


def text_chunks(text: str) -> list[Chunk]:
    """The status in markdown; and the view's third axis points up."""
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    return [static("status", document), static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)]


def digest(sampled: Frames) -> str:
    """Of the joints: equal paths have equal ids, and the viewer takes no others for one."""
    return hashlib.sha256(np.ascontiguousarray(sampled.joints).tobytes()).hexdigest()[:8]


def about_chunk(about: About) -> Chunk:
    """Where the recording comes from, and its format."""
    known = {name: value for name, value in vars(about).items() if value is not None}
    return static(ABOUT, rr.AnyValues(**known, **{NUMBER: RECORDING.number}))


def write_recording(
    file: Path, recording_id: str, name: str, chunks: Sequence[Chunk], blueprint: Any = None
) -> None:
    """Write chunks and a blueprint as one recording; without a name it is a part of another."""
    # the properties would hold the time of writing
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
    content = stream.binary_stream()  # its own files would be half written where a disk is full
    with stream:
        if blueprint is not None:
            # first, and active: a viewer that drew something before keeps to a layout of its own
            stream.send_blueprint(blueprint)
            stream.flush()
        if name:
            stream.send_recording_name(name)
        rr.send_chunks(chunks, recording=stream)
    write_bytes(file, content.read() or b"")


def read_recording(file: Path) -> RecordingSummary:
    """Read a recording back.

    Raises RecordingError if it is not a recording of one path.
    """
    stored, chunks, blueprint = read_chunks(file)
    moving_joints = _chunk(file, chunks, "/joints", "Scalars:scalars")
    joints = component(moving_joints, "Scalars:scalars")
    line = _chunk(file, chunks, "/tool/trace", "LineStrips3D:strips")
    trace = component(line, "LineStrips3D:strips")[0][0]
    return RecordingSummary(
        application_id=stored.application_id,
        recording_id=stored.recording_id,
        entity_paths=tuple(sorted({chunk.entity_path for chunk in chunks})),
        meshes=sum(has(chunk, "Asset3D:blob") for chunk in chunks),
        joints=np.array(joints, dtype=float),
        times=seconds_of(moving_joints),
        tool_ends=np.array([trace[0], trace[-1]], dtype=float),
        has_blueprint=blueprint,
        about=about_of(stored.recording_id, chunks),
    )


def read_chunks(file: Path) -> tuple[Any, list[Chunk], bool]:
    """The one store of a file, its chunks, and whether there is a blueprint.

    Raises RecordingError if it is not a recording, holds several, or is of a format that this
    release can't read.
    """
    try:
        reader = RrdReader(existing(file))
        stores = reader.recordings()
        if len(stores) != 1:
            raise RecordingError(f"{file}: holds {len(stores)} recordings, not one")
        chunks, blueprint = reader.stream().to_chunks(), bool(reader.blueprints())
    except RuntimeError as error:
        raise RecordingError(f"{file}: not a recording: {error}") from None
    about = _about_row(chunks)
    number = (about.get(NUMBER) or [None])[0]
    try:
        RECORDING.require(1 if number is None else number)
    except FormatError as error:
        raise RecordingError(f"{file}: {error}") from None
    return stores[0], chunks, blueprint


def _about_row(chunks: Sequence[Chunk]) -> dict[str, list[Any]]:
    """What the recording says of itself, each value in a list; nothing if it does not."""
    for chunk in chunks:
        if chunk.entity_path == f"/{ABOUT}":
            row: dict[str, list[Any]] = chunk.to_record_batch().to_pylist()[0]
            return row
    return {}


def about_of(recording_id: str, chunks: Sequence[Chunk]) -> About:
    """What a recording says of itself; of one from before it did, what its id says."""
    if row := _about_row(chunks):
        return About(**{name: row[name][0] for name in vars(About()) if name in row})
    if found := _OLD_ID.match(recording_id):
        query, seed = (
            None if found[name] is None else int(found[name]) for name in ("query", "seed")
        )
        executed = found["executed"] is not None
        return About(found["planner"], found["constraint"], "", query, seed, executed)
    return About()


def seconds_of(chunk: Chunk) -> Float[np.ndarray, "frames"] | None:
    """When its rows are [s]; None where they are counted."""
    if chunk.timeline_names != [TIME]:
        return None
    column = chunk.to_record_batch().column(TIME)
    return 1e-9 * np.asarray(column.cast(pa.int64()).to_numpy(zero_copy_only=False), float)


def sample(path: PathRecord, manifold: ConstraintManifold, frames: int) -> Frames:
    """The path at times that are equally far apart.

    Raises RecordingError if it is not the robot's, or its times are none.
    """
    joints, robot = np.asarray(path.joints, dtype=float), manifold.robot
    name, dof, shape = path.name, robot.dof, joints.shape
    if joints.ndim != 2 or len(joints) < 2 or shape[1] != dof:
        must = f"must be (T, {dof}) with T of 2 or more"
        raise RecordingError(f"{name}: joints of shape {shape}: {must}")
    if not np.isfinite(joints).all():
        raise RecordingError(f"{name}: joints that are not finite")
    if frames < 2:
        raise RecordingError(f"{name}: frames = {frames}: must be 2 or more")
    if path.latent is not None and (curve := path.latent.curve).shape != (shape[0], 2):
        must = f"must be {(shape[0], 2)}"
        raise RecordingError(f"{name}: latent curve of shape {curve.shape}: {must}")
    times = paced(robot, joints) if path.times is None else np.asarray(path.times, dtype=float)
    if times.shape != shape[:1]:
        raise RecordingError(f"{name}: times of shape {times.shape}: must be {shape[:1]}")
    if not np.isfinite(times).all() or times[0] != 0.0 or (np.diff(times) < 0.0).any():
        raise RecordingError(f"{name}: times must be finite and rise from 0")
    at_s = np.linspace(0.0, times[-1], frames)
    latent = None if path.latent is None else _interpolate(at_s, times, path.latent.curve)
    return Frames.of(robot, _interpolate(at_s, times, joints), at_s, latent)


def paced(robot: SerialRobot, joints: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "T"]:
    """Times [s] of a path that has none: from rest to rest within the arm's velocity limits and the
    planner's accelerations.  One that stands still takes a second.
    """
    steps = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] == 0.0:
        return np.linspace(0.0, 1.0, len(joints))
    moved = np.concatenate([[True], steps > _APART * along[-1]])
    limits = PlannerParams()
    sliding = robot.chain.prismatic
    acceleration = np.where(sliding, limits.acceleration_m_s2, limits.acceleration_rad_s2)
    velocity = np.where(robot.velocity > 0.0, robot.velocity, np.inf)  # some URDFs say 0
    times = Pace(velocity, acceleration).times(joints[moved], None)
    return np.interp(along, along[moved], times)


def _interpolate(at_s: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at_s, times, column) for column in values.T], axis=1)


def scene_chunks(
    robot: SerialRobot,
    workcell: Sequence[Shape],
    sampled: Frames,
    *,
    meshes: bool,
    attached: Sequence[Attached] = (),
) -> Iterator[Chunk]:
    """The robot over the timeline, the workcell and what the robot carries, with their meshes or
    with the names of their URDFs alone.

    Raises RecordingError if a mesh that is asked for is missing.
    """
    yield from _robot_chunks(robot, sampled)
    shapes = [(shape, "workcell", ROOT_FRAME) for shape in workcell]
    shapes += [(held.shape, "attached", held.link) for held in attached]
    for shape, group, frame in shapes:
        yield from _shape_chunks(shape, _entity(group, shape.name), frame)
    if meshes:
        yield from mesh_chunks(robot.urdf, "/robot")
        for shape, group, _ in shapes:
            if placed := shape.urdf_model():
                yield from mesh_chunks(placed.file, _entity(group, shape.name), f"{shape.name}/")


def _robot_chunks(robot: SerialRobot, sampled: Frames) -> Iterator[Chunk]:
    """The robot's fixed joints, and its moving ones over the timeline."""
    tree = UrdfTree.from_file_path(robot.urdf)
    yield static("robot", rr.AnyValues(urdf=urdf_name(robot.urdf)))
    yield static(
        "transforms/base",
        rr.Transform3D(parent_frame=ROOT_FRAME, child_frame=tree.root_link().name),
    )
    for joint in tree.joints():
        entity = _entity("transforms", joint.name)
        if joint.name in robot.joint_names:
            values = sampled.joints[:, robot.joint_names.index(joint.name)]
            yield moving(
                entity, joint.compute_transform_columns(values.tolist(), clamp=False), sampled.time
            )
        else:
            yield static(entity, joint.compute_transform(0.0, clamp=False))


def _shape_chunks(shape: Shape, entity: str, frame: str) -> Iterator[Chunk]:
    """A shape at its place in a frame: the base's, or that of the link that carries it."""
    placed = shape.urdf_model()
    # what links may touch is what the arm stands on
    around = GROUND if shape.exempt_links else OTHER
    colour = around if frame == ROOT_FRAME else CARRIED
    style = {"colors": [colour], "fill_mode": "solid", "labels": [shape.name], "show_labels": False}
    archetype = shape.drawn(rr, style)
    if archetype is not None:
        yield static(entity, archetype)
        if frame != ROOT_FRAME:
            yield static(entity, rr.CoordinateFrame(frame))
    if placed is None:
        return
    prefix = f"{shape.name}/"
    tree = UrdfTree.from_file_path(placed.file, frame_prefix=prefix)
    yield static(entity, rr.AnyValues(urdf=urdf_name(placed.file), frame_prefix=prefix))
    root = {"parent_frame": frame, "child_frame": prefix + tree.root_link().name}
    pose = rr.Transform3D(translation=placed.position, mat3x3=placed.rotation, **root)
    yield static(_entity("transforms", shape.name, "base"), pose)
    for joint in tree.joints():
        place = _entity("transforms", shape.name, joint.name)
        yield static(place, joint.compute_transform(0.0, clamp=False))


def mesh_chunks(urdf: Path, entity: str, frame_prefix: str | None = None) -> list[Chunk]:
    """The visual geometry of a URDF below an entity; collision hulls drawn over it would flicker.

    Raises RecordingError if a mesh is missing.
    """
    with _package_path(urdf):
        tree = UrdfTree.from_file_path(urdf, frame_prefix=frame_prefix)
        stream = tree.stream(include_joint_transforms=False)
        chunks = [chunk.with_entity_path(f"{entity}{chunk.entity_path}") for chunk in stream]
    chunks = [chunk for chunk in chunks if "/collision_geometries/" not in chunk.entity_path]
    # Rerun only warns of a mesh that it can't find, and leaves its entity with a pose alone
    pose = ("InstancePoses3D:", "CoordinateFrame:")
    placed = {chunk.entity_path for chunk in chunks if has(chunk, "InstancePoses3D:translations")}
    drawn = {chunk.entity_path for chunk in chunks if not has(chunk, *pose)}
    if missing := sorted(path.split("/visual_geometries/")[-1] for path in placed - drawn):
        raise RecordingError(f"{urdf}: no mesh could be read for {', '.join(missing)}")
    if not drawn:
        raise RecordingError(f"{urdf}: has no visual geometry")
    return chunks


@contextlib.contextmanager
def _package_path(urdf: Path) -> Iterator[None]:
    """Let Rerun look for package:// meshes in the folders above the URDF, as PyBullet does."""
    name = "ROS_PACKAGE_PATH"
    folders = [str(folder) for folder in urdf.resolve().parents]
    with _ENVIRONMENT:  # another thread may record as well
        before = os.environ.get(name)
        os.environ[name] = os.pathsep.join(folders + ([before] if before else []))
        try:
            yield
        finally:
            if before is None:
                del os.environ[name]
            else:
                os.environ[name] = before


def _way_chunks(robot: SerialRobot, ways: Sequence[Float[np.ndarray, "T D"]]) -> Iterator[Chunk]:
    """The tool's lines on other ways, thin and grey."""
    if ways:
        lines = [robot.forward(points)[0] for points in ways]
        yield static("tool/ways", rr.LineStrips3D(lines, colors=[OTHER], radii=[_THIN]))


def tool_chunks(
    sampled: Frames, colour: tuple[int, int, int], kept: Constraint | None = None
) -> Iterator[Chunk]:
    """The tool's trace with its ends, where it is with its axes, and what a constraint keeps."""
    yield static("tool/trace", rr.LineStrips3D([sampled.tool], colors=[colour], radii=[_WIDTH]))
    for name, point, own in _ends(sampled.tool):
        marker = rr.Points3D([point], colors=[own], radii=[_END], labels=[name])
        yield static(f"tool/{name}", marker)
    yield from tool_axes(sampled, kept)
    yield from tool_moves(sampled)


def tool_axes(sampled: Frames, kept: Constraint | None) -> Iterator[Chunk]:
    """The tool's place and axes, and what a constraint keeps: what moves with `tool_moves`."""
    now = rr.Points3D(np.zeros((1, 3)), colors=[INK], radii=[_POINT])
    axes = rr.Arrows3D(vectors=AXIS_M * np.eye(3), colors=AXES, radii=[0.003])
    yield static(f"{FRAME}/axes", axes, now)
    for drawing in kept_drawings(kept, sampled.tool):
        yield static(*drawing)


def tool_moves(sampled: Frames) -> Iterator[Chunk]:
    """The tool's frame, and its place, where what does not turn with it is drawn."""
    turn = Rotation.from_matrix(sampled.turn).as_quat()
    frame = rr.Transform3D.columns(translation=sampled.tool, quaternion=turn)
    yield moving(FRAME, frame, sampled.time)
    yield moving(PLACE, rr.Transform3D.columns(translation=sampled.tool), sampled.time)


def _ends(points: np.ndarray) -> tuple[tuple[str, np.ndarray, tuple[int, int, int]], ...]:
    return ("start", points[0], _START), ("goal", points[-1], _GOAL)


def constraint_series(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "frames D"]
) -> list[Series]:
    """What the constraint bounds, in mm and degrees."""
    return manifold.constraint.series(manifold.residual(joints))


def share_series(
    manifold: ConstraintManifold, joints: Float[np.ndarray, "frames D"], tolerance: float
) -> list[Series]:
    """The same in percent of its limit: what the judge grants [rad or m], beyond the constraint's
    own tolerance.
    """
    found = []
    for one in constraint_series(manifold, joints):
        limit = one.limit + _IN_UNIT[one.unit] * tolerance
        found.append(Series(one.name, one.unit, 100.0 * one.values / limit, limit))
    return found


def series_chunks(series: Sequence[Series], sampled: Frames) -> Iterator[Chunk]:
    """Series with their limits."""
    for one in series:
        entity = _entity("constraint", one.unit, one.name)
        name = f"{one.name} [{one.unit}]"
        yield _limited(entity, name, f"limit of {name}")
        yield _with_limit(entity, one.values, one.limit, sampled)


def share_chunks(shares: Sequence[Series], sampled: Frames) -> Iterator[Chunk]:
    """Shares of limits with the line at 100 %, whose name says what that is."""
    for one in shares:
        yield _limited(_entity(SHARE, one.name), one.name, f"limit, {one.limit:.3g} {one.unit}")
    yield from share_moves(shares, sampled)


def share_moves(shares: Sequence[Series], sampled: Frames) -> Iterator[Chunk]:
    """The shares over the timeline."""
    for one in shares:
        yield _with_limit(_entity(SHARE, one.name), one.values, 100.0, sampled)


def _limited(entity: str, *names: str) -> Chunk:
    lines = rr.SeriesLines(names=list(names), colors=[_NOW, LIMIT], widths=[2.0, 1.0])
    return static(entity, lines)


def _with_limit(entity: str, values: np.ndarray, limit: float, sampled: Frames) -> Chunk:
    both = np.stack([values, np.full_like(values, limit)], axis=1)
    return scalars(entity, both, sampled.time)


def joint_chunks(robot: SerialRobot, sampled: Frames) -> Iterator[Chunk]:
    """Joint positions [rad or m] with their limits, and as shares of each joint's range."""
    own, names = colours(np.arange(robot.dof)), list(robot.joint_names)
    limits = rr.AnyValues(lower=robot.lower.tolist(), upper=robot.upper.tolist())
    yield static("joints", rr.SeriesLines(names=names, colors=own), limits)
    yield scalars("joints", sampled.joints, sampled.time)
    share = range_share(sampled.joints, robot.lower, robot.upper)
    ends = np.broadcast_to([1.0, -1.0], (len(share), 2))
    shown = [*names, "upper limit", "lower limit"]
    colors, widths = np.concatenate([own, [LIMIT, LIMIT]]), [1.5] * robot.dof + [1.0, 1.0]
    yield static("joint_range", rr.SeriesLines(names=shown, colors=colors, widths=widths))
    yield scalars("joint_range", np.concatenate([share, ends], axis=1), sampled.time)


def range_share(
    joints: Float[np.ndarray, "frames D"], lower: np.ndarray, upper: np.ndarray
) -> Float[np.ndarray, "frames D"]:
    """Where each joint is within its range: -1 at its lower limit, 1 at its upper one."""
    return np.asarray((2.0 * joints - lower - upper) / (upper - lower))


def _latent_chunks(latent: LatentView | None, sampled: Frames) -> Iterator[Chunk]:
    if latent is None or sampled.curve is None:
        return
    curve, (low, high) = _upright(sampled.curve), _latent_bounds(latent)
    # discs that just cover a grid of this many points
    spacing = math.sqrt(float(np.prod(high - low)) / max(len(latent.points), 1))
    points, own, radii = _upright(latent.points), colours(latent.values), [math.sqrt(0.5) * spacing]
    shown = rr.Points2D(points, colors=own, radii=radii, draw_order=0.0)
    yield static("latent/submanifold", shown)
    yield static("latent/axes", _axes(low, high, latent.axis_names))
    line = rr.LineStrips2D([curve], colors=[INK], radii=[_WIDTH], draw_order=20.0)
    yield static("latent/curve", line)
    for name, point, colour in _ends(curve):
        marker = rr.Points2D([point], colors=[colour], radii=[_END], labels=[name], draw_order=30.0)
        yield static(f"latent/{name}", marker)
    now = rr.Points2D.from_fields(colors=[INK], radii=[_POINT], draw_order=40.0)
    yield static("latent/position", now)
    yield moving("latent/position", rr.Points2D.columns(positions=curve), sampled.time)


def _upright(points: np.ndarray) -> np.ndarray:
    """Rerun's planes have their second axis pointing down."""
    return np.stack([points[:, 0], -points[:, 1]], axis=1)


def _axes(low: np.ndarray, high: np.ndarray, names: tuple[str, str]) -> Any:
    corner = [[[low[0], low[1]], [high[0], low[1]]], [[low[0], low[1]], [low[0], high[1]]]]
    strips = [_upright(np.array(line)) for line in corner]
    thin = {"colors": [INK], "radii": [rr.Radius.ui_points(1.0)], "draw_order": 10.0}
    return rr.LineStrips2D(strips, labels=list(names), show_labels=True, **thin)


def _latent_bounds(latent: LatentView) -> tuple[np.ndarray, np.ndarray]:
    shown = np.concatenate([latent.points, latent.curve])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1e-6)
    return low - margin, high + margin


def component(chunk: Chunk, name: str) -> list[Any]:
    """One component of a chunk, row by row, as lists."""
    return list(chunk.to_record_batch().column(name).to_pylist())


def _blueprint(
    path: PathRecord, sampled: Frames, series: Sequence[Series], shares: Sequence[Series]
) -> Any:
    rows: list[tuple[Any, float]] = []
    if path.latent is not None:
        plane = panels.latent_view_of(path.latent.axis_names, *_latent_bounds(path.latent))
        rows.append((plane, 1.6))
    rows.append((panels.status_panel(), 0.8))
    rows += [(panel, 1.0) for panel in constraint_panel(series, shares)]
    rows.append((panels.joint_panel(), 1.2))
    more = ("goal",) * (path.goal is not None) + ENTITIES * bool(path.demonstrations)
    return panels.arranged(scene_panel(sampled, *more), rows, path_time(sampled))


def constraint_panel(series: Sequence[Series], shares: Sequence[Series]) -> list[Any]:
    """What the constraint bounds; nothing where it bounds nothing."""
    largest = max((float(one.values.max()) for one in shares), default=None)
    return panels.constraint_panel(largest, residuals=bool(series))


def path_time(sampled: Frames) -> Any:
    """The time panel of a path."""
    return panels.time_panel(TIME, sampled.duration_s)


def scene_panel(sampled: Frames, *more: str) -> Any:
    """The robot in its workcell with its tool's trace, and what lies below more entities."""
    return panels.scene_view("Robot", (*panels.ROOTS, *more), sampled.arm.reshape(-1, 3))


def _entity(*parts: str) -> str:
    return str(rr.new_entity_path(list(parts)))


def static(entity: str, *archetypes: Any) -> Chunk:
    """What an entity has all the time."""
    batches = [batch for own in archetypes for batch in own.as_component_batches()]
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [], columns)


def moving(entity: str, columns: Any, time: rr.TimeColumn) -> Chunk:
    """What an entity has at each frame."""
    return Chunk.from_columns(entity, [time], columns)


def scalars(entity: str, values: Float[np.ndarray, "frames k"], time: rr.TimeColumn) -> Chunk:
    """One or more numbers at each frame."""
    return moving(entity, rr.Scalars.columns(scalars=values), time)


def has(chunk: Chunk, *components: str) -> bool:
    """Whether a chunk holds any of the components."""
    names = chunk.to_record_batch().schema.names
    return any(name.startswith(component) for name in names for component in components)


def _chunk(file: Path, chunks: Sequence[Chunk], entity: str, name: str) -> Chunk:
    """The chunk with one component of one entity."""
    for chunk in chunks:
        if chunk.entity_path == entity and has(chunk, name):
            return chunk
    raise RecordingError(f"{file}: has no {name} at {entity}: not a recording of a path")


def rerun_command(*arguments: str) -> list[str]:
    """Rerun's own command, of this environment."""
    # python -m rerun_cli would return 0 whatever the tool says
    return [sys.executable, "-m", "rerun", *arguments]


def existing(file: Path) -> Path:
    """The file itself.  Raises RecordingError if there is none."""
    if not file.is_file():
        raise RecordingError(f"{file}: no such recording")
    return file
