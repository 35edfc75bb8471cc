"""The planner's files: robot, workcell, constraints, settings and roadmaps, small enough to travel
with the package; nothing in them is trained.

A folder with planner.json (the SHA-256 of every other file in it too) and roadmaps.safetensors.
Nothing in it is code, nothing is unpickled.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load, save

from constraint_geodesics.geometry.graph import components
from constraint_geodesics.params import (
    ConstraintParams,
    JudgeParams,
    PlannerParams,
    RobotParams,
    WorkcellParams,
)
from constraint_geodesics.plugs import MLFLOW, plug
from constraint_geodesics.search.roadmap import Roadmap
from constraint_geodesics.text_files import written

FORMAT = 2
_CONSTRAINT: TypeAdapter[ConstraintParams] = TypeAdapter(ConstraintParams)
CARD, ROADMAPS = "planner.json", "roadmaps.safetensors"
PIPELINE = Path("data/planner")
"""Where the pipeline leaves the planner's files, in a checkout."""
PACKAGED = Path(__file__).parent / "pretrained"
"""The bundle of the committed run, which comes with the package."""


class BundleError(ValueError):
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
        write_files(folder / CARD, FORMAT, card, {ROADMAPS: roadmap_arrays(self.roadmaps)})


def write_files(
    card_file: Path,
    version: int,
    card: Mapping[str, Any],
    arrays: Mapping[str, Mapping[str, np.ndarray]],
) -> None:
    """Write arrays as safetensors files and the card beside them with their checksums, all of them
    or none; who is killed between two of them leaves what the card does not fit.
    """
    contents = {name: save(dict(values)) for name, values in arrays.items()}
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    whole: dict[str, Any] = {"format": version, **card, "sha256": digests}
    digests[card_file.name] = card_digest(whole)
    with ExitStack() as files:  # the card, which was entered first, takes its place last
        part = files.enter_context(written(card_file))
        part.write_text(json.dumps(whole, indent=1) + "\n")
        for name, content in contents.items():
            files.enter_context(written(card_file.parent / name)).write_bytes(content)


def read_files(
    card_file: Path, version: int, names: Sequence[str]
) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """The card and the arrays that `write_files` wrote.

    Raises BundleError if a file is missing, altered (its checksum differs), or of another format.
    """
    card = _card(card_file, version)
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


def roadmaps_of(arrays: Mapping[str, np.ndarray]) -> dict[str, Roadmap]:
    """What `roadmap_arrays` wrote."""
    names = sorted({name.split("/")[0] for name in arrays})
    return {name: _roadmap(arrays, name) for name in names}


def open_bundle(source: str | Path | None = None) -> tuple[Bundle, str]:
    """A bundle and where it came from: a folder, an MLflow address (models:/… or runs:/…), or by
    default the pipeline's outputs in this checkout, else the files that come with the package.

    Raises BundleError if the files are missing or altered, TrackingError if MLflow does not have
    them.
    """
    if isinstance(source, str) and ":/" in source:
        with plug(MLFLOW)(source) as folder:
            return read_bundle(folder), f"MLflow's {source}"
    folder = bundle_folder(source)
    if source is not None:
        return read_bundle(folder), str(source)
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

    Raises BundleError if a file is missing, altered (its checksum differs), or of another format.
    """
    card, arrays = read_files(folder / CARD, FORMAT, (ROADMAPS,))
    try:
        roadmaps = roadmaps_of(arrays[ROADMAPS])
        alone = sorted(set(roadmaps) - set(card["constraints"]))
        if alone:
            strays = f"roadmaps of {alone}, which are no constraints of {CARD}"
            raise BundleError(f"{folder / ROADMAPS}: {strays}")
        return Bundle(
            RobotParams.model_validate(card["robot"]),
            WorkcellParams.model_validate(card["workcell"]),
            {name: _CONSTRAINT.validate_python(c) for name, c in card["constraints"].items()},
            PlannerParams.model_validate(card["planner"]),
            JudgeParams.model_validate(card["judge"]),
            roadmaps,
        )
    except (AttributeError, KeyError, TypeError, ValidationError) as error:
        raise BundleError(
            f"{folder / CARD}: not a planner's card: {' '.join(str(error).split())[:200]}"
        ) from None


def _card(file: Path, version: int) -> dict[str, Any]:
    try:
        card = json.loads(file.read_text())
    except OSError:
        what = f"there is no {file.name}: not a folder of a planner"
        raise BundleError(f"{file.parent}: {what}") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BundleError(f"{file}: not JSON: {error}") from None
    written = card.get("format") if isinstance(card, dict) else None
    if written != version or not isinstance(card.get("sha256"), dict):
        raise BundleError(f"{file}: format {written}: this version reads format {version}")
    if card["sha256"].get(file.name) != card_digest(card):
        raise BundleError(f"{file}: altered since it was written (its checksum differs)")
    return card


def card_digest(card: Mapping[str, Any]) -> str:
    """Checksum of all of a card but the checksums themselves."""
    rest = {name: value for name, value in card.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _arrays(file: Path, wanted: str | None) -> dict[str, np.ndarray]:
    try:
        content = file.read_bytes()
    except OSError:
        raise BundleError(f"{file}: missing") from None
    if hashlib.sha256(content).hexdigest() != wanted:
        raise BundleError(f"{file}: altered since it was written (its checksum differs)")
    try:
        return load(content)
    except SafetensorError as error:
        raise BundleError(f"{file}: not safetensors: {error}") from None


def _roadmap(arrays: Mapping[str, np.ndarray], name: str) -> Roadmap:
    joints = arrays[f"{name}/joints"].astype(np.float64)
    edges = arrays[f"{name}/edges"].astype(np.int64)
    return Roadmap(
        joints, edges, arrays[f"{name}/lengths"].astype(np.float64), components(len(joints), edges)
    )
