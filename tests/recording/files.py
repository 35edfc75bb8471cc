"""What a recording's file holds, read straight from it; and bodies round the robots recorded."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import Chunk, RrdReader

from constraint_geodesics.constraints.constraint import Pose
from constraint_geodesics.recording.recording import rerun_command
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.urdf import data_path

TABLE = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1))
TRAY = Body("tray", data_path() / "tray" / "traybox.urdf", (0.6, 0.3, 0.1), (0.1, -0.2, 0.5))
HELD_AT = Pose.from_rpy((0.4, 0.0, 0.3), (np.pi / 2, 0.0, 0.0))
START, CHANGE = np.array([[0.3, -0.5, -1.0, 0.4, 0.5, 0.2], [0.8, 0.3, -0.2, 0.4, 0.2, 0.4]])
"""A path of the xArm, before it is retracted [rad]."""


def batches(file: Path) -> Iterator[tuple[Chunk, Any]]:
    """Every chunk, and its columns."""
    for chunk in RrdReader(file).stream():
        yield chunk, chunk.to_record_batch()


def columns(file: Path, entity: str, component: str) -> Any:
    """The columns of the chunk with one component of one entity."""
    for chunk, batch in batches(file):
        if chunk.entity_path == entity and component in batch.schema.names:
            return batch
    raise AssertionError(f"{entity} has no {component}")


def column(file: Path, entity: str, component: str) -> list[Any]:
    """Rows of one component of one entity."""
    rows: list[Any] = columns(file, entity, component).column(component).to_pylist()
    return rows


def seconds(file: Path, entity: str, component: str) -> list[float]:
    """When the rows of one component of one entity are [s]."""
    times = columns(file, entity, component).column("time").to_pylist()
    return [time.total_seconds() for time in times]


def timelines(file: Path) -> set[str]:
    return {name for chunk, _ in batches(file) for name in chunk.timeline_names}


def same_recordings(a: Path, b: Path) -> bool:
    """Whether two recordings hold the same data, in whatever order."""
    assert a.is_file()
    assert b.is_file()
    command = rerun_command("rrd", "compare", "--unordered", str(a), str(b))
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
