"""The planner in MLflow's model registry: a pyfunc model of its files, a new version for each that
differs.

The second part of experiment.py.  Weights stay safetensors with checksums; the model's code is one
file of this package, so nothing is pickled.
"""

import hashlib
import shutil
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from constraint_geodesics.tracking.experiment import StageRun
from constraint_geodesics.tracking.store import (
    CHAMPION,
    PLANNER_MODEL,
    client_of,
    explained,
    keep_folder,
    mlflow_module,
)

FILES = "planner"
"""The folder of the planner's own files within a model."""
DESCRIPTION = (
    "Plans paths that keep a task constraint. A row of the input is a query: `start` and "
    "`goal`, joint angles in rad, "
    "and `constraint`, a name or its axes and tolerance as JSON. A row of the output has the "
    "path's `status`, "
    "`explanation`, `joints` and `times`."
)


def register_planner(run: StageRun, folder: Path, code: Path, example: Mapping[str, Any]) -> str:
    """Register a planner's files and let the alias `champion` point to them; returns the version.

    Files and code that a version has already make no new one.  A run of a DVC experiment registers
    its planner, but leaves the champion where it is.

    folder: as `Bundle.write` writes it.  code: the file that answers with them.  example: one
    query.
    Raises TrackingError if the store does not take it.
    """
    digest = _digest_of(folder, code)
    with explained(run.tracking_uri):
        client = client_of(run.tracking_uri)
        if not client.search_registered_models(f"name = '{PLANNER_MODEL}'"):
            client.create_registered_model(PLANNER_MODEL, description=DESCRIPTION)
        found = client.search_model_versions(f"name = '{PLANNER_MODEL}'")
        version = next((v.version for v in found if v.tags.get("sha256") == digest), None)
        if version is None:
            version = _new_version(run, folder, code, example, digest)
        if "dvc_experiment" not in run.tags:
            client.set_registered_model_alias(PLANNER_MODEL, CHAMPION, version)
    return str(version)


def _new_version(
    run: StageRun, folder: Path, code: Path, example: Mapping[str, Any], digest: str
) -> str:
    mlflow_module()
    import pandas as pd
    from mlflow import pyfunc
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, DataType, Schema
    from mlflow.types.schema import Array

    angles, text = Array(DataType.double), DataType.string
    asked = Schema([ColSpec(angles, "start"), ColSpec(angles, "goal"), ColSpec(text, "constraint")])
    answered = Schema(
        [
            ColSpec(text, "status"),
            ColSpec(text, "explanation"),
            ColSpec(Array(angles), "joints"),
            ColSpec(angles, "times"),
        ]
    )
    with tempfile.TemporaryDirectory() as scratch:
        target, files = Path(scratch) / "model", Path(scratch) / FILES
        shutil.copytree(folder, files)  # a model keeps the folder's name
        pyfunc.save_model(
            target,
            python_model=str(code),
            artifacts={FILES: str(files)},
            signature=ModelSignature(asked, answered),
            input_example=pd.DataFrame([dict(example)]),
            pip_requirements=installed_requirements(),
        )
        address = keep_folder(run.tracking_uri, run.run_id, target, FILES)
    tags = {name: run.tags[name] for name in ("git_commit", "git_dirty") if name in run.tags}
    client = client_of(run.tracking_uri)
    tags["sha256"] = digest
    return str(client.create_model_version(PLANNER_MODEL, address, run.run_id, tags).version)


_EXTRAS = ("", "record", "pipeline")
"""Of this package, that a served model needs."""


def installed_requirements() -> list[str]:
    """The packages that this one and its learning need, as they are installed; not itself, which no
    index has.
    """
    own = "constraint-geodesics"
    named = {
        each.name
        for each in (Requirement(text) for text in metadata.requires(own) or ())
        if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in _EXTRAS)
    }
    return [f"{name}=={metadata.version(name)}" for name in sorted(named - {own})]


def _digest_of(folder: Path, code: Path) -> str:
    """Of a planner's files and of what answers with them: this package's version, and its file."""
    version = metadata.version("constraint-geodesics")
    parts = folder_digest(folder), hashlib.sha256(code.read_bytes()).hexdigest(), version
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def folder_digest(folder: Path) -> str:
    """SHA-256 of a folder's files with their names."""
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(
            file.relative_to(folder).as_posix().encode()
            + hashlib.sha256(file.read_bytes()).digest()
        )
    return digest.hexdigest()
