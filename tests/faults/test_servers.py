"""What several machines share: runs in an MLflow server on PostgreSQL, data in a DVC remote.

The servers are those that the system has; what is missing is named in the reason of the skip.
"""

import os
import pwd
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run

from constraint_geodesics import Planner
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.params import ComputeParams
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.tracking.experiment import ChildRun, Work, tracked_stage
from tests.faults.effort import Effort, counting
from tests.ports import free_port
from tests.tracking.test_experiment import git, server
from tests.tracking.test_registry import ADDRESS, QUERY, registered

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

TWO = ComputeParams(backend="loky", workers=2)
STARTS_S = 60


def require(programs: tuple[str, ...] = (), packages: tuple[str, ...] = ()) -> None:
    """Skip where something is not installed."""
    missing = [f"the program {own}" for own in programs if shutil.which(own) is None]
    missing += [f"the package {own}" for own in packages if find_spec(own) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")


def wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + STARTS_S
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError(f"{process.args}: does not answer on port {port}")


@contextmanager
def running(command: list[str], port: int, **options: object) -> Iterator[None]:
    """A server, from when its port answers."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, **quiet, **options)
    try:
        wait_for(port, process)
        yield
    finally:
        process.terminate()
        process.wait(30)


@contextmanager
def postgresql() -> Iterator[str]:
    """The address of a new database; PostgreSQL refuses to run as root, so then it is another's."""
    who = next((own for own in pwd.getpwall() if own.pw_name in ("postgres", "nobody")), None)
    as_other = {"user": who.pw_uid, "group": who.pw_gid} if who and os.getuid() == 0 else {}
    port = free_port()
    with tempfile.TemporaryDirectory() as folder:
        if as_other:
            os.chown(folder, as_other["user"], as_other["group"])
        made = ["initdb", "--pgdata", f"{folder}/db", "--username", "runs", "--auth", "trust"]
        subprocess.run(made, check=True, capture_output=True, cwd=folder, **as_other)
        command = ["postgres", "-D", f"{folder}/db", "-p", str(port), "-k", folder]
        with running([*command, "-h", "127.0.0.1"], port, cwd=folder, **as_other):
            yield f"postgresql+psycopg://runs@127.0.0.1:{port}/postgres"


def train(task: tuple[ChildRun, int]) -> dict[str, float]:
    child, seed = task
    with child as run:
        for step in range(5):
            run.log(step, {"loss": 1.0 / (1 + step + seed)})
    return {"length": float(seed)}


def test_runs_of_several_processes_and_a_model_in_a_server_on_postgresql(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, effort: Effort
) -> None:
    """With an artifact folder of the server's own, which no client sees."""
    require(("initdb", "postgres"), ("psycopg",))
    checkout, files = tmp_path / "checkout", tmp_path / "files"
    checkout.mkdir()
    (checkout / "figure.png").write_bytes(b"a figure")
    mlflow = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", "0"]
    with counting("mlflow_on_postgresql", effort) as row, ExitStack() as opened:
        database = opened.enter_context(postgresql())
        own = ["--backend-store-uri", database, "--artifacts-destination", str(files)]
        address = opened.enter_context(server([*mlflow, "--workers", "2", *own], "health"))
        monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
        with tracked_stage(Work("train", "cup", {"seeds": 8}), "shared", checkout) as stage:
            tasks = [(stage.child(f"seed {seed}", {"seed": seed}), seed) for seed in range(8)]
            stage.summarise(parallel_map(train, tasks, TWO), [])
            stage.figure(checkout / "figure.png")
        client = MlflowClient(address)
        (experiment,) = [own for own in client.search_experiments() if own.name == "shared"]
        runs = client.search_runs([experiment.experiment_id])
        row["runs"] = len(tasks) + 1
        row["lost"] = row["runs"] - sum(_is_whole(client, run) for run in runs)
        assert (len(runs), row["lost"]) == (9, 0)
        (figure,) = files.rglob("figure.png")
        assert figure.read_bytes() == b"a figure"
        registered(checkout, PACKAGED)
        monkeypatch.chdir(checkout)
        with Planner.load(ADDRESS) as planner:
            path = planner.plan(QUERY["start"], QUERY["goal"], "level_cup")
        assert path.status == "solved"
        assert not (checkout / "mlflow.db").exists()


def _is_whole(client: MlflowClient, run: Run) -> bool:
    """Whether a run is finished, and that of a seed has all that it reported."""
    seed = run.data.params.get("seed")
    steps = range(5) if seed is not None else ()
    wanted = [1.0 / (1 + step + int(seed)) for step in steps]
    history = client.get_metric_history(run.info.run_id, "loss") if seed is not None else []
    return run.info.status == "FINISHED" and [point.value for point in history] == wanted


def dvc(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "dvc", *arguments]
    keys = dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "test")
    environment = os.environ | keys | {"AWS_DEFAULT_REGION": "us-east-1", "DVC_NO_ANALYTICS": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextmanager
def remote(kind: str, folder: Path) -> Iterator[list[tuple[str, ...]]]:
    """The commands, after `dvc remote`, that name it."""
    if kind == "local":
        yield [("add", "--default", "shared", str(folder))]
        return
    port = free_port()
    with running(["moto_server", "-H", "127.0.0.1", "-p", str(port)], port):
        address = f"http://127.0.0.1:{port}"
        urllib.request.urlopen(urllib.request.Request(f"{address}/bucket", method="PUT"))
        yield [
            ("add", "--default", "shared", "s3://bucket/data"),
            ("modify", "shared", "endpointurl", address),
        ]


@pytest.mark.parametrize("kind", ["local", "s3"])
def test_another_checkout_has_the_data_from_the_remote_and_nothing_to_do(
    kind: str, tmp_path: Path, effort: Effort
) -> None:
    if kind == "s3":
        require(("moto_server",), ("dvc_s3",))
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    (ours / "dvc.yaml").write_text(
        "stages:\n  draw:\n    cmd: seq 1 100000 > rows.csv\n    outs: [rows.csv]\n"
    )
    with counting(f"dvc_remote_{kind}", effort) as row:
        git(ours, "init", "--quiet")
        dvc(ours, "init", "--quiet")
        with remote(kind, tmp_path / "remote") as commands:
            for command in commands:
                dvc(ours, "remote", *command)
            dvc(ours, "repro")
            git(ours, "add", ".")
            git(ours, "commit", "--quiet", "-m", "drawn")
            dvc(ours, "push")
            git(tmp_path, "clone", "--quiet", str(ours), str(theirs))
            assert not (theirs / "rows.csv").exists()
            dvc(theirs, "pull")
        files = ["rows.csv"]
        whole = [
            (theirs / own).is_file() and (theirs / own).read_bytes() == (ours / own).read_bytes()
            for own in files
        ]
        row["files"] = len(files)
        row["lost"] = len(files) - sum(whole)
        assert not row["lost"]
        assert "Running stage" not in dvc(theirs, "repro")
