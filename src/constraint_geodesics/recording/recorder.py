"""Recordings of the paths that a table reports, one file a path, without meshes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GridSubmanifold, Submanifold
from constraint_geodesics.recording.recording import LatentView, PathRecord, record_path
from constraint_geodesics.scene.scene import Scene

PRINCIPAL = ("first principal axis", "second principal axis")
GRID_POINTS = 80
"""At most so many points a side of a latent grid: finer ones are larger and show no more."""


@dataclass(frozen=True)
class RowRecorder:
    """Records the paths of one constraint, searched on one learned manifold or shown on it."""

    constraint: str
    manifold: ConstraintManifold
    scene: Scene
    learned: LearnedManifold
    submanifold: Submanifold
    frames: int
    tolerance: float
    """What the judge grants a violation [rad or m]."""

    def record(
        self, rows: Sequence[Mapping[str, Any]], paths: Sequence[Float[np.ndarray, "T D"]]
    ) -> None:
        """Record the path of each row in the file that its `recording` names."""
        for row, joints in zip(rows, paths, strict=True):
            text = status_text(row, self.constraint, self.tolerance)
            key = row["planner"], self.constraint, row["query"], row["seed"]
            latent, allowed = self._latent_view(joints), self.tolerance
            path = PathRecord(*key, joints, text, latent, tolerance=allowed, meshes=False)
            file = Path(row["recording"])
            around, carried = self.scene.workcell, self.scene.attached
            record_path(file, path, self.manifold, around, frames=self.frames, attached=carried)

    def _latent_view(self, joints: Float[np.ndarray, "T D"]) -> LatentView:
        """The sub-manifold and the encoded path in the latent plane, or in two principal axes."""
        curve, submanifold = self.learned.encode(joints), self.submanifold
        if isinstance(submanifold, GridSubmanifold):
            stride = math.ceil(len(submanifold.first_axis) / GRID_POINTS)
            axes = submanifold.first_axis[::stride], submanifold.second_axis[::stride]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            values = submanifold.inclusion[::stride, ::stride].reshape(-1)
            return LatentView(points, values, curve, ("z1", "z2"))
        centre, plane = principal_plane(submanifold.latent)
        points, labels = (submanifold.latent - centre) @ plane.T, submanifold.labels
        return LatentView(points, labels, (curve - centre) @ plane.T, PRINCIPAL)


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


def status_text(row: Mapping[str, Any], constraint: str, allowed: float) -> str:
    """What a viewer reads of the path.  allowed: the violation that the judge grants [rad or m]."""
    verdict = "valid" if row["valid"] else f"not valid: {row['reason']}"
    degrees = (f"{np.degrees(angle):.4f}°" for angle in (row["max_violation_rad"], allowed))
    lengths = (f"{1e3 * length:.4f} mm" for length in (row["max_violation_m"], allowed))
    largest, limit = map(", ".join, zip(degrees, lengths, strict=True))
    return (
        f"**{row['planner']}**, constraint `{constraint}`, query {row['query']}, seed "
        f"{row['seed']}\n\n- {verdict}\n"
        f"- joint length {row['length_rad']:.3f} rad, tool {row['tool_length_m']:.3f} m\n"
        f"- largest violation {largest} (the judge allows {limit})"
    )
