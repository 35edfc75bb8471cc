"""Recordings of some of the benchmark's paths: of the planners that are looked at side by side, one
query a scene.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.recording.recorder import status_text
from constraint_geodesics.recording.recording import PathRecord, record_path
from constraint_geodesics.scene.scene import Scene


class Asked(Protocol):
    """What is asked of a query."""

    @property
    def constraint(self) -> str:
        """Its name."""
        ...

    @property
    def scene(self) -> str:
        """The scene's name."""
        ...

    @property
    def query(self) -> int:
        """Its number."""
        ...


@dataclass(frozen=True)
class PathRecorder:
    """Records the first seed's path of the named planners and queries; picklable.

    root: the checkout, which the file names are relative to.  queries: of each scene.  frames: of a
    recording.
    """

    root: Path
    folder: Path
    planners: tuple[str, ...]
    queries: Mapping[str, int]
    frames: int

    def __call__(
        self,
        case: Asked,
        planner: str,
        seed: int,
        joints: Float[np.ndarray, "T D"],
        measures: Any,
        scene: Scene,
        manifold: ConstraintManifold,
    ) -> str:
        """The file, relative to the root if it lies there, or "" where this path is not recorded.

        measures: a dataclass with valid, reason, length_rad, tool_length_m and max_violation_*, as
        a row of text.
        """
        if planner not in self.planners or seed != 0 or self.queries.get(case.scene) != case.query:
            return ""
        plain = re.sub(r"[^a-z0-9]+", "_", planner.lower()).strip("_")
        file = self.folder / case.constraint / f"{case.scene}-query{case.query}-{plain}.rrd"
        row = {**asdict(measures), "planner": planner, "query": case.query, "seed": seed}
        text = f"{status_text(row, case.constraint)}\n- scene `{case.scene}`"
        record = PathRecord(
            planner, case.constraint, case.query, seed, joints, text, scene=case.scene, meshes=False
        )
        record_path(file, record, manifold, scene.workcell, frames=self.frames)
        file, root = (
            file.resolve(),
            self.root.resolve(),
        )  # the root is mostly given as the folder one is in
        return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.as_posix()
