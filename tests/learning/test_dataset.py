import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from constraint_geodesics.constraints.pose import Constraint, ConstraintManifold, Pose
from constraint_geodesics.learning.dataset import (
    DatasetError,
    ShardTask,
    data_card,
    draw_queries,
    draw_shard,
    read_joints,
    read_queries,
    seed_of,
    shard_tasks,
    write_joints,
    write_queries,
)
from constraint_geodesics.pipeline.compute import parallel_map

ABOUT = {"seed": "1", "constraint": "level_cup"}


def labelled(scene, manifold, params, workers, rows=600):
    tasks = shard_tasks(ShardTask(scene, manifold, rows, seed_of("level_cup", 1)), 200)
    return parallel_map(draw_shard, tasks, params.compute.model_copy(update={"workers": workers}))


def test_bytes_do_not_depend_on_the_number_of_workers(scene, params, tmp_path) -> None:
    manifold = scene.manifold(params.constraints["level_cup"])
    for workers in (1, 2):
        write_joints(
            labelled(scene, manifold, params, workers), tmp_path / f"{workers}.parquet", ABOUT
        )
    assert (tmp_path / "1.parquet").read_bytes() == (tmp_path / "2.parquet").read_bytes()


def test_rows_are_what_pybullet_and_the_constraint_say(scene, params, tmp_path) -> None:
    manifold = scene.manifold(params.constraints["level_cup_relaxed"])
    shards = labelled(scene, manifold, params, 1, rows=400)
    write_joints(shards, tmp_path / "joints.parquet", ABOUT)
    schema = pq.read_schema(tmp_path / "joints.parquet")
    assert schema.field("tool_x").metadata == {b"unit": b"m"}
    assert schema.field("joint_1").metadata == {b"unit": b"rad"}
    assert schema.metadata[b"constraint_geodesics.seed"] == b"1"
    found = read_joints(tmp_path / "joints.parquet")
    assert len(found.joints) == 400
    assert manifold.violation(found.joints).max() <= 1e-9
    assert scene.robot.limit_distance(found.joints).min() >= 0
    tilt = np.linalg.norm(manifold.residual(found.joints)[:, 3:], axis=1)
    assert 0.3 < np.median(tilt) / np.radians(10.0) < 0.95, (
        "the whole band is used, not its edge alone"
    )
    with scene.world() as world:
        np.testing.assert_array_equal(world.free(found.joints), found.free)
    card = data_card(shards)
    assert card["rows"] == 400
    assert card["free"] == pytest.approx(found.free.mean())
    assert sum(card["histograms"]["joint_1"]["counts"]) == 400
    kept = card["drawn"] * (1 - card["rejected_not_converged"] - card["rejected_outside_limits"])
    assert kept >= 400


def test_queries_are_usable_ends_unlike_the_data(scene, params, tmp_path) -> None:
    manifold = scene.manifold(params.constraints["slide"])
    queries = draw_queries(scene, manifold, "slide", 5, 7)
    assert len(queries) == 5
    ends = np.concatenate([queries.starts, queries.goals])
    assert manifold.violation(ends).max() <= 1e-9
    with scene.world() as world:
        assert world.free(ends).all()
    write_queries(queries, tmp_path / "queries.csv")
    again = read_queries(tmp_path / "queries.csv")
    np.testing.assert_array_equal(again.goals, queries.goals)


def test_a_broken_table_is_named(scene, params, tmp_path) -> None:
    manifold = scene.manifold(params.constraints["level_cup"])
    file = tmp_path / "joints.parquet"
    write_joints(labelled(scene, manifold, params, 1, rows=50), file, ABOUT)
    frame = pd.read_parquet(file)
    frame.loc[3, "joint_2"] = np.nan
    frame.to_parquet(file)
    with pytest.raises(DatasetError, match="joint_2"):
        read_joints(file)


def test_a_constraint_out_of_reach_is_said(scene) -> None:
    far = Constraint((1, 1, 1, 0, 0, 0), reference=Pose.from_rpy([9.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
    manifold = ConstraintManifold(scene.robot, far)
    (task,) = shard_tasks(ShardTask(scene, manifold, 10, (1,)), 10)
    with pytest.raises(DatasetError, match="satisfy the constraint"):
        draw_shard(task)


def test_seven_joints_are_labelled_alike(kuka_scene) -> None:
    pose = Pose.from_rpy([0.4, 0.0, 0.4], [np.pi / 2, 0.0, 0.0])
    manifold = ConstraintManifold(kuka_scene.robot, Constraint((0, 0, 0, 1, 1, 0), reference=pose))
    (task,) = shard_tasks(ShardTask(kuka_scene, manifold, 100, (1,)), 100)
    frame = draw_shard(task).frame
    assert "joint_7" in frame
    assert frame["residual"].max() <= 1e-9
