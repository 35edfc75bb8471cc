"""Recordings of the paths that a table reports, one file a path."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certifier import Limits
from constraint_geodesics.constraints.pose import ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GridSubmanifold, Submanifold
from constraint_geodesics.recording.recording import LatentView, PathRecord, record_path
from constraint_geodesics.scene.world import Solid

PRINCIPAL = ("first principal axis", "second principal axis")
GRID_POINTS = 80
"""At most so many points a side of a latent grid in a recording: finer ones are larger and show
nothing more.
"""


@dataclass(frozen=True)
class Setting:
    """What a table's paths keep and stand in: the robot's constraint, its part of a learned
    manifold, and the workcell.
    """

    constraint: str
    manifold: ConstraintManifold
    learned: LearnedManifold
    submanifold: Submanifold
    workcell: Sequence[Solid]


def record_rows(
    setting: Setting,
    rows: Sequence[Mapping[str, Any]],
    paths: Sequence[Float[np.ndarray, "T D"]],
    frames: int,
) -> None:
    """Record the path of each row in the file that its `recording` names, without meshes."""
    for row, joints in zip(rows, paths, strict=True):
        record = PathRecord(
            row["planner"],
            setting.constraint,
            row["query"],
            row["seed"],
            joints,
            status_text(row, setting.constraint),
            latent_view(setting.submanifold, setting.learned, joints),
        )
        file = Path(row["recording"])
        file.parent.mkdir(parents=True, exist_ok=True)
        record_path(file, record, setting.manifold, setting.workcell, frames=frames, meshes=False)


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
    centre, axes = principal_plane(submanifold.latent)
    points, names = (submanifold.latent - centre) @ axes.T, PRINCIPAL
    return LatentView(points, submanifold.labels, (curve - centre) @ axes.T, names)


def principal_plane(
    points: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "2 d"]]:
    """Mean of some points and their first two principal axes, each with its largest entry
    positive.
    """
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
    largest = np.abs(axes).argmax(axis=1)
    return centre, axes * np.sign(axes[np.arange(len(axes)), largest])[:, None]


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
