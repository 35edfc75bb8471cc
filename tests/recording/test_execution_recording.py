"""Recordings of a real execution that spills, read back from the file."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.params import Params
from constraint_geodesics.recording.execution_recording import (
    ExecutionRecord,
    in_cup,
    record_execution,
    record_executions,
    tilt,
)
from constraint_geodesics.recording.recording import (
    About,
    RecordingError,
    read_recording,
    same_recordings,
)
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, execute

CUP = CupSettings(spheres=4, settle_s=0.2)
AXIS = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def record(scene: Scene, params: Params) -> ExecutionRecord:
    """A level cup turned over about the tool's axis."""
    near = np.array([-1.35, -0.47, -0.87, -2.28, 0.34, 0.74])
    start = retract(scene.manifold(params.constraints["level_cup"]), near).joints
    path = start + np.linspace(0.0, -2.6, 100)[:, None] * np.eye(6)[5]
    times = time_parametrisation(path, scene.robot.velocity, np.full(6, 4.0))
    execution = execute(scene, path, times, AXIS, CUP)
    return ExecutionRecord("straight joint line", "level_cup", 2, execution, CUP)


@pytest.fixture(scope="module")
def file(record: ExecutionRecord, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "folder" / "execution.rrd"
    record_execution(file, record, scene.robot, scene.workcell)
    return file


def column(file: Path, entity: str, component: str) -> tuple[list[Any], list[Any] | None]:
    """Rows of one component of one entity, and its times [s], straight from the file."""
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names:
            times = None
            if not chunk.is_static:
                times = [value.total_seconds() for value in batch.column("time").to_pylist()]
            return batch.column(component).to_pylist(), times
    raise AssertionError(f"{entity} has no {component}")


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
        "/spheres",
        "/cup_tilt",
        "/cup_spheres",
        "/workcell/table",
        "/status",
    } <= set(summary.entity_paths)
    assert summary.has_blueprint
    np.testing.assert_array_equal(summary.joints, execution.joints)
    ends = scene.robot.forward(execution.joints[[0, -1]])[0]
    np.testing.assert_allclose(summary.tool_ends, ends, atol=1e-6)
    assert file.stat().st_size < 2.5e6


def test_everything_moves_over_the_seconds_of_the_execution(
    file: Path, record: ExecutionRecord
) -> None:
    assert {name for chunk in RrdReader(file).stream() for name in chunk.timeline_names} == {"time"}
    for entity, component in (
        ("/transforms/joint6", "Transform3D:quaternion"),
        ("/spheres", "Points3D:positions"),
        ("/cup", "Transform3D:translation"),
        ("/cup/wall", "Transform3D:quaternion"),
        ("/cup_spheres", "Scalars:scalars"),
        ("/joints", "Scalars:scalars"),
    ):
        _, times = column(file, entity, component)
        assert times == pytest.approx(record.execution.times.tolist(), abs=1e-6)


def test_spheres_and_cup_are_where_the_simulation_had_them(
    file: Path, record: ExecutionRecord
) -> None:
    execution = record.execution
    positions = np.array(column(file, "/spheres", "Points3D:positions")[0])
    np.testing.assert_allclose(positions, execution.sphere_positions, atol=1e-6)
    assert len(set(column(file, "/spheres", "Points3D:colors")[0][0])) == CUP.spheres
    assert column(file, "/spheres", "Points3D:radii")[0][0] == pytest.approx([CUP.sphere_radius_m])
    centres = np.array(column(file, "/cup", "Transform3D:translation")[0])[:, 0]
    np.testing.assert_allclose(centres, execution.cup_pose[:, :3], atol=1e-6)
    quaternions = np.array(column(file, "/cup/wall", "Transform3D:quaternion")[0])[:, 0]
    np.testing.assert_allclose(quaternions, execution.cup_pose[:, 3:], atol=1e-6)
    assert column(file, "/cup/wall", "Cylinders3D:lengths")[0][0] == pytest.approx([CUP.height_m])
    assert column(file, "/cup/wall", "Cylinders3D:radii")[0][0] == pytest.approx([0.035])


def test_the_series_say_what_the_execution_found(file: Path, record: ExecutionRecord) -> None:
    execution = record.execution
    counted = np.array(column(file, "/cup_spheres", "Scalars:scalars")[0])[:, 0]
    np.testing.assert_array_equal(counted, in_cup(execution, CUP))
    assert (counted[0], counted[-1]) == (4, 0) == (execution.spheres, execution.kept)
    tilts = np.array(column(file, "/cup_tilt", "Scalars:scalars")[0])[:, 0]
    np.testing.assert_allclose(tilts, np.degrees(tilt(execution)))
    assert tilts[0] < 0.1
    assert tilts.max() == pytest.approx(np.degrees(execution.largest_tilt_rad), abs=0.5)
    (text,), _ = column(file, "/status", "TextDocument:text")
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


def test_each_record_gets_a_file_of_its_name(
    record: ExecutionRecord, scene: Scene, tmp_path: Path
) -> None:
    files = record_executions(tmp_path / "new", [None, record], scene.robot, scene.workcell)
    assert files == ["", (tmp_path / "new" / "query2-straight-joint-line.rrd").as_posix()]
    assert [path.as_posix() for path in (tmp_path / "new").iterdir()] == files[1:]
    assert read_recording(Path(files[1])).meshes == 0
    assert Path(files[1]).stat().st_size < 0.3e6


def test_what_does_not_fit_together_is_refused(
    record: ExecutionRecord, scene: Scene, kuka_scene: Scene, tmp_path: Path
) -> None:
    frames = len(record.execution.times)
    for wrong, robot, message in (
        (record, kuka_scene.robot, rf"joints of shape \({frames}, 6\): must be \({frames}, 7\)"),
        (
            replace(record, cup=CupSettings(spheres=5)),
            scene.robot,
            rf"query2-.*: sphere_positions of shape \({frames}, 4, 3\): must be \({frames}, 5, 3\)",
        ),
    ):
        with pytest.raises(RecordingError, match=message):
            record_execution(tmp_path / "execution.rrd", wrong, robot, scene.workcell)
    assert not (tmp_path / "execution.rrd").exists()
