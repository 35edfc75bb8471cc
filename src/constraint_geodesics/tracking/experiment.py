"""Runs in MLflow: one parent run a stage and matrix item, one child a seed.  The importer of
mlflow, with registry.py.

The JSON and CSV files under reports/ are the truth; MLflow mirrors them.  Only MLflow's low-level
client is used: it has no active run that could be shared by accident, prints nothing, and sends a
report in one call.

Runs are in `mlflow.db` at the root of the checkout and their files in `mlartifacts/` beside it, or
in the store that MLFLOW_TRACKING_URI names.  In an SQLite store a run knows its files as
`mlflow-artifacts:/…`, an address without a folder, which the dashboard's server looks up in its own
`mlartifacts/`: no server is needed while a stage runs, and a checkout that was moved keeps its
figures.  MLflow's client can't download such files without the server; they lie in
`mlartifacts/<experiment>/<run id>/artifacts/`.
"""

import hashlib
import json
import logging
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

from constraint_geodesics.params import Params, RewardParams

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import DatasetInput

LONGEST_VALUE = 6000
PARAMS_A_CALL = 100
METRICS_A_CALL = 1000
"""The most that MLflow takes."""
DIGITS = 9
"""Of a reported number: enough to compare runs, too few to show the last bits of another processor.
"""
FIRST_ANSWER_S = 5
SYSTEM_EVERY_S = 5.0
"""How often processor, memory, disk and network are logged while a stage runs."""
PLANNER_MODEL = "constraint_geodesics"
"""The registered planner's name."""
CHAMPION = "champion"
"""The alias of the version that people load."""


class TrackingError(RuntimeError):
    """MLflow can't be used; the message is one line with the store's address."""


@dataclass(frozen=True)
class Subject:
    """What a stage works on: tags by which its runs are found, and parameters by which they are
    compared.
    """

    tags: Mapping[str, str] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)


def subject_of(
    params: Params,
    *,
    constraint: str | None = None,
    manifold: str | None = None,
    reward: RewardParams | None = None,
) -> Subject:
    """The names of constraint, manifold and reward as tags; their entries in params.yaml as
    `constraint.*` and `manifold.*`.

    A reward has no name: its tag is what it is made of, eq. 15.
    """
    names = {
        "constraint": constraint,
        "manifold": manifold,
        "reward": None if reward is None else _in_short(reward),
    }
    values = {
        "constraint": None if constraint is None else params.constraints[constraint],
        "manifold": params.manifolds.get(manifold or ""),  # an analytic one is in no file
    }
    return Subject(
        {name: text for name, text in names.items() if text is not None},
        {name: value for name, value in values.items() if value is not None},
    )


def _in_short(reward: RewardParams) -> str:
    weights = f"K_L={reward.length_weight:g} K_Δ={reward.reduction_weight:g}"
    return f"{reward.form} b={reward.b:g} c={reward.c:g} {weights}"


@dataclass(frozen=True)
class MetricLogger:
    """Sends figures at a step to one run, in one call.  Picklable, so that a worker process can use
    it.
    """

    tracking_uri: str
    run_id: str

    def __call__(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log figures at an epoch or environment step; those that are not finite are left out.

        Raises TrackingError if the store does not take them.
        """
        now = round(time.time() * 1000)
        entity = mlflow_module().entities.Metric
        batch = [
            entity(name, float(value), now, step)
            for name, value in metrics.items()
            if math.isfinite(value)
        ]
        with explained(self.tracking_uri):
            for first in range(0, len(batch), METRICS_A_CALL):
                client_of(self.tracking_uri).log_batch(
                    self.run_id, metrics=batch[first : first + METRICS_A_CALL]
                )


@dataclass
class ChildRun:
    """One seed's run, sent to the process that works on the seed: it starts when entered there and
    ends when left.

    FINISHED, FAILED or KILLED, as the body ends.  A task that is run again on another worker makes
    another run.
    """

    tracking_uri: str
    experiment_id: str
    tags: Mapping[str, str]
    params: Mapping[str, Any]
    run_id: str = field(default="", init=False)

    def __enter__(self) -> Self:
        with explained(self.tracking_uri):
            client = client_of(self.tracking_uri)
            self.run_id = client.create_run(self.experiment_id, tags=dict(self.tags)).info.run_id
            _log_params(client, self.run_id, self.params)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with explained(self.tracking_uri) if error is None else suppress(Exception):
            client_of(self.tracking_uri).set_terminated(self.run_id, _status(error))

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
    params: Mapping[str, Any]
    children: list[str]
    """Names, in the order in which `child` was called."""

    def report(self, metrics: Mapping[str, Any], file: Path) -> None:
        """Write figures as JSON, the truth, and mirror the numbers among them under names joined by
        "/".

        metrics: nested records of numbers, texts and lists; lists are not mirrored.  Numbers get 9
        digits, one that is not finite becomes null, keys are sorted: equal figures give equal
        bytes.
        """
        stable = _stable(metrics)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(
            json.dumps(stable, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False)
            + "\n",
            "utf-8",
        )
        flat = _flat(stable, "/").items()
        # MLflow takes no other characters in a metric's name
        numbers = {
            re.sub(r"[^\w\-. :/]", "_", k): value
            for k, value in flat
            if isinstance(value, int | float)
        }
        self.metric_logger()(0, numbers)
        _keep_copy(self.tracking_uri, self.run_id, file, "reports")

    def metric_logger(self) -> MetricLogger:
        """Where a training loop reports."""
        return MetricLogger(self.tracking_uri, self.run_id)

    def child(self, name: str, params: Mapping[str, Any]) -> ChildRun:
        """A run below this one, not yet started; its name must be new.

        params: what sets it apart, as tags and as parameters; those of this run are its own as
        well, so that children of different runs can be compared.
        """
        if name in self.children:
            raise ValueError(f"there is already a child run {name!r}")
        self.children.append(name)
        tags = {**self.tags, **{key: str(value) for key, value in params.items()}, "child": name}
        tags |= {
            "mlflow.runName": _named(f"{self.tags['item']} {name}", self.tags),
            "mlflow.parentRunId": self.run_id,
        }
        return ChildRun(self.tracking_uri, self.experiment_id, tags, {**self.params, **params})

    def summarise(
        self,
        figures: Sequence[Mapping[str, float]],
        curves: Sequence[Sequence[Mapping[str, float]]] = (),
    ) -> None:
        """Log the children's final figures, in their order: each on its child, mean and spread on
        this run.

        `final/<name>` on the child; `seeds/<name>_mean`, `_std` (over the seeds at hand: divided by
        their number) and `_count` on this run, of the seeds whose figure is finite.

        curves: each child's figures over its `steps`, which it has logged itself; their mean and
        spread at each step that all of them have is logged on this run, as a learning curve.
        """
        run_ids = self._child_ids()
        for name, row in zip(self.children, figures, strict=True):
            final = {f"final/{key}": value for key, value in row.items()}
            MetricLogger(self.tracking_uri, run_ids[name])(0, final)
        self.metric_logger()(0, _spread(figures))
        for step, rows in _together(curves):
            self.metric_logger()(
                step, {n: v for n, v in _spread(rows).items() if not n.endswith("_count")}
            )

    def recordings(self, rows: Sequence[Mapping[str, Any]], shown: str = "") -> None:
        """Tell where paths are recorded: all of them in a file of this run and in its description;
        on each child, as the tag `recording`, the first one of its seed whose planner is `shown`.

        rows: with planner, query, seed, length_rad and recording, which is empty where there is
        none.
        """
        recorded = [row for row in rows if row["recording"]]
        if not recorded:
            return
        lines = [
            f"- {row['planner']}, query {row['query']}, seed {row['seed']}, "
            f"{row['length_rad']:.3f} rad: "
            f"`geodesics replay {row['recording']}`"
            for row in recorded
        ]
        run_ids = self._child_ids() if self.children else {}
        with explained(self.tracking_uri):
            client = client_of(self.tracking_uri)
            note = client.get_run(self.run_id).data.tags.get("mlflow.note.content", "")
            client.set_tag(
                self.run_id, "mlflow.note.content", "\n".join([note, "", "Recordings:", "", *lines])
            )
            for name, run_id in run_ids.items():
                own = [r for r in recorded if r["planner"] == shown and name == f"seed {r['seed']}"]
                if own:
                    client.set_tag(run_id, "recording", str(own[0]["recording"]))
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "recordings.md"
            file.write_text("\n".join(lines) + "\n")
            _keep_copy(self.tracking_uri, self.run_id, file)

    def _child_ids(self) -> dict[str, str]:
        return {run.data.tags["child"]: run.info.run_id for run in _children(self)}

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
    subject: Subject = Subject(),
) -> Iterator[StageRun]:
    """A run for the time of the stage: FINISHED, FAILED or KILLED, as the body ends; its children
    end with it.

    params: what the stage was asked, flattened to names joined by ".".  inputs: files and folders
    it reads, linked by DVC's MD5.  subject: what else to find the run and compare it by, as
    `subject_of` makes it. What the machine does meanwhile is logged as `system/...`, every 5 s.
    Raises TrackingError, one line, before any work: an input is missing, or the store can't be
    reached.
    """
    uri = tracking_uri(root)
    own_tags = {"stage": stage, "item": item, **subject.tags, **_source_tags(root)}
    own_params = {**_stored(params), **_stored(subject.params)}
    for file in inputs:
        if not file.exists():
            raise TrackingError(f"{stage} {item}: its input {file} does not exist")
    with explained(uri):
        client, experiment_id = _open_store(uri, experiment)
        shown = {
            "mlflow.runName": _named(f"{stage} {item}", own_tags),
            "mlflow.note.content": _note(stage, own_tags),
        }
        run_id = client.create_run(experiment_id, tags={**own_tags, **shown}).info.run_id
    run = StageRun(uri, experiment_id, run_id, own_tags, own_params, [])
    try:
        with explained(uri):
            _log_params(client, run_id, own_params)
            client.log_inputs(run_id, [_dataset(file, root) for file in inputs])
        with _system_metrics(uri, run_id):
            yield run
    except BaseException as error:
        with suppress(Exception):  # the body's error is the one to see
            _end(run, _status(error))
        raise
    with explained(uri):
        _end(run, "FINISHED")


@contextmanager
def _system_metrics(uri: str, run_id: str) -> Iterator[None]:
    mlflow_module()
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    logging.getLogger(SystemMetricsMonitor.__module__).setLevel(
        logging.WARNING
    )  # it tells of every start and end
    monitor = SystemMetricsMonitor(run_id, SYSTEM_EVERY_S, tracking_uri=uri)
    monitor.start()
    try:
        yield
    finally:
        monitor.finish()


def _named(name: str, tags: Mapping[str, str]) -> str:
    """A run's name; a run of an experiment is told from those of the pipeline by the experiment's
    name.
    """
    return f"{name} ({tags['dvc_experiment']})" if "dvc_experiment" in tags else name


def _note(stage: str, tags: Mapping[str, str]) -> str:
    again = (
        f"`dvc repro --single-item --force {tags['dvc_stage']}`"
        if "dvc_stage" in tags
        else f"`stages/{stage}.py`"
    )
    return f"Made by {again}; its figures are under `reports/{stage}/`."


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
        raise TrackingError(
            f"MLFLOW_TRACKING_URI={_without_password(uri)}: this server shows its runs "
            f"itself, open it in a browser"
        )
    database = _sqlite_file(uri)
    artifacts = _artifact_folder(database) if database else root.resolve() / "mlartifacts"
    # the job runner serves language models; without it the dashboard starts and stops in half the
    # time
    quiet = ["env", "MLFLOW_DISABLE_TELEMETRY=true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"]
    server = [
        sys.executable,
        "-m",
        "mlflow",
        "server",
        "--host",
        "127.0.0.1",
        "--port",
        str(port),
        "--workers",
        "1",
    ]
    return [*quiet, *server, "--backend-store-uri", uri, "--artifacts-destination", str(artifacts)]


@contextmanager
def fetch_artifacts(address: str, root: Path = Path()) -> Iterator[Path]:
    """A folder with the files behind an MLflow address (models:/… or runs:/…), gone when the
    context ends; of a model that holds a planner's files, these.

    Raises TrackingError if there is no such model or run, or the store can't be reached.
    """
    mlflow, uri = mlflow_module(), tracking_uri(root)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = _beside_store(uri, address)
            if found is None:
                fetched = mlflow.artifacts.download_artifacts(
                    artifact_uri=address, dst_path=folder, tracking_uri=uri, registry_uri=uri
                )
                found = Path(fetched)
        except (mlflow.exceptions.MlflowException, OSError) as error:
            raise TrackingError(f"{address}: {' '.join(str(error).split())[:200]}") from None
        own = found / "artifacts" / "planner"
        yield own if (found / "MLmodel").is_file() and own.is_dir() else found


def _beside_store(uri: str, address: str) -> Path | None:
    """Where files that only the dashboard's server could send lie beside an SQLite store, or None
    for all others.
    """
    database = _sqlite_file(uri)
    if database is None:
        return None
    source = _stored_at(uri, address)
    if not source.startswith("mlflow-artifacts:"):
        return None
    place = _artifact_folder(database) / urlsplit(source).path.lstrip("/")
    if not place.exists():
        raise FileNotFoundError(f"its files are missing in {place}")
    return place


def _stored_at(uri: str, address: str) -> str:
    client = client_of(uri)
    if address.startswith("models:"):
        from mlflow.store.artifact.utils.models import get_model_name_and_version

        return str(
            client.get_model_version_download_uri(*get_model_name_and_version(client, address))
        )
    run_id, _, path = address.removeprefix("runs:/").partition("/")
    return (
        f"{client.get_run(run_id).info.artifact_uri}/{path}"
        if address.startswith("runs:")
        else address
    )


def mlflow_module() -> ModuleType:
    """MLflow, imported with the first run (1.3 s): without usage reports to its makers, notes and
    links.
    """
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
    os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    import mlflow
    import mlflow.entities

    return mlflow


def client_of(uri: str) -> "MlflowClient":
    """MLflow's low-level client of a store."""
    return mlflow_module().MlflowClient(uri)


@contextmanager
def explained(uri: str) -> Iterator[None]:
    """Every way in which a store fails, as a TrackingError of one line."""
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (mlflow_module().MlflowException, SQLAlchemyError, OSError, ImportError) as error:
        message = f"MLflow store {uri}: {' '.join(str(error).split())[:300]}"
        raise TrackingError(_without_password(message)) from error


def _without_password(text: str) -> str:
    return re.sub(r"//[^/@]*@", "//", text)


def _open_store(uri: str, experiment: str) -> tuple["MlflowClient", str]:
    """A client whose store exists, and the experiment in it: processes that create one database at
    once would fail.
    """
    database = _sqlite_file(uri)
    lock: AbstractContextManager[Any] = nullcontext()
    if database is not None:
        database.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(f"{database}.lock")
    with lock, _impatient():
        if not uri.startswith("http"):
            _check_database(uri)
        client = client_of(uri)
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
    wanted = {
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
        "MLFLOW_HTTP_REQUEST_TIMEOUT": str(FIRST_ANSWER_S),
    }
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
        location = (
            f"mlflow-artifacts:/{re.sub(r'[^A-Za-z0-9_-]+', '_', name)}" if in_sqlite else None
        )
        return str(client.create_experiment(name, artifact_location=location))
    return str(found.experiment_id)


def _sqlite_file(uri: str) -> Path | None:
    dialect, _, rest = uri.partition(":///")
    return Path(rest.partition("?")[0]) if dialect.partition("+")[0] == "sqlite" and rest else None


def _artifact_folder(database: Path) -> Path:
    return database.parent / "mlartifacts"


def _keep_copy(uri: str, run_id: str, file: Path, folder: str | None = None) -> None:
    with explained(uri):
        client, target = client_of(uri), _own_folder(uri, run_id)
        if target is None:
            client.log_artifact(run_id, str(file), folder)
            return
        (target / (folder or "")).mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, target / (folder or ""))


def keep_folder(uri: str, run_id: str, folder: Path, name: str) -> str:
    """Keep a copy of a folder with a run, under a name; returns its address."""
    with explained(uri):
        client, target = client_of(uri), _own_folder(uri, run_id)
        if target is None:
            client.log_artifacts(run_id, str(folder), name)
        else:
            shutil.copytree(folder, target / name, dirs_exist_ok=True)
        return f"{client.get_run(run_id).info.artifact_uri}/{name}"


def _own_folder(uri: str, run_id: str) -> Path | None:
    """Where the dashboard's server will look for a run's files beside an SQLite store; MLflow
    itself would need that server now.  None for other stores.
    """
    address, database = client_of(uri).get_run(run_id).info.artifact_uri, _sqlite_file(uri)
    if database is None or not address.startswith("mlflow-artifacts:"):
        return None
    return _artifact_folder(database) / urlsplit(address).path.lstrip("/")


def _log_params(client: "MlflowClient", run_id: str, params: BaseModel | Mapping[str, Any]) -> None:
    entity = mlflow_module().entities.Param
    batch = [entity(name, _text(value)) for name, value in _flat(_stored(params), ".").items()]
    for first in range(0, len(batch), PARAMS_A_CALL):
        client.log_batch(run_id, params=batch[first : first + PARAMS_A_CALL])


def _stored(params: Any) -> Any:
    if isinstance(params, BaseModel):
        return params.model_dump(mode="json")
    return (
        {str(name): _stored(value) for name, value in params.items()}
        if isinstance(params, Mapping)
        else params
    )


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


def _dataset(file: Path, root: Path) -> "DatasetInput":
    """An input under its path in the checkout.

    The digest is computed from what the stage is about to read, by DVC's rule, not looked up in
    dvc.lock: so it is also right while DVC has not written the lock yet, for a file inside an
    output folder, and for a stage run by hand.
    """
    entities, path = mlflow_module().entities, file.resolve()
    name = (
        path.relative_to(root.resolve()).as_posix()
        if path.is_relative_to(root.resolve())
        else path.as_posix()
    )
    dataset = entities.Dataset(name, dvc_md5(path), "local", json.dumps({"uri": name}))
    return entities.DatasetInput(dataset, [entities.InputTag("mlflow.data.context", "input")])


def dvc_md5(path: Path) -> str:
    """DVC's name of a file's or folder's content: the MD5 of its bytes, or of its list of files
    with `.dir` behind.
    """
    if path.is_dir():
        files = sorted(
            entry.relative_to(path).as_posix() for entry in path.rglob("*") if entry.is_file()
        )
        listed = [{"md5": dvc_md5(path / name), "relpath": name} for name in files]
        return hashlib.md5(json.dumps(listed, sort_keys=True).encode()).hexdigest() + ".dir"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "md5").hexdigest()


def _source_tags(root: Path) -> dict[str, str]:
    """The commit the stage runs from, whether its sources differ from it, and DVC's names of stage
    and experiment.
    """
    known = {"dvc_stage": "DVC_STAGE", "dvc_experiment": "DVC_EXP_NAME"}
    tags = {tag: os.environ[name] for tag, name in known.items() if os.environ.get(name)}
    commit = _git(root, "rev-parse", "HEAD")
    if commit:
        # what a pipeline itself writes while it runs makes no commit dirty
        changed = _git(root, "status", "--porcelain", "--", ".", ":!dvc.lock", ":!reports")
        tags |= {
            "git_commit": commit,
            "mlflow.source.git.commit": commit,
            "git_dirty": str(bool(changed)).lower(),
        }
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
    found = client_of(run.tracking_uri).search_runs(
        [run.experiment_id], query, order_by=["attributes.start_time ASC"]
    )
    return list(found)


def _end(run: StageRun, status: str) -> None:
    """End a run, and what workers that died left running below it."""
    client = client_of(run.tracking_uri)
    if run.children:
        for child in _children(run):
            if child.info.status == "RUNNING":
                client.set_terminated(
                    child.info.run_id, "KILLED" if status == "FINISHED" else status
                )
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


def _together(
    curves: Sequence[Sequence[Mapping[str, float]]],
) -> list[tuple[int, list[dict[str, float]]]]:
    """The rows of all curves at each of their common steps."""
    by_step = [{int(row["steps"]): row for row in curve} for curve in curves]
    common = sorted(set.intersection(*map(set, by_step))) if by_step else []
    return [
        (step, [{n: v for n, v in rows[step].items() if n != "steps"} for rows in by_step])
        for step in common
    ]


def _flat(values: Mapping[str, Any], joint: str, prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, Mapping)
        flat |= (
            _flat(value, joint, f"{prefix}{name}{joint}") if nested else {f"{prefix}{name}": value}
        )
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
