"""Figures as PNG files: small, and equal bytes for equal figures."""

import io
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from constraint_geodesics.text_files import written

DPI = 120


def save_png(figure: Figure, file: Path) -> None:
    """Write a figure with at most 256 colours and no metadata."""
    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    with Image.open(raw) as image:
        reduced = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=2)
    with written(file) as part:
        reduced.save(part, format="PNG", optimize=True)
