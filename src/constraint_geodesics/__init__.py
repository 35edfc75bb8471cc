"""Shortest robot paths that keep a task constraint, certified on the whole path."""

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
    from constraint_geodesics.scene.box import Box as Box
    from constraint_geodesics.scene.capsule import Capsule as Capsule
    from constraint_geodesics.scene.cylinder import Cylinder as Cylinder
    from constraint_geodesics.scene.mesh import Mesh as Mesh
    from constraint_geodesics.scene.point_cloud import PointCloud as PointCloud
    from constraint_geodesics.scene.sphere import Sphere as Sphere
    from constraint_geodesics.trajectory import Trajectory as Trajectory

os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)
if "numba" in sys.modules:  # it has read its settings already
    sys.modules["numba"].config.CACHE_LOCATOR_CLASSES = os.environ["NUMBA_CACHE_LOCATOR_CLASSES"]

_MODULES = {
    "Box": "scene.box",
    "Capsule": "scene.capsule",
    "Constraint": "constraints.constraint",
    "Cylinder": "scene.cylinder",
    "GoalRegion": "goals.region",
    "Mesh": "scene.mesh",
    "Planner": "planner",
    "PointCloud": "scene.point_cloud",
    "Pose": "constraints.constraint",
    "Sphere": "scene.sphere",
    "Trajectory": "trajectory",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import what users import when it is asked for: a stage must not wait for a planner it does
    not use.
    """
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
