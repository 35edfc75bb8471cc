"""What the planner's core reaches of the lab, by name: imported when it is asked for, so that the
core imports nothing of it.
"""

from importlib import import_module
from typing import Any

PLUGS = {
    "mlflow": "tracking.store:fetch_artifacts",
    "learned samples": "learning.inference:FrozenManifold",
    "learned proposals": "geodesics.policy_proposals:PolicyProposals",
}


def plug(name: str) -> Any:
    """The object behind a name."""
    module, attribute = PLUGS[name].split(":")
    return getattr(import_module(f"constraint_geodesics.{module}"), attribute)
