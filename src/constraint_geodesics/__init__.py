"""Shortest robot paths that keep a task constraint, by policy search on one learned manifold."""

import os
import sys
from typing import TYPE_CHECKING, Any

from constraint_geodesics.kernel_digest import LOCATORS

if TYPE_CHECKING:
    from constraint_geodesics.constraints.pose import Constraint as Constraint
    from constraint_geodesics.constraints.pose import Pose as Pose
    from constraint_geodesics.planner import Path as Path
    from constraint_geodesics.planner import Planner as Planner

os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)
if "numba" in sys.modules:  # it has read its settings already
    sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = os.environ["NUMBA_CACHE_LOCATOR_CLASSES"]

__all__ = ["Constraint", "Path", "Planner", "Pose"]


def __getattr__(name: str) -> Any:
    """Import what users import when it is asked for: a stage must not wait for a planner it does
    not use.
    """
    if name in ("Constraint", "Pose"):
        from constraint_geodesics.constraints import pose

        return getattr(pose, name)
    if name in ("Planner", "Path"):
        from constraint_geodesics import planner

        return getattr(planner, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
