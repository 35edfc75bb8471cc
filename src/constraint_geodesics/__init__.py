"""Shortest robot paths that keep a task constraint, by policy search on one learned manifold."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from constraint_geodesics.kernel_digest import LOCATORS

if TYPE_CHECKING:
    from constraint_geodesics.constraints.pose import Constraint as Constraint
    from constraint_geodesics.constraints.pose import Pose as Pose
    from constraint_geodesics.planner import Planner as Planner
    from constraint_geodesics.trajectory import Trajectory as Trajectory

os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)  # numba reads it when it compiles

__all__ = ["Constraint", "Planner", "Pose", "Trajectory"]
_MODULES = {
    "Constraint": "constraints.pose",
    "Planner": "planner",
    "Pose": "constraints.pose",
    "Trajectory": "trajectory",
}


def __getattr__(name: str) -> Any:
    """Import what users import when it is asked for: a stage must not wait for a planner it does
    not use.
    """
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
