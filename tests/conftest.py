"""Robots and scenes that many tests share; everything is real, small and read only."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import settings

from constraint_geodesics import warmup
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import Params, load_params
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.urdf import data_path

ROOT = Path(__file__).resolve().parents[1]


settings.register_profile("same", derandomize=True, database=None, deadline=None)
settings.load_profile("same")
"""Cases of Hypothesis are drawn, yet the same on every run, so that a red run can be repeated."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """How much tests/faults tries: `make test-faults` and `make soak`."""
    parser.addoption("--faults", action="store_true", help="with long tests of faults")
    parser.addoption("--soak", action="store_true", help="with hours of them")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Before several workers start, each of which would wait for it."""
    if getattr(session.config.option, "numprocesses", None):
        warmup.ensure()


SLOW_FIRST = (
    *("end_to_end", "report", "laws", "constraints", "geodesics", "tracking", "studies"),
    *("test_doctor.py", "test_kills.py", "test_docs.py", "test_load.py", "test_warmup.py"),
    *("test_planner.py", "test_no_network.py", "test_triangles.py", "test_without_pybullet.py"),
)
"""Folders and files that take longest: what is left for the end is small, and no worker waits for
another.
"""


@pytest.hookimpl(tryfirst=True)  # xdist reads the groups in the same hook
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A file stays on one worker, so that what its tests share is made once."""
    order = {name: place for place, name in enumerate(SLOW_FIRST)}
    items.sort(key=lambda item: min(order.get(n, len(order)) for n in item.path.parts[-2:]))
    long = config.getoption("faults") or config.getoption("soak")
    for item in items:
        if item.get_closest_marker("long") and not long:
            item.add_marker(pytest.mark.skip(reason="in make test-faults and make soak"))
        if not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(item.path.relative_to(ROOT).as_posix()))


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def params() -> Params:
    return load_params(ROOT / "params.yaml")


@pytest.fixture(scope="session")
def scene(params: Params) -> Scene:
    return Scene.from_params(params)


@pytest.fixture(scope="session")
def xarm(scene: Scene) -> SerialRobot:
    return scene.robot


@pytest.fixture(scope="session")
def kuka() -> SerialRobot:
    return load_robot(data_path() / "kuka_iiwa" / "model.urdf", "lbr_iiwa_link_7")


@pytest.fixture(scope="session")
def kuka_scene(kuka: SerialRobot) -> Scene:
    table = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), ("lbr_iiwa_link_0",))
    return Scene(kuka, (table,))


@dataclass(frozen=True)
class Trained:
    """A small learned manifold and the free configurations it was trained on."""

    manifold: LearnedManifold
    joints: np.ndarray


@pytest.fixture(scope="session")
def trained(scene: Scene, params: Params, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    manifold = constraint_manifold(scene.robot, params.constraints["free"])
    joints = draw_free(ShardTask(scene, manifold, 4000, (1,)))
    small = params.manifolds["planner"].model_copy(
        update={"epochs": 4, "variance_epochs": 2, "variance_centres": 64}
    )
    folder = tmp_path_factory.mktemp("manifold")
    chart = train_manifold(
        joints, scene.robot, small, TrainingRun(folder, lambda *_: None, False)
    ).manifold
    return Trained(chart, joints)
