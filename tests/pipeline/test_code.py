"""A stage runs again where what it computes may have changed, and nowhere else."""

from pathlib import Path

import pytest
import yaml

from constraint_geodesics.pipeline import code
from constraint_geodesics.pipeline.code import DRAWING, code_of

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "constraint_geodesics"
PIPELINES = ("dvc.yaml", "stages/dvc.yaml", "stages/sweep/dvc.yaml")
FILES = {
    "geometry/length.py": "from package.geometry import curves\n\n\ndef length():\n    return 1\n",
    "geometry/curves.py": 'DEGREE = 3\n"""Of a curve."""\n',
    "planner.py": "def draw():\n    from package.palette import BLUE\n",
    "palette.py": "BLUE = 1\n",
    "recording/rerun.py": "from package.palette import BLUE\n",
    "unused.py": "",
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        file = tmp_path / "package" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path / "package"


def read(package: Path, script: str) -> dict[str, str]:
    file = package.parent / "script.py"
    file.write_text(script)
    for found in (code.digest, code._tree, code._imported):
        found.cache_clear()
    return code_of(file, package)


def test_what_an_import_reaches_counts_wherever_it_stands(package: Path) -> None:
    late = "def main():\n    from package.geometry.length import length\n"
    assert set(read(package, late)) == {"geometry/length.py", "geometry/curves.py"}
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import package.planner\n"
    assert not read(package, typed)


def test_drawing_counts_where_a_stage_draws(package: Path) -> None:
    assert set(read(package, "from package import planner\n")) == {"planner.py", "defaults"}
    drawn = set(read(package, "from package import planner\nimport package.recording.rerun\n"))
    assert drawn == {"planner.py", "defaults", "recording/rerun.py", "palette.py"}


def test_text_changes_no_digest_and_code_does(package: Path) -> None:
    script, file = "import package.geometry.curves\n", package / "geometry" / "curves.py"
    before = read(package, script)
    file.write_text('"""Curves."""\n\nDEGREE = (\n    3  # cubic\n)\n"""Another text."""\n')
    assert read(package, script) == before
    file.write_text("DEGREE = 4\n")
    assert read(package, script) != before


def test_every_stage_hangs_on_its_script_and_its_own_code() -> None:
    for name in PIPELINES:
        for stage, entry in yaml.safe_load((ROOT / name).read_text())["stages"].items():
            script = entry["cmd"].split()[1]
            own = f"data/code/{Path(script).stem}.txt"
            if stage != "digest_code":
                assert {script, own} <= set(entry["deps"]), stage
                listed = [dep for dep in entry["deps"] if dep.startswith("src/")]
                assert not listed, f"{stage} lists files that its imports name"


@pytest.mark.parametrize(
    "stage", [file.stem for file in sorted((ROOT / "stages").glob("train_*.py"))]
)
def test_no_training_hangs_on_what_is_drawn(stage: str) -> None:
    found = code_of(ROOT / "stages" / f"{stage}.py", PACKAGE)
    rooms = {name.split("/")[0].removesuffix(".py") for name in found}
    assert {"learning", "geodesics"} & rooms
    # the diffusion model learns the planner's own paths: what finds them is part of its data
    planning = set() if stage == "train_path_diffusion" else {"planner", "search"}
    assert not rooms & {*DRAWING, *planning, "cli", "peers", "tracking"}


@pytest.mark.parametrize(
    ("stage", "files"),
    [
        ("label_joints", ("constraints/pose.py", "constraints/functions.py", "scene/capsule.py")),
        ("execute_paths", ("certification/pose.py", "planner.py")),
        ("benchmark_planners", ("peers/birrt.py", "peers/ompl.py")),
        ("run_benchmark", ("peers/planner.py", "planner.py", "geodesics/learned_method.py")),
    ],
)
def test_kinds_that_are_found_by_name_count(stage: str, files: tuple[str, ...]) -> None:
    assert set(files) <= set(code_of(ROOT / "stages" / f"{stage}.py", PACKAGE))
