"""Shortest robot paths that keep a task constraint, by policy search on one learned manifold."""

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from constraint_geodesics.kernel_digest import LOCATORS

if TYPE_CHECKING:
    from constraint_geodesics.constraints.constraint import Constraint as Constraint
    from constraint_geodesics.constraints.constraint import Pose as Pose
    from constraint_geodesics.goals.region import GoalRegion as GoalRegion
    from constraint_geodesics.planner import Planner as Planner
    from constraint_geodesics.trajectory import Trajectory as Trajectory

os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)
if "numba" in sys.modules:  # it has read its settings already
    sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = os.environ["NUMBA_CACHE_LOCATOR_CLASSES"]

__all__ = ["Constraint", "GoalRegion", "Planner", "Pose", "Trajectory"]
_MODULES = {
    "Constraint": "constraints.constraint",
    "GoalRegion": "goals.region",
    "Planner": "planner",
    "Pose": "constraints.constraint",
    "Trajectory": "trajectory",
}


def __getattr__(name: str) -> Any:
    """Import what users import when it is asked for: a stage must not wait for a planner it does
    not use.
    """
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
