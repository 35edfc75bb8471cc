"""The stages that ask all planners on problems: what they write, and that they go on where they
stopped.
"""

import json
import shutil
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from tests.benchmark.problem_fixtures import moveit_pair, small_file, written

from constraint_geodesics import bundle
from constraint_geodesics.params import Params, load_params
from constraint_geodesics.pipeline.layout import Layout

ROOT = Path(__file__).parents[2]
ONE = {"planner": {"kind": "planner"}}


@pytest.fixture
def layout(tmp_path) -> Layout:
    (tmp_path / "reports").mkdir()
    return Layout(tmp_path)


def params_with(**changes: Any) -> Params:
    given = {name.replace("__", "."): value for name, value in changes.items()}
    return load_params(ROOT / "params.yaml", {"compute.workers": 1, **given})


def run(name: str, params: Params, layout: Layout) -> tuple[dict[str, Any], pd.DataFrame, str]:
    sys.path.insert(0, str(ROOT / "stages"))
    try:
        import_module(f"benchmark_{name}").main(params, layout)
    finally:
        sys.path.remove(str(ROOT / "stages"))
    reports = layout.root / "reports"
    told = json.loads((reports / f"{name}.json").read_text())
    rows = pd.read_csv(reports / f"{name}.csv.gz", comment="#")
    return told, rows, (reports / f"{name}.md").read_text()


def test_problems_of_a_file_and_a_held_tilt_become_a_report(layout, capfd) -> None:
    file = layout.root / "small.json.gz"
    params = params_with(
        problems__file=file.name, problems__tilted=1, problems__planners=ONE, problems__every=2
    )
    with pytest.raises(FileNotFoundError, match=r"small.json.gz: missing: .*docs/problems.md"):
        run("problems", params, layout)
    written(small_file(), file)
    told, rows, text = run("problems", params, layout)
    assert {name: own["all"]["planner"]["problems"] for name, own in told["figures"].items()} == {
        "free": 2,
        "tilt of 15° at most": 2,
    }
    assert rows.groupby("constraint")["limit_s"].first().to_dict() == {
        "free": params.problems.limit_s,
        "tilt of 15° at most": params.problems.held_limit_s,
    }
    assert "of each scene one in 2" in text
    assert "panda_finger_joint1 is held at 0.065" in text
    assert "0 to 0.04 m" in text.replace("\n", " ")
    capfd.readouterr()
    _, again, _ = run("problems", params, layout)
    assert "problems:" not in capfd.readouterr().err, "nothing was left to do"
    pd.testing.assert_frame_equal(rows, again)


def test_the_problems_may_be_a_folder_of_moveits(layout) -> None:
    moveit_pair(layout.root / "problems" / "crate", "0001")
    params = params_with(problems__file="problems", problems__tilted=0, problems__planners=ONE)
    told, _, text = run("problems", params, layout)
    assert told["figures"]["free"]["crate"]["planner"]["problems"] == 1
    assert "The problems of problems (SHA-256 " in text


def test_clutter_becomes_a_report(layout) -> None:
    shutil.copytree(bundle.PACKAGED, layout.planner, ignore=shutil.ignore_patterns("learned"))
    params = params_with(
        clutter__scenes=1,
        clutter__queries=1,
        clutter__constraints=["free", "slide"],
        problems__planners=ONE,
    )
    told, rows, text = run("clutter", params, layout)
    assert set(told["figures"]) == {"free", "slide"}
    assert set(told["figures"]["free"]) == {"10 shapes", "100 shapes", "12 thin plates", "all"}
    assert set(rows["planner"]) == {"planner"}
    assert not rows["touches"].any()
    assert "## Scene by scene: slide" in text
