"""A plain installation plans, checks and draws: it loads neither the lab nor the libraries of the
extras, and needs none of them.
"""

import json
import subprocess
import sys
from pathlib import Path

from tests.planner_fixtures import pairs_of

from constraint_geodesics import bundle
from constraint_geodesics.extras import EXTRAS

ONLY_IN_EXTRAS = sorted({*EXTRAS["bench"], "yaml", "click", "networkx"} - {"packaging"})
"""What comes with the extras' packages too; Matplotlib needs packaging."""
HEAVY = {*ONLY_IN_EXTRAS, "matplotlib", "typer", "rich", "ruamel"}
LAB = {"learning", "geodesics", "peers", "benchmark", "studies", "report", "tracking", "pipeline"}
ABSENT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
"""
"""As if packages were not installed."""
PLANS = f"""{ABSENT}
import json
from constraint_geodesics import Planner
from constraint_geodesics.bundle import PACKAGED
start, goal = json.loads(sys.stdin.read())
with Planner.load(PACKAGED) as planner:
    path = planner.plan(start, goal, "level_cup")
loaded = sorted(name for name, module in sys.modules.items() if module is not None)
path.save("path.csv")
path.draw("path.png")
print(json.dumps([path.status, loaded]))
"""
CHECKS = f"""{ABSENT}
sys.argv = ["geodesics", "check", "path.csv", "--planner", {{planner!r}}]
from constraint_geodesics import cli
cli.main()
"""


def run(program: str, folder: Path, text: str = "") -> str:
    """What a program prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, input=text, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_plain_installation_plans_draws_and_checks(tmp_path) -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    asked = json.dumps([start.tolist(), goal.tolist()])
    status, modules = json.loads(run(PLANS.format(absent=ONLY_IN_EXTRAS), tmp_path, asked))
    assert status == "solved"
    assert (tmp_path / "path.png").stat().st_size > 10_000
    assert not HEAVY & {name.split(".")[0] for name in modules}
    own = [name.split(".") for name in modules if name.startswith(f"{bundle.__package__}.")]
    assert not LAB & {parts[1] for parts in own}
    words = {"absent": ONLY_IN_EXTRAS, "planner": str(bundle.PACKAGED)}
    assert run(CHECKS.format(**words), tmp_path).startswith("valid: ")
