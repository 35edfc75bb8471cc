"""A real sweep of two configurations with two seeds, killed after the first and started again: what
was done stays, and all of it is found in MLflow, in DVC and in the ranking.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from mlflow import MlflowClient

from constraint_geodesics.pipeline.experiments import (
    ExperimentClone,
    ExperimentError,
    experiment_names,
)
from tests.end_to_end import smoke

pytestmark = pytest.mark.timeout(900)

SPACE = """
search: grid
space:
  policies.reward.b: [1.0, 3.0]   # params.yaml's own, and another
"""
DATA = """
import importlib, sys
sys.path.insert(0, "stages")
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout
for name, *items in (
    ("digest_code",), ("label_joints", "free"), ("label_joints", "level_cup"),
    ("train_manifold", "planner"),
):
    importlib.import_module(name).main(load_params(), Layout(), *items)
"""
"""In one process: each for itself would import the same for seconds."""
STAGES = ("digest_code", "label_joints", "train_manifold")
LONGEST_S = 300.0


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """In a process group of its own, so that it is killed with all its workers."""
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=smoke.environment(folder) | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def ran(folder: Path, *words: str) -> str:
    process = started(folder, *words)
    said, complained = process.communicate()
    assert process.returncode == 0, complained
    return said


def sweep(folder: Path) -> str:
    return ran(folder, "stages/run_sweep.py", "space.yaml")


def seed_files(folder: Path) -> dict[str, tuple[bytes, int]]:
    files = (folder / ".geodesics" / "sweep").glob("sweep-*/seed-*.json")
    return {str(file): (file.read_bytes(), file.stat().st_mtime_ns) for file in files}


def runs(folder: Path) -> list[Any]:
    client = MlflowClient(f"sqlite:///{folder / 'mlflow.db'}")
    found = client.get_experiment_by_name("constraint_geodesics")
    return client.search_runs([found.experiment_id], "tags.stage = 'sweep_policies'")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A committed checkout with the data and the manifold that policies are trained on."""
    folder = tmp_path_factory.mktemp("sweep")
    smoke.copy_checkout(folder)
    smoke.shrink_params(folder)
    stages = yaml.safe_load((folder / "dvc.yaml").read_text())["stages"]
    kept = {name: stages[name] for name in STAGES}
    kept["train_manifold"]["matrix"] = {"manifold": ["planner"]}
    (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": kept}))
    for name in ("dvc.yaml", "dvc.lock"):
        (folder / "stages" / name).unlink(missing_ok=True)
    (folder / "space.yaml").write_text(SPACE)
    ran(folder, "-c", DATA)
    assert smoke.dvc(folder, "commit", "--force", "dvc.yaml").returncode == 0
    identity = ["-c", "user.name=smoke", "-c", "user.email=smoke@localhost"]
    subprocess.run(["git", "add", "--all"], cwd=folder, check=True)
    subprocess.run(["git", *identity, "commit", "--quiet", "-m", "data"], cwd=folder, check=True)
    return folder


@pytest.fixture(scope="module")
def killed(checkout: Path) -> dict[str, tuple[bytes, int]]:
    """What is left of a sweep that was killed while DVC kept its first configuration."""
    process, began = started(checkout, "stages/run_sweep.py", "space.yaml"), time.monotonic()
    while not list((checkout / ".geodesics" / "sweep").glob("sweep-*/told.json")):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() - began < LONGEST_S
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return seed_files(checkout)


@pytest.fixture(scope="module")
def resumed(checkout: Path, killed: dict[str, tuple[bytes, int]]) -> Path:
    sweep(checkout)
    return checkout


def test_what_was_done_before_it_was_killed_stays(killed, resumed) -> None:
    assert 2 <= len(killed) < 4
    now = seed_files(resumed)
    assert len(now) == 4
    assert {name: now[name] for name in killed} == killed


def test_each_configuration_is_a_run_with_its_seeds_below_it(resumed) -> None:
    found = runs(resumed)
    parents = [run for run in found if "child" not in run.data.tags]
    assert len(parents) == 2
    for parent in parents:
        own = [r for r in found if r.data.tags.get("mlflow.parentRunId") == parent.info.run_id]
        finished = [run for run in own if run.info.status == "FINISHED"]
        assert {run.info.status for run in own} <= {"FINISHED", "KILLED"}
        assert sorted(run.data.params["seed"] for run in finished) == ["0", "1"]
        assert all("final/feasible" in run.data.metrics for run in finished)
        assert parent.info.status == "FINISHED"
        assert parent.data.metrics["seeds/feasible_count"] == 2
        assert parent.data.metrics["rank"] in (1, 2)
    assert sorted(run.data.params["reward.b"] for run in parents) == ["1.0", "3.0"]


def test_each_configuration_is_an_experiment_of_dvc(resumed) -> None:
    names = experiment_names(resumed)
    assert names == {name.split("/")[-2] for name in seed_files(resumed)}
    shown = json.loads(smoke.dvc(resumed, "exp", "show", "--json").stdout)
    tried = [
        (params["policies"]["reward"]["b"], metrics["seeds"])
        for row in shown[1]["experiments"]
        for revision in row["revs"]
        for params in [revision["data"]["params"]["params.yaml"]["data"]]
        for metrics in [
            revision["data"]["metrics"]["reports/sweep_policies/configuration.json"]["data"]
        ]
    ]
    assert sorted(tried) == [(1.0, 2), (3.0, 2)]
    done = subprocess.run(
        ["git", "status", "--porcelain"], cwd=resumed, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["??", "reports/sweep_policies/"], "the checkout stays as it was"


def test_the_ranking_is_printed_as_a_table_and_as_json(resumed) -> None:
    command = ["-m", "constraint_geodesics.cli", "results", "--experiments"]
    table = ran(resumed, *command)
    assert "| 1 " in table
    assert "as in params.yaml" in table
    assert "b=3" in table
    rows = json.loads(ran(resumed, *command, "--json"))["rows"]
    assert [row["rank"] for row in rows] == [1, 2]
    assert [row["seeds"] for row in rows] == [2, 2]
    for row in rows:
        assert 0 <= row["score_low"] <= row["score"] <= row["score_high"] <= 1
        assert row["steps_per_second"] > 0
    assert rows[0]["score"] >= rows[1]["score"]


def test_a_sweep_that_is_done_does_nothing(resumed) -> None:
    before, experiments, known = seed_files(resumed), experiment_names(resumed), len(runs(resumed))
    sweep(resumed)
    assert seed_files(resumed) == before
    assert experiment_names(resumed) == experiments
    assert len(runs(resumed)) == known


def test_an_experiment_that_dvc_refuses_is_named_in_one_line(resumed, tmp_path) -> None:
    clone = ExperimentClone(resumed, tmp_path / "clone", {})
    with pytest.raises(ExperimentError, match=r"^dvc exp run .*--name odd nowhere: .*'nowhere'"):
        clone.run("odd", {}, "nowhere")
    assert "odd" not in experiment_names(resumed)
