"""The MLflow store that runs are written to: its address, its client, and files kept with a run.

Runs are in `mlflow.db` at the root of the checkout and their files in `mlartifacts/` beside it, or
in the store that MLFLOW_TRACKING_URI names.  In an SQLite store a run knows its files as
`mlflow-artifacts:/…`, an address without a folder, which the dashboard's server looks up in its own
`mlartifacts/`: no server is needed while a stage runs, and a checkout that was moved keeps its
figures.  MLflow's client can't download such files without the server; they lie in
`mlartifacts/<experiment>/<run id>/artifacts/`.

With experiment.py and registry.py the importer of mlflow.
"""

import errno
import hashlib
import json
import math
import os
import re
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from filelock import FileLock
from pydantic import BaseModel

from constraint_geodesics.pipeline.machine import git_says
from constraint_geodesics.tracking import views

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import DatasetInput, Experiment

LONGEST_VALUE = 6000
"""Characters of a parameter: the most that MLflow takes."""
DIGITS = 9
"""Of a reported number: enough to compare runs, too few to show the last bits of another processor.
"""
MOST_RUNS = 50_000
"""That MLflow names at once."""
FIRST_ANSWER_S = 15
LOOPBACK, DATABASE = "127.0.0.1", "mlflow.db"
PLANNER_MODEL, CHAMPION = "constraint_geodesics", "champion"
"""The registered planner's name, and the alias of the version that people load."""


REFUSED = ("INVALID_PARAMETER_VALUE", "RESOURCE_DOES_NOT_EXIST", "RESOURCE_ALREADY_EXISTS")
"""MLflow's codes of what it will not take another time either."""


class TrackingError(RuntimeError):
    """MLflow can't be used; the message is one line with the store's address.

    refused: the store is there and does not take what it was told.
    """

    def __init__(self, message: str, refused: bool = False) -> None:
        super().__init__(message)
        self.refused = refused


def tracking_uri(root: Path) -> str:
    """MLFLOW_TRACKING_URI, or the SQLite file at the root of the checkout; never relative."""
    uri = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{root / DATABASE}"
    file = _sqlite_file(uri)
    return uri if file is None or file.is_absolute() else f"sqlite:///{file.resolve()}"


def store_name(uri: str, root: Path) -> str:
    """A store's address without a password, and without the folder of its own checkout."""
    return _without_password(uri).replace(f"{root.resolve()}/", "")


def ui_command(root: Path, port: int) -> list[str]:
    """The command that serves the dashboard, for this machine only.

    root: a folder in or below the checkout.  Raises TrackingError if there is no store, or
    the runs are on a server, which has a dashboard of its own.
    """
    uri = _shown_store(root)
    database = _sqlite_file(uri)
    artifacts = _artifact_folder(database) if database else root.resolve() / "mlartifacts"
    # the job runner serves language models; without it the dashboard starts and stops in half the
    # time
    quiet = ["env", "MLFLOW_DISABLE_TELEMETRY=true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"]
    server = [
        sys.executable,
        *f"-m mlflow server --host {LOOPBACK} --port {port} --workers 1".split(),
    ]
    return [*quiet, *server, "--backend-store-uri", uri, "--artifacts-destination", str(artifacts)]


def runs_page(root: Path, port: int) -> str:
    """The address at which that dashboard compares the runs of the experiment that ran last: in
    the first view that finds any, as which stages ran decides which views have rows; all runs where
    none does, and the dashboard's first page where nothing ran yet.

    Raises TrackingError if the store can't be read.
    """
    uri, address = _shown_store(root), f"http://{LOOPBACK}:{port}"
    with explained(uri):
        check_database(uri)
        client = client_of(uri)
        known = {own.experiment_id: own for own in client.search_experiments()}
        order = ["attributes.start_time DESC"]
        last = client.search_runs([*known], order_by=order, max_results=1)
        if not last:
            return address
        number = last[0].info.experiment_id
        view = next((own for own in views.VIEWS if _finds(client, number, own.search)), None)
    with suppress(TrackingError), explained(uri):  # a store that can't be written is shown as it is
        _show(client, known[number])
    return views.page_of(address, number, view)


def _finds(client: "MlflowClient", experiment_id: str, search: str) -> bool:
    return bool(client.search_runs([experiment_id], search, max_results=1))


def _shown_store(root: Path) -> str:
    found = next((own for own in (root, *root.parents) if _has_store(own)), root)
    uri = tracking_uri(found)
    if uri.startswith("http"):
        raise TrackingError(
            f"MLFLOW_TRACKING_URI={_without_password(uri)}: this server shows its runs "
            f"itself, open it in a browser"
        )
    database = _sqlite_file(uri)
    if database is not None and not database.is_file():
        raise TrackingError(
            f"{database}: there are no runs here: go to a checkout, and `dvc repro`, or name a "
            f"store in MLFLOW_TRACKING_URI"
        )
    return uri


def _has_store(folder: Path) -> bool:
    return (folder / "params.yaml").is_file() and (folder / DATABASE).is_file()


def require_free(port: int, host: str = LOOPBACK) -> None:
    """Raises TrackingError where a server can't listen: one line that names the option to change,
    and a free port for one that is taken.
    """
    error = _refusal(port, host)
    if error is None:
        return
    if error.errno == errno.EADDRINUSE:
        free = _free_port(port, host)
        raise TrackingError(f"port {port} of {host} is taken: add --port {free}, which is free")
    option = f"--port {port}" if isinstance(error, PermissionError) else f"--host {host}"
    raise TrackingError(f"{option}: {error.strerror}")


def _refusal(port: int, host: str) -> OSError | None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the servers do
        try:
            probe.bind((host, port))
        except OSError as error:
            return error
    return None


def _free_port(above: int, host: str) -> int:
    """The first free one above a port, else any."""
    near = range(above + 1, min(above + 100, 65536))
    return next((port for port in near if _refusal(port, host) is None), 0) or _any_port(host)


def _any_port(host: str) -> int:
    with socket.socket() as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


@contextmanager
def fetch_artifacts(address: str, root: Path = Path()) -> Iterator[Path]:
    """A folder with the files behind an MLflow address (models:/… or runs:/…), gone when the
    context ends; of a model that holds a planner's files, these.

    Raises TrackingError if there is no such model or run, or the store can't be reached.
    """
    from sqlalchemy.exc import SQLAlchemyError

    mlflow, uri = mlflow_module(), tracking_uri(root)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = _beside_store(uri, address)
            if found is None:
                if urlsplit(uri).scheme in ("http", "https"):
                    with impatient():
                        client_of(uri).search_experiments(max_results=1)
                fetched = mlflow.artifacts.download_artifacts(
                    artifact_uri=address, dst_path=folder, tracking_uri=uri, registry_uri=uri
                )
                found = Path(fetched)
            elif not found.exists():
                raise FileNotFoundError(f"its files are missing in {found}")
        except SQLAlchemyError as error:
            line = f"{address}: MLflow store {_without_password(uri)}: {_said(error, 200)}"
            raise TrackingError(line) from None
        except (mlflow.exceptions.MlflowException, OSError) as error:
            raise TrackingError(f"{address}: {_said(error, 200)}") from None
        except ImportError as error:  # a kind of store that needs a library of its own
            raise TrackingError(f"{address}: {error}: install it") from None
        own = found / "artifacts" / "planner"
        yield own if (found / "MLmodel").is_file() and own.is_dir() else found


def _beside_store(uri: str, address: str) -> Path | None:
    """Where the dashboard's server looks for files beside an SQLite store; MLflow itself would need
    that server now.  None for all others.
    """
    database = _sqlite_file(uri)
    if database is not None and not database.is_file():  # MLflow would make one
        raise FileNotFoundError(f"there are no runs yet: {database} is missing")
    check_database(uri)
    source = "" if database is None else _stored_at(uri, address)
    if database is None or not source.startswith("mlflow-artifacts:"):
        return None
    kept = _artifact_folder(database)
    found = kept / urlsplit(source).path.lstrip("/")
    if not found.resolve().is_relative_to(kept.resolve()):
        raise TrackingError(f"{address}: leaves {kept}")
    return found


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
    os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "CRITICAL")
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
        message = f"MLflow store {_without_password(uri)}: {_said(error, 300)}"
        refused = getattr(error, "error_code", "") in REFUSED
        raise TrackingError(message, refused) from error


def _said(error: Exception, most: int) -> str:
    """In one line, without a password, of which a cut would leave a part."""
    return _without_password(" ".join(str(error).split()))[:most]


def _without_password(text: str) -> str:
    return re.sub(r"//[^/@]*@", "//", text)


def open_store(uri: str, experiment: str) -> tuple["MlflowClient", str]:
    """A client whose store exists, and the experiment in it: processes that create one database at
    once would fail.
    """
    database = _sqlite_file(uri)
    lock: AbstractContextManager[Any] = nullcontext()
    if database is not None:
        database.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(f"{database}.lock")
    with lock, impatient():
        check_database(uri)
        client = client_of(uri)
        return client, _experiment(client, experiment, database is not None)


def check_database(uri: str) -> None:
    """MLflow tries a database that it can't open again and again, for minutes.  Raises what
    SQLAlchemy does; does nothing for a store that is none.
    """
    import sqlalchemy

    if urlsplit(uri).scheme.partition("+")[0] in ("sqlite", "postgresql", "mysql", "mssql"):
        engine = sqlalchemy.create_engine(uri)
        sqlalchemy.inspect(engine)
        engine.dispose()


@contextmanager
def impatient(tries: int = 1, answer_s: int = FIRST_ANSWER_S) -> Iterator[None]:
    """MLflow itself waits minutes for a server that does not answer."""
    wanted = {
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": str(tries),
        "MLFLOW_HTTP_REQUEST_TIMEOUT": str(answer_s),
    }
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)  # another thread's block may have ended first


def _experiment(client: "MlflowClient", name: str, in_sqlite: bool) -> str:
    found = client.get_experiment_by_name(name)
    if found is None:
        folder = re.sub(r"[^A-Za-z0-9_-]+", "_", name)
        location = f"mlflow-artifacts:/{folder}" if in_sqlite else None
        return str(client.create_experiment(name, location, views.experiment_tags()))
    _show(client, found)
    return str(found.experiment_id)


def _show(client: "MlflowClient", experiment: "Experiment") -> None:
    """Give an experiment of an older version its description and its views."""
    for key, value in views.outdated(experiment.tags).items():
        client.set_experiment_tag(experiment.experiment_id, key, value)


def _sqlite_file(uri: str) -> Path | None:
    dialect, _, rest = uri.partition(":///")
    return Path(rest.partition("?")[0]) if dialect.partition("+")[0] == "sqlite" and rest else None


def _artifact_folder(database: Path) -> Path:
    return database.parent / "mlartifacts"


def keep_copy(uri: str, run_id: str, file: Path, folder: str | None = None) -> None:
    """Keep a copy of a file with a run."""
    with explained(uri):
        client, target = client_of(uri), _beside_store(uri, f"runs:/{run_id}")
        if target is None:
            client.log_artifact(run_id, str(file), folder)
            return
        (target / (folder or "")).mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, target / (folder or ""))


def keep_folder(uri: str, run_id: str, folder: Path, name: str) -> str:
    """Keep a copy of a folder with a run, under a name; returns its address."""
    with explained(uri):
        client, target = client_of(uri), _beside_store(uri, f"runs:/{run_id}")
        if target is None:
            client.log_artifacts(run_id, str(folder), name)
        else:
            shutil.copytree(folder, target / name, dirs_exist_ok=True)
        return f"{client.get_run(run_id).info.artifact_uri}/{name}"


def log_params(client: "MlflowClient", run_id: str, params: BaseModel | Mapping[str, Any]) -> None:
    """Parameters under names joined by "."; long texts are cut."""
    entity = mlflow_module().entities.Param
    batch = [entity(name, _text(value)) for name, value in flat(stored(params), ".").items()]
    client.log_batch(run_id, params=batch)


def stored(params: Any) -> Any:
    """Records as plain mappings."""
    if isinstance(params, BaseModel):
        return params.model_dump(mode="json")
    return (
        {str(name): stored(value) for name, value in params.items()}
        if isinstance(params, Mapping)
        else params
    )


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 1] + "…"


def dataset_of(file: Path, root: Path) -> "DatasetInput":
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


def source_tags(root: Path) -> dict[str, str]:
    """The commit the stage runs from, whether its sources differ from it, and DVC's names of stage
    and experiment.
    """
    known = {"dvc_stage": "DVC_STAGE", "dvc_experiment": "DVC_EXP_NAME"}
    tags = {tag: os.environ[name] for tag, name in known.items() if os.environ.get(name)}
    commit = git_says(root, "rev-parse", "HEAD")
    if commit:
        # what a pipeline itself writes while it runs makes no commit dirty
        written = (":!dvc.lock", ":!*/dvc.lock", ":!reports", ":!.geodesics")
        changed = git_says(root, "status", "--porcelain", "--", ".", *written)
        tags |= {
            "git_commit": commit,
            "mlflow.source.git.commit": commit,
            "git_dirty": str(bool(changed)).lower(),
        }
    return tags


def flat(values: Mapping[str, Any], joint: str) -> dict[str, Any]:
    """Nested mappings as one, their names joined."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            found |= {f"{name}{joint}{own}": v for own, v in flat(value, joint).items()}
        else:
            found[name] = value
    return found


def stable(value: Any) -> Any:
    """Plain JSON values; arrays and their scalars become lists and numbers."""
    if isinstance(value, Mapping):
        return {str(name): stable(entry) for name, entry in value.items()}
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, list | tuple):
        return [stable(entry) for entry in plain]
    if isinstance(plain, float):
        return float(f"{plain:.{DIGITS}g}") + 0.0 if math.isfinite(plain) else None
    return plain
