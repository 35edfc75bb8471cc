"""Labelled joint configurations: drawn in shards, projected, judged by PyBullet, kept as parquet.

A shard's rows depend on its seed alone, and each opens a physics world of its own (a world
remembers contacts), so the bytes are the same for any number of workers.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import StringIO
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
from constraint_geodesics.parquet_files import read_parquet
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.text_files import read_text, reason_of, written

POSE_COLUMNS = (*(f"tool_{x}" for x in "xyz"), *(f"quaternion_{x}" for x in "xyzw"))
RPY_COLUMNS = ("roll", "pitch", "yaw")
UNITS = {"tool": "m", "quaternion": "1", "residual": "m or rad"} | dict.fromkeys(
    ("self", "workcell"), "bool"
)
"""Of columns, by the first part of their names; the others are in rad."""
HISTOGRAM_BINS = 24


class DatasetError(ValueError):
    """A table that can't be used, or a constraint that no configuration satisfies."""


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
    """Start and goal pairs [rad] on one constraint manifold, free and within the limits."""

    starts: Float[np.ndarray, "n D"]
    goals: Float[np.ndarray, "n D"]

    def __len__(self) -> int:
        return len(self.starts)


def seed_of(constraint: str, seed: int) -> tuple[int, int]:
    """A seed in which the constraint's name takes part."""
    return seed, zlib.crc32(constraint.encode())


def shard_tasks(whole: ShardTask, shard_rows: int) -> list[ShardTask]:
    """A task in shards of so many rows at most, each with a seed of its own."""
    sizes = [min(shard_rows, whole.rows - first) for first in range(0, whole.rows, shard_rows)]
    return [replace(whole, rows=n, seed=(*whole.seed, i)) for i, n in enumerate(sizes)]


def draw_shard(task: ShardTask) -> Shard:
    """Draw uniformly within the limits, project onto the constraint, keep what stays, label it.

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


def draw_free(task: ShardTask) -> Float[np.ndarray, "m D"]:
    """Those of a shard's configurations that are free of collision."""
    frame = draw_shard(task).frame
    return joints_of(frame)[free_rows(frame)]


def _label(task: ShardTask, joints: np.ndarray) -> pd.DataFrame:
    with task.scene.world() as world:
        labels = world.label(joints)
    columns: dict[str, np.ndarray] = {
        f"joint_{i + 1}": joints[:, i] for i in range(joints.shape[1])
    }
    poses = np.concatenate([labels.position, labels.quaternion], axis=1)
    columns |= dict(zip(POSE_COLUMNS, poses.T, strict=True))
    columns |= dict(zip(RPY_COLUMNS, labels.rpy.T, strict=True))
    columns["self_collision"] = labels.self_collision
    columns["workcell_collision"] = labels.workcell_collision
    columns["limit_distance"] = task.scene.robot.limit_distance(joints)
    if not task.manifold.constraint.is_free:
        columns["residual"] = task.manifold.violation(joints)
    return pd.DataFrame(columns)


def draw_queries(
    scene: Scene, manifold: ConstraintManifold, name: str, count: int, seed: int
) -> Queries:
    """Pairs of configurations drawn like the data, from a seed of their own, and free."""
    ends = np.empty((0, scene.robot.dof))
    for attempt in range(100):
        task = ShardTask(scene, manifold, 4 * count, (*seed_of(name, seed), attempt, 1))
        ends = np.concatenate([ends, draw_free(task)])
        if len(ends) >= 2 * count:
            return Queries(ends[:count], ends[count : 2 * count])
    raise DatasetError(f"constraint {name!r}: hardly any configuration is free of collision")


def data_card(shards: Sequence[Shard]) -> dict[str, Any]:
    """Counts, ranges, rejected fractions and histograms of one set."""
    frame = pd.concat([shard.frame for shard in shards], ignore_index=True)
    drawn = sum(shard.drawn for shard in shards)
    numeric = frame.select_dtypes("number")
    ranges = {str(name): [float(x.min()), float(x.max())] for name, x in numeric.items()}
    histograms = {}
    for name, values in numeric.items():
        counts, edges = np.histogram(values, bins=HISTOGRAM_BINS)
        first, last = float(edges[0]), float(edges[-1])
        histograms[str(name)] = {"first": first, "last": last, "counts": counts.tolist()}
    return {
        "rows": len(frame),
        "drawn": drawn,
        "rejected_not_converged": sum(shard.not_converged for shard in shards) / drawn,
        "rejected_outside_limits": sum(shard.outside_limits for shard in shards) / drawn,
        "self_collision": float(frame["self_collision"].mean()),
        "workcell_collision": float(frame["workcell_collision"].mean()),
        "free": float(free_rows(frame).mean()),
        "ranges": ranges,
        "histograms": histograms,
    }


def write_joints(shards: Sequence[Shard], file: Path, about: dict[str, str]) -> None:
    """One parquet file: each column's unit in its field, `about` (seed, robot …) in the schema."""
    frame = pd.concat([shard.frame for shard in shards], ignore_index=True)
    table = pa.Table.from_pandas(frame, preserve_index=False)
    fields = [
        field.with_metadata({"unit": UNITS.get(field.name.split("_")[0], "rad")})
        for field in table.schema
    ]
    table = table.cast(
        pa.schema(fields, metadata={"constraint_geodesics." + k: v for k, v in about.items()})
    )
    with written(file) as part:
        pq.write_table(table, part, compression="zstd", write_page_checksum=True)


def read_joints(file: Path) -> JointSet:
    """Read and check one set.  Raises DatasetError with file and column of a bad row."""
    try:
        table = read_parquet(file)
    except FileNotFoundError:
        raise DatasetError(f"{file}: missing") from None
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DatasetError(f"{file}: no table of configurations: {reason_of(error)}") from None
    if table.empty:
        raise DatasetError(f"{file}: has no rows")
    frame = _checked(table, file)
    return JointSet(joints_of(frame), free_rows(frame))


def write_queries(queries: Queries, file: Path) -> None:
    """One row a query: start_1 … start_D, goal_1 … goal_D [rad]."""
    columns = {
        f"{end}_{i + 1}": values[:, i]
        for end, values in (("start", queries.starts), ("goal", queries.goals))
        for i in range(values.shape[1])
    }
    with written(file) as part:
        pd.DataFrame(columns).rename_axis("query").to_csv(part)


def read_queries(file: Path) -> Queries:
    """Read what `write_queries` wrote.  Raises DatasetError, one line, for what is none."""
    try:
        text = StringIO(read_text(file))
        frame = pd.read_csv(text, index_col="query", float_precision="round_trip")
        first, last = (frame.filter(like=f"{end}_").to_numpy(float) for end in ("start", "goal"))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{file}: no table of queries: {reason_of(error)}") from None
    if first.shape != last.shape or not first.size:
        what = f"starts {first.shape} and goals {last.shape}"
        raise DatasetError(f"{file}: no table of queries: has {what}")
    bad = np.flatnonzero(~np.isfinite(np.hstack([first, last])).all(axis=1))
    if len(bad):
        raise DatasetError(f"{file}: query {frame.index[bad[0]]}: must be finite numbers")
    return Queries(first, last)


def joints_of(frame: pd.DataFrame) -> Float[np.ndarray, "n D"]:
    """The joint columns, in their order."""
    return frame.filter(regex=r"^joint_\d+$").to_numpy(float)


def free_rows(frame: pd.DataFrame) -> Bool[np.ndarray, "n"]:
    """Which rows are free of collision."""
    return ~(frame["self_collision"] | frame["workcell_collision"]).to_numpy(bool)


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
    except (pandera.errors.SchemaError, pandera.errors.SchemaErrors) as error:
        raise DatasetError(f"{file}: {' '.join(str(error).split())[:300]}") from None
