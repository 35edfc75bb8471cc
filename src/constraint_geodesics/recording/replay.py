"""Recordings of the paths that a table reports, one file a path."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from sklearn.decomposition import PCA

from constraint_geodesics.certification.certifier import Limits
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GridSubmanifold, Submanifold
from constraint_geodesics.params import RecordingParams
from constraint_geodesics.recording.recording import LatentView, PathRecord, record_path
from constraint_geodesics.scene.world import Solid

GRID_POINTS = 80
"""At most so many points a side of a latent grid in a recording: finer ones are larger and show
nothing more.
"""


def record_rows(
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    paths: Sequence[Float[np.ndarray, "T D"]],
    constraint: str,
    chart: LearnedManifold,
    manifold: ConstraintManifold,
    submanifold: Submanifold,
    workcell: Sequence[Solid],
    params: RecordingParams,
) -> list[dict[str, Any]]:
    """Record the paths of the first queries, without meshes.

    Returns the rows with the file of each, or "", as `recording`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    named = []
    for row, joints in zip(rows, paths, strict=True):
        file = folder / f"query{row['query']}-{row['planner']}-seed{row['seed']}.rrd"
        recorded = row["query"] < params.queries and len(joints) > 1
        if recorded:
            latent = latent_view(submanifold, chart, joints)
            record = PathRecord(
                row["planner"],
                constraint,
                row["query"],
                row["seed"],
                joints,
                status_text(row, constraint),
                latent,
            )
            record_path(file, record, manifold, workcell, frames=params.frames, meshes=False)
        named.append({**row, "recording": file.as_posix() if recorded else ""})
    return named


def save_paths(
    rows: Sequence[Mapping[str, Any]], paths: Sequence[Float[np.ndarray, "T D"]], folder: Path
) -> None:
    """All joint paths [rad] of a table in one npz, named <planner>-<query>-<seed>."""
    folder.mkdir(parents=True, exist_ok=True)
    named = {
        f"{row['planner']}-{row['query']}-{row['seed']}": path
        for row, path in zip(rows, paths, strict=True)
    }
    np.savez_compressed(folder / "paths.npz", **named)  # type: ignore[arg-type]


def latent_view(
    submanifold: Submanifold, chart: LearnedManifold, joints: Float[np.ndarray, "T D"]
) -> LatentView:
    """The sub-manifold and an encoded path: the latent plane itself, or its first two principal
    axes.
    """
    curve = chart.encode(joints)
    if isinstance(submanifold, GridSubmanifold):
        stride = math.ceil(len(submanifold.first_axis) / GRID_POINTS)
        first, second = submanifold.first_axis[::stride], submanifold.second_axis[::stride]
        points = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1).reshape(-1, 2)
        values = submanifold.inclusion[::stride, ::stride].reshape(-1)
        return LatentView(points, values, curve, ("z1", "z2"))
    plane = PCA(2, svd_solver="full").fit(submanifold.latent)
    names = ("first principal axis", "second principal axis")
    return LatentView(
        plane.transform(submanifold.latent), submanifold.labels, plane.transform(curve), names
    )


def status_text(row: Mapping[str, Any], constraint: str) -> str:
    """What a viewer is told of the path."""
    allowed = Limits.violation_tolerance
    verdict = "valid" if row["valid"] else f"not valid: {row['reason']}"
    return "\n".join(
        (
            f"**{row['planner']}**, constraint `{constraint}`, query {row['query']}, seed "
            f"{row['seed']}",
            "",
            f"- {verdict}",
            f"- joint length {row['length_rad']:.3f} rad, tool {row['tool_length_m']:.3f} m",
            f"- largest violation {np.degrees(row['max_violation_rad']):.4f}°, "
            f"{1e3 * row['max_violation_m']:.4f} mm "
            f"(the judge allows {np.degrees(allowed):.4f}°, {1e3 * allowed:.4f} mm)",
        )
    )
