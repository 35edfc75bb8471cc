"""`--json` of `params`, `results`, `replay` and `bench`: one strict object, and the exit codes as
without it.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from constraint_geodesics import bundle
from constraint_geodesics.benchmark.queries import TABLE, Query, write_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.pipeline.layout import Layout
from tests.planner_fixtures import packaged_learned, pairs_of
from tests.test_cli_plan import called, strict

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def geodesics(monkeypatch, capfd, tmp_path):
    """The command in this process, in an empty folder: its exit code and what it wrote."""
    monkeypatch.chdir(tmp_path)

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, words)

    return start


def test_the_verdict_on_parameters_is_json(geodesics, tmp_path) -> None:
    shutil.copy(ROOT / "params.yaml", tmp_path)
    code, out, err = geodesics("params", "--json")
    assert (code, err) == (0, "")
    assert strict(out) == {"file": "params.yaml", "valid": True, "error": None}
    parameters = yaml.safe_load((tmp_path / "params.yaml").read_text())
    parameters["labels"]["free_rows"] = 0
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(parameters))
    code, out, err = geodesics("params", "--json")
    assert (code, err) == (2, "")
    assert strict(out)["valid"] is False
    assert "labels.free_rows=0" in strict(out)["error"]
    assert geodesics("params")[0] == 2


def test_results_are_json(geodesics, tmp_path) -> None:
    code, out, err = geodesics("results", "--json")
    assert (code, out) == (1, "")
    assert "make repro" in err
    (tmp_path / "reports").mkdir()
    shutil.copy(ROOT / "reports" / "table.csv", tmp_path / "reports")
    code, out, err = geodesics("results", "--json")
    assert (code, err) == (0, "")
    rows = strict(out)["rows"]
    names, *lines = [
        line.split(",") for line in (ROOT / "reports" / "table.csv").read_text().splitlines()
    ]
    assert len(rows) == len(lines) > 10
    for row, cells in zip(rows, lines, strict=True):
        assert list(row) == names
        for value, cell in zip(row.values(), cells, strict=True):
            assert (
                (value is None) if cell == "" else str(value) == cell or float(value) == float(cell)
            )


def test_recordings_are_listed_as_json(geodesics, tmp_path) -> None:
    assert geodesics("replay", "--json")[:2] == (1, "")
    file = tmp_path / "data" / "recordings" / "stage" / "path.rrd"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"RRF2")
    code, out, err = geodesics("replay", "--json")
    assert (code, err) == (0, "")
    (row,) = strict(out)["recordings"]
    assert (row["number"], row["file"]) == (1, str(file.relative_to(tmp_path)))
    assert row["query"] is row["seed"] is row["length_rad"] is row["valid"] is None, (
        "it is no recording"
    )
    code, out, err = geodesics("replay", "--json", str(file))
    assert (code, out) == (2, "")
    assert err.startswith("error: --json prints the list")


def test_the_benchmarks_summary_is_json(geodesics, tmp_path) -> None:
    """One query, two planners, one of which is given more time than is wanted."""
    parameters = yaml.safe_load((ROOT / "params.yaml").read_text())
    known = parameters["benchmark"]["planners"]
    few = {name: known[name] for name in ("straight + band", "RRT* 10 s")}
    compared = {"planners": ["straight + band"], "seeds": 1}
    parameters["benchmark"] |= {"planners": few, "recorded": [], "compared": compared}
    parameters["benchmark"]["placed_by"] = ["straight + band"]
    parameters["constraints"] = {
        name: parameters["constraints"][name] for name in ("free", "level_cup")
    }
    parameters["geodesics"]["illustrated_constraints"] = ["level_cup"]
    parameters["clutter"]["constraints"] = ["free"]
    parameters["carried"]["constraints"] = ["level_cup"]
    parameters["studies"]["constraint"] = "level_cup"
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(parameters))
    shutil.copy(ROOT / "requirements.lock", tmp_path)
    layout = Layout(tmp_path)
    shutil.copytree(bundle.PACKAGED, layout.planner)
    LearnedManifold.from_arrays(packaged_learned().manifold).save(layout.manifold("planner"))
    (start, goal), *_ = pairs_of("free", 1, seed=1)
    write_queries([Query("free", TABLE, 0, start, goal)], layout.benchmark_queries("free"))
    code, out, err = geodesics("bench", "--constraint", "free", "--json")
    assert code == 0, err
    answer = strict(out)
    assert answer["left_out"] == ["RRT* 10 s"]
    assert Path(answer["rows"]).is_file()
    (row,) = answer["overview"]
    assert (row["planner"], row["rows"], row["queries"]) == ("straight + band", 1, 1)
    assert row["success"] in (0.0, 1.0)
    again = strict(geodesics("bench", "--constraint", "free", "--json")[1])
    assert again == answer, "what is done is not done again"
    assert np.isfinite(row["time_median_s"])
