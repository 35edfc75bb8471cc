"""The planner's files: robot, workcell, constraints, settings and roadmaps, small enough to travel
with the package; nothing in them is trained.

A folder with planner.json (the SHA-256 of every other file in it too), roadmaps.safetensors, and
the URDFs and meshes that are not PyBullet's (`taken_along.py`).
Nothing in it is code, nothing is unpickled.  Checksums tell what was altered by accident, not who
wrote it: what a folder names (URDFs, meshes, modules) and holds (graphs) is looked at as well.
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from platformdirs import user_cache_path
from pydantic import TypeAdapter, ValidationError
from safetensors.numpy import save

from constraint_geodesics.array_files import ArrayFileError, read_weights
from constraint_geodesics.errors import WrongUsageError
from constraint_geodesics.fields import Name
from constraint_geodesics.formats import PLANNER, Format, FormatError
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.graph import components
from constraint_geodesics.params import (
    ConstraintParams,
    JudgeParams,
    PlannerParams,
    RobotParams,
    WorkcellParams,
    one_line,
)
from constraint_geodesics.plugs import MLFLOW, plug, require_trusted
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.search.roadmap import Roadmap
from constraint_geodesics.taken_along import FILES, MissingFileError, put_back, taken_along
from constraint_geodesics.text_files import read_content, read_json, written

_CONSTRAINTS: TypeAdapter[dict[Name, ConstraintParams]] = TypeAdapter(dict[Name, ConstraintParams])
CARD, ROADMAPS = "planner.json", "roadmaps.safetensors"
PIPELINE = Path("data/planner")
"""Where the pipeline leaves the planner's files, in a checkout."""
PACKAGED = Path(__file__).parent / "pretrained"
"""The bundle of the committed run, which comes with the package."""


class BundleError(WrongUsageError):
    """A planner's files can't be used; the message names the file and says why."""


@dataclass(frozen=True)
class Bundle:
    """What a planner is made of: parameters, and roadmaps by constraint."""

    robot: RobotParams
    workcell: WorkcellParams
    constraints: Mapping[str, ConstraintParams]
    planner: PlannerParams
    judge: JudgeParams
    roadmaps: Mapping[str, Roadmap]

    def write(self, folder: Path) -> None:
        """Write all files."""
        card = {
            "robot": self.robot.model_dump(mode="json"),
            "workcell": self.workcell.model_dump(mode="json"),
            "constraints": {
                name: c.model_dump(mode="json") for name, c in self.constraints.items()
            },
            "planner": self.planner.model_dump(mode="json"),
            "judge": self.judge.model_dump(mode="json"),
        }
        write_files(folder / CARD, PLANNER, card, {ROADMAPS: roadmap_arrays(self.roadmaps)})


def write_files(
    card_file: Path,
    written_as: Format,
    card: Mapping[str, Any],
    arrays: Mapping[str, Mapping[str, np.ndarray]],
) -> None:
    """Write arrays as safetensors files, files that the card names, and the card beside them with
    their checksums, all of them or none; who is killed between two of them, or can't put one in
    its place, leaves what the card does not fit.
    """
    card, contents = taken_along(card)
    contents |= {name: save(dict(values)) for name, values in arrays.items()}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    whole: dict[str, Any] = {**written_as.entries, **card, "sha256": digests}
    digests[card_file.name] = card_digest(whole)
    with ExitStack() as files:  # the card, which was entered first, takes its place last
        part = files.enter_context(written(card_file))
        part.write_text(json.dumps(whole, indent=1) + "\n")
        for name, content in contents.items():
            files.enter_context(written(card_file.parent / name)).write_bytes(content)


def read_files(
    card_file: Path, read_as: Format, names: Sequence[str]
) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """The card and the arrays that `write_files` wrote, brought up to date.

    Raises BundleError if a file is missing, altered (its checksum differs), or of a format that
    this release can't read.
    """
    card = _card(card_file, read_as)
    try:
        put_back(card, card_file.parent)
    except MissingFileError as error:
        raise BundleError(str(error)) from None
    return card, {
        name: _arrays(card_file.parent / name, card["sha256"].get(name)) for name in names
    }


def roadmap_arrays(roadmaps: Mapping[str, Roadmap]) -> dict[str, np.ndarray]:
    """Roadmaps as named arrays in single precision."""
    arrays: dict[str, np.ndarray] = {}
    for name, roadmap in roadmaps.items():
        numbers = np.uint16 if len(roadmap.joints) < 2**16 else np.uint32
        arrays[f"{name}/joints"] = roadmap.joints.astype(np.float32)
        arrays[f"{name}/edges"] = roadmap.edges.astype(numbers)
        arrays[f"{name}/lengths"] = roadmap.lengths.astype(np.float32)
    return arrays


def roadmaps_of(arrays: Mapping[str, np.ndarray], file: Path) -> dict[str, Roadmap]:
    """What `roadmap_arrays` wrote into a file.  Raises BundleError for what is no graph."""
    found = {}
    for name in sorted({name.split("/")[0] for name in arrays}):
        try:
            found[name] = _roadmap(arrays, name)
        except (GeometryError, KeyError, ValueError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise BundleError(f"{file}: the graph of {name!r}: {what}") from None
    return found


def open_bundle(source: str | Path | None = None) -> tuple[Bundle, str]:
    """A bundle and where it came from: a folder, an MLflow address (models:/… or runs:/…), or by
    default the pipeline's outputs in this checkout, else the files that come with the package.

    Raises BundleError if the files are missing or altered, TrackingError if MLflow does not have
    them.
    """
    if isinstance(source, str) and ":/" in source:
        with plug(MLFLOW)(source) as folder:
            return _from_elsewhere(_lasting(folder)), f"MLflow's {source}"
    folder = bundle_folder(source)
    if source is not None:
        own = folder.resolve() in (PIPELINE.resolve(), PACKAGED.resolve())
        return (read_bundle if own else _from_elsewhere)(folder), str(source)
    if folder == PIPELINE:
        return read_bundle(folder), f"the pipeline's outputs in {PIPELINE.resolve()}"
    return read_bundle(folder), "the files that come with the package"


def bundle_folder(source: str | Path | None) -> Path:
    """The folder that a source names; None: the pipeline's in this checkout, else the package's."""
    if source is not None:
        return Path(source)
    return PIPELINE if (PIPELINE / CARD).is_file() else PACKAGED


def read_bundle(folder: Path) -> Bundle:
    """Read what `Bundle.write` wrote.

    Raises BundleError if a file is missing, altered (its checksum differs), or of a format that
    this release can't read.
    """
    card, arrays = read_files(folder / CARD, PLANNER, (ROADMAPS,))
    try:
        roadmaps = roadmaps_of(arrays[ROADMAPS], folder / ROADMAPS)
        alone = sorted(set(roadmaps) - set(card["constraints"]))
        if alone:
            strays = f"roadmaps of {alone}, which are no constraints of {CARD}"
            raise BundleError(f"{folder / ROADMAPS}: {strays}")
        return Bundle(
            RobotParams.model_validate(card["robot"]),
            WorkcellParams.model_validate(card["workcell"]),
            _CONSTRAINTS.validate_python(card["constraints"]),
            PlannerParams.model_validate(card["planner"]),
            JudgeParams.model_validate(card["judge"]),
            roadmaps,
        )
    except (AttributeError, KeyError, TypeError, ValidationError) as error:
        what = one_line(error) if isinstance(error, ValidationError) else str(error)
        raise BundleError(
            f"{folder / CARD}: not a planner's card: {' '.join(what.split())[:200]}"
        ) from None


def _lasting(folder: Path) -> Path:
    """A folder that MLflow takes away again; a copy of it in the user's cache where the planner
    goes on reading files of it.
    """
    if not ((folder / FILES).is_dir() and (folder / CARD).is_file()):
        return folder
    digest = hashlib.sha256(read_content(folder / CARD, piped=False)).hexdigest()[:16]
    place = user_cache_path("constraint_geodesics") / "planners" / digest
    with suppress(BundleError):
        read_bundle(place)
        return place
    shutil.rmtree(place, ignore_errors=True)  # cut short, altered, or never what its card says
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=place.parent) as part:
        # links stay links, so that they are seen
        whole = Path(shutil.copytree(folder, Path(part) / digest, symlinks=True))
        try:
            whole.rename(place)
        except OSError:  # another process may be first
            if not place.is_dir():
                raise
    return place


def _from_elsewhere(folder: Path) -> Bundle:
    """A bundle that neither this checkout nor the package made: it may name files of its own
    folder, of the current one and of PyBullet's alone, and no module that the caller has not
    imported.  Raises BundleError.
    """
    bundle = read_bundle(folder)
    named = [("robot.urdf", bundle.robot.urdf), ("robot.may_touch", bundle.robot.may_touch)]
    for name, shape in bundle.workcell.shapes.items():
        named += [
            (f"workcell.{name}.{entry}", str(getattr(shape, entry)))
            for entry in ("urdf", "file")
            if hasattr(shape, entry)
        ]
    for entry, file in named:
        if isinstance(file, str) and not _is_within(Path(file), folder):
            raise BundleError(
                f"{folder / CARD}: {entry}={file!r}: leaves the planner's folder, the current one "
                f"and pybullet_data: name a file in one of them"
            )
    for name, constraint in bundle.constraints.items():
        module = getattr(constraint, "factory", "").partition(":")[0]
        try:
            require_trusted(module or __name__)
        except ImportError as error:
            raise BundleError(f"{folder / CARD}: constraints.{name}.factory: {error}") from None
    return bundle


def _is_within(file: Path, folder: Path) -> bool:
    """Whether a file, looked for where `find_urdf` does, lies in one of the folders that a bundle
    may name files of.
    """
    places = [Path.cwd(), folder]
    with suppress(RobotError):  # there may be no PyBullet
        places.append(data_path())
    looked_at = [place / file for place in places]
    found = [one for one in looked_at if one.is_file()] or looked_at[:1]
    try:
        return all(
            any(one.resolve().is_relative_to(place.resolve()) for place in places) for one in found
        )
    except ValueError:  # no name of a file
        return False


def _card(file: Path, read_as: Format) -> dict[str, Any]:
    try:
        card = read_json(file)
    except OSError as error:
        what = f"there is no {file.name}: not a folder of a planner"
        if file.exists():
            what = f"{file.name}: {error.strerror}"
        raise BundleError(f"{file.parent}: {what}") from None
    except ValueError as error:
        raise BundleError(f"{file}: not JSON: {error}") from None
    if not isinstance(card, dict):
        raise BundleError(f"{file}: not a planner's card: must be entries by name")
    try:
        found = read_as.updated(card)
    except FormatError as error:
        raise BundleError(f"{file}: {error}") from None
    if not isinstance(card.get("sha256"), dict):
        raise BundleError(f"{file}: not a planner's card: sha256 is missing")
    if card["sha256"].get(file.name) != card_digest(card):
        raise BundleError(f"{file}: altered since it was written (its checksum differs)")
    return found


def card_digest(card: Mapping[str, Any]) -> str:
    """Checksum of all of a card but the checksums themselves."""
    rest = {name: value for name, value in card.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _arrays(file: Path, wanted: str | None) -> dict[str, np.ndarray]:
    try:
        return read_weights(file, wanted or "")
    except ArrayFileError as error:
        raise BundleError(str(error)) from None


def _roadmap(arrays: Mapping[str, np.ndarray], name: str) -> Roadmap:
    joints, edges, lengths = (arrays[f"{name}/{part}"] for part in ("joints", "edges", "lengths"))
    if joints.ndim != 2 or edges.shape != (len(edges), 2) or lengths.shape != edges.shape[:1]:
        shapes = f"joints {joints.shape}, edges {edges.shape}, lengths {lengths.shape}"
        raise ValueError(f"{shapes}: must be (n, D), (m, 2) and (m,)")
    if edges.dtype.kind not in "iu" or (lengths < 0.0).any():
        raise ValueError("edges must be numbers of nodes, and lengths not negative")
    joints, edges = joints.astype(np.float64), edges.astype(np.int64)
    return Roadmap(joints, edges, lengths.astype(np.float64), components(len(joints), edges))
