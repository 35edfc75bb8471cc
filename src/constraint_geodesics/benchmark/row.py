"""The benchmark's table: one row a planner, constraint, scene, query and seed."""

import gzip
import json
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from io import TextIOWrapper
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pandas as pd

from constraint_geodesics.text_files import reading, written

KEY = ("planner", "constraint", "scene", "query", "seed")
LATENT = "latent_length_"
"""Before a learned manifold's name: length of the encoded path on it (eq. 2)."""
SEAL = "crc32"
"""The checksum in a kept row; rows of before there was one have none."""
TEXTS = ("kind", "settings", "status", "reason", "recording")
COLUMNS = (
    *("planner", "kind", "settings", "constraint", "scene", "query", "seed"),
    *("status", "valid", "reason", "time_s", "iterations", "length_rad", "best_known_rad"),
    *("tool_length_m", "max_violation_rad", "max_violation_m", "max_step_rad"),
    *("touches", "looked_at"),
    *("peak_memory_mb", "scene_s", "core_share", "recording"),
)
"""Of the table, before the latent lengths.  planner: its name in params.yaml; kind: its file in
peers/; settings: a digest of all its settings, so that two rows with the same one are of the same
planner.  time_s: from the problem to the path; scene_s: its preparation for the scene;
core_share: of a core, that its process had meanwhile.  touches: 1 where PyBullet finds a contact on
the path, of looked_at configurations; blank in tables of before it was asked.
"""
NUMBERS = COLUMNS[COLUMNS.index("time_s") : -1]
_OLD_NAMES = {"latent_length": f"{LATENT}planner"}


def key_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What tells a row from all others."""
    return tuple(row[name] for name in KEY)


def row_line(row: Mapping[str, Any]) -> str:
    """A row as a line of JSON, with a checksum of the rest."""
    return json.dumps({**row, SEAL: _seal(row)}, allow_nan=False)


def _seal(row: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps({name: row[name] for name in row if name != SEAL}).encode())


def read_rows(file: Path, wanted: Mapping[str, str]) -> list[dict[str, Any]]:
    """Rows of a file of JSON lines whose planner has the wanted fingerprint, the last of each key;
    no torn lines, and none whose checksum differs.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for line in file.read_text(errors="replace").splitlines() if file.is_file() else ():
        try:
            row = json.loads(line)
        except ValueError:  # killed while it was written
            continue
        if not isinstance(row, dict) or row.pop(SEAL, None) not in (None, _seal(row)):
            continue  # damaged since: asked again
        if "started" not in row and wanted.get(str(row.get("planner")), "") == row.get(
            "fingerprint"
        ):
            found[key_of(row)] = row
    return list(found.values())


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """All rows with best_known_rad, the shortest valid path that any planner and seed found for the
    query.
    """
    table = _completed(pd.DataFrame(rows))
    assert not table.duplicated(list(KEY)).any()
    best = (
        table["length_rad"]
        .where(table["valid"])
        .groupby([table[k] for k in ("constraint", "scene", "query")])
    )
    table["best_known_rad"] = best.transform("min")
    return table.sort_values(list(KEY), kind="stable", ignore_index=True)


def _completed(table: pd.DataFrame) -> pd.DataFrame:
    """The table's columns in their order, blank where an older file has none."""
    table = table.rename(columns=_OLD_NAMES)
    texts = {name: table[name].fillna("") if name in table else "" for name in TEXTS}
    blank = {name: np.nan for name in COLUMNS if name not in table}
    latent = [str(name) for name in table if str(name).startswith(LATENT)]
    table = table.assign(**{**blank, **texts})[[*COLUMNS, *latent]]
    return table.astype(dict.fromkeys((*NUMBERS, *latent), float))


def write_table(table: pd.DataFrame, file: Path, about: Mapping[str, str]) -> None:
    """Write the rows as CSV, with a comment line for each entry of `about` (commit, lock file,
    processor) before; gzipped where the file is called so, the same bytes for the same rows.
    """
    with written(file) as part, ExitStack() as opened:
        if file.suffix == ".gz":
            raw = opened.enter_context(part.open("wb"))
            packed = opened.enter_context(gzip.GzipFile("", "wb", fileobj=raw, mtime=0))
            lines: TextIO = opened.enter_context(TextIOWrapper(packed, encoding="utf-8"))
        else:
            lines = opened.enter_context(part.open("w"))
        lines.writelines(f"# {name}: {' '.join(value.split())}\n" for name, value in about.items())
        table.to_csv(lines, index=False, float_format="%.12g")


def read_table(file: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """The rows of `write_table`, and what its comment lines say; columns that an older table does
    not have are blank.
    """
    with reading(file):
        opened = gzip.open if file.suffix == ".gz" else open
        with opened(file, "rt", encoding="utf-8") as lines:
            head = [line[2:].split(": ", 1) for line in lines if line.startswith("# ")]
        table = pd.read_csv(
            file, comment="#", float_precision="round_trip", dtype=dict.fromkeys(TEXTS, str)
        )
        return _completed(table), {name: value.strip() for name, value in head}
