"""Files of arrays that others wrote, read with an end in sight.  Nothing in them is code: pickled
objects are refused.
"""

import hashlib
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load

from constraint_geodesics.text_files import DamagedFileError, read_content, reason_of, require_short


class ArrayFileError(DamagedFileError):
    """A file's arrays can't be used; the message is one line with the file and what is wrong."""


def read_weights(file: Path, sha256: str | None = None) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file, all of finite numbers.

    sha256: what its bytes must hash to, where that is known.  Raises ArrayFileError for a file that
    is missing, altered, none, or holds a number that is not finite.
    """
    try:
        content = read_content(file, piped=False)
    except FileNotFoundError:
        raise ArrayFileError(f"{file}: missing") from None
    except OSError as error:
        raise ArrayFileError(f"{file}: {error.strerror}") from None
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise ArrayFileError(f"{file}: altered since it was written (its checksum differs)")
    try:
        arrays: dict[str, np.ndarray] = load(content)
    except (SafetensorError, KeyError, TypeError, ValueError, OverflowError, MemoryError) as error:
        raise ArrayFileError(f"{file}: not safetensors: {reason_of(error)}") from None
    require_finite(arrays, file)
    return arrays


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file.  Raises ArrayFileError for a file that is missing, none, holds
    objects, or grows beyond what is read of one.
    """
    try:
        with zipfile.ZipFile(file) as members:
            unpacked = sum(member.file_size for member in members.infolist())
        require_short(unpacked, file, what=", unpacked")
        with np.load(file, allow_pickle=False) as kept:
            return {name: kept[name] for name in kept.files}
    except FileNotFoundError:
        raise ArrayFileError(f"{file}: missing") from None
    except OSError as error:
        raise ArrayFileError(f"{file}: {reason_of(error)}") from None
    except (
        *(EOFError, ValueError, KeyError, TypeError, MemoryError, OverflowError),
        *(RuntimeError, SyntaxError, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise ArrayFileError(f"{file}: no npz file of arrays: {reason_of(error)}") from None


def require_finite(arrays: Mapping[str, np.ndarray], file: Path) -> None:
    """Raises ArrayFileError with the first number that is not finite, or an array of no numbers."""
    for name, values in arrays.items():
        if values.dtype.kind not in "fiub":
            raise ArrayFileError(f"{file}: {name!r} is of type {values.dtype}: must be numbers")
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            place = tuple(bad[0].tolist())
            raise ArrayFileError(
                f"{file}: {name!r} has {values[place]} at {list(place)}: must be finite"
            )
