"""What is kept of the benchmark's paths: recordings of those that are looked at side by side, or
the paths themselves.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.benchmark.runner import Answer
from constraint_geodesics.recording.recorder import status_text
from constraint_geodesics.recording.recording import PathRecord, record_path
from constraint_geodesics.text_files import reading, written


def first_queries(queries: Sequence[Query]) -> frozenset[tuple[str, str, int]]:
    """The first query of each constraint and scene."""
    first: dict[tuple[str, str], int] = {}
    for query in queries:
        first.setdefault((query.constraint, query.scene), query.number)
    return frozenset((*case, number) for case, number in first.items())


@dataclass(frozen=True)
class PathRecorder:
    """Records the first seed's path of the named planners and queries; picklable.

    root: the checkout, which the file names are relative to.  queries: constraint, scene and
    number of each.  frames: of a recording.  tolerance: what the judge grants a violation
    [rad or m].
    """

    root: Path
    folder: Path
    planners: tuple[str, ...]
    queries: frozenset[tuple[str, str, int]]
    frames: int
    tolerance: float

    def __call__(self, answer: Answer) -> str:
        """The file, relative to the root if it lies there, or "" where the path is not recorded."""
        query, planner = answer.query, answer.planner
        asked = (query.constraint, query.scene, query.number) in self.queries
        if planner not in self.planners or answer.seed != 0 or not asked:
            return ""
        plain = re.sub(r"[^a-z0-9]+", "_", planner.lower()).strip("_")
        name = f"{query.scene}-query{query.number}-{plain}.rrd"
        row = {"planner": planner, "query": query.number, "seed": answer.seed}
        measured = {**asdict(answer.measures), **row}
        text = status_text(measured, query.constraint, self.tolerance)
        record = PathRecord(
            planner,
            query.constraint,
            query.number,
            answer.seed,
            answer.joints,
            f"{text}\n- scene `{query.scene}`",
            scene=query.scene,
            tolerance=self.tolerance,
            meshes=False,
        )
        file = (self.folder / query.constraint / name).resolve()
        around, carried = answer.scene.workcell, answer.scene.attached
        record_path(file, record, answer.manifold, around, frames=self.frames, attached=carried)
        root = self.root.resolve()
        return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.as_posix()


@dataclass(frozen=True)
class PathKeeper:
    """Keeps every path [rad] in a file of its own, for a stage that goes on with it; picklable."""

    folder: Path

    def __call__(self, answer: Answer) -> str:
        """It is no recording."""
        with written(self._file(answer.planner, answer.query.number, answer.seed)) as part:
            np.save(part, answer.joints)
        return ""

    def path(self, row: Mapping[str, Any], dof: int) -> Float[np.ndarray, "T D"]:
        """The path of a row, or (0, D)."""
        file = self._file(str(row["planner"]), int(row["query"]), int(row["seed"]))
        found = np.isfinite(row["length_rad"]) and file.is_file()
        with reading(file):
            return np.load(file, allow_pickle=False) if found else np.empty((0, dof))

    def _file(self, planner: str, query: int, seed: int) -> Path:
        return self.folder / f"{planner}-{query}-{seed}.npy"
