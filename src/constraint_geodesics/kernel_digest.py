"""One digest of all files with compiled kernels: a kernel calls others across files, and numba
itself looks only at the file that a kernel stands in.
"""

import hashlib
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parent
LOCATORS = ",".join(
    (
        *(f"{__package__}.kernel_cache.{name}" for name in ("Chosen", "InTree", "UserWide")),
        "UserProvidedCacheLocator",
        "InTreeCacheLocator",
        "UserWideCacheLocator",
        "IPythonCacheLocator",
        "ZipCacheLocator",
    )
)
"""What numba asks where a compiled function is kept: this package's own first, then numba's."""
FOLDER = "kernels-"
"""What the name of a folder with compiled kernels begins with."""


@lru_cache  # `cache` is not in Python 3.8, which has to import this to be named by `doctor`
def kernels_digest(package: Path = PACKAGE) -> bytes:
    """Of all files in which numba compiles something."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        content = file.read_bytes()
        if b"njit" in content or b"c_function" in content:
            digest.update(file.relative_to(package).as_posix().encode() + content)
    return digest.digest()


def folder_of(digest: bytes) -> str:
    """Name of the folder of what was compiled from these files."""
    return f"{FOLDER}{digest.hex()[:12]}"
