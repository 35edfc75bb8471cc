"""Constraints from demonstrations: what all of them keep to, as relations of the tool's pose."""

from constraint_geodesics.identification.demonstrations import DemonstrationError
from constraint_geodesics.identification.files import load_constraint, save_constraint
from constraint_geodesics.identification.identify import Identified, identify

__all__ = ["DemonstrationError", "Identified", "identify", "load_constraint", "save_constraint"]
