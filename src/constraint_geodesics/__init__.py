"""Shortest robot paths that keep a task constraint, by policy search on one learned manifold."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from constraint_geodesics.constraints.constraint import Constraint as Constraint
    from constraint_geodesics.constraints.constraint import Pose as Pose
    from constraint_geodesics.planner import Path as Path
    from constraint_geodesics.planner import Planner as Planner

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
