"""Several recordings put together as one, to be seen at once: over each other, or side by side.

Each recording keeps what is its own below an entity of its own, in the colour of its planner; what
it shares with the others (the workcell, the limits) is there once.  Recordings that name URDFs get
their meshes here.
"""

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float
from rerun.chunk import Chunk

from constraint_geodesics.palette import planner_colour
from constraint_geodesics.recording import panels, recording
from constraint_geodesics.recording.colours import LIMIT, Colour, rgb
from constraint_geodesics.recording.kept import REGION
from constraint_geodesics.recording.recording import TIME, About, RecordingError, static
from constraint_geodesics.scene.urdf import find_urdf

OTHERS_OPACITY = 0.45
"""Of the robots over the first one."""

_IN_SPACE = (
    *("robot", "transforms", "tool", "attached", "cup", "spheres", "workcell", "hidden"),
    *("goal", "demonstrations", "identified"),
)
_ASKED = ("/goal/", "/demonstrations", "/identified", f"/{REGION}")
"""What was asked: of paths over each other, that of the first is drawn."""
_LIMITED = ("constraint/", "share/")


@dataclass(frozen=True)
class Opened:
    """A recording as it was read, its meshes added."""

    file: Path
    recording_id: str
    about: About
    chunks: tuple[Chunk, ...]
    added: tuple[Chunk, ...]
    """Those of the chunks that the file does not hold: the meshes that it names."""


@dataclass(frozen=True)
class Composed:
    """What one recording is written from."""

    recording_id: str
    name: str
    chunks: list[Chunk]
    blueprint: Any


@dataclass(frozen=True)
class _Part:
    """A recording among others: its words, entity and colour."""

    source: Opened
    label: str
    entity: str
    colour: Colour
    place: float
    """Where along its trace its words are."""


@dataclass(frozen=True)
class _Lines:
    """The series of one entity."""

    names: list[str]
    values: Float[np.ndarray, "frames k"]
    time: rr.TimeColumn


def opened(file: Path) -> Opened:
    """Read a recording and add the meshes that it names but does not hold.

    Raises RecordingError if it is not a recording or a mesh is missing, and RobotError if a URDF
    is.
    """
    stored, chunks, _ = recording.read_chunks(file)
    added = _missing_meshes(chunks)
    about = recording.about_of(stored.recording_id, chunks)
    return Opened(file, stored.recording_id, about, (*chunks, *added), tuple(added))


def _missing_meshes(chunks: Sequence[Chunk]) -> list[Chunk]:
    drawn = [chunk.entity_path for chunk in chunks if "/visual_geometries/" in chunk.entity_path]
    added = []
    for chunk in chunks:
        entity = chunk.entity_path
        if recording.has(chunk, "urdf") and not any(
            path.startswith(f"{entity}/") for path in drawn
        ):
            row = chunk.to_record_batch().to_pylist()[0]
            urdf, prefix = find_urdf(row["urdf"][0]), row.get("frame_prefix", [None])[0]
            added += recording.mesh_chunks(urdf, entity, prefix)
    return added


def overlaid(sources: Sequence[Opened]) -> Composed:
    """Paths over each other: every planner has a robot in its colour, all but the first one half
    transparent.

    Raises RecordingError for executed paths, for paths of several constraints or in different
    surroundings, and for what is no recording of one path.
    """
    _of_one_kind(sources)
    if sources[0].about.executed:
        raise RecordingError("executed paths are not laid over each other: add --side-by-side")
    if len(constraints := {source.about.constraint for source in sources}) > 1:
        several = f"several constraints ({', '.join(sorted(constraints))})"
        raise RecordingError(f"paths of {several}: add --side-by-side")
    _same_surroundings(sources)
    parts = _parts(sources)
    shared = [chunk for chunk in sources[0].chunks if _is_surroundings(chunk)]
    own = [
        chunk
        for k, part in enumerate(parts)
        for chunk in _in_space(part, 1.0 if k == 0 else OTHERS_OPACITY)
        if not _is_surroundings(chunk, part.entity)
        and not (k and chunk.entity_path.startswith(tuple(f"/{part.entity}{e}" for e in _ASKED)))
    ]
    return _composed(parts, shared + _ends_once(own), apart=False)


def side_by_side(sources: Sequence[Opened]) -> Composed:
    """Paths, executed ones among them, each in its own view.  Raises RecordingError for what is no
    recording of one path.
    """
    _of_one_kind(sources)
    parts = _parts(sources)
    own = [chunk for part in parts for chunk in _in_space(part, 1.0)]
    return _composed(parts, own, apart=True)


def _of_one_kind(sources: Sequence[Opened]) -> None:
    for source in sources:
        if not any(chunk.entity_path == "/joints" for chunk in source.chunks):
            raise RecordingError(f"{source.file}: not a recording of one path: open it by itself")
    timed = [source.file for source in sources if TIME in _timelines(source)]
    counted = [source.file for source in sources if TIME not in _timelines(source)]
    if timed and counted:
        both = f"{timed[0]} is in seconds, and {counted[0]}, of an earlier release, in frames"
        raise RecordingError(f"{both}: open them one after another, or record it again")


def _timelines(source: Opened) -> list[str]:
    moving = (chunk for chunk in source.chunks if not chunk.is_static)
    return [
        name for chunk in moving if chunk.entity_path == "/joints" for name in chunk.timeline_names
    ]


def _same_surroundings(sources: Sequence[Opened]) -> None:
    first = _surroundings(sources[0])
    for source in sources[1:]:
        if _surroundings(source) != first:
            both = f"{sources[0].file} and {source.file}"
            raise RecordingError(
                f"{both} have different bodies round the robot: add --side-by-side"
            )


def _surroundings(source: Opened) -> dict[tuple[str, ...], Any]:
    """The bodies as they stand, meshes and names of URDFs left out."""
    bodies = [chunk for chunk in source.chunks if _is_surroundings(chunk)]
    found = {}
    for chunk in bodies:
        if not recording.has(chunk, "Asset3D:", "urdf"):
            names = _components(chunk)
            rows = chunk.to_record_batch().select(names).to_pylist()
            found[chunk.entity_path, *names] = rows
    return found


def _is_surroundings(chunk: Chunk, below: str = "") -> bool:
    """Whether a chunk is a body of the workcell or its place, and not the robot's."""
    parts = chunk.entity_path.removeprefix(f"/{below}").strip("/").split("/")
    return parts[0] == "workcell" or (parts[0] == "transforms" and len(parts) > 2)


def _components(chunk: Chunk) -> list[str]:
    """Its columns but for the row ids."""
    names = chunk.to_record_batch().schema.names
    return [name for name in names if not name.startswith("rerun.controls")]


def _ends_once(chunks: Sequence[Chunk]) -> list[Chunk]:
    """Starts and goals that several paths share are marked once."""
    kept: list[Chunk] = []
    seen: list[tuple[str, Any]] = []
    for chunk in chunks:
        marks = chunk.entity_path.endswith(("/tool/start", "/tool/goal"))
        row = recording.component(chunk, "Points3D:positions") if marks else None
        mark = (chunk.entity_path.rpartition("/")[2], row)  # a closed path begins where it ends
        if row is None or mark not in seen:
            kept.append(chunk)
            seen += [] if row is None else [mark]
    return kept


def _parts(sources: Sequence[Opened]) -> list[_Part]:
    labels = labels_of([source.about for source in sources])
    colours = shades([planner_colour(source.about.planner) for source in sources])
    places = np.linspace(0.0, 1.0, len(sources) + 2)[1:-1]
    parts = []
    for k, (source, label) in enumerate(zip(sources, labels, strict=True)):
        entity = f"path{k}_{re.sub(r'[^a-z0-9]+', '_', label.lower()).strip('_')}"
        parts.append(_Part(source, label, entity, colours[k], float(places[k])))
    return parts


def labels_of(abouts: Sequence[About]) -> list[str]:
    """The planner of each; constraint, scene and query where they differ; else the seed."""
    labels = [about.planner or "path" for about in abouts]
    for what, words in (("constraint", "{}"), ("scene", "{}"), ("query", "query {}")):
        values = [getattr(about, what) for about in abouts]
        if len(set(values)) > 1:
            both = zip(labels, values, strict=True)
            labels = [_with_value(label, words, value) for label, value in both]
    alike = Counter(labels)
    labels = [
        _with_value(label, "seed {}", about.seed if alike[label] > 1 else None)
        for label, about in zip(labels, abouts, strict=True)
    ]
    several, seen = Counter(labels), Counter[str]()
    for k, label in enumerate(labels):
        seen[label] += 1
        labels[k] = f"{label} ({seen[label]})" if several[label] > 1 else label
    return labels


def _with_value(label: str, words: str, value: str | int | None) -> str:
    return label if value in (None, "") else f"{label}, {words.format(value)}"


def shades(colours: Sequence[str]) -> list[Colour]:
    """Each colour as it is the first time, and lighter each further time."""
    seen: Counter[str] = Counter()
    found = []
    for colour in colours:
        white = 1.0 - 0.6 ** seen[colour]
        red, green, blue = (round(value + white * (255 - value)) for value in rgb(colour))
        found.append((red, green, blue))
        seen[colour] += 1
    return found


def _in_space(part: _Part, opacity: float) -> Iterator[Chunk]:
    """What of a recording stands in space, below the part's entity and in its colour."""
    for chunk in part.source.chunks:
        path = chunk.entity_path
        if path.split("/")[1] not in _IN_SPACE:
            continue
        moved = _with_frames(chunk, f"{part.entity}/").with_entity_path(f"/{part.entity}{path}")
        if recording.has(chunk, "Asset3D:blob") and path.startswith("/robot/"):
            factor = (*part.colour, round(255 * opacity))
            own = rr.Asset3D.from_fields(albedo_factor=factor)
            yield from _changed(moved, "Asset3D:albedo_factor", own)
        elif path == "/tool/trace":
            yield from _coloured(moved, rr.LineStrips3D, part.colour)
            yield static(f"{part.entity}/tool/name", _name(part, chunk))
        elif path in ("/tool/frame/axes", "/tool/position") and chunk.is_static:
            yield from _coloured(moved, rr.Points3D, part.colour)
        else:
            yield moved


def _name(part: _Part, trace: Chunk) -> Any:
    """The part's name on its trace, at its own place, so that those of equal paths do not meet."""
    points = recording.component(trace, "LineStrips3D:strips")[0][0]
    at, unseen = points[round(part.place * (len(points) - 1))], rr.Radius.ui_points(0.0)
    return rr.Points3D([at], colors=[part.colour], radii=[unseen], labels=[part.label])


def _with_frames(chunk: Chunk, prefix: str) -> Chunk:
    """The chunk with a prefix before its coordinate frames' names, but for those of entities."""
    batch = chunk.to_record_batch()
    for name in ("CoordinateFrame:frame", "Transform3D:child_frame", "Transform3D:parent_frame"):
        if name in batch.schema.names:
            rows = [
                [
                    frame if frame.startswith(recording.ROOT_FRAME) else prefix + frame
                    for frame in row
                ]
                for row in batch.column(name).to_pylist()
            ]
            at = batch.schema.get_field_index(name)
            field = batch.schema.field(at)
            batch = batch.set_column(at, field, pa.array(rows, field.type))
    (changed,) = Chunk.from_record_batch(batch)
    return changed


def _changed(chunk: Chunk, name: str, archetype: Any) -> Iterator[Chunk]:
    """A static chunk without one component, then what replaces it."""
    batch = chunk.to_record_batch()
    if name in batch.schema.names:
        batch = batch.drop_columns([name])
    yield from Chunk.from_record_batch(batch)
    yield static(chunk.entity_path, archetype)


def _coloured(chunk: Chunk, kind: Any, colour: Colour) -> Iterator[Chunk]:
    own = kind.from_fields(colors=[colour])
    return _changed(chunk, f"{kind.__name__}:colors", own)


def _composed(parts: Sequence[_Part], in_space: Sequence[Chunk], *, apart: bool) -> Composed:
    series = [_series_of(part.source.chunks) for part in parts]
    latent, latent_view = _latent(parts)
    shown = ([] if latent_view is None else [(latent_view, 1.6)]) + _panels(series)
    time = _clock(series)
    texts = [
        recording.component(chunk, "TextDocument:text")[0][0]
        for part in parts
        for chunk in part.source.chunks
        if chunk.entity_path == "/status"
    ]
    own = [*_series_chunks(parts, series), *latent, *recording.text_chunks("\n\n".join(texts))]
    ids = " ".join([part.source.recording_id for part in parts] + [str(apart)])
    name = ", ".join(part.label for part in parts)
    held = {part.source.about.constraint for part in parts}
    name += f": {held.pop()}" if len(held) == 1 else ""
    return Composed(
        f"together-{hashlib.sha256(ids.encode()).hexdigest()[:12]}",
        name,
        [*in_space, *own],
        _side_by_side(parts, shown, time) if apart else _over(parts, shown, time),
    )


def _series_of(chunks: Sequence[Chunk]) -> dict[str, _Lines]:
    names, values = {}, {}
    for chunk in chunks:
        # Rerun escapes spaces and the like
        entity = re.sub(r"\\(.)", r"\1", chunk.entity_path.strip("/"))
        if recording.has(chunk, "SeriesLines:names"):
            names[entity] = recording.component(chunk, "SeriesLines:names")[0]
        elif recording.has(chunk, "Scalars:scalars"):
            rows = np.array(recording.component(chunk, "Scalars:scalars"), dtype=float)
            values[entity] = (rows, _time(chunk))
    found = [entity for entity in names if entity in values]
    return {entity: _Lines(names[entity], *values[entity]) for entity in found}


def _time(chunk: Chunk) -> rr.TimeColumn:
    (timeline,) = chunk.timeline_names
    seconds = recording.seconds_of(chunk)
    if seconds is None:
        return rr.TimeColumn(timeline, sequence=recording.component(chunk, timeline))
    return rr.TimeColumn(timeline, duration=seconds.tolist())


def _series_chunks(parts: Sequence[_Part], series: Sequence[dict[str, _Lines]]) -> Iterator[Chunk]:
    """One line a recording in its colour, then each limit once."""
    limits: dict[str, _Lines] = {}
    entities = {entity for own in series for entity in own}
    alone = Counter(entity.rpartition("/")[0] for entity in entities)
    for part, own in zip(parts, series, strict=True):
        for entity, lines in own.items():
            group, _, last = entity.rpartition("/")
            what = f": {last}" if group and alone[group] > 1 else ""
            for shown, names, values in _own_lines(entity, lines, f"{part.label}{what}"):
                drawn = _Lines(names, values, lines.time)
                yield from _lines(f"{shown}/{part.entity}", part.colour, drawn)
            for shown, name, value in _limits(entity, lines, part.source.chunks):
                # as long as the longest of the paths
                if shown not in limits or len(lines.values) > len(limits[shown].values):
                    level = np.full((len(lines.values), 1), value)
                    limits[shown] = _Lines([f"{name}{what}"], level, lines.time)
    for shown, lines in limits.items():
        yield from _lines(shown, LIMIT, lines, width=1.0)


def _own_lines(
    entity: str, lines: _Lines, label: str
) -> Iterator[tuple[str, list[str], np.ndarray]]:
    """Of one recording: where lines go, their names, and their values without the limits."""
    if entity == "joints":
        for k, joint in enumerate(lines.names):
            yield f"joint/{joint}", [label], lines.values[:, k : k + 1]
    elif entity == "joint_range":
        joints = [name for name in lines.names if not name.endswith(" limit")]
        yield entity, [f"{label}: {joint}" for joint in joints], lines.values[:, : len(joints)]
    else:
        yield entity, [label], lines.values[:, :1]


def _limits(
    entity: str, lines: _Lines, chunks: Sequence[Chunk]
) -> Iterator[tuple[str, str, float]]:
    """The limits that belong to some lines: where each goes, what it is called, and its value."""
    if entity == "joints":
        for chunk in chunks:
            if chunk.entity_path == "/joints" and recording.has(chunk, "lower"):
                row = chunk.to_record_batch().to_pylist()[0]
                for side in ("lower", "upper"):
                    for joint, value in zip(lines.names, row[side], strict=True):
                        yield f"joint/{joint}/{side}_limit", f"{side} limit", value
    elif entity == "joint_range":
        yield "joint_range/upper_limit", "upper limit", 1.0
        yield "joint_range/lower_limit", "lower limit", -1.0
    elif entity.startswith(_LIMITED):
        yield f"{entity}/limit_{lines.values[0, 1]:.6g}", "limit", float(lines.values[0, 1])


def _lines(entity: str, colour: Colour, lines: _Lines, width: float = 2.0) -> Iterator[Chunk]:
    count = len(lines.names)
    entity = str(rr.new_entity_path(entity.split("/")))
    style = {"colors": [colour] * count, "widths": [width] * count}
    yield static(entity, rr.SeriesLines(names=list(lines.names), **style))
    yield recording.scalars(entity, lines.values, lines.time)


def _panels(series: Sequence[dict[str, _Lines]]) -> list[tuple[Any, float]]:
    """A panel for each quantity that any of the recordings has, with its share of the height."""
    found: dict[str, list[_Lines]] = defaultdict(list)
    for own in series:
        for entity, lines in own.items():
            found[entity].append(lines)

    def top(begin: str, columns: slice = slice(None)) -> float | None:
        own = [one for entity, lines in found.items() if entity.startswith(begin) for one in lines]
        return max((float(lines.values[:, columns].max()) for lines in own), default=None)

    residuals = any(entity.startswith("constraint/") for entity in found)
    shares = top("share/", slice(1))
    rows = [(one, 1.0) for one in panels.constraint_panel(shares, residuals=residuals)]
    if (spheres := top("cup_spheres")) is not None:
        rows += [(one, 1.0) for one in panels.cup_panels(spheres, top("cup_tilt") or 0.0)]
    joints = sorted({joint for lines in found["joints"] for joint in lines.names})
    single = [
        rrb.TimeSeriesView(origin=f"joint/{joint}", name=f"{joint} [rad or m]") for joint in joints
    ]
    together = [panels.range_panel(legend=False)] if "joint_range" in found else []
    return [*rows, (rrb.Tabs(*together, *single, active_tab=0), 1.2)]


def _over(parts: Sequence[_Part], rows: Sequence[tuple[Any, float]], time: Any) -> Any:
    entities = ["workcell", "transforms", *(part.entity for part in parts)]
    scene = panels.scene_view("Robots", entities, _traces(parts))
    return panels.arranged(scene, [(panels.status_panel(), 0.8), *rows], time)


def _side_by_side(parts: Sequence[_Part], rows: Sequence[tuple[Any, float]], time: Any) -> Any:
    seen = _traces(parts)
    scenes = rrb.Grid(*(panels.scene_view(part.label, [part.entity], seen) for part in parts))
    below = rrb.Horizontal(panels.status_panel(), *(panel for panel, _ in rows))
    return panels.blueprint(rrb.Vertical(scenes, below, row_shares=[3.0, 1.5]), time)


def _clock(series: Sequence[dict[str, _Lines]]) -> Any:
    """The time panel of the longest."""
    columns = [lines.time for own in series for lines in own.values()]
    times = np.concatenate([np.asarray(column.times.cast(pa.int64())) for column in columns])
    return panels.time_panel(columns[0].timeline, 1e-9 * float(times.max()))


def _traces(parts: Sequence[_Part]) -> Float[np.ndarray, "n 3"]:
    """Where the tools go [m]."""
    traces = [
        recording.component(chunk, "LineStrips3D:strips")[0][0]
        for part in parts
        for chunk in part.source.chunks
        if chunk.entity_path == "/tool/trace"
    ]
    return np.concatenate([np.zeros((1, 3)), *(np.array(trace, dtype=float) for trace in traces)])


def _latent(parts: Sequence[_Part]) -> tuple[list[Chunk], Any]:
    """The first sub-manifold shown, all curves on it, and the view."""
    of = {part.entity: _latent_chunks(part.source) for part in parts}
    shown = [part for part in parts if "submanifold" in of[part.entity]]
    if not shown:
        return [], None
    points, axes = (of[shown[0].entity][name][0] for name in ("submanifold", "axes"))
    same = _positions(points)
    shown = [part for part in shown if _positions(of[part.entity]["submanifold"][0]) == same]
    chunks = [points, axes]
    for k, part in enumerate(shown):
        for name in ("curve", "position", *(("start", "goal") if k == 0 else ())):
            for chunk in of[part.entity][name]:
                chunks += _in_latent(chunk, name, part)
    strips = recording.component(axes, "LineStrips2D:strips")[0]
    corners = np.array(strips[0] + strips[1]) * [1.0, -1.0]  # the plane's second axis points down
    names = recording.component(axes, "LineStrips2D:labels")[0]
    return chunks, panels.latent_view_of(names, corners.min(axis=0), corners.max(axis=0))


def _latent_chunks(source: Opened) -> dict[str, list[Chunk]]:
    found: dict[str, list[Chunk]] = defaultdict(list)
    for chunk in source.chunks:
        if chunk.entity_path.startswith("/latent/"):
            found[chunk.entity_path.rpartition("/")[2]].append(chunk)
    return found


def _positions(chunk: Chunk) -> Any:
    return chunk.to_record_batch().column("Points2D:positions")


def _in_latent(chunk: Chunk, name: str, part: _Part) -> Iterator[Chunk]:
    own = chunk.with_entity_path(f"/latent/{name}/{part.entity}")
    if name == "curve":
        yield from _coloured(own, rr.LineStrips2D, part.colour)
    elif name == "position" and chunk.is_static:
        yield from _coloured(own, rr.Points2D, part.colour)
    else:
        yield own
