"""Runs in MLflow: one parent run a stage and matrix item, one child a seed.  The only importer of mlflow.

The JSON and CSV files under reports/ are the truth; MLflow mirrors them.  Only MLflow's low-level client is used: it
has no active run that could be shared by accident, prints nothing, and sends a report in one call.

Runs are in `mlflow.db` at the root of the checkout and their files in `mlartifacts/` beside it, or in the store that
MLFLOW_TRACKING_URI names.  In an SQLite store a run knows its files as `mlflow-artifacts:/…`, an address without a
folder, which the dashboard's server looks up in its own `mlartifacts/`: no server is needed while a stage runs, and a
checkout that was moved keeps its figures.  MLflow's client can't download such files without the server; they lie in
`mlartifacts/<experiment>/<run id>/artifacts/`.
"""

import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, pstdev
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

from filelock import FileLock
from pydantic import BaseModel

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import DatasetInput

LONGEST_VALUE = 6000
PARAMS_A_CALL = 100
METRICS_A_CALL = 1000
"""The most that MLflow takes."""
DIGITS = 9
"""Of a reported number: enough to compare runs, too few to show the last bits of another processor."""
FIRST_ANSWER_S = 5


class TrackingError(RuntimeError):
    """MLflow can't be used; the message is one line with the store's address."""


@dataclass(frozen=True)
class MetricLogger:
    """Sends figures at a step to one run, in one call.  Picklable, so that a worker process can use it."""

    tracking_uri: str
    run_id: str

    def __call__(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log figures at an epoch or environment step; those that are not finite are left out.

        Raises TrackingError if the store does not take them.
        """
        now = round(time.time() * 1000)
        entity = _mlflow().entities.Metric
        batch = [entity(name, float(value), now, step) for name, value in metrics.items() if math.isfinite(value)]
        with _explained(self.tracking_uri):
            for first in range(0, len(batch), METRICS_A_CALL):
                _client(self.tracking_uri).log_batch(self.run_id, metrics=batch[first : first + METRICS_A_CALL])


@dataclass
class ChildRun:
    """One seed's run, sent to the process that works on the seed: it starts when entered there and ends when left.

    FINISHED, FAILED or KILLED, as the body ends.  A task that is run again on another worker makes another run.
    """

    tracking_uri: str
    experiment_id: str
    tags: Mapping[str, str]
    params: Mapping[str, Any]
    run_id: str = field(default="", init=False)

    def __enter__(self) -> Self:
        with _explained(self.tracking_uri):
            client = _client(self.tracking_uri)
            self.run_id = client.create_run(self.experiment_id, tags=dict(self.tags)).info.run_id
            _log_params(client, self.run_id, self.params)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with _explained(self.tracking_uri) if error is None else suppress(Exception):
            _client(self.tracking_uri).set_terminated(self.run_id, _status(error))

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Figures at an environment step."""
        MetricLogger(self.tracking_uri, self.run_id)(step, metrics)

    def artifact(self, file: Path) -> None:
        """Keep a copy of a file with the run."""
        _keep_copy(self.tracking_uri, self.run_id, file)


@dataclass(frozen=True)
class StageRun:
    """The run of one stage and matrix item."""

    tracking_uri: str
    experiment_id: str
    run_id: str
    tags: Mapping[str, str]
    children: list[str]
    """Names, in the order in which `child` was called."""

    def report(self, metrics: Mapping[str, Any], file: Path) -> None:
        """Write figures as JSON, the truth, and mirror the numbers among them under names joined by "/".

        metrics: nested records of numbers, texts and lists; lists are not mirrored.  Numbers get 9 digits, one that
        is not finite becomes null, keys are sorted: equal figures give equal bytes.
        """
        stable = _stable(metrics)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(
            json.dumps(stable, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False) + "\n", "utf-8"
        )
        flat = _flat(stable, "/").items()
        # MLflow takes no other characters in a metric's name
        numbers = {re.sub(r"[^\w\-. :/]", "_", k): value for k, value in flat if isinstance(value, int | float)}
        self.metric_logger()(0, numbers)

    def metric_logger(self) -> MetricLogger:
        """Where a training loop reports."""
        return MetricLogger(self.tracking_uri, self.run_id)

    def child(self, name: str, params: Mapping[str, Any]) -> ChildRun:
        """A run below this one, not yet started; its name must be new."""
        if name in self.children:
            raise ValueError(f"there is already a child run {name!r}")
        self.children.append(name)
        tags = {**self.tags, "mlflow.runName": f"{self.tags['item']} {name}", "child": name}
        return ChildRun(self.tracking_uri, self.experiment_id, tags | {"mlflow.parentRunId": self.run_id}, params)

    def summarise(self, figures: Sequence[Mapping[str, float]]) -> None:
        """Log the children's final figures, in their order: each on its child, mean and spread on this run.

        `final/<name>` on the child; `seeds/<name>_mean`, `_std` (over the seeds at hand: divided by their number) and
        `_count` on this run, of the seeds whose figure is finite.
        """
        run_ids = {run.data.tags["child"]: run.info.run_id for run in _children(self)}
        for name, row in zip(self.children, figures, strict=True):
            final = {f"final/{key}": value for key, value in row.items()}
            MetricLogger(self.tracking_uri, run_ids[name])(0, final)
        self.metric_logger()(0, _spread(figures))

    def figure(self, file: Path) -> None:
        """Keep a copy of a figure with the run."""
        _keep_copy(self.tracking_uri, self.run_id, file, "figures")


@contextmanager
def tracked_stage(
    stage: str,
    item: str,
    params: BaseModel | Mapping[str, Any],
    inputs: Sequence[Path],
    *,
    experiment: str,
    root: Path,
    tags: Mapping[str, str] | None = None,
) -> Iterator[StageRun]:
    """A run for the time of the stage: FINISHED, FAILED or KILLED, as the body ends; its children end with it.

    params: what the stage was asked, flattened to names joined by ".".  inputs: files and folders it reads, linked by
    DVC's MD5.  tags: what else to find the run by, for example its constraint and manifold.
    Raises TrackingError, one line, before any work: an input is missing, or the store can't be reached.
    """
    uri = tracking_uri(root)
    own_tags = {"stage": stage, "item": item, **(tags or {}), **_source_tags(root)}
    for file in inputs:
        if not file.exists():
            raise TrackingError(f"{stage} {item}: its input {file} does not exist")
    with _explained(uri):
        client, experiment_id = _open_store(uri, experiment)
        run_id = client.create_run(experiment_id, tags={**own_tags, "mlflow.runName": f"{stage} {item}"}).info.run_id
    run = StageRun(uri, experiment_id, run_id, own_tags, [])
    try:
        with _explained(uri):
            _log_params(client, run_id, params)
            client.log_inputs(run_id, [_dataset(file, root) for file in inputs])
        yield run
    except BaseException as error:
        with suppress(Exception):  # the body's error is the one to see
            _end(run, _status(error))
        raise
    with _explained(uri):
        _end(run, "FINISHED")


def tracking_uri(root: Path) -> str:
    """MLFLOW_TRACKING_URI, or the SQLite file at the root of the checkout; never relative."""
    uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{root / 'mlflow.db'}"
    file = _sqlite_file(uri)
    return uri if file is None or file.is_absolute() else f"sqlite:///{file.resolve()}"


def ui_command(root: Path, port: int) -> list[str]:
    """The command that opens the dashboard, for this machine only.

    Raises TrackingError if the runs are on a server, which has a dashboard of its own.
    """
    uri = tracking_uri(root)
    if uri.startswith("http"):
        raise TrackingError(f"MLFLOW_TRACKING_URI={uri}: this server shows its runs itself, open it in a browser")
    database = _sqlite_file(uri)
    artifacts = _artifact_folder(database) if database else root.resolve() / "mlartifacts"
    # the job runner serves language models; without it the dashboard starts and stops in half the time
    quiet = ["env", "MLFLOW_DISABLE_TELEMETRY=true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"]
    server = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    return [*quiet, *server, "--backend-store-uri", uri, "--artifacts-destination", str(artifacts)]


@contextmanager
def fetch_artifacts(address: str, root: Path = Path()) -> Iterator[Path]:
    """A folder with the files behind an MLflow address (models:/… or runs:/…), gone when the context ends.

    Raises TrackingError if there is no such model or run, or the store can't be reached.
    """
    mlflow = _mlflow()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = mlflow.artifacts.download_artifacts(
                artifact_uri=address, dst_path=folder, tracking_uri=tracking_uri(root)
            )
        except (mlflow.exceptions.MlflowException, OSError) as error:
            raise TrackingError(f"{address}: {' '.join(str(error).split())[:200]}") from None
        yield Path(found)


def _mlflow() -> ModuleType:
    """MLflow, imported with the first run (1.3 s): without usage reports to its makers, notes and links."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    import mlflow
    import mlflow.entities

    return mlflow


def _client(uri: str) -> "MlflowClient":
    return _mlflow().MlflowClient(uri)


@contextmanager
def _explained(uri: str) -> Iterator[None]:
    """Every way in which a store fails, as one line."""
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (_mlflow().MlflowException, SQLAlchemyError, OSError, ImportError) as error:
        message = f"MLflow store {uri}: {' '.join(str(error).split())[:300]}"
        raise TrackingError(re.sub(r"//[^/@]*@", "//", message)) from error  # an address may hold a password


def _open_store(uri: str, experiment: str) -> tuple["MlflowClient", str]:
    """A client whose store exists, and the experiment in it: processes that create one database at once would fail."""
    database = _sqlite_file(uri)
    lock: AbstractContextManager[Any] = nullcontext()
    if database is not None:
        database.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(f"{database}.lock")
    with lock, _impatient():
        if not uri.startswith("http"):
            _check_database(uri)
        client = _client(uri)
        return client, _experiment(client, experiment, database is not None)


def _check_database(uri: str) -> None:
    """MLflow tries a database that it can't open again and again, for minutes."""
    import sqlalchemy

    if urlsplit(uri).scheme.partition("+")[0] in ("sqlite", "postgresql", "mysql", "mssql"):
        engine = sqlalchemy.create_engine(uri)
        sqlalchemy.inspect(engine)
        engine.dispose()


@contextmanager
def _impatient() -> Iterator[None]:
    """For the first call alone: MLflow waits minutes for a server that does not answer."""
    wanted = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": str(FIRST_ANSWER_S)}
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _experiment(client: "MlflowClient", name: str, in_sqlite: bool) -> str:
    found = client.get_experiment_by_name(name)
    if found is None:
        location = f"mlflow-artifacts:/{re.sub(r'[^A-Za-z0-9_-]+', '_', name)}" if in_sqlite else None
        return str(client.create_experiment(name, artifact_location=location))
    return str(found.experiment_id)


def _sqlite_file(uri: str) -> Path | None:
    dialect, _, rest = uri.partition(":///")
    return Path(rest.partition("?")[0]) if dialect.partition("+")[0] == "sqlite" and rest else None


def _artifact_folder(database: Path) -> Path:
    return database.parent / "mlartifacts"


def _keep_copy(uri: str, run_id: str, file: Path, folder: str | None = None) -> None:
    with _explained(uri):
        client = _client(uri)
        address, database = client.get_run(run_id).info.artifact_uri, _sqlite_file(uri)
        if database is None or not address.startswith("mlflow-artifacts:"):
            client.log_artifact(run_id, str(file), folder)
            return
        # where the dashboard's server will look; MLflow itself would need that server now
        target = _artifact_folder(database) / urlsplit(address).path.lstrip("/") / (folder or "")
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, target)


def _log_params(client: "MlflowClient", run_id: str, params: BaseModel | Mapping[str, Any]) -> None:
    entity = _mlflow().entities.Param
    batch = [entity(name, _text(value)) for name, value in _flat(_stored(params), ".").items()]
    for first in range(0, len(batch), PARAMS_A_CALL):
        client.log_batch(run_id, params=batch[first : first + PARAMS_A_CALL])


def _stored(params: Any) -> Any:
    if isinstance(params, BaseModel):
        return params.model_dump(mode="json")
    return {str(name): _stored(value) for name, value in params.items()} if isinstance(params, Mapping) else params


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


def _dataset(file: Path, root: Path) -> "DatasetInput":
    """An input under its path in the checkout.

    The digest is computed from what the stage is about to read, by DVC's rule, not looked up in dvc.lock: so it is
    also right while DVC has not written the lock yet, for a file inside an output folder, and for a stage run by hand.
    """
    entities, path = _mlflow().entities, file.resolve()
    name = path.relative_to(root.resolve()).as_posix() if path.is_relative_to(root.resolve()) else path.as_posix()
    dataset = entities.Dataset(name, dvc_md5(path), "local", json.dumps({"uri": name}))
    return entities.DatasetInput(dataset, [entities.InputTag("mlflow.data.context", "input")])


def dvc_md5(path: Path) -> str:
    """DVC's name of a file's or folder's content: the MD5 of its bytes, or of its list of files with `.dir` behind."""
    if path.is_dir():
        files = sorted(entry.relative_to(path).as_posix() for entry in path.rglob("*") if entry.is_file())
        listed = [{"md5": dvc_md5(path / name), "relpath": name} for name in files]
        return hashlib.md5(json.dumps(listed, sort_keys=True).encode()).hexdigest() + ".dir"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "md5").hexdigest()


def _source_tags(root: Path) -> dict[str, str]:
    """The commit the stage runs from, whether its sources differ from it, and DVC's name of the stage."""
    tags = {"dvc_stage": os.environ["DVC_STAGE"]} if "DVC_STAGE" in os.environ else {}
    commit = _git(root, "rev-parse", "HEAD")
    if commit:
        # what a pipeline itself writes while it runs makes no commit dirty
        changed = _git(root, "status", "--porcelain", "--", ".", ":!dvc.lock", ":!reports")
        tags |= {"git_commit": commit, "mlflow.source.git.commit": commit, "git_dirty": str(bool(changed)).lower()}
    return tags


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""


def _children(run: StageRun) -> list[Any]:
    """Oldest first, so that the last run of one name is the one that counts."""
    query = f"tags.`mlflow.parentRunId` = '{run.run_id}'"
    found = _client(run.tracking_uri).search_runs([run.experiment_id], query, order_by=["attributes.start_time ASC"])
    return list(found)


def _end(run: StageRun, status: str) -> None:
    """End a run, and what workers that died left running below it."""
    client = _client(run.tracking_uri)
    if run.children:
        for child in _children(run):
            if child.info.status == "RUNNING":
                client.set_terminated(child.info.run_id, "KILLED" if status == "FINISHED" else status)
    client.set_terminated(run.run_id, status)


def _status(error: BaseException | None) -> str:
    if error is None:
        return "FINISHED"
    return "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED"


def _spread(figures: Sequence[Mapping[str, float]]) -> dict[str, float]:
    spread: dict[str, float] = {}
    for name in figures[0]:
        values = [float(row[name]) for row in figures if math.isfinite(row[name])]
        spread[f"seeds/{name}_count"] = len(values)
        if values:
            spread |= {f"seeds/{name}_mean": fmean(values), f"seeds/{name}_std": pstdev(values)}
    return spread


def _flat(values: Mapping[str, Any], joint: str, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        flat |= _flat(value, joint, f"{prefix}{name}{joint}") if nested else {f"{prefix}{name}": value}
    return flat


def _stable(value: Any) -> Any:
    """Plain JSON values; arrays and their scalars become lists and numbers."""
    if isinstance(value, Mapping):
        return {str(name): _stable(entry) for name, entry in value.items()}
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, list | tuple):
        return [_stable(entry) for entry in plain]
    if isinstance(plain, float):
        return float(f"{plain:.{DIGITS}g}") + 0.0 if math.isfinite(plain) else None
    return plain
