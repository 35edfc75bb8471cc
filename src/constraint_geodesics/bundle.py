"""The planner's files: networks, graphs and settings of one run, small enough to travel with the
package.

A folder with planner.json (robot, workcell, constraints, settings, and the SHA-256 of every other
file), manifold.safetensors, policies.safetensors and roadmaps.safetensors.  Nothing in it is code,
nothing is unpickled.
"""

import hashlib
import json
from collections.abc import Mapping
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
    GeodesicParams,
    JudgeParams,
    PlannerParams,
    RobotParams,
    WorkcellParams,
)
from constraint_geodesics.search.roadmap import Roadmap

FORMAT = 1
_CONSTRAINT: TypeAdapter[ConstraintParams] = TypeAdapter(ConstraintParams)
CARD, MANIFOLD, POLICIES, ROADMAPS = (
    "planner.json",
    "manifold.safetensors",
    "policies.safetensors",
    "roadmaps.safetensors",
)
PIPELINE = Path("data/planner")
"""Where the pipeline leaves the planner's files, in a checkout."""
PACKAGED = Path(__file__).parent / "pretrained"
"""The bundle of the committed run, which comes with the package."""


class BundleError(ValueError):
    """A planner's files can't be used; the message names the file and says why."""


@dataclass(frozen=True)
class Bundle:
    """What a planner is made of: parameters, and the arrays of its networks; roadmaps by
    constraint.
    """

    robot: RobotParams
    workcell: WorkcellParams
    constraints: Mapping[str, ConstraintParams]
    planner: PlannerParams
    policy: GeodesicParams
    judge: JudgeParams
    manifold: Mapping[str, np.ndarray]
    policies: Mapping[str, np.ndarray]
    roadmaps: Mapping[str, Roadmap]

    def write(self, folder: Path) -> None:
        """Write all files; the card last, so that an interrupted write leaves no bundle that looks
        whole.
        """
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CARD).unlink(missing_ok=True)
        contents = {
            MANIFOLD: save(dict(self.manifold)),
            POLICIES: save(dict(self.policies)),
            ROADMAPS: self._graphs(),
        }
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        card: dict[str, Any] = {
            "format": FORMAT,
            "robot": self.robot.model_dump(mode="json"),
            "workcell": self.workcell.model_dump(mode="json"),
            "constraints": {
                name: c.model_dump(mode="json") for name, c in self.constraints.items()
            },
            "planner": self.planner.model_dump(mode="json"),
            "policy": self.policy.model_dump(mode="json"),
            "judge": self.judge.model_dump(mode="json"),
            "sha256": {
                name: hashlib.sha256(content).hexdigest() for name, content in contents.items()
            },
        }
        card["sha256"][CARD] = card_digest(card)
        (folder / CARD).write_text(json.dumps(card, indent=1) + "\n")

    def _graphs(self) -> bytes:
        arrays: dict[str, np.ndarray] = {}
        for name, roadmap in self.roadmaps.items():
            arrays[f"{name}/joints"] = roadmap.joints.astype(np.float32)
            arrays[f"{name}/edges"] = roadmap.edges.astype(
                np.uint16 if len(roadmap.joints) < 2**16 else np.uint32
            )
            arrays[f"{name}/lengths"] = roadmap.lengths.astype(np.float32)
        return save(arrays)


def open_bundle(source: str | Path | None = None) -> tuple[Bundle, str]:
    """A bundle and where it came from: a folder, an MLflow address (models:/… or runs:/…), or by
    default the pipeline's outputs in this checkout, else the files that come with the package.

    Raises BundleError if the files are missing or altered, TrackingError if MLflow does not have
    them.
    """
    if source is None:
        if (PIPELINE / CARD).is_file():
            return read_bundle(PIPELINE), f"the pipeline's outputs in {PIPELINE.resolve()}"
        return read_bundle(PACKAGED), "the files that come with the package"
    if isinstance(source, str) and ":/" in source:
        from constraint_geodesics.tracking.experiment import fetch_artifacts

        with fetch_artifacts(source) as folder:
            return read_bundle(folder), f"MLflow's {source}"
    return read_bundle(Path(source)), str(source)


def read_bundle(folder: Path) -> Bundle:
    """Read what `Bundle.write` wrote.

    Raises BundleError if a file is missing, altered (its checksum differs), or of another format.
    """
    card = _card(folder)
    arrays = {
        name: _arrays(folder / name, card["sha256"].get(name))
        for name in (MANIFOLD, POLICIES, ROADMAPS)
    }
    try:
        alone = set(_named(arrays[ROADMAPS])) - set(card["constraints"])
        if alone:
            raise BundleError(
                f"{folder / ROADMAPS}: graphs of {sorted(alone)}, which are no constraints of "
                f"{CARD}"
            )
        return Bundle(
            RobotParams.model_validate(card["robot"]),
            WorkcellParams.model_validate(card["workcell"]),
            {name: _CONSTRAINT.validate_python(c) for name, c in card["constraints"].items()},
            PlannerParams.model_validate(card["planner"]),
            GeodesicParams.model_validate(card["policy"]),
            JudgeParams.model_validate(card["judge"]),
            arrays[MANIFOLD],
            arrays[POLICIES],
            {name: _roadmap(arrays[ROADMAPS], name) for name in _named(arrays[ROADMAPS])},
        )
    except (AttributeError, KeyError, TypeError, ValidationError) as error:
        raise BundleError(
            f"{folder / CARD}: not a planner's card: {' '.join(str(error).split())[:200]}"
        ) from None


def _card(folder: Path) -> dict[str, Any]:
    file = folder / CARD
    try:
        card = json.loads(file.read_text())
    except OSError:
        raise BundleError(f"{folder}: there is no {CARD}: not a folder of a planner") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BundleError(f"{file}: not JSON: {error}") from None
    if (
        not isinstance(card, dict)
        or card.get("format") != FORMAT
        or not isinstance(card.get("sha256"), dict)
    ):
        written = card.get("format") if isinstance(card, dict) else None
        raise BundleError(f"{file}: format {written}: this version reads format {FORMAT}")
    if card["sha256"].get(CARD) != card_digest(card):
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


def _named(arrays: Mapping[str, np.ndarray]) -> list[str]:
    return sorted({name.split("/")[0] for name in arrays})


def _roadmap(arrays: Mapping[str, np.ndarray], name: str) -> Roadmap:
    joints = arrays[f"{name}/joints"].astype(np.float64)
    edges = arrays[f"{name}/edges"].astype(np.int64)
    return Roadmap(
        joints, edges, arrays[f"{name}/lengths"].astype(np.float64), components(len(joints), edges)
    )
