"""Runs as they lie in a real store, read back with MLflow's own client."""

import ast
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
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run
from tests.ports import free_port

from constraint_geodesics.params import ComputeParams, PoseConstraintParams, PoseParams, load_params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.tracking import experiment
from constraint_geodesics.tracking.experiment import (
    ChildRun,
    Subject,
    Work,
    begin_run,
    continue_run,
    end_run,
    subject_of,
    tracked_stage,
)
from constraint_geodesics.tracking.store import TrackingError, dvc_md5, tracking_uri, ui_command

ROOT = Path(__file__).resolve().parents[2]
TWO = ComputeParams(backend="loky", workers=2)


def git(root: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.com"]
    return subprocess.run(
        ["git", "-C", str(root), *identity, *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A committed checkout; its store is made by the first test."""
    folder = tmp_path_factory.mktemp("checkout")
    (folder / ".gitignore").write_text("mlflow.db*\nmlartifacts/\ndata/\n")
    (folder / "data").mkdir()
    (folder / "data" / "joints.csv").write_text("1,2\n")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "-m", "start")
    return folder


@pytest.fixture(autouse=True)
def own_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("DVC_STAGE", raising=False)


def runs_of(uri: str, experiment: str) -> dict[str, Run]:
    """All runs of one experiment by name."""
    client = MlflowClient(uri)
    found = client.get_experiment_by_name(experiment)
    assert found is not None
    return {run.info.run_name: run for run in client.search_runs([found.experiment_id])}


def figures_of(run: Run) -> dict[str, float]:
    """Its metrics without those of the machine, which a run has if it takes long enough."""
    return {
        name: value for name, value in run.data.metrics.items() if not name.startswith("system/")
    }


def work(task: tuple[ChildRun, int]) -> dict[str, float]:
    child, seed = task
    with child as run:
        for step in range(3):
            run.log(step, {"loss": seed + 1 / (1 + step), "broken": math.nan})
    return {"length": float(seed)}


def test_a_stage_is_a_parent_its_seeds_are_children(root: Path) -> None:
    reference = PoseParams(position_m=(0.4, 0, 0.3), rpy_rad=(0, 0, 0))
    held = PoseConstraintParams(
        description="level", axes=(0, 0, 0, 1, 1, 0), tolerance=(0,) * 6, reference=reference
    )
    params = {"seeds": [1, 3], "constraint": held, "long": "x" * 7000}
    params |= {f"p{i}": i for i in range(150)}
    about = Subject({"constraint": "cup"}, {"manifold": {"latent_dim": 6}})
    with tracked_stage(Work("train", "planner-cup", params, [], about), "tree", root) as stage:
        tasks = [(stage.child(f"seed {seed}", {"seed": seed}), seed) for seed in (1, 3)]
        curves = [
            [{"steps": 1.0, "loss": 1.0}, {"steps": 2.0, "loss": 5.0}],
            [{"steps": 2.0, "loss": 3.0}],
        ]
        stage.summarise(parallel_map(work, tasks, TWO), curves)
    runs = runs_of(tracking_uri(root), "tree")
    assert set(runs) == {"train planner-cup", "planner-cup seed 1", "planner-cup seed 3"}
    parent, child = runs["train planner-cup"], runs["planner-cup seed 3"]

    assert parent.info.run_id == stage.run_id
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert parent.data.params["constraint.axes"] == "[0, 0, 0, 1, 1, 0]"
    assert parent.data.params["p149"] == "149"
    assert parent.data.params["long"] == "x" * 5999 + "…"
    tags = {"stage": "train", "item": "planner-cup", "constraint": "cup", "git_dirty": "false"}
    tags["git_commit"] = git(root, "rev-parse", "HEAD")
    assert parent.data.tags.items() >= tags.items()
    assert parent.data.params["manifold.latent_dim"] == "6"
    assert figures_of(parent) == {
        "seeds/length_mean": 2.0,
        "seeds/length_std": 1.0,
        "seeds/length_count": 2.0,
        "seeds/loss_mean": 4.0,
        "seeds/loss_std": 1.0,
    }
    client = MlflowClient(tracking_uri(root))
    (mean,) = client.get_metric_history(parent.info.run_id, "seeds/loss_mean")
    assert mean.step == 2, "the only step that both have"

    own = {**tags, "seed": "3", "mlflow.parentRunId": stage.run_id}
    assert child.data.tags.items() >= own.items()
    assert child.data.params == {**parent.data.params, "seed": "3"}, (
        "children of different runs can be compared"
    )
    history = client.get_metric_history(child.info.run_id, "loss")
    assert [(point.step, point.value) for point in history] == [(0, 4.0), (1, 3.5), (2, 3 + 1 / 3)]
    assert child.data.metrics == {"loss": 3 + 1 / 3, "final/length": 3.0}


def test_runs_are_compared_by_the_same_figures_on_children_and_parent(root: Path) -> None:
    with tracked_stage(Work("train", "cup"), "compared", root) as stage:
        for seed in (0, 1):
            with stage.child(f"seed {seed}", {"seed": seed, "planner": "ours"}):
                pass
        stage.compared(
            [
                {"success": 1.0, "median_ratio": 1.25, "median_ms": 4.0},
                {"success": 0.5, "median_ratio": math.nan, "median_ms": 6.0},
            ]
        )
    runs = runs_of(tracking_uri(root), "compared")
    assert figures_of(runs["train cup"]) == {
        "success": 0.75,
        "median_ratio": 1.25,
        "median_ms": 5.0,
    }
    assert figures_of(runs["cup seed 1"]) == {"success": 0.5, "median_ms": 6.0}
    assert runs["cup seed 1"].data.tags.items() >= {"seed": "1", "planner": "ours"}.items()


def test_a_stage_without_items_names_its_runs_once_and_a_cell_is_a_run(
    root: Path, tmp_path: Path
) -> None:
    file = tmp_path / "table.csv"
    file.write_text("planner,success\n")
    with tracked_stage(Work("bench", "bench"), "cells", root) as stage:
        stage.mirror({"rows": 2, "of": {"BiRRT, atlas": 0.5}, "list": [1]}, file)
        cells = {"cup, ours": ({"planner": "ours"}, {"success": 1.0, "median_ms": None})}
        stage.cells(cells)
        by_method = {"formula": {"deg": 0.0}, "VAE, policy": {"deg": 7.5}}
        stage.cells({"door": ({"task": "door"}, by_method)})
    runs = runs_of(tracking_uri(root), "cells")
    assert set(runs) == {"bench", "cup, ours", "door, formula", "door, VAE, policy"}
    learned = runs["door, VAE, policy"]
    assert figures_of(learned) == {"deg": 7.5}
    assert learned.data.tags.items() >= {"task": "door", "method": "VAE, policy"}.items()
    assert figures_of(runs["bench"]) == {"rows": 2.0, "of/BiRRT_ atlas": 0.5}
    assert figures_of(runs["cup, ours"]) == {"success": 1.0}
    assert runs["cup, ours"].data.tags["planner"] == "ours"
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    kept = root / "mlartifacts/cells" / stage.run_id / "artifacts/reports/table.csv"
    assert kept.read_text() == file.read_text()


STAGES = [
    own
    for file in ("dvc.yaml", "stages/dvc.yaml", "stages/sweep/dvc.yaml")
    for own in yaml.safe_load((ROOT / file).read_text())["stages"].values()
]
SCRIPTS = sorted({own["cmd"].split()[1] for own in STAGES})


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_stage_that_makes_a_result_has_a_run(script: str) -> None:
    """But for the digests of code, which no run is compared by."""
    tree = ast.parse((ROOT / script).read_text())
    called = {
        node.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    has_run = called & {"tracked_stage", "run_sweep"}
    assert bool(has_run) == (script != "stages/digest_code.py")


def test_a_run_that_was_killed_is_continued_with_the_children_it_has(root: Path) -> None:
    work_of = Work("sweep", "b=1 K_Δ=0.5 (12ab)", {"b": 1})
    killed = begin_run(work_of, "sweeps", root)
    with killed.child("seed 0", {"seed": 0}):
        pass
    killed.child("seed 1", {"seed": 1}).__enter__()  # its process died: nothing ended either
    run = continue_run(work_of, "sweeps", root)
    assert run.run_id == killed.run_id
    assert run.child_names() == ["seed 0", "seed 1"]
    with run.child("seed 1", {"seed": 1}):
        pass
    end_run(run, "FINISHED")
    client = MlflowClient(run.tracking_uri)
    of_parent = f"tags.`mlflow.parentRunId` = '{run.run_id}'"
    children = client.search_runs([run.experiment_id], of_parent)
    ended = sorted((child.data.tags["child"], child.info.status) for child in children)
    assert ended == [("seed 0", "FINISHED"), ("seed 1", "FINISHED"), ("seed 1", "KILLED")]
    assert client.get_run(run.run_id).info.status == "FINISHED"
    assert client.get_run(run.run_id).data.params == {"b": "1"}
    other = continue_run(Work("sweep", "b=3 (34cd)", {"b": 3}), "sweeps", root)
    assert other.run_id != run.run_id
    end_run(other, "KILLED")
    assert len(client.search_runs([run.experiment_id], "tags.stage = 'sweep'")) == 5


def test_a_run_says_where_its_paths_are_recorded(root: Path) -> None:
    paths = [("line", 0, "line.rrd"), ("ours", 0, "a.rrd"), ("ours", 0, ""), ("ours", 1, "b.rrd")]
    rows = [
        {"planner": planner, "query": 0, "seed": seed, "length_rad": 1.5, "recording": recording}
        for planner, seed, recording in paths
    ]
    with tracked_stage(Work("train", "cup"), "recorded", root) as stage:
        for seed in (0, 1):
            with stage.child(f"seed {seed}", {"seed": seed}):
                pass
        stage.recordings(rows, "ours")
    runs = runs_of(tracking_uri(root), "recorded")
    named = [runs[f"cup seed {seed}"].data.tags["recording"] for seed in (0, 1)]
    assert named == ["a.rrd", "b.rrd"]
    listed = (root / "mlartifacts/recorded" / stage.run_id / "artifacts/recordings.md").read_text()
    for text in (listed, runs["train cup"].data.tags["mlflow.note.content"]):
        assert re.findall(r"`geodesics replay (\S+)`", text) == ["line.rrd", "a.rrd", "b.rrd"]


def test_the_machine_is_watched_while_a_stage_runs(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment, "SYSTEM_AFTER_S", 0.0)
    monkeypatch.setattr(experiment, "SYSTEM_EVERY_S", 0.05)
    with tracked_stage(Work("train", "cup"), "watched", root) as stage:
        time.sleep(0.5)
    metrics = MlflowClient(stage.tracking_uri).get_run(stage.run_id).data.metrics
    assert 0.0 < metrics["system/system_memory_usage_percentage"] < 100.0
    assert "system/cpu_utilization_percentage" in metrics
    assert all(name.startswith("system/") for name in metrics), "apart from what the stage reports"
    with tracked_stage(Work("train", "cup", watched=False), "watched", root) as stage:
        time.sleep(0.5)
    assert not MlflowClient(stage.tracking_uri).get_run(stage.run_id).data.metrics


def test_a_run_of_an_experiment_is_named_after_it(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DVC_EXP_NAME", "tilt-5")
    with (
        tracked_stage(Work("train", "cup"), "named after", root) as stage,
        stage.child("seed 1", {"seed": 1}),
    ):
        pass
    runs = runs_of(tracking_uri(root), "named after")
    assert set(runs) == {"train cup (tilt-5)", "cup seed 1 (tilt-5)"}
    assert {run.data.tags["dvc_experiment"] for run in runs.values()} == {"tilt-5"}


def test_runs_are_found_by_constraint_manifold_and_reward() -> None:
    params = load_params(ROOT / "params.yaml")
    reward = params.policies.reward
    found = subject_of(params, constraint="slide", manifold="planner", reward=reward)
    assert set(found.tags) == {"constraint", "manifold", "reward"}
    assert found.tags["reward"].startswith("corrected b=")
    assert found.params == {"constraint": params.constraints["slide"]}
    assert subject_of(params, manifold="sphere") == Subject({"manifold": "sphere"})


def test_figures_that_some_seeds_lack_are_counted(root: Path) -> None:
    with tracked_stage(Work("train", "gaps"), "gaps", root) as stage:
        for seed in (1, 2, 3):
            with stage.child(f"seed {seed}", {}):
                pass
        stage.summarise(
            [{"a": 1.0, "b": math.nan}, {"a": math.nan, "b": math.nan}, {"a": 3.0, "b": math.inf}]
        )
    figures = figures_of(runs_of(tracking_uri(root), "gaps")["train gaps"])
    assert figures == {
        "seeds/a_mean": 2.0,
        "seeds/a_std": 1.0,
        "seeds/a_count": 2.0,
        "seeds/b_count": 0.0,
    }


def test_the_json_report_and_the_store_hold_the_same_numbers(root: Path, tmp_path: Path) -> None:
    figures = {
        "rows": np.int64(3),
        "length": {"mean": 1 / 3, "std": np.float32(0.5), "worst": math.nan},
        "curve": np.array([1.0, math.inf]),
        "name": "größer",
        "zero": -0.0,
        "valid": True,
    }
    with tracked_stage(Work("label", "cup"), "report", root) as stage:
        stage.report(figures, tmp_path / "new" / "cup.json")
        stage.report(dict(reversed(figures.items())), tmp_path / "again.json")
        stage.metric_logger()(7, {"epoch_loss": 0.5})
    text = (tmp_path / "new" / "cup.json").read_text("utf-8")
    assert json.loads(text) == {
        "curve": [1.0, None],
        "length": {"mean": 0.333333333, "std": 0.5, "worst": None},
        "name": "größer",
        "rows": 3,
        "valid": True,
        "zero": 0.0,
    }
    assert "-0" not in text
    assert (tmp_path / "again.json").read_text("utf-8") == text
    mirrored = {
        "length/mean": 0.333333333,
        "length/std": 0.5,
        "rows": 3,
        "valid": 1,
        "zero": 0,
        "epoch_loss": 0.5,
    }
    assert figures_of(runs_of(tracking_uri(root), "report")["label cup"]) == mirrored


def test_sources_that_differ_make_a_run_dirty_but_reports_do_not(root: Path) -> None:
    def dirty() -> str:
        with tracked_stage(Work("label", "cup"), "dirty", root) as stage:
            pass
        return str(MlflowClient(stage.tracking_uri).get_run(stage.run_id).data.tags["git_dirty"])

    (root / "reports").mkdir()
    (root / "reports" / "cup.json").write_text("{}")
    assert dirty() == "false"
    (root / "stray.py").write_text("")
    assert dirty() == "true"
    (root / "stray.py").unlink()


@pytest.mark.parametrize(
    ("error", "status"), [(ValueError("no"), "FAILED"), (KeyboardInterrupt(), "KILLED")]
)
def test_a_stage_that_fails_says_so_and_ends_its_children(
    root: Path, error: BaseException, status: str
) -> None:
    def stage() -> None:
        with tracked_stage(Work("train", "cup"), status, root) as run:
            run.child("abandoned", {}).__enter__()
            raise error

    with pytest.raises(type(error)):
        stage()
    runs = runs_of(tracking_uri(root), status)
    statuses = {name: run.info.status for name, run in runs.items()}
    assert statuses == {"train cup": status, "cup abandoned": status}


def test_a_child_that_fails_says_so_and_its_name_is_new(root: Path) -> None:
    with tracked_stage(Work("train", "cup"), "child", root) as stage:
        child = stage.child("seed 1", {})
        with pytest.raises(ValueError, match="seed 1"):
            stage.child("seed 1", {})
        with pytest.raises(ZeroDivisionError), child:
            raise ZeroDivisionError
    statuses = {name: run.info.status for name, run in runs_of(tracking_uri(root), "child").items()}
    assert statuses == {"train cup": "FINISHED", "cup seed 1": "FAILED"}


def first_run(task: tuple[Path, int]) -> str:
    root, number = task
    stage = tracked_stage(Work("train", f"item{number}"), "fresh", root)
    with stage as run, run.child("seed 1", {"seed": 1}) as child:
        child.log(1, {"loss": 1.0})
    return run.run_id


def test_processes_may_make_the_store_at_once(tmp_path: Path) -> None:
    settings = ComputeParams(backend="loky", workers=4)
    run_ids = parallel_map(first_run, [(tmp_path, number) for number in range(4)], settings)
    runs = runs_of(tracking_uri(tmp_path), "fresh")
    assert {runs[f"train item{number}"].info.run_id for number in range(4)} == set(run_ids)
    assert len(runs) == 8
    assert {run.info.status for run in runs.values()} == {"FINISHED"}


def test_the_named_store_is_used(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///elsewhere/runs.db")
    assert tracking_uri(root) == f"sqlite:///{tmp_path}/elsewhere/runs.db"
    with tracked_stage(Work("label", "cup"), "named", root) as stage:
        stage.figure(root / "data" / "joints.csv")
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert set(runs_of(f"sqlite:///{tmp_path}/elsewhere/runs.db", "named")) == {"label cup"}
    own = tmp_path / "elsewhere" / "mlartifacts" / "named" / stage.run_id / "artifacts"
    assert (own / "figures" / "joints.csv").read_text() == "1,2\n"
    assert MlflowClient(tracking_uri(root)).get_experiment_by_name("named") is None


@pytest.mark.parametrize(
    "uri",
    [
        "http://user:secret@127.0.0.1:9",
        "sqlite:////proc/nowhere/runs.db",
        "sqlite:///{folder}/not_a_database.db",
        "file:///tmp/mlruns",
        "nonsense://runs",
    ],
)
def test_a_store_that_fails_stops_the_stage_at_once_in_one_line(
    uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "not_a_database.db").write_text("text " * 1000)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri.format(folder=tmp_path))
    start = time.monotonic()
    with (
        pytest.raises(TrackingError) as caught,
        tracked_stage(Work("label", "cup"), "none", tmp_path),
    ):
        pytest.fail("the body must not start")
    assert time.monotonic() - start < 60, "MLflow itself tries for minutes"
    assert "\n" not in str(caught.value)
    assert uri.format(folder=tmp_path).rpartition("@")[2] in str(caught.value)
    assert "secret" not in str(caught.value)
    assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ


def test_a_missing_input_stops_the_stage_before_it_has_a_run(root: Path) -> None:
    with (
        pytest.raises(TrackingError, match=r"label cup: its input .*absent\.csv does not exist"),
        tracked_stage(Work("label", "cup", {}, [root / "absent.csv"]), "missing", root),
    ):
        pytest.fail("the body must not start")
    assert MlflowClient(tracking_uri(root)).get_experiment_by_name("missing") is None


PIPELINE: dict[str, Any] = {
    "stages": {
        "draw": {
            "cmd": "mkdir -p data/joints/sub && echo 1 > data/joints/a.csv"
            " && echo 2 > data/joints/sub/b.csv"
            " && echo 3 > data/card.json",
            "outs": ["data/joints", "data/card.json"],
        },
        "train": {
            "matrix": {"item": ["cup"]},
            "cmd": f"{sys.executable} train.py",
            "deps": ["data/joints", "data/card.json"],
        },
    }
}
TRAIN = """
from pathlib import Path
from constraint_geodesics.tracking.experiment import Work, tracked_stage

inputs = [Path("data/joints"), Path("data/joints/a.csv"), Path("data/card.json")]
with tracked_stage(Work("train", "cup", {}, inputs), "dvc", Path()) as run:
    run.report({"loss": 1}, Path("report.json"))
"""


def test_inputs_are_linked_by_dvcs_own_md5_and_nothing_is_printed(tmp_path: Path) -> None:
    (tmp_path / "dvc.yaml").write_text(yaml.safe_dump(PIPELINE))
    (tmp_path / "train.py").write_text(TRAIN)
    options: dict[str, Any] = {"cwd": tmp_path, "check": True, "capture_output": True, "text": True}
    dvc = [sys.executable, "-m", "dvc"]
    subprocess.run([*dvc, "init", "--no-scm", "--quiet"], **options)
    shown = subprocess.run([*dvc, "repro", "--no-commit"], **options)
    assert "mlflow" not in (shown.stdout + shown.stderr).lower()
    lock = yaml.safe_load((tmp_path / "dvc.lock").read_text())
    md5 = {out["path"]: out["md5"] for out in lock["stages"]["draw"]["outs"]}
    run = runs_of(tracking_uri(tmp_path), "dvc")["train cup"]
    assert run.data.tags["dvc_stage"] == "train@cup"
    assert {entry.dataset.name: entry.dataset.digest for entry in run.inputs.dataset_inputs} == {
        **md5,
        "data/joints/a.csv": hashlib.md5(b"1\n").hexdigest(),
    }
    assert md5["data/joints"].endswith(".dir")
    (tmp_path / "data" / "joints" / "sub" / "b.csv").write_text("changed")
    assert dvc_md5(tmp_path / "data" / "joints") != md5["data/joints"]


@contextmanager
def server(
    command: list[str],
    page: str,
    environment: dict[str, str] | None = None,
    cwd: Path | None = None,
) -> Iterator[str]:
    """The address of what a command serves on a free port, from when a page of it answers."""
    port = free_port()
    assert command[command.index("--host") + 1] == "127.0.0.1"
    command[command.index("--port") + 1] = str(port)
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=log, env=environment, cwd=cwd, start_new_session=True
        )
        try:
            deadline = time.monotonic() + 90
            while True:
                try:
                    urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}")
                    break
                except OSError:
                    if time.monotonic() > deadline or process.poll() is not None:
                        log.seek(0)
                        pytest.fail(
                            f"{page} does not answer: {log.read().decode(errors='replace')}"
                        )
                    time.sleep(0.1)
            yield f"http://127.0.0.1:{port}"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, 15)
            process.wait(20)


def dashboard(root: Path) -> AbstractContextManager[str]:
    """The server of ui_command."""
    return server(ui_command(root, 5000), "health")


def test_a_moved_checkout_keeps_its_figures_and_a_server_can_be_the_store(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with tracked_stage(Work("report", "all"), "moved", root) as stage:
        stage.figure(root / "data" / "joints.csv")
    moved = tmp_path / "moved"
    shutil.copytree(root, moved)
    shutil.rmtree(root / "mlartifacts")
    with dashboard(moved) as address:
        query = urllib.parse.urlencode({"run_id": stage.run_id, "path": "figures/joints.csv"})
        assert urllib.request.urlopen(f"{address}/get-artifact?{query}").read() == b"1,2\n"

        monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
        capfd.readouterr()
        with (
            tracked_stage(Work("train", "cup"), "served", root) as stage,
            stage.child("seed 1", {}),
        ):
            stage.figure(root / "data" / "joints.csv")
        assert capfd.readouterr() == ("", "")
        with pytest.raises(TrackingError, match=address):
            ui_command(root, 5000)
    uri = f"sqlite:///{moved}/mlflow.db"
    served = runs_of(uri, "served")
    assert {name: run.info.status for name, run in served.items()} == {
        "train cup": "FINISHED",
        "cup seed 1": "FINISHED",
    }
    (kept,) = (moved / "mlartifacts").rglob(f"{stage.run_id}/artifacts/figures/joints.csv")
    assert kept.read_text() == "1,2\n"
