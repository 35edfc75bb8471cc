"""What an extra brings is what pyproject.toml says, and a command that needs one says so in one
line.
"""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
ASKED = """
from constraint_geodesics import cli
sys.argv = ["geodesics", *{words!r}]
cli.main()
"""
LACKING = f"""
import sys
for module in {{modules!r}}:
    sys.modules[module] = None
{ASKED}"""
REFUSED = f"""
import sys
class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {{modules!r}}:
            raise ModuleNotFoundError("No module named " + name)
sys.meta_path.insert(0, Refusing())
{ASKED}"""
"""As where they are not installed: a module that is None is there for SciPy, which looks."""
ENDS = (
    "--start=0 0 -1 0 0 0",
    "--goal=0 0 -1.5 0 0 0",
    "--constraint=free",
    f"--planner={PACKAGED}",
)
WITHOUT_CODE = {"example-robot-data"}
"""Distributions that bring no module; what needs them says so itself."""
RECORDING = str(ROOT / "README.md")
"""A file that exists is all that is looked at before."""
COMMANDS = {
    ("plan", *ENDS, "--record=path.rrd", "--out=path.csv"): "record",
    ("replay", RECORDING): "record",
    ("demo",): "record",
    ("plan", *ENDS, "--method=learned"): "pipeline",
    ("plan", *ENDS[:3], "--planner=models:/planner/1"): "pipeline",
    ("ui",): "pipeline",
    ("results", "--json"): "pipeline",
    ("params",): "bench",
    ("bench",): "bench",
}


def brought(extra: str) -> set[str]:
    """The distributions of an extra, those of the extras in it too."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = set()
    for line in declared["optional-dependencies"][extra]:
        if inner := re.match(r"constraint-geodesics\[(\w+)\]", line):
            names |= brought(inner[1])
        else:
            names.add(re.match(r"[\w.-]+", line)[0])
    core = {re.match(r"[\w.-]+", line)[0] for line in declared["dependencies"]}
    return names - core


@pytest.mark.parametrize("extra", EXTRAS)
def test_an_extra_s_modules_are_those_of_its_packages(extra) -> None:
    of = packages_distributions()
    bringing = [{name.lower().replace("_", "-") for name in of[m]} for m in EXTRAS[extra]]
    assert all(names & brought(extra) for names in bringing)
    assert brought(extra) - WITHOUT_CODE <= set().union(*bringing)


def test_the_demo_needs_what_it_names_alone(tmp_path) -> None:
    """And no library of the pipeline; packaging is matplotlib's, too."""
    others = sorted({*EXTRAS["bench"]} - {*EXTRAS["record"], "packaging"})
    program = REFUSED.format(modules=others, words=("demo", "--out=d.rrd", ENDS[-1]))
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "d.rrd").stat().st_size


@pytest.mark.parametrize(("words", "extra"), COMMANDS.items(), ids=lambda one: one[0])
def test_a_command_names_the_extra_that_it_needs(words, extra, tmp_path) -> None:
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports" / "table.csv").touch()
    program = LACKING.format(modules=EXTRAS[extra], words=words)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert f'pip install "constraint-geodesics[{extra}]"' in done.stderr
    assert not (tmp_path / "path.csv").exists(), "it is said before anything is done"
