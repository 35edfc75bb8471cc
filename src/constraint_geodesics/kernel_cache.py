"""Where numba keeps this package's compiled kernels: where it always does, but under a stamp of all
kernel files, so that a kernel is compiled again when one that it calls has changed.

`constraint_geodesics/__init__.py` names these classes to numba, before anything is compiled.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core import caching

from constraint_geodesics.kernel_digest import PACKAGE, kernels_digest


class _Own:
    """For functions of this package alone."""

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> Any:
        """The place of one function, or None: ask the next class."""
        inside = Path(py_file).resolve().is_relative_to(PACKAGE.resolve())
        return super().from_function(py_func, py_file) if inside else None  # type: ignore[misc]

    def get_source_stamp(self) -> bytes:
        """Of the sources that a function was compiled from."""
        return kernels_digest()


class Chosen(_Own, caching.UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class InTree(_Own, caching.InTreeCacheLocator):
    """Beside the kernel's own file."""


class UserWide(_Own, caching.UserWideCacheLocator):
    """In the user's own cache, where the package can't be written to."""
