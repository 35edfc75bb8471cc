"""A capsule from params.yaml to the recording: planned round, certified, drawn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from tests.planner_fixtures import packaged_planner, pairs_of

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.capsule import Capsule


def across(planner: Planner, name: str) -> tuple[Capsule, np.ndarray, np.ndarray]:
    """A tilted pipe through the place where the tool is halfway, and the ends of the path."""
    for start, goal in pairs_of(name, 12, seed=11):
        before = planner.plan(start, goal, name)
        if before.status != "solved" or before.length_rad < 2.0:
            continue
        middle = planner.scene.robot.forward(before.at(0.5))[0]
        x, y, z = (middle + np.array([0.03, 0.05, 0.15])).tolist()
        pipe = Capsule("pipe", (x, y, z), tuple((2.0 * middle - (x, y, z)).tolist()), 0.06)
        with replace(planner.scene.now, workcell=(*planner.scene.workcell, pipe)).world() as world:
            ends_free = world.is_free(start) and world.is_free(goal)
            if ends_free and world.first_collision(before.joints) is not None:
                return pipe, start, goal
    raise AssertionError("no query leaves room for a pipe")


@pytest.mark.parametrize("name", ["free", "level_cup"])
def test_a_path_goes_round_a_capsule_and_is_certified_and_recorded(
    name: str, tmp_path: Path
) -> None:
    planner = packaged_planner()
    pipe, start, goal = across(planner, name)
    bundle = replace(planner.bundle, workcell=planner.bundle.workcell.including(pipe))
    with Planner(bundle, "with a pipe") as other:
        path = other.plan(start, goal, name)
        assert path.status == "solved", path.explanation
        assert path.certificate is not None
        assert path.certificate.valid
        with other.scene.world() as world:
            assert world.first_collision(path.joints) is None
    file = tmp_path / "path.rrd"
    path.record(file)
    drawn = drawn_capsule(file)
    assert drawn["labels"] == ["pipe"]
    assert drawn["radii"] == pytest.approx([pipe.radius_m])
    turn = Rotation.from_quat(drawn["quaternions"][0]).as_matrix()
    top = np.array(drawn["translations"][0]) + turn[:, 2] * drawn["lengths"][0]
    np.testing.assert_allclose(drawn["translations"][0], pipe.from_m, atol=1e-6)
    np.testing.assert_allclose(top, pipe.to_m, atol=1e-6)


def drawn_capsule(file: Path) -> dict:
    """The components of the pipe in a recording."""
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/workcell/pipe":
            names = [name for name in batch.schema.names if ":" in name]
            return {name.split(":")[1]: batch.column(name)[0].as_py() for name in names}
    raise AssertionError(f"{file}: has no pipe")


def test_a_bundle_with_a_capsule_is_written_and_read(tmp_path: Path) -> None:
    bundle = packaged_planner().bundle
    pipe = Capsule("pipe", (0.5, -0.2, 0.4), (0.5, 0.2, 0.6), 0.05)
    replace(bundle, workcell=bundle.workcell.including(pipe)).write(tmp_path)
    assert read_bundle(tmp_path).workcell.shapes["pipe"] == pipe
