"""Where numba keeps this package's compiled kernels: where it always does, but in a folder named by
a digest of all kernel files, so that a kernel is compiled again when one that it calls has changed.

`constraint_geodesics/__init__.py` names these classes to numba, before anything is compiled.
"""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import caching

from constraint_geodesics.kernel_digest import FOLDER, PACKAGE, folder_of, kernels_digest

_READY: set[Path] = set()
"""Folders that are made, and have no older ones beside them."""


@cache
def _inside(py_file: str) -> bool:
    return Path(py_file).resolve().is_relative_to(PACKAGE.resolve())


class _Own:
    """For functions of this package alone."""

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The place of one function, or None: ask the next class."""
        return super().from_function(py_func, py_file) if _inside(py_file) else None  # type: ignore[misc]

    def get_cache_path(self) -> str:
        """The folder of the kernels as they are now."""
        return str(Path(super().get_cache_path()) / folder_of(kernels_digest()))  # type: ignore[misc]

    def ensure_cache_path(self) -> None:
        """Make the folder; those of kernels that have changed since go."""
        own = Path(self.get_cache_path())
        if own in _READY and own.is_dir():  # asked for once a kernel
            return
        super().ensure_cache_path()  # type: ignore[misc]
        _READY.add(own)
        for other in own.parent.glob(f"{FOLDER}*"):
            if other != own:
                shutil.rmtree(other, ignore_errors=True)

    def get_source_stamp(self) -> bytes:
        """Of the sources that a function was compiled from."""
        return kernels_digest()


class Chosen(_Own, caching.UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class InTree(_Own, caching.InTreeCacheLocator):
    """Beside the kernel's own file."""


class UserWide(_Own, caching.UserWideCacheLocator):
    """In the user's own cache, where the package can't be written to."""
