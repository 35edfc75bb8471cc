"""What a caller gives, checked: one test for each kind of value, and how a refused one is shown."""

import os
from typing import Any

import numpy as np

LARGEST = 1e9
"""Of any number: beyond it squares and sums overflow, and nothing here is counted or measured."""
MOST_ANGLE = 4.0 * np.pi
"""Larger numbers than two turns [rad] are taken for degrees."""
_SHOWN = 80
"""Letters of a refused value in a message."""


def shown(value: object) -> str:
    """A value in one line of a few letters, for a message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"


def is_number(value: object) -> bool:
    """Whether it is a real number: a text is none, nor is True."""
    real = isinstance(value, int | float | np.integer | np.floating)
    return real and not isinstance(value, bool)


def numbers(value: Any, *, flags: bool = False) -> np.ndarray | None:
    """A copy of real numbers, as float64; None for what holds anything else: texts, dates, True,
    complex numbers, gaps, rows of unequal length.  They may be infinite or not a number.
    flags: True and False are taken for 1 and 0.
    """
    try:
        table = np.asarray(value)
        kind = table.dtype.kind
        if kind == "O" and table.size and all(map(is_number, table.flat)):
            kind = "f"  # integers that no type of NumPy holds
        if kind not in ("iufb" if flags else "iuf") or np.ma.is_masked(value):
            return None
        return np.array(table, np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None


def finite_number(value: Any) -> float | None:
    """A finite real number, also as an array without axes; None for anything else."""
    found = numbers(value)
    if found is None or found.ndim or not np.isfinite(found):
        return None
    return float(found)


def are_usable(found: np.ndarray) -> bool:
    """Whether all numbers are finite, and none is beyond LARGEST."""
    return bool((np.abs(found) <= LARGEST).all())  # nan is not


def checked_joints(q: Any, dof: int, name: str, error: type[ValueError]) -> np.ndarray:
    """A copy of one value a joint (D,) [rad or m].  Raises the error, with the name, if it is
    none.
    """
    values = numbers(q)
    if values is None:
        raise error(f"{name} = {shown(q)}: must be {dof} numbers [rad]")
    if values.shape != (dof,):
        raise error(f"{name} has shape {values.shape}: must be ({dof},) [rad]")
    if not are_usable(values):
        which = int(np.argmin(np.abs(values) <= LARGEST))
        what = f"= {values[which]:g}: must be at most {LARGEST:g} in size"
        raise error(f"{name}[{which}] {what if np.isfinite(values[which]) else 'is not finite'}")
    return values


def checked_path(file: Any, name: str, error: type[ValueError]) -> Any:
    """A path, or its text.  Raises the error, with the name, if it is none."""
    if not isinstance(file, str | os.PathLike) or not os.fspath(file):
        raise error(f"{name} = {shown(file)}: must be the path of a file")
    return file
