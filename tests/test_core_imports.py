"""Planning loads neither the lab nor the libraries that only the lab needs."""

import json
import subprocess
import sys

from constraint_geodesics import bundle
from tests.planner_fixtures import pairs_of

HEAVY = {
    *("torch", "lightning", "stable_baselines3", "mlflow", "dvc", "pandas", "matplotlib"),
    *("ompl", "sklearn", "rerun", "gymnasium", "typer"),
}
LAB = {"learning", "geodesics", "peers", "benchmark", "studies", "report", "tracking", "pipeline"}
PLANS = """
import json, sys
from constraint_geodesics import Planner
from constraint_geodesics.bundle import PACKAGED
start, goal = json.loads(sys.stdin.read())
with Planner.load(PACKAGED) as planner:
    path = planner.plan(start, goal, "level_cup")
print(json.dumps([path.status, sorted(sys.modules)]))
"""


def test_planning_loads_neither_the_lab_nor_its_libraries() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    done = subprocess.run(
        [sys.executable, "-c", PLANS],
        input=json.dumps([start.tolist(), goal.tolist()]),
        capture_output=True,
        text=True,
        check=True,
    )
    status, modules = json.loads(done.stdout)
    assert status == "solved"
    assert not HEAVY & {name.split(".")[0] for name in modules}
    own = [name.split(".") for name in modules if name.startswith(f"{bundle.__package__}.")]
    assert not LAB & {parts[1] for parts in own}
