"""Compile the kernels once, before workers do it each for themselves: half of them in one process,
half in another.
"""

import subprocess
import sys

from constraint_geodesics.cli import what_takes_time

CERTIFIED = """
import numpy as np
from constraint_geodesics.search.candidates import Parts
from tests.planner_fixtures import manifold_of, packaged_planner
from constraint_geodesics.certification.certifier import Certifier, Limits
planner = packaged_planner()
start, goal = planner.nodes("level_cup")[:2]
with Certifier(planner.scene, Limits()) as certifier:
    times = np.linspace(0.0, 1.0, 9)
    certifier.certify(np.linspace(start, goal, 9), planner.constraints["level_cup"], times=times)
planner.plan(start, goal, "level_cup", parts=Parts(straight=False, graph=False))
"""
PLANNED = """
from tests.planner_fixtures import packaged_planner
planner = packaged_planner()
nodes = planner.nodes("level_cup")
planner.plan(nodes[0], nodes[-1], "level_cup", budget_s=0.2)
"""


def compile_kernels() -> None:
    """Nothing where they are compiled already.  A failure is left to the tests, which say more."""
    if what_takes_time().startswith("compiling"):
        running = [
            subprocess.Popen([sys.executable, "-c", program]) for program in (CERTIFIED, PLANNED)
        ]
        for one in running:
            one.wait()
