"""The store's experiment as the dashboard opens it, and ports that servers can't have."""

import shutil
import socket
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Experiment

from constraint_geodesics.tracking import views
from constraint_geodesics.tracking.experiment import Work, tracked_stage
from constraint_geodesics.tracking.store import (
    TrackingError,
    open_store,
    require_free,
    runs_page,
    tracking_uri,
)
from constraint_geodesics.tracking.views import VIEWS


@pytest.fixture(autouse=True)
def own_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with one run, behind the experiment of an older version."""
    folder = tmp_path_factory.mktemp("store")
    (folder / "params.yaml").touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        MlflowClient(tracking_uri(folder)).create_experiment("older")
        with tracked_stage(Work("train", "cup"), "own", folder):
            pass
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """One to change; a new store would take seconds."""
    return shutil.copytree(made, tmp_path / "copy")


def experiment(folder: Path, name: str) -> Experiment:
    found = MlflowClient(tracking_uri(folder)).get_experiment_by_name(name)
    assert found is not None
    return found


def test_an_experiment_is_made_with_its_description_and_views(made: Path) -> None:
    assert experiment(made, "own").tags.items() >= views.experiment_tags().items()
    assert views.NOTE not in experiment(made, "older").tags


def test_an_older_experiment_gets_them_and_keeps_what_is_changed_by_hand(copy: Path) -> None:
    uri = tracking_uri(copy)
    _, number = open_store(uri, "older")
    assert experiment(copy, "older").tags.items() >= views.experiment_tags().items()
    MlflowClient(uri).set_experiment_tag(number, VIEWS[0].tag, "somebody's own")
    open_store(uri, "older")
    assert experiment(copy, "older").tags[VIEWS[0].tag] == "somebody's own"


def test_the_page_is_that_of_the_experiment_that_ran_last(copy: Path) -> None:
    (copy / "below").mkdir()
    address, _, page = runs_page(copy / "below", 5001).partition("/#/")
    assert address == "http://127.0.0.1:5001"
    number = experiment(copy, "own").experiment_id
    assert page == f"experiments/{number}/runs?workflowType=machine_learning", "no view finds it"
    with tracked_stage(Work("train", "cup"), "older", copy):
        pass
    assert f"/experiments/{experiment(copy, 'older').experiment_id}/runs?" in runs_page(copy, 5001)


def test_the_first_view_that_finds_a_run_is_opened(copy: Path) -> None:
    with (
        tracked_stage(Work("train_analytic", "plane"), "own", copy) as run,
        run.child("seed 0", {"seed": 0}),
    ):
        pass
    assert "?viewStateShareKey=seeds&" in runs_page(copy, 5001)
    with (
        tracked_stage(Work("train_geodesics", "planner-cup"), "own", copy) as run,
        run.child("seed 0", {"seed": 0}) as seed,
    ):
        seed.log(0, {"success": 1.0})
    assert "?viewStateShareKey=results&" in runs_page(copy, 5001)


def test_a_store_without_runs_is_opened_on_its_first_page(tmp_path: Path) -> None:
    open_store(tracking_uri(tmp_path), "own")
    assert runs_page(tmp_path, 5001) == "http://127.0.0.1:5001"


def test_a_store_that_is_none_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").write_text("text " * 1000)
    with pytest.raises(TrackingError, match=r"mlflow\.db") as caught:
        runs_page(tmp_path, 5001)
    assert "\n" not in str(caught.value)


def test_a_taken_port_names_a_free_one_of_the_same_host() -> None:
    with socket.socket() as taken:
        taken.bind(("0.0.0.0", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for host in ("127.0.0.1", "0.0.0.0"):
            with pytest.raises(TrackingError, match=rf"port {port} of {host} is taken") as caught:
                require_free(port, host)
            free = int(str(caught.value).partition("--port ")[2].partition(",")[0])
            require_free(free, host)


@pytest.mark.parametrize("host", ["203.0.113.9", "no.such.host.invalid"])
def test_a_host_that_is_not_this_machine_is_named_by_its_option(host: str) -> None:
    with pytest.raises(TrackingError, match=rf"^--host {host}: ") as caught:
        require_free(5002, host)
    assert "\n" not in str(caught.value)
