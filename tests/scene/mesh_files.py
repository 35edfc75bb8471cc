"""Meshes that tests write: unions of boxes, so that a test knows them by other means too."""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from constraint_geodesics.scene.shape import Triple

_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_FACES = np.array(list("013032467475045051237276026064157173"), int).reshape(-1, 3)


class Brick(NamedTuple):
    """A box of a mesh: its centre and half edges [m]."""

    centre: Triple
    half_edges: Triple


def write_bricks(file: Path, bricks: Sequence[Brick]) -> Path:
    """An OBJ or a binary STL file of boxes."""
    corners = np.concatenate([_SIGNS * own.half_edges + own.centre for own in bricks])
    faces = np.concatenate([_FACES + 8 * k for k in range(len(bricks))])
    if file.suffix == ".stl":
        rows = [struct.pack("<12fH", 0, 0, 0, *corners[own].ravel(), 0) for own in faces]
        file.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + b"".join(rows))
    else:
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
        file.write_text("\n".join(lines) + "\n")
    return file
