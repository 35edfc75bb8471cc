"""What a picture of a page shows, by its pixels."""

import io
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

Picture = UInt8[np.ndarray, "height width 3"]
NEAR = 24
"""By so much may a channel differ: antialiasing and shading change a colour a little."""


def picture(page: "Page | Locator") -> Picture:
    """The page, or a part of it, as it is now."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def having(shown: Picture, colour: str) -> Bool[np.ndarray, "height width"]:
    """Where a picture has a colour, given as "#rrggbb"."""
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    near: np.ndarray = (abs(shown.astype(int) - wanted) <= NEAR).all(axis=-1)
    return near


def scene_of(shown: Picture) -> Picture:
    """Rerun's 3D view of a recording: the left half of the page below its bars, above the
    timeline.
    """
    height, width, _ = shown.shape
    return shown[round(0.1 * height) : round(0.92 * height), : round(0.55 * width)]
