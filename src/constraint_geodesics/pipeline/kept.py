"""Rows of a long stage, written down task by task: an interrupted run of it is gone on with."""

import json
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from constraint_geodesics.params import ComputeParams, Params
from constraint_geodesics.pipeline.code import code_digest, code_lines, data_digest, digest
from constraint_geodesics.pipeline.compute import as_finished
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.text_files import kept_json, write_text

Item = TypeVar("Item")
Rows = list[dict[str, Any]]


def kept_folder(params: Params, layout: Layout, stage: str, *data: Path) -> Path:
    """Where rows of a stage are until all are there: those of these parameters, this code, machine
    and data alone.  data: folders that it reads.
    """
    script = layout.root / "stages" / f"{stage}.py"
    code = digest(script), code_lines(script), code_digest()
    told = [params.model_dump_json(), *code, data_digest(*data), *machine().values()]
    return layout.scratch(stage, sha256(" ".join(told).encode()).hexdigest()[:12])


def kept_map(
    function: Callable[[Item], Rows],
    items: Sequence[Item],
    folder: Path,
    settings: ComputeParams,
    *,
    description: str,
) -> list[Rows]:
    """`parallel_map`, but that items whose rows lie in the folder are not done again.  Rows are
    what JSON holds; the caller removes the folder when all is written.
    """
    files = [folder / f"{k}.json" for k in range(len(items))]
    found: list[Rows | None] = [kept_json(file) for file in files]
    left = [k for k, rows in enumerate(found) if rows is None]
    todo = [items[k] for k in left]
    for place, rows in as_finished(function, todo, settings, description=description):
        text = json.dumps(rows)
        write_text(files[left[place]], text)
        found[left[place]] = json.loads(text)  # as whoever goes on with it has them
    return [rows for rows in found if rows is not None]
