"""Recordings of the paths that a table reports, one file a path, without meshes."""

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
from constraint_geodesics.params import RecordingParams
from constraint_geodesics.recording.recording import LatentView, PathRecord, record_path
from constraint_geodesics.scene.world import Solid

GRID_POINTS = 80
"""At most so many points a side of a latent grid: finer ones are larger and show no more."""


@dataclass(frozen=True)
class RowRecorder:
    """Records the first queries' paths of one constraint on one learned manifold."""

    folder: Path
    constraint: str
    manifold: ConstraintManifold
    workcell: Sequence[Solid]
    learned: LearnedManifold
    submanifold: Submanifold
    params: RecordingParams

    def record(
        self, rows: Sequence[Mapping[str, Any]], paths: Sequence[Float[np.ndarray, "T D"]]
    ) -> list[dict[str, Any]]:
        """The rows with the file of each, or "", as `recording`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return [
            {**row, "recording": self._record(row, joints)}
            for row, joints in zip(rows, paths, strict=True)
        ]

    def _record(self, row: Mapping[str, Any], joints: Float[np.ndarray, "T D"]) -> str:
        if row["query"] >= self.params.queries or len(joints) < 2:
            return ""
        planner, query, seed = row["planner"], row["query"], row["seed"]
        file = self.folder / f"query{query}-{planner}-seed{seed}.rrd"
        text, latent = status_text(row, self.constraint), self._latent_view(joints)
        path = PathRecord(planner, self.constraint, query, seed, joints, text, latent, meshes=False)
        record_path(file, path, self.manifold, self.workcell, frames=self.params.frames)
        return file.as_posix()

    def _latent_view(self, joints: Float[np.ndarray, "T D"]) -> LatentView:
        """The sub-manifold and the encoded path in the latent plane, or in two principal axes."""
        from sklearn.decomposition import PCA

        curve, submanifold = self.learned.encode(joints), self.submanifold
        if isinstance(submanifold, GridSubmanifold):
            stride = math.ceil(len(submanifold.first_axis) / GRID_POINTS)
            axes = submanifold.first_axis[::stride], submanifold.second_axis[::stride]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            values = submanifold.inclusion[::stride, ::stride].reshape(-1)
            return LatentView(points, values, curve, ("z1", "z2"))
        plane = PCA(2, svd_solver="full").fit(submanifold.latent)
        points, curve = plane.transform(submanifold.latent), plane.transform(curve)
        names = ("first principal axis", "second principal axis")
        return LatentView(points, submanifold.labels, curve, names)


def save_paths(
    rows: Sequence[Mapping[str, Any]], paths: Sequence[Float[np.ndarray, "T D"]], folder: Path
) -> None:
    """All joint paths [rad] of a table in one npz, named <planner>-<query>-<seed>."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{row['planner']}-{row['query']}-{row['seed']}" for row in rows]
    named = dict(zip(names, paths, strict=True))
    np.savez_compressed(folder / "paths.npz", **named)  # type: ignore[arg-type]


def status_text(row: Mapping[str, Any], constraint: str) -> str:
    """What a viewer reads of the path."""
    allowed = Limits.violation_tolerance
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
