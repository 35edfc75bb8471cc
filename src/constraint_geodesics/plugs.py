"""What the planner's core reaches by name: imported when it is asked for, so that the core imports
nothing of the lab.
"""

from importlib import import_module
from typing import Any

MLFLOW = "tracking.store:fetch_artifacts"
METHODS = {
    "planner": "methods:SearchMethod",
    "learned": "geodesics.learned_method:LearnedMethod",
    "learned+band": "geodesics.learned_method:RefinedLearnedMethod",
}
"""How a planner may look for curves, each a class that `methods.Method` describes."""


def plug(address: str) -> Any:
    """The object at a module's attribute."""
    module, attribute = address.split(":")
    return getattr(import_module(f"constraint_geodesics.{module}"), attribute)
