"""Joint paths that one stage finds and another records: kept apart from how they are drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.array_files import read_npz
from constraint_geodesics.text_files import written

Row = Mapping[str, Any]


def named_recordings(
    rows: Sequence[Row], paths: Sequence[Float[np.ndarray, "T D"]], folder: Path, queries: int
) -> list[dict[str, Any]]:
    """The rows with the file under which each path of the first queries will be recorded, or "", as
    `recording`.

    rows: with planner, query and seed.
    """
    named = []
    for row, joints in zip(rows, paths, strict=True):
        file = folder / f"query{row['query']}-{row['planner']}-seed{row['seed']}.rrd"
        recorded = row["query"] < queries and len(joints) > 1
        named.append({**row, "recording": file.as_posix() if recorded else ""})
    return named


def save_paths(
    rows: Sequence[Row], paths: Sequence[Float[np.ndarray, "T D"]], folder: Path
) -> None:
    """All joint paths [rad] of a table in one npz, for `read_paths`."""
    named = {_name(row): path for row, path in zip(rows, paths, strict=True)}
    with written(folder / "paths.npz") as part:
        np.savez_compressed(part, **named)  # type: ignore[arg-type]


def read_paths(rows: Sequence[Row], folder: Path) -> list[Float[np.ndarray, "T D"]]:
    """The paths of some rows of the table that `save_paths` kept."""
    kept = read_npz(folder / "paths.npz")
    return [kept[_name(row)] for row in rows]


def _name(row: Row) -> str:
    return f"{row['planner']}-{row['query']}-{row['seed']}"
