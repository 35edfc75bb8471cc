"""One digest of all files with compiled kernels: a kernel calls others across files, and numba
itself looks only at the file that a kernel stands in.
"""

import hashlib
from functools import cache
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
ROOMS = ("certification", "constraints", "geometry", "robot", "scene", "search")
"""Rooms whose kernels are compiled before the first path is there."""


@cache
def kernels_digest(package: Path = PACKAGE) -> bytes:
    """Of all files in which numba compiles something."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        content = file.read_bytes()
        if b"njit" in content:
            digest.update(file.relative_to(package).as_posix().encode() + content)
    return digest.digest()


def are_compiled(package: Path = PACKAGE) -> bool:
    """Whether what the planner needs has been compiled from the kernels as they are."""
    stamp = kernels_digest(package)
    caches = {room: (package / room / "__pycache__").glob("*.nbi") for room in ROOMS}
    return all(any(stamp in file.read_bytes() for file in own) for own in caches.values())
