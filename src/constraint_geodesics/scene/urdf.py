"""Where URDF files lie: in this checkout, or among those that ship with PyBullet."""

import contextlib
import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from threading import RLock

from constraint_geodesics.robot.kinematics import RobotError

_QUIET = RLock()


def has_pybullet() -> bool:
    """Whether PyBullet is installed: there are wheels for Python 3.11, and none for later ones."""
    return find_spec("pybullet") is not None


def data_path() -> Path:
    """Folder of the robots and meshes that ship with PyBullet.  Raises RobotError without it."""
    if not has_pybullet():
        raise RobotError("PyBullet, with its robots, is not installed: its wheels need Python 3.11")
    with quiet():
        import pybullet_data
    return Path(pybullet_data.getDataPath())


def find_urdf(name: str | Path) -> Path:
    """A URDF named by a path in this checkout, or by one in pybullet_data; RobotError if there is
    neither.
    """
    if Path(name).is_file():
        return Path(name)
    try:
        shipped = data_path() / name
    except RobotError as error:
        raise RobotError(f"{name}: no such URDF here, and {error}") from None
    if shipped.is_file():
        return shipped
    raise RobotError(f"{name}: no such URDF, neither in this checkout nor in pybullet_data")


def urdf_name(urdf: Path) -> str:
    """A URDF as params.yaml names it: within pybullet_data, within this checkout, or by its whole
    path.
    """
    shipped = [data_path().resolve()] if has_pybullet() else []
    for folder in (*shipped, Path.cwd()):
        if urdf.resolve().is_relative_to(folder):
            return urdf.resolve().relative_to(folder).as_posix()
    return urdf.resolve().as_posix()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence the lines that PyBullet writes past Python straight to the process's output, those of
    other threads for as long with them: where files are loaded, and nowhere else.
    """
    with _QUIET:  # two at once would save each other's silence, and keep it
        sys.stdout.flush()
        sys.stderr.flush()
        saved = [(stream, os.dup(stream)) for stream in (1, 2)]
        try:
            with open(os.devnull, "w") as nothing:
                for stream, _ in saved:
                    os.dup2(nothing.fileno(), stream)
            yield
        finally:
            for stream, copy in saved:
                os.dup2(copy, stream)
                os.close(copy)
