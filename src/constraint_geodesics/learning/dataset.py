"""Labelled joint configurations: drawn in shards, projected onto a constraint, judged by PyBullet,
kept as parquet.

A shard's rows depend on its seed alone, and every shard opens a physics world of its own (a world
remembers contacts), so the bytes written are the same whatever the number of workers.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pandera.pandas as pandera
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.scene.scene import Scene

POSE_COLUMNS = (
    "tool_x",
    "tool_y",
    "tool_z",
    "quaternion_x",
    "quaternion_y",
    "quaternion_z",
    "quaternion_w",
)
RPY_COLUMNS = ("roll", "pitch", "yaw")
UNITS = {
    "joint": "rad",
    "tool": "m",
    "quaternion": "1",
    "roll": "rad",
    "pitch": "rad",
    "yaw": "rad",
    "self_collision": "bool",
    "workcell_collision": "bool",
    "limit_distance": "rad",
    "residual": "m or rad",
}
HISTOGRAM_BINS = 24

Map = Callable[[Callable[["ShardTask"], "Shard"], Sequence["ShardTask"]], list["Shard"]]


class DatasetError(ValueError):
    """A table that can't be used, or a constraint that no configuration satisfies; the message says
    which.
    """


@dataclass(frozen=True)
class ShardTask:
    """One shard to draw: so many rows on one constraint manifold from one seed."""

    scene: Scene
    manifold: ConstraintManifold
    rows: int
    seed: tuple[int, ...]


@dataclass(frozen=True)
class Shard:
    """Labelled rows, and how many configurations were drawn and turned away for them."""

    frame: pd.DataFrame
    drawn: int
    not_converged: int
    outside_limits: int


@dataclass(frozen=True)
class JointSet:
    """The labelled configurations of one constraint."""

    joints: Float[np.ndarray, "n D"]
    free: Bool[np.ndarray, "n"]
    """Touching neither the arm itself nor the workcell."""

    @property
    def free_joints(self) -> Float[np.ndarray, "m D"]:
        """Only the configurations free of collision."""
        return self.joints[self.free]


@dataclass(frozen=True)
class Queries:
    """Start and goal pairs [rad] on one constraint manifold, free of collision and within the
    limits.
    """

    starts: Float[np.ndarray, "n D"]
    goals: Float[np.ndarray, "n D"]

    def __len__(self) -> int:
        return len(self.starts)


def shard_tasks(
    scene: Scene, manifold: ConstraintManifold, name: str, rows: int, shard_rows: int, seed: int
) -> list[ShardTask]:
    """The shards of one constraint's set; the constraint's name takes part in the seed."""
    sizes = [min(shard_rows, rows - first) for first in range(0, rows, shard_rows)]
    return [
        ShardTask(scene, manifold, n, (seed, zlib.crc32(name.encode()), i))
        for i, n in enumerate(sizes)
    ]


def draw_shard(task: ShardTask) -> Shard:
    """Draw uniformly within the limits, project onto the constraint, keep what stays within them,
    and label it.

    A tolerance is used evenly: each configuration is projected onto its own share of the band.
    Raises DatasetError if hardly anything satisfies the constraint within the limits.
    """
    rng = np.random.default_rng(task.seed)
    robot, manifold = task.scene.robot, task.manifold
    kept: list[np.ndarray] = []
    count = drawn = not_converged = outside = 0
    while count < task.rows:
        candidates = robot.sample(max(task.rows - count, 64), rng)
        share = rng.uniform(size=len(candidates)) ** (1.0 / max(manifold.rows.held.sum(), 1))
        result = retract(manifold, candidates, Retraction(), band=share)
        inside = robot.limit_distance(result.joints) >= 0
        good = result.joints[result.converged & inside]
        drawn += len(candidates)
        not_converged += int((~result.converged).sum())
        outside += int((result.converged & ~inside).sum())
        kept.append(good)
        count += len(good)
        if drawn > 1000 * task.rows and count < task.rows:
            raise DatasetError(
                f"only {count} of {drawn} configurations satisfy the constraint within the limits"
            )
    joints = np.concatenate(kept)[: task.rows]
    return Shard(_label(task, joints), drawn, not_converged, outside)


def _label(task: ShardTask, joints: np.ndarray) -> pd.DataFrame:
    with task.scene.world() as world:
        labels = world.label(joints)
    columns: dict[str, np.ndarray] = {
        f"joint_{i + 1}": joints[:, i] for i in range(joints.shape[1])
    }
    poses = np.concatenate([labels.position, labels.quaternion], axis=1)
    columns |= dict(zip(POSE_COLUMNS, poses.T, strict=True)) | dict(
        zip(RPY_COLUMNS, labels.rpy.T, strict=True)
    )
    columns["self_collision"] = labels.self_collision
    columns["workcell_collision"] = labels.workcell_collision
    columns["limit_distance"] = task.scene.robot.limit_distance(joints)
    if not task.manifold.constraint.is_free:
        columns["residual"] = task.manifold.violation(joints)
    return pd.DataFrame(columns)


def draw_queries(
    scene: Scene, manifold: ConstraintManifold, name: str, count: int, seed: int
) -> Queries:
    """Pairs of configurations drawn like the data, from a seed of their own, and free of
    collision.
    """
    free: list[np.ndarray] = []
    found = 0
    for attempt in range(100):
        shard = draw_shard(
            ShardTask(scene, manifold, 4 * count, (seed, zlib.crc32(name.encode()), attempt, 1))
        )
        free.append(joints_of(shard.frame)[free_rows(shard.frame)])
        found += len(free[-1])
        if found >= 2 * count:
            ends = np.concatenate(free)[: 2 * count]
            return Queries(ends[:count], ends[count:])
    raise DatasetError(f"constraint {name!r}: hardly any configuration is free of collision")


def data_card(shards: Sequence[Shard]) -> dict[str, Any]:
    """Counts, ranges, rejected fractions and histograms of one set."""
    frame = pd.concat([shard.frame for shard in shards], ignore_index=True)
    drawn = sum(shard.drawn for shard in shards)
    numeric = frame.select_dtypes("number")
    histograms = {}
    for name in numeric:
        counts, edges = np.histogram(numeric[name], bins=HISTOGRAM_BINS)
        histograms[str(name)] = {
            "first": float(edges[0]),
            "last": float(edges[-1]),
            "counts": counts.tolist(),
        }
    return {
        "rows": len(frame),
        "drawn": drawn,
        "rejected_not_converged": sum(shard.not_converged for shard in shards) / drawn,
        "rejected_outside_limits": sum(shard.outside_limits for shard in shards) / drawn,
        "self_collision": float(frame["self_collision"].mean()),
        "workcell_collision": float(frame["workcell_collision"].mean()),
        "free": float(free_rows(frame).mean()),
        "ranges": {
            str(name): [float(numeric[name].min()), float(numeric[name].max())] for name in numeric
        },
        "histograms": histograms,
    }


def write_joints(shards: Sequence[Shard], file: Path, about: dict[str, str]) -> None:
    """One parquet file, with each column's unit in its field and `about` (seed, robot, constraint)
    in the schema.
    """
    frame = pd.concat([shard.frame for shard in shards], ignore_index=True)
    table = pa.Table.from_pandas(frame, preserve_index=False)
    fields = [field.with_metadata({"unit": _unit(field.name)}) for field in table.schema]
    table = table.cast(
        pa.schema(fields, metadata={"constraint_geodesics." + k: v for k, v in about.items()})
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, file, compression="zstd")


def read_joints(file: Path) -> JointSet:
    """Read and check one set.  Raises DatasetError naming the file and the column if a row can't be
    used.
    """
    frame = _checked(pd.read_parquet(file), file)
    return JointSet(joints_of(frame), free_rows(frame))


def write_queries(queries: Queries, file: Path) -> None:
    """One row a query: start_1 … start_D, goal_1 … goal_D [rad]."""
    columns = {
        f"{end}_{i + 1}": values[:, i]
        for end, values in (("start", queries.starts), ("goal", queries.goals))
        for i in range(values.shape[1])
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(columns).rename_axis("query").to_csv(file)


def read_queries(file: Path) -> Queries:
    """Read what `write_queries` wrote."""
    frame = pd.read_csv(file, index_col="query", float_precision="round_trip")
    return Queries(*(frame.filter(like=f"{end}_").to_numpy(float) for end in ("start", "goal")))


def joints_of(frame: pd.DataFrame) -> Float[np.ndarray, "n D"]:
    """The joint columns, in their order."""
    return frame.filter(regex=r"^joint_\d+$").to_numpy(float)


def free_rows(frame: pd.DataFrame) -> Bool[np.ndarray, "n"]:
    """Which rows are free of collision."""
    return ~(frame["self_collision"] | frame["workcell_collision"]).to_numpy(bool)


def _unit(column: str) -> str:
    return UNITS[column] if column in UNITS else UNITS[column.split("_")[0]]


def _checked(frame: pd.DataFrame, file: Path) -> pd.DataFrame:
    finite = pandera.Check(np.isfinite, error="finite")
    schema = pandera.DataFrameSchema(
        {
            r"^joint_\d+$": pandera.Column(float, finite, regex=True),
            **{name: pandera.Column(float, finite) for name in (*POSE_COLUMNS, *RPY_COLUMNS)},
            "self_collision": pandera.Column(bool),
            "workcell_collision": pandera.Column(bool),
            "limit_distance": pandera.Column(float, pandera.Check.ge(0)),
            "residual": pandera.Column(float, pandera.Check.in_range(0, 1e-6), required=False),
        },
        strict=True,
    )
    try:
        return schema.validate(frame)
    except pandera.errors.SchemaError as error:
        raise DatasetError(f"{file}: {' '.join(str(error).split())[:300]}") from None
