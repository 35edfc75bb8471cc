"""Rerun recordings: one file a path, with the robot moving, what the constraint says and the curve
in latent space.

The first importer of rerun; the others are execution_recording.py, for which the functions further
down without an underscore are there, overlay.py, which puts recordings together, and viewer.py,
which opens them.  A recording holds no wall-clock time, so that equal paths give equal recordings.
"""

import contextlib
import hashlib
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, Shaped
from rerun.chunk import Chunk, RrdReader
from rerun.urdf import UrdfTree

from constraint_geodesics import palette
from constraint_geodesics.certification.certifier import Limits
from constraint_geodesics.constraints.constraint import ConstraintManifold, Series
from constraint_geodesics.robot.kinematics import SerialRobot, rotation_from_rpy
from constraint_geodesics.scene.world import Box, Solid, Sphere, data_path

APPLICATION = "constraint_geodesics"
TIMELINE = "frame"
ABOUT = "about"
"""The entity that says where a recording comes from."""
LOWEST_VIOLATION = 1e-12
"""Violations below this [rad or m] are shown as this, as there is no logarithm of 0."""

ROOT_FRAME = "tf#/"
"""Rerun's name for the frame of the root entity."""


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour of the palette as Rerun takes it."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


LIMIT = rgb(palette.VERMILION)
"""Of the lines that a series must not cross."""
_START, _GOAL, _NOW, _INK = (
    rgb(colour) for colour in (palette.START, palette.GOAL, palette.BLUE, palette.BLACK)
)
_BOX, _OUTSIDE, _PAPER = (150, 150, 150), (200, 200, 200), (255, 255, 255)
_PALETTE = tuple(
    rgb(colour)
    for colour in (
        palette.SKY,
        palette.ORANGE,
        palette.PURPLE,
        palette.BLUE,
        palette.YELLOW,
        palette.GREEN,
        palette.VERMILION,
    )
)
_OLD_ID = re.compile(
    r"(?P<constraint>.+)-query(?P<query>\d+)-(?P<planner>.+?)(-seed(?P<seed>\d+)|-(?P<executed>executed))$"
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
    query: int
    seed: int
    joints: Float[np.ndarray, "T D"]
    """Configurations along the path [rad or m], the latent curve's points in the same order."""
    text: str
    latent: LatentView | None = None
    scene: str = ""
    """What stands round the robot beside its workcell, where that has a name."""
    tolerance: float = Limits.violation_tolerance
    """What the judge grants a violation [rad or m]."""

    @property
    def name(self) -> str:
        """For people; two paths may share it."""
        return f"{self.constraint}-query{self.query}-{self.planner}-seed{self.seed}"


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
    tool_ends: Float[np.ndarray, "2 3"]
    """First and last point of the tool's trace in the base frame [m]."""
    has_blueprint: bool
    about: About


@dataclass(frozen=True)
class Frames:
    """A path as it is shown: joints [rad or m], tool in the base frame [m] and latent point of each
    frame.

    time: the timeline, with one entry a frame.
    """

    joints: Float[np.ndarray, "frames D"]
    tool: Float[np.ndarray, "frames 3"]
    curve: Float[np.ndarray, "frames 2"] | None
    time: rr.TimeColumn


def record_path(
    file: Path,
    path: PathRecord,
    manifold: ConstraintManifold,
    workcell: Sequence[Solid],
    *,
    frames: int,
    meshes: bool = True,
) -> None:
    """Write the recording of one path, its blueprint inside.

    meshes: with those of the robot and the bodies, to be opened anywhere; without them the file is
    a tenth as large and names the URDFs that `geodesics replay` adds them from.
    Raises RecordingError if the path is not one of the manifold's robot or a mesh that is to be
    written is missing.
    """
    record_frames(file, path, sample(path, manifold, frames), manifold, workcell, meshes=meshes)


def record_frames(
    file: Path,
    path: PathRecord,
    sampled: Frames,
    manifold: ConstraintManifold,
    workcell: Sequence[Solid],
    *,
    meshes: bool,
) -> None:
    """Write the recording of a path that is sampled already."""
    series = [
        *manifold.constraint.series(manifold.residual(sampled.joints)),
        *_violations(manifold, sampled.joints, path.tolerance),
    ]
    robot = manifold.robot
    chunks = [
        *scene_chunks(robot, workcell, sampled, meshes=meshes),
        *tool_chunks(sampled, rgb(palette.planner_colour(path.planner))),
        *_series_chunks(series, sampled),
        *joint_chunks(robot, sampled),
        *_latent_chunks(path.latent, sampled),
        about_chunk(About(path.planner, path.constraint, path.scene, path.query, path.seed)),
        static("status", rr.TextDocument(path.text, media_type=rr.MediaType.MARKDOWN)),
        static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP),
    ]
    name = f"{path.constraint}, query {path.query}: {path.planner}, seed {path.seed}"
    write_recording(
        file, f"{path.name}-{digest(sampled)}", name, chunks, _blueprint(path, sampled, series)
    )


def digest(sampled: Frames) -> str:
    """Of the joints: recordings of equal paths have equal ids, and the viewer takes no two others
    for one.
    """
    return hashlib.sha256(np.ascontiguousarray(sampled.joints).tobytes()).hexdigest()[:8]


def about_chunk(about: About) -> Chunk:
    """Where the recording comes from."""
    known = {name: value for name, value in vars(about).items() if value is not None}
    return static(ABOUT, rr.AnyValues(**known))


def write_recording(
    file: Path, recording_id: str, name: str, chunks: Sequence[Chunk], blueprint: Any = None
) -> None:
    """Write chunks, and a blueprint where there is one, as one recording; without a name it is a
    part of another.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    # the properties would hold the time of writing
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
    with stream:
        stream.save(file, default_blueprint=blueprint)
        if name:
            stream.send_recording_name(name)
        rr.send_chunks(chunks, recording=stream)


def read_recording(file: Path) -> RecordingSummary:
    """Read a recording back.

    Raises RecordingError if it is not a recording of one path.
    """
    stored, chunks, blueprint = read_chunks(file)
    joints = _column(file, chunks, "/joints", "Scalars:scalars")
    trace = _column(file, chunks, "/tool/trace", "LineStrips3D:strips")[0][0]
    return RecordingSummary(
        application_id=stored.application_id,
        recording_id=stored.recording_id,
        entity_paths=tuple(sorted({chunk.entity_path for chunk in chunks})),
        meshes=sum(has(chunk, "Asset3D:blob") for chunk in chunks),
        joints=np.array(joints, dtype=float),
        tool_ends=np.array([trace[0], trace[-1]], dtype=float),
        has_blueprint=blueprint,
        about=about_of(stored.recording_id, chunks),
    )


def read_chunks(file: Path) -> tuple[Any, list[Chunk], bool]:
    """The one store of a file, its chunks, and whether there is a blueprint.

    Raises RecordingError if it is not a recording, or holds several.
    """
    try:
        reader = RrdReader(existing(file))
        stores = reader.recordings()
        if len(stores) != 1:
            raise RecordingError(f"{file}: holds {len(stores)} recordings, not one")
        return stores[0], reader.stream().to_chunks(), bool(reader.blueprints())
    except RuntimeError as error:
        raise RecordingError(f"{file}: not a recording: {error}") from None


def about_of(recording_id: str, chunks: Sequence[Chunk]) -> About:
    """What a recording says of itself; of one from before it did, what its id says."""
    for chunk in chunks:
        if chunk.entity_path == f"/{ABOUT}":
            row = chunk.to_record_batch().to_pylist()[0]
            return About(**{name: row[name][0] for name in vars(About()) if name in row})
    if found := _OLD_ID.match(recording_id):
        seed = found["seed"]
        return About(
            found["planner"],
            found["constraint"],
            query=int(found["query"]),
            seed=None if seed is None else int(seed),
            executed=found["executed"] is not None,
        )
    return About()


def same_recordings(a: Path, b: Path) -> bool:
    """Whether two recordings hold the same data, in whatever order.

    Raises RecordingError if a file is missing.
    """
    result = subprocess.run(
        rerun_command("rrd", "compare", "--unordered", str(existing(a)), str(existing(b))),
        capture_output=True,
        check=False,
    )
    return result.returncode == 0


def sample(path: PathRecord, manifold: ConstraintManifold, frames: int) -> Frames:
    """The path at points of equal joint arc length.  Raises RecordingError if it is not one of the
    robot.
    """
    joints = np.asarray(path.joints, dtype=float)
    name, dof = path.name, manifold.robot.dof
    if joints.ndim != 2 or len(joints) < 2 or joints.shape[1] != dof:
        raise RecordingError(
            f"{name}: joints of shape {joints.shape}: must be (T, {dof}) with T of 2 or more"
        )
    if not np.isfinite(joints).all():
        raise RecordingError(f"{name}: joints that are not finite")
    if frames < 2:
        raise RecordingError(f"{name}: frames = {frames}: must be 2 or more")
    if path.latent is not None and path.latent.curve.shape != (len(joints), 2):
        raise RecordingError(
            f"{name}: latent curve of shape {path.latent.curve.shape}: must be {(len(joints), 2)}"
        )
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], frames)
    sampled = _interpolate(at, length, joints)
    curve = None if path.latent is None else _interpolate(at, length, path.latent.curve)
    time = rr.TimeColumn(TIMELINE, sequence=range(frames))
    return Frames(sampled, manifold.robot.forward(sampled)[0], curve, time)


def _interpolate(at: np.ndarray, length: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, length, column) for column in values.T], axis=1)


def scene_chunks(
    robot: SerialRobot, workcell: Sequence[Solid], sampled: Frames, *, meshes: bool
) -> Iterator[Chunk]:
    """The robot over the timeline and the workcell, with their meshes or with the names of their
    URDFs alone.

    Raises RecordingError if a mesh that is asked for is missing.
    """
    yield from _robot_chunks(robot, sampled)
    for body in workcell:
        yield from _body_chunks(body)
    if meshes:
        yield from mesh_chunks(robot.urdf, "/robot")
        for body in workcell:
            if not isinstance(body, (Box, Sphere)):
                yield from mesh_chunks(body.urdf, _entity("workcell", body.name), f"{body.name}/")


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


def _body_chunks(body: Solid) -> Iterator[Chunk]:
    """A body of the workcell at its place."""
    entity = _entity("workcell", body.name)
    if isinstance(body, Box):
        yield static(
            entity,
            rr.Boxes3D(
                centers=[body.centre],
                sizes=[body.size],
                colors=[_BOX],
                fill_mode="solid",
                labels=[body.name],
                show_labels=False,
            ),
        )
        return
    if isinstance(body, Sphere):
        yield static(
            entity,
            rr.Ellipsoids3D(
                centers=[body.centre],
                radii=[body.radius],
                colors=[_BOX],
                fill_mode="solid",
                labels=[body.name],
                show_labels=False,
            ),
        )
        return
    tree = UrdfTree.from_file_path(body.urdf, frame_prefix=f"{body.name}/")
    yield static(entity, rr.AnyValues(urdf=urdf_name(body.urdf), frame_prefix=f"{body.name}/"))
    yield static(
        _entity("transforms", body.name, "base"),
        rr.Transform3D(
            translation=body.position,
            mat3x3=rotation_from_rpy(np.array(body.rpy)),
            parent_frame=ROOT_FRAME,
            child_frame=f"{body.name}/{tree.root_link().name}",
        ),
    )
    for joint in tree.joints():
        yield static(
            _entity("transforms", body.name, joint.name), joint.compute_transform(0.0, clamp=False)
        )


def urdf_name(urdf: Path) -> str:
    """A URDF as params.yaml names it: within pybullet_data, within this checkout, or by its whole
    path.
    """
    for folder in (data_path().resolve(), Path.cwd()):
        if urdf.resolve().is_relative_to(folder):
            return urdf.resolve().relative_to(folder).as_posix()
    return urdf.resolve().as_posix()


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
    placed = {chunk.entity_path for chunk in chunks if has(chunk, "InstancePoses3D:translations")}
    drawn = {
        chunk.entity_path
        for chunk in chunks
        if not has(chunk, "InstancePoses3D:", "CoordinateFrame:")
    }
    if missing := sorted(path.split("/visual_geometries/")[-1] for path in placed - drawn):
        raise RecordingError(f"{urdf}: no mesh could be read for {', '.join(missing)}")
    if not drawn:
        raise RecordingError(f"{urdf}: has no visual geometry")
    return chunks


@contextlib.contextmanager
def _package_path(urdf: Path) -> Iterator[None]:
    """Let Rerun look for package:// meshes in the folders above the URDF, as PyBullet does."""
    name = "ROS_PACKAGE_PATH"
    before = os.environ.get(name)
    folders = [str(folder) for folder in urdf.resolve().parents]
    os.environ[name] = os.pathsep.join(folders + ([before] if before else []))
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def tool_chunks(sampled: Frames, colour: tuple[int, int, int]) -> Iterator[Chunk]:
    """The tool's trace with its ends, and where it is."""
    tool = sampled.tool
    size = rr.Radius.ui_points
    yield static("tool/trace", rr.LineStrips3D([tool], colors=[colour], radii=[size(2.0)]))
    for name, point, own in (("start", tool[0], _START), ("goal", tool[-1], _GOAL)):
        yield static(
            f"tool/{name}", rr.Points3D([point], colors=[own], radii=[size(7.0)], labels=[name])
        )
    yield static("tool/position", rr.Points3D.from_fields(colors=[_INK], radii=[size(5.0)]))
    yield moving("tool/position", rr.Points3D.columns(positions=tool), sampled.time)


def _violations(manifold: ConstraintManifold, joints: np.ndarray, tolerance: float) -> list[Series]:
    """What is beyond the constraint's own tolerance, as a power of ten: the judge's limit is far
    below a pixel else.
    """
    if manifold.constraint.is_free:
        return []
    values = np.log10(np.maximum(manifold.violation(joints), LOWEST_VIOLATION))
    return [Series("violation", "log10 rad or m", values, math.log10(tolerance))]


def _series_chunks(series: Sequence[Series], sampled: Frames) -> Iterator[Chunk]:
    for one in series:
        entity = one.name if one.name == "violation" else _entity("constraint", one.unit, one.name)
        names = [one.name, f"limit of {one.name}"]  # the panel says the unit
        yield static(entity, rr.SeriesLines(names=names, colors=[_NOW, LIMIT], widths=[2.0, 1.0]))
        yield scalars(
            entity,
            np.stack([one.values, np.full_like(one.values, one.limit)], axis=1),
            sampled.time,
        )


def joint_chunks(robot: SerialRobot, sampled: Frames) -> Iterator[Chunk]:
    """Joint positions as series, [rad or m] with the limits beside them, and as shares of each
    joint's range.
    """
    own, names = colours(np.arange(robot.dof)), list(robot.joint_names)
    yield static("joints", rr.SeriesLines(names=names, colors=own))
    yield static("joints", rr.AnyValues(lower=robot.lower.tolist(), upper=robot.upper.tolist()))
    yield scalars("joints", sampled.joints, sampled.time)
    share = range_share(sampled.joints, robot.lower, robot.upper)
    ends = np.broadcast_to([1.0, -1.0], (len(share), 2))
    yield static(
        "joint_range",
        rr.SeriesLines(
            names=[*names, "upper limit", "lower limit"],
            colors=np.concatenate([own, [LIMIT, LIMIT]]),
            widths=[1.5] * robot.dof + [1.0, 1.0],
        ),
    )
    yield scalars("joint_range", np.concatenate([share, ends], axis=1), sampled.time)


def range_share(
    joints: Float[np.ndarray, "frames D"],
    lower: Float[np.ndarray, "D"],
    upper: Float[np.ndarray, "D"],
) -> Float[np.ndarray, "frames D"]:
    """Where each joint is within its range: -1 at its lower limit, 1 at its upper one."""
    return np.asarray((2.0 * joints - lower - upper) / (upper - lower))


def _latent_chunks(latent: LatentView | None, sampled: Frames) -> Iterator[Chunk]:
    if latent is None or sampled.curve is None:
        return
    curve, size = _upright(sampled.curve), rr.Radius.ui_points
    low, high = _latent_bounds(latent)
    # discs that just cover a grid of this many points
    spacing = math.sqrt(float(np.prod(high - low)) / max(len(latent.points), 1))
    yield static(
        "latent/submanifold",
        rr.Points2D(
            _upright(latent.points),
            colors=colours(latent.values),
            radii=[math.sqrt(0.5) * spacing],
            draw_order=0.0,
        ),
    )
    yield static("latent/axes", _axes(low, high, latent.axis_names))
    yield static(
        "latent/curve", rr.LineStrips2D([curve], colors=[_INK], radii=[size(2.0)], draw_order=20.0)
    )
    for name, point, colour in (("start", curve[0], _START), ("goal", curve[-1], _GOAL)):
        marker = rr.Points2D(
            [point], colors=[colour], radii=[size(7.0)], labels=[name], draw_order=30.0
        )
        yield static(f"latent/{name}", marker)
    yield static(
        "latent/position",
        rr.Points2D.from_fields(colors=[_INK], radii=[size(5.0)], draw_order=40.0),
    )
    yield moving("latent/position", rr.Points2D.columns(positions=curve), sampled.time)


def _upright(points: np.ndarray) -> np.ndarray:
    """Rerun's planes have their second axis pointing down."""
    return np.stack([points[:, 0], -points[:, 1]], axis=1)


def _axes(low: np.ndarray, high: np.ndarray, names: tuple[str, str]) -> Any:
    corner = [[[low[0], low[1]], [high[0], low[1]]], [[low[0], low[1]], [low[0], high[1]]]]
    strips = [_upright(np.array(line)) for line in corner]
    return rr.LineStrips2D(
        strips,
        colors=[_INK],
        radii=[rr.Radius.ui_points(1.0)],
        labels=list(names),
        show_labels=True,
        draw_order=10.0,
    )


def _latent_bounds(latent: LatentView) -> tuple[np.ndarray, np.ndarray]:
    shown = np.concatenate([latent.points, latent.curve])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1e-6)
    return low - margin, high + margin


def colours(values: np.ndarray) -> np.ndarray:
    """Colours that the colour-blind can tell apart: one a component for integers, a scale (dark is
    high) for floats.
    """
    if np.issubdtype(values.dtype, np.integer):
        palette = np.array([*_PALETTE, _OUTSIDE], dtype=np.uint8)
        return palette[np.where(values < 0, len(_PALETTE), values % len(_PALETTE))]
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    scaled = np.nan_to_num((values - low) / max(high - low, 1e-12), nan=1.0, posinf=1.0, neginf=0.0)
    return np.asarray(matplotlib.colormaps["cividis_r"](scaled, bytes=True))[:, :3]


def _blueprint(path: PathRecord, sampled: Frames, series: Sequence[Series]) -> Any:
    right: list[Any] = [] if path.latent is None else [_latent_panel(path.latent)]
    right += [
        _residual_panel(unit, series)
        for unit in ("deg", "mm")
        if any(one.unit == unit for one in series)
    ]
    right += [violation_panel() for one in series if one.name == "violation"]
    shares = [2.5 if isinstance(panel, rrb.Spatial2DView) else 1.0 for panel in right]
    right.append(joint_panel())
    shares.append(1.8)  # its legend names every joint
    return arranged(scene_panel(sampled), rrb.Vertical(*right, row_shares=shares), path_time())


def path_time() -> Any:
    """The time panel of paths."""
    return rrb.TimePanel(
        state="collapsed", timeline=TIMELINE, fps=30.0, play_state="playing", loop_mode="all"
    )


def arranged(scene: Any, right: Any, time: Any) -> Any:
    """The blueprint of a recording: the scene with the status below it, the other panels beside
    it.
    """
    status = rrb.TextDocumentView(origin="status", name="Status")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, status, row_shares=[3.0, 1.0]), right, column_shares=[3.0, 2.0]
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        time,
        auto_views=False,
        auto_layout=False,
    )


def scene_panel(sampled: Frames, *more: str) -> Any:
    """The robot in its workcell with its tool's trace, and what lies below more entities."""
    shown = ("robot", "workcell", "tool", "transforms", *more)
    return scene_view("Robot", shown, float(np.linalg.norm(sampled.tool, axis=1).max()))


def scene_view(name: str, entities: Sequence[str], reach_m: float) -> Any:
    """What lies below some entities, seen from beyond the robot's reach."""
    eye = rrb.EyeControls3D(
        position=(1.2 * reach_m, -1.2 * reach_m, 0.9 * reach_m),
        look_target=(0.0, 0.0, 0.45 * reach_m),
        eye_up=(0.0, 0.0, 1.0),
    )
    # a grid at z = 0 would flicker with the top of a table there
    return rrb.Spatial3DView(
        origin="/",
        name=name,
        eye_controls=eye,
        contents=[f"+ /{entity}/**" for entity in entities],
        line_grid=rrb.LineGrid3D(visible=False),
    )


def _residual_panel(unit: str, series: Sequence[Series]) -> Any:
    shown = [one for one in series if one.unit == unit]
    return residual_panel(unit, max(max(one.limit, float(one.values.max())) for one in shown))


def residual_panel(unit: str, largest: float) -> Any:
    """What the constraint bounds, on a scale of at least one unit: an exactly held axis has
    rounding errors only.
    """
    axis = rrb.ScalarAxis(range=(0.0, 1.2 * max(1.0, largest)))
    return rrb.TimeSeriesView(
        origin=f"constraint/{unit}", name=f"Constraint residual [{unit}]", axis_y=axis
    )


def violation_panel(*, legend: bool = True) -> Any:
    """Powers of ten, up to ten rad."""
    axis, words = (
        rrb.ScalarAxis(range=(math.log10(LOWEST_VIOLATION) - 0.5, 1.0)),
        rrb.PlotLegend(visible=legend),
    )
    return rrb.TimeSeriesView(
        origin="violation",
        name="Violation beyond the tolerance [log10 rad or m]",
        axis_y=axis,
        plot_legend=words,
    )


def joint_panel() -> Any:
    """All joints as shares of their range, and behind that in their own units."""
    return rrb.Tabs(
        range_panel(),
        rrb.TimeSeriesView(origin="joints", name="Joint positions [rad or m]"),
        active_tab=0,
    )


def range_panel(*, legend: bool = True) -> Any:
    """All joints as shares of their range."""
    axis, words = rrb.ScalarAxis(range=(-1.1, 1.1)), rrb.PlotLegend(visible=legend)
    return rrb.TimeSeriesView(
        origin="joint_range", name="Joints within their limits (±1)", axis_y=axis, plot_legend=words
    )


def _latent_panel(latent: LatentView) -> Any:
    return latent_view_of(latent.axis_names, *_latent_bounds(latent))


def latent_view_of(axis_names: Sequence[str], low: np.ndarray, high: np.ndarray) -> Any:
    """The latent plane between two corners."""
    room = 0.1 * (high - low)  # for the axes' names
    low, high = low - room, high + room
    return rrb.Spatial2DView(
        origin="latent",
        name=f"Latent space: {', '.join(axis_names)}",
        background=_PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1])),
    )


def _entity(*parts: str) -> str:
    return str(rr.new_entity_path(list(parts)))


def static(entity: str, archetype: Any) -> Chunk:
    """What an entity has all the time."""
    columns = [
        batch.partition([len(batch.as_arrow_array())]) for batch in archetype.as_component_batches()
    ]
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


def _column(file: Path, chunks: Sequence[Chunk], entity: str, component: str) -> list[Any]:
    """One component of one entity, row by row, as lists."""
    for chunk in chunks:
        if chunk.entity_path == entity and has(chunk, component):
            return list(chunk.to_record_batch().column(component).to_pylist())
    raise RecordingError(f"{file}: has no {component} at {entity}: not a recording of a path")


def rerun_command(*arguments: str) -> list[str]:
    """Rerun's own command, of this environment."""
    # python -m rerun_cli would return 0 whatever the tool says
    return [sys.executable, "-m", "rerun", *arguments]


def existing(file: Path) -> Path:
    """The file itself.  Raises RecordingError if there is none."""
    if not file.is_file():
        raise RecordingError(f"{file}: no such recording")
    return file
