"""The palette's colours as Rerun takes them."""

import matplotlib
import numpy as np

from constraint_geodesics import palette

Colour = tuple[int, int, int]


def rgb(colour: str) -> Colour:
    """A colour of the palette, given as "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


LIMIT = rgb(palette.VERMILION)
"""Of the lines that a series must not cross."""
AXES = tuple(rgb(colour) for colour in (palette.VERMILION, palette.GREEN, palette.BLUE))
"""Of a frame's x, y and z."""
INK, OTHER = rgb(palette.BLACK), rgb(palette.GREY)
"""Of what is now, and of what is shown beside it."""
GROUND, CARRIED = rgb(palette.LIGHT), rgb(palette.SKY)
_COUNTED, _OUTSIDE = tuple(rgb(colour) for colour in palette.SERIES), rgb(palette.LIGHT)


def colours(values: np.ndarray) -> np.ndarray:
    """Colours that the colour-blind can tell apart: one a component for integers, a scale (dark is
    high) for floats.
    """
    if np.issubdtype(values.dtype, np.integer):
        table = np.array([*_COUNTED, _OUTSIDE], dtype=np.uint8)
        return table[np.where(values < 0, len(_COUNTED), values % len(_COUNTED))]
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    scaled = np.nan_to_num((values - low) / max(high - low, 1e-12), nan=1.0, posinf=1.0, neginf=0.0)
    return np.asarray(matplotlib.colormaps["cividis_r"](scaled, bytes=True))[:, :3]
