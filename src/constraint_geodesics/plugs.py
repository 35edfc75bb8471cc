"""What the planner's core reaches by name: imported when it is asked for, so that the core imports
nothing of the lab.
"""

import sys
from importlib import import_module
from typing import Any, NamedTuple

from constraint_geodesics.extras import require


class Plug(NamedTuple):
    """A module and its attribute, and the extra that they need."""

    address: str
    extra: str | None = None


MLFLOW = Plug("tracking.store:fetch_artifacts", "pipeline")
PULL = Plug("geodesics.pull_kernels:tangential_gradient")
PULL_BOUNDS = Plug("geodesics.pull_kernels:Bounds")
METHODS = {
    "planner": Plug("methods:SearchMethod"),
    "learned": Plug("geodesics.learned_method:LearnedMethod", "pipeline"),
    "learned+band": Plug("geodesics.learned_method:RefinedLearnedMethod", "pipeline"),
}
"""How a planner may look for curves, each a class that `methods.Method` describes."""


def require_trusted(module: str) -> None:
    """Raises ImportError for a module that a file names and nobody has imported: a file's word is
    no reason to run it.  Ours are trusted.
    """
    if module not in sys.modules and not module.startswith(f"{__package__}."):
        raise ImportError(
            f"import {module} before, if you trust it: "
            "no module is imported because a file names it"
        )


def plug(wanted: Plug) -> Any:
    """The object at a module's attribute.  Raises MissingExtraError where its extra is missing."""
    if wanted.extra is not None:
        require(wanted.extra)
    module, attribute = wanted.address.split(":")
    return getattr(import_module(f"constraint_geodesics.{module}"), attribute)
