"""Files of every release are read by this one, and hold what they held."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from constraint_geodesics.bundle import CARD, ROADMAPS, read_bundle
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.geodesics.learned_method import FOLDER, read_learned
from constraint_geodesics.identification import load_constraint
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.planner import Planner
from constraint_geodesics.recording.recording import read_recording
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.scene.scene_file import read_attached, read_scene
from constraint_geodesics.trajectory import read_trajectory
from tests.golden.write import (
    FACTS,
    HERE,
    ROOT,
    constraint_facts,
    graph_facts,
    network_facts,
    planner_facts,
    shape_facts,
)

RELEASES = sorted(
    (file.parent for file in HERE.glob(f"*/{FACTS}")),
    key=lambda folder: [int(number) for number in re.findall(r"\d+", folder.name)],
)
MOST_BYTES = 300_000
"""Of a release's files."""


@pytest.fixture(params=RELEASES, ids=lambda folder: folder.name)
def release(request) -> Path:
    return Path(request.param)


@pytest.fixture
def facts(release: Path) -> dict[str, Any]:
    return dict(json.loads((release / FACTS).read_text()))


@pytest.fixture
def robot(release: Path) -> SerialRobot:
    """That of the release's planner."""
    return robot_from(read_bundle(release / "planner").robot)


def same(found: Any, told: Any) -> None:
    """Numbers to rounding, all else exactly; only what was told then is compared."""
    if isinstance(told, dict):
        for name, value in told.items():
            same(found[name], value)
    elif isinstance(told, list) and told and isinstance(told[0], dict | list):
        assert len(found) == len(told)
        for one, other in zip(found, told, strict=True):
            same(one, other)
    elif told is None or isinstance(told[0] if isinstance(told, list) and told else told, str):
        assert found == told
    else:
        np.testing.assert_allclose(found, told, rtol=1e-9, atol=1e-12)


def same_constraint(found: Constraint | None, told: dict[str, Any], robot: SerialRobot) -> None:
    assert found is not None
    now = constraint_facts(found, robot, np.array(told["q_rad"]))
    same(now, {name: told[name] for name in ("residual", "units")})


def test_the_release_that_is_made_here_has_its_files() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert version in {folder.name for folder in RELEASES}


def test_they_are_small(release: Path) -> None:
    assert sum(file.stat().st_size for file in release.rglob("*")) < MOST_BYTES


@pytest.mark.parametrize("name", ["path.csv", "moving.csv"])
def test_a_trajectory(release: Path, facts: dict[str, Any], robot: SerialRobot, name: str) -> None:
    told = facts["trajectories"][name]
    found = read_trajectory(release / name, robot.joint_names, robot)
    assert len(found.joints) == told["waypoints"]
    assert found.joints[0].tolist() == told["first_rad"]
    assert found.joints[-1].tolist() == told["last_rad"]
    same(found.joints.mean(axis=0), told["mean_rad"])
    assert found.times is not None
    assert found.times[-1] == told["duration_s"]
    start = found.start_velocity
    assert (None if start is None else start.tolist()) == told["start_velocity"]
    assert (start is None) == (name == "path.csv")
    same_constraint(found.constraint, told, robot)


def test_a_recording(release: Path, facts: dict[str, Any]) -> None:
    told, found = facts["recording"], read_recording(release / "path.rrd")
    assert len(found.joints) == told["frames"]
    np.testing.assert_allclose(found.joints[0], told["first_rad"], atol=1e-6)
    np.testing.assert_allclose(found.joints[-1], told["last_rad"], atol=1e-6)
    np.testing.assert_allclose(found.tool_ends, told["tool_ends_m"], atol=1e-6)
    for name in ("planner", "constraint", "query", "seed"):
        assert getattr(found.about, name) == told[name]


def test_scenes(release: Path, facts: dict[str, Any]) -> None:
    told = facts["scene"]
    found = read_scene(release / "scene.yaml")
    assert found.shapes.keys() == told["shapes"].keys()
    same({name: shape_facts(shape) for name, shape in found.shapes.items()}, told["shapes"])
    assert [list(pair) for pair in found.allowed] == told["allowed"]
    alone = read_attached(release / "attached.yaml")
    for held, wanted in ((found.attached, "attached"), (alone.attached, "attached alone")):
        about = {
            name: {"link": one.link, "touching": list(one.touching)} | shape_facts(one.shape)
            for name, one in held.items()
        }
        assert about.keys() == told[wanted].keys()
        same(about, told[wanted])


def test_a_constraint(release: Path, facts: dict[str, Any], robot: SerialRobot) -> None:
    found = load_constraint(release / "constraint.yaml", robot)
    same_constraint(found, facts["identification"]["constraint.yaml"], robot)


def test_demonstrations(release: Path, facts: dict[str, Any], robot: SerialRobot) -> None:
    told = facts["identification"]["demonstrations.csv"]
    found, motions = demonstrations_from(release / "demonstrations.csv", robot)
    assert motions
    assert [len(rows) for rows in found] == told["rows"]
    assert found[0][0].tolist() == told["first_rad"]
    assert found[-1][-1].tolist() == told["last_rad"]


def test_a_planner(release: Path, facts: dict[str, Any]) -> None:
    told, folder = facts["planner"], release / "planner"
    found = read_bundle(folder)
    same(planner_facts(found), {name: own for name, own in told.items() if name != "roadmaps"})
    same(graph_facts(dict(found.roadmaps)), told["roadmaps"])
    with Planner.load(folder) as planner:
        assert set(told["axes"]) <= set(planner.constraints)
        assert len(planner.nodes("level_cup")) == told["roadmaps"]["level_cup"]["nodes"]


def test_a_learned_method(release: Path, facts: dict[str, Any]) -> None:
    told, found = facts["learned"], read_learned(release / "planner" / FOLDER)
    assert found.chart == told["chart"]
    assert found.settings.degree == told["degree"]
    now = network_facts(found.manifold, found.policy, dict(found.submanifolds))
    np.testing.assert_allclose(now["decoded_rad"], told["decoded_rad"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(now["action"], told["action"], rtol=1e-5, atol=1e-6)
    same(now["submanifolds"], told["submanifolds"])
    with Planner.load(release / "planner", "learned") as planner:
        assert planner.method.name == "learned"


def test_they_are_files_of_the_kinds_that_people_keep(release: Path) -> None:
    assert {file.relative_to(release).as_posix() for file in release.rglob("*.*")} >= {
        *("path.csv", "moving.csv", "path.rrd", "scene.yaml", "attached.yaml", "part.obj"),
        *("demonstrations.csv", "constraint.yaml"),
        *(f"planner/{name}" for name in (CARD, ROADMAPS)),
        *(f"planner/{FOLDER}/{name}.safetensors" for name in ("manifold", "policy")),
    }
