"""Robots and scenes that many tests share; everything is real, small and read only."""

from pathlib import Path

import pytest
import torch

from constraint_geodesics.constraints.scene import Scene
from constraint_geodesics.params import Params, load_params
from constraint_geodesics.robot.bullet import Box, data_path
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot

ROOT = Path(__file__).resolve().parents[1]


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
