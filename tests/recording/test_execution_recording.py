"""Recordings of a real execution that spills, read back from the file."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.recording.files import column, same_recordings, seconds, timelines

from constraint_geodesics.constraints.constraint import constraint_from, constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.params import Params
from constraint_geodesics.recording.execution_recording import (
    ExecutionRecord,
    in_cup,
    record_execution,
    tilt,
)
from constraint_geodesics.recording.recording import About, read_recording
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, execute, execution_name

CUP = CupSettings(spheres=4, settle_s=0.2)
AXIS = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def record(scene: Scene, params: Params) -> ExecutionRecord:
    """A level cup turned over about the tool's axis."""
    near = np.array([-1.35, -0.47, -0.87, -2.28, 0.34, 0.74])
    start = retract(constraint_manifold(scene.robot, params.constraints["level_cup"]), near).joints
    path = start + np.linspace(0.0, -2.6, 100)[:, None] * np.eye(6)[5]
    times = time_parametrisation(path, scene.robot.velocity, np.full(6, 4.0))
    execution = execute(scene, path, times, AXIS, CUP)
    kept = constraint_from(params.constraints["level_cup"], scene.robot)
    return ExecutionRecord("straight joint line", "level_cup", 2, execution, CUP, kept)


@pytest.fixture(scope="module")
def file(record: ExecutionRecord, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "folder" / "execution.rrd"
    record_execution(file, record, scene.robot, scene.workcell)
    return file


def test_recording_reads_back_as_the_execution(
    file: Path, record: ExecutionRecord, scene: Scene
) -> None:
    summary, execution = read_recording(file), record.execution
    assert summary.application_id == "constraint_geodesics"
    assert re.fullmatch(
        r"level_cup-query2-straight-joint-line-executed-[0-9a-f]{8}", summary.recording_id
    )
    assert summary.about == About("straight joint line", "level_cup", query=2, executed=True)
    assert summary.meshes == 7
    assert {
        "/cup",
        "/cup/wall",
        "/tool/frame/upright",
        "/tool/place/level",
        "/spheres",
        "/cup_tilt",
        "/cup_spheres",
        "/workcell/table",
        "/status",
    } <= set(summary.entity_paths)
    assert summary.has_blueprint
    np.testing.assert_array_equal(summary.joints, execution.joints)
    np.testing.assert_allclose(summary.times, execution.times, atol=1e-6)
    ends = scene.robot.forward(execution.joints[[0, -1]])[0]
    np.testing.assert_allclose(summary.tool_ends, ends, atol=1e-6)
    assert file.stat().st_size < 2.5e6


def test_everything_moves_over_the_seconds_of_the_execution(
    file: Path, record: ExecutionRecord
) -> None:
    assert timelines(file) == {"time"}
    for entity, component in (
        ("/transforms/joint6", "Transform3D:quaternion"),
        ("/spheres", "Points3D:positions"),
        ("/cup", "Transform3D:translation"),
        ("/cup/wall", "Transform3D:quaternion"),
        ("/cup_spheres", "Scalars:scalars"),
        ("/joints", "Scalars:scalars"),
    ):
        times = record.execution.times.tolist()
        assert seconds(file, entity, component) == pytest.approx(times, abs=1e-6)


def test_spheres_and_cup_are_where_the_simulation_had_them(
    file: Path, record: ExecutionRecord
) -> None:
    execution = record.execution
    positions = np.array(column(file, "/spheres", "Points3D:positions"))
    np.testing.assert_allclose(positions, execution.sphere_positions, atol=1e-6)
    assert len(set(column(file, "/spheres", "Points3D:colors")[0])) == CUP.spheres
    assert column(file, "/spheres", "Points3D:radii")[0] == pytest.approx([CUP.sphere_radius_m])
    centres = np.array(column(file, "/cup", "Transform3D:translation"))[:, 0]
    np.testing.assert_allclose(centres, execution.cup_pose[:, :3], atol=1e-6)
    quaternions = np.array(column(file, "/cup/wall", "Transform3D:quaternion"))[:, 0]
    np.testing.assert_allclose(quaternions, execution.cup_pose[:, 3:], atol=1e-6)
    assert column(file, "/cup/wall", "Cylinders3D:lengths")[0] == pytest.approx([CUP.height_m])
    assert column(file, "/cup/wall", "Cylinders3D:radii")[0] == pytest.approx([0.035])


def test_the_series_say_what_the_execution_found(file: Path, record: ExecutionRecord) -> None:
    execution = record.execution
    counted = np.array(column(file, "/cup_spheres", "Scalars:scalars"))[:, 0]
    np.testing.assert_array_equal(counted, in_cup(execution, CUP))
    assert (counted[0], counted[-1]) == (4, 0) == (execution.spheres, execution.kept)
    tilts = np.array(column(file, "/cup_tilt", "Scalars:scalars"))[:, 0]
    np.testing.assert_allclose(tilts, np.degrees(tilt(execution)))
    assert tilts[0] < 0.1
    assert tilts.max() == pytest.approx(np.degrees(execution.largest_tilt_rad), abs=0.5)
    (text,) = column(file, "/status", "TextDocument:text")
    assert "0 of 4 spheres stayed in the cup" in text[0]
    assert "**straight joint line**, constraint `level_cup`, query 2" in text[0]


def test_equal_executions_give_equal_recordings(
    file: Path, record: ExecutionRecord, scene: Scene, tmp_path: Path
) -> None:
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_execution(again, record, scene.robot, scene.workcell)
    record_execution(other, replace(record, query=3), scene.robot, scene.workcell)
    assert same_recordings(file, again)
    assert not same_recordings(file, other)


def test_without_meshes_a_recording_is_small(
    record: ExecutionRecord, scene: Scene, tmp_path: Path
) -> None:
    file = tmp_path / "new" / "execution.rrd"
    record_execution(file, record, scene.robot, scene.workcell, meshes=False)
    assert read_recording(file).meshes == 0
    assert file.stat().st_size < 0.3e6


def test_files_are_named_by_query_and_kind() -> None:
    assert execution_name(2, "straight joint line") == "query2-straight-joint-line"
