"""The planner in a real registry: registered, loaded by its alias, and served as its page
says.
"""

import json
import re
import shutil
import socket
import subprocess
import sys
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.tracking.test_experiment import server

from constraint_geodesics import Constraint, Planner, Pose
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.tracking.experiment import Work, tracked_stage
from constraint_geodesics.tracking.registry import register_planner
from constraint_geodesics.tracking.store import (
    CHAMPION,
    PLANNER_MODEL,
    TrackingError,
    client_of,
    fetch_artifacts,
    tracking_uri,
)

ROOT = Path(__file__).resolve().parents[2]
CODE = ROOT / "src/constraint_geodesics/tracking/served_model.py"
QUERY = {
    "start": [1.329923, -0.584036, -3.766650, -2.008429, 0.728803, -2.581396],
    "goal": [1.071549, -0.217480, -1.682647, -2.906655, -0.337949, 1.348704],
    "constraint": "level_cup",
}
ADDRESS = f"models:/{PLANNER_MODEL}@{CHAMPION}"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout whose store has the packaged planner."""
    folder = tmp_path_factory.mktemp("registry")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        assert registered(folder, PACKAGED) == "1"
    return folder


@pytest.fixture
def copy(root: Path, tmp_path: Path) -> Path:
    """One to change; a new store would take seconds."""
    return shutil.copytree(root, tmp_path / "copy")


@pytest.fixture(autouse=True)
def own_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("DVC_EXP_NAME", raising=False)


def registered(root: Path, files: Path) -> str:
    with tracked_stage(Work("build_planner", "planner"), "built", root) as run:
        return register_planner(run, files, CODE, QUERY)


def champion(root: Path) -> str:
    return str(
        client_of(tracking_uri(root)).get_model_version_by_alias(PLANNER_MODEL, CHAMPION).version
    )


def other_files(folder: Path) -> Path:
    """The same planner with another file beside it."""
    shutil.copytree(PACKAGED, folder)
    (folder / "note.txt").write_text("another")
    return folder


def test_the_champion_plans_without_a_server(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)
    with Planner.load(ADDRESS) as planner, Planner.load(PACKAGED) as packaged:
        assert planner.source == f"MLflow's {ADDRESS}"
        path, same = (
            each.plan(QUERY["start"], QUERY["goal"], "level_cup") for each in (planner, packaged)
        )
    np.testing.assert_array_equal(path.joints, same.joints)


@pytest.mark.parametrize(
    "address", [f"models:/{PLANNER_MODEL}@nobody", f"models:/{PLANNER_MODEL}/9", "runs:/0/x"]
)
def test_what_is_not_there_is_said_in_one_line(root: Path, address: str) -> None:
    with pytest.raises(TrackingError, match=address) as caught, fetch_artifacts(address, root):
        pass
    assert "\n" not in str(caught.value)


def test_files_that_were_deleted_are_missed_by_name(copy: Path) -> None:
    shutil.rmtree(copy / "mlartifacts")
    with pytest.raises(TrackingError, match="mlartifacts"), fetch_artifacts(ADDRESS, copy):
        pass


def test_a_model_s_code_is_not_run_to_load_its_planner(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = (copy / "mlartifacts").rglob("served_model.py")
    code.write_text(f"open({str(copy / 'canary')!r}, 'w')\n")
    monkeypatch.chdir(copy)
    Planner.load(ADDRESS).close()
    assert not (copy / "canary").exists()


def test_an_address_that_leaves_the_store_s_files_is_refused(root: Path) -> None:
    client = client_of(tracking_uri(root))
    run = client.get_model_version_by_alias(PLANNER_MODEL, CHAMPION).run_id
    address = f"runs:/{run}/../../../.."
    with pytest.raises(TrackingError, match="leaves") as caught, fetch_artifacts(address, root):
        pass
    assert "\n" not in str(caught.value)


def test_other_files_are_a_new_version_and_equal_ones_are_not(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert registered(copy, PACKAGED) == "1"
    assert registered(copy, other_files(copy / "other")) == "2"
    assert champion(copy) == "2"
    assert registered(copy, PACKAGED) == "1"
    assert champion(copy) == "1", "what the pipeline built last"
    monkeypatch.setenv("DVC_EXP_NAME", "tilt-5")
    assert registered(copy, copy / "other") == "2"
    assert champion(copy) == "1", "an experiment does not replace it"


def test_a_model_has_a_signature_an_example_and_nothing_pickled(root: Path) -> None:
    (model,) = (root / "mlartifacts").rglob("MLmodel")
    files = {file.name for file in model.parent.rglob("*") if file.is_file()}
    assert {
        "served_model.py",
        "input_example.json",
        "planner.json",
        "roadmaps.safetensors",
    } <= files
    assert not [name for name in files if name.endswith((".pkl", ".pickle"))]
    needed = (model.parent / "requirements.txt").read_text().split()
    assert f"torch=={torch.__version__.split('+')[0]}" in [line.split("+")[0] for line in needed]
    assert not [line for line in needed if line.startswith("constraint")], (
        "no index has it, or another's"
    )
    for name in ("start", "goal", "constraint", "status", "joints", "times"):
        assert f'"name": "{name}"' in model.read_text()


def test_the_champion_is_served_as_its_page_says(root: Path) -> None:
    page = (ROOT / "docs" / "mlflow.md").read_text()
    reference = Pose.from_rpy([0.0, 0.0, 0.0], [0.4, 0.0, 0.0])
    tilted = Constraint((0, 0, 0, 1, 1, 0), reference=reference)
    (serve,) = re.findall(r"^geodesics (serve .*)$", page, re.M)
    (body,) = re.findall(r"^curl \S+ .*? -d '(.*?)'$", page, re.M | re.S)
    command = [sys.executable, "-m", "constraint_geodesics.cli", *serve.split()]
    with (
        server([*command, "--host", "127.0.0.1"], "ping", cwd=root) as address,
        ThreadPoolExecutor(4) as pool,
    ):
        (path,) = ask(address, body)
        at_once = list(pool.map(lambda _: ask(address, body)[0], range(8)))
        others = [
            QUERY | {"constraint": "nothing"},
            QUERY | {"constraint": '{"axes": [0, 0, 0, 1, 1, 0]}'},
            QUERY | {"constraint": json.dumps(tilted.to_json())},
            QUERY | {"constraint": '{"axes": [0, 0, 0, 1, 1, 0], "tolerances": [1, 1]}'},
        ]
        unknown, own, off, misspelt = ask(address, json.dumps({"dataframe_records": others}))
    assert all(answer["joints"] == path["joints"] for answer in at_once), (
        "requests do not disturb each other"
    )
    assert path["status"] == own["status"] == "solved"
    np.testing.assert_allclose(
        [path["joints"][0], path["joints"][-1]], [QUERY["start"], QUERY["goal"]], atol=1e-6
    )
    assert len(path["times"]) == len(path["joints"]) == path["rows"]
    assert unknown["status"] == "bad_query"
    assert "level_cup" in unknown["explanation"]
    assert off["status"] == "start_violates"
    assert misspelt["status"] == "bad_query"
    assert "tolerances is not taken over" in misspelt["explanation"]


def test_what_cannot_be_served_is_one_line(root: Path, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for folder, address, words in (
            (root, ADDRESS, f"port {port} of 127.0.0.1 is taken: add --port "),
            (root, f"models:/{PLANNER_MODEL}@nobody", "nobody"),
            (tmp_path, ADDRESS, "mlflow.db is missing"),
        ):
            command = [sys.executable, "-m", "constraint_geodesics.cli", "serve", address]
            if folder == root and address == ADDRESS:
                command += ["--port", str(port)]
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=False, timeout=60
            )
            assert (done.returncode, done.stdout) == (1, "")
            (line,) = done.stderr.splitlines()
            assert line.startswith("error: ")
            assert words in line
    assert not list(tmp_path.iterdir()), "looking makes no store"


def ask(address: str, body: str) -> list[dict[str, Any]]:
    request = urllib.request.Request(
        f"{address}/invocations", body.encode(), {"Content-Type": "application/json"}
    )
    answer: list[dict[str, Any]] = json.loads(urllib.request.urlopen(request, timeout=120).read())[
        "predictions"
    ]
    return answer
