"""Arms from their URDFs and tool poses as goals: small parts with real planners, and the figures of
rows that are known.
"""

import importlib.util
import json
from importlib import metadata

import numpy as np
import pandas as pd
import pytest
from tests.conftest import ROOT
from tests.planner_fixtures import packaged_planner

from constraint_geodesics.benchmark.queries import TABLE, read_queries
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.extras import MissingExtraError
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies import arms
from constraint_geodesics.studies.arm_parts import (
    PIPELINE_ARM,
    Part,
    figures,
    kept,
    measure,
    parts_of,
    table_of,
)
from constraint_geodesics.studies.arm_queries import (
    between_configurations,
    to_free_yaw,
    to_redundant_poses,
)


@pytest.fixture(scope="module")
def stage():
    file = ROOT / "stages" / "benchmark_arms.py"
    spec = importlib.util.spec_from_file_location("benchmark_arms", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def some_queries(constraint: str, count: int):
    queries = read_queries(Layout(ROOT).benchmark_queries(constraint))
    return tuple(q for q in queries if q.scene == TABLE)[:count]


def row(**values) -> dict:
    named = {"table": "pose", "arm": "A", "constraint": "free", "query": 0, "status": "solved"}
    lengths = {"length_rad": 1.0, "time_ms": 2.0, "best_known_rad": 1.0}
    return named | lengths | {"birrt_status": "", "given_status": ""} | values


NOTHING = {"length_rad": np.nan, "best_known_rad": np.nan}


def test_a_part_is_measured_once_and_again_for_other_code(tmp_path) -> None:
    queries = some_queries("level_cup", 2)
    file = tmp_path / "rows" / "part.json"
    part = Part("pose", PIPELINE_ARM, "level_cup", queries, PACKAGED, file, "as it is")
    assert kept(part) is None
    measure(part)
    rows = table_of(kept(part))
    assert list(rows["query"]) == [0, 1]
    assert (rows["status"] == "solved").all()
    assert (rows["best_known_rad"] <= rows["length_rad"]).all()
    assert (rows["best_known_rad"] <= rows["given_length_rad"] + 1e-9).all()
    other = Part("pose", PIPELINE_ARM, "level_cup", queries, PACKAGED, file, "changed")
    assert kept(other) is None
    file.write_text(file.read_text()[:-20])
    assert kept(part) is None


def test_a_free_yaw_is_no_worse_than_the_best_of_a_grid() -> None:
    (found,) = to_free_yaw(packaged_planner(), some_queries("free", 1))
    assert found.status == "solved"
    assert found.length_rad <= 1.01 * found.best_known_rad


def test_birrt_is_asked_every_pair_between_configurations() -> None:
    with arms.ARMS["iiwa"].planner() as planner:
        rows = between_configurations(planner, "free", 2, seed=0)
        poses = to_redundant_poses(planner, 1, seed=0)
    assert [own.query for own in rows] == [0, 1]
    for own in rows:
        assert own.status == own.birrt_status == "solved"
        assert own.best_known_rad == min(own.best_known_rad, own.length_rad, own.birrt_length_rad)
        assert own.prepared_s > 0.0
    assert poses[0].status == "solved"
    assert poses[0].best_known_rad <= poses[0].length_rad


def test_birrt_is_asked_what_the_planner_does_not_solve(monkeypatch) -> None:
    monkeypatch.setattr("constraint_geodesics.studies.arm_queries.BIRRT_S", 0.1)
    rows = between_configurations(packaged_planner(), "roll", 3, seed=0, ask_all=False)
    assert len(rows) == 3
    assert any(own.status != "solved" for own in rows)
    assert all((own.status == "solved") == (own.birrt_status == "") for own in rows)


def test_the_first_path_of_an_arm_in_new_processes() -> None:
    first, again = arms.first_paths("xArm 6", seed=0)
    assert first.status == again.status == "solved"
    assert first.length_rad == again.length_rad
    assert min(first.made_s, again.made_s) > 0.0


def test_a_process_that_fails_says_why() -> None:
    with pytest.raises(RuntimeError, match="no such arm: no first path: KeyError"):
        arms.first_paths("no such arm", seed=0)


@pytest.fixture
def without_robots(monkeypatch) -> None:
    def lacking(name: str):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(arms.metadata, "distribution", lacking)


BRINGS = 'example-robot-data is not installed: pip install "constraint-geodesics[bench]" brings it'


def test_without_the_robots_one_line_says_how_they_come(without_robots) -> None:
    with pytest.raises(MissingExtraError) as error:
        arms.ARMS["UR5"].path  # noqa: B018
    assert str(error.value) == BRINGS
    assert arms.ARMS["iiwa"].path.is_file(), "pybullet_data's need nothing more"


def test_the_stage_says_it_before_it_measures(stage, without_robots, monkeypatch, capfd) -> None:
    monkeypatch.chdir(ROOT)
    with pytest.raises(SystemExit) as ended:
        run_stage(stage.main, [])
    assert ended.value.code == 2
    assert capfd.readouterr().err.splitlines()[-1] == f"error: {BRINGS}"


def test_every_arm_has_its_urdf() -> None:
    pytest.importorskip("cmeel", reason="the robots come with the extra bench")
    for name, arm in arms.ARMS.items():
        assert f'"{arm.tool_link}"' in arm.path.read_text(), name


def test_parts_are_all_tables_once(params, tmp_path) -> None:
    queries = {name: some_queries(name, 100) for name in params.constraints}
    parts = parts_of(queries, PACKAGED, tmp_path)
    assert len({part.file for part in parts}) == len(parts) == 3 + 16 + 5 + 2 + 6 + 8
    asked = [part.queries for part in parts if part.table == "pose"]
    assert sum(map(len, asked)) == 600
    assert {part.arm for part in parts if part.table == "redundant_pose"} == set(arms.REDUNDANT)


def test_figures_count_failures_and_compare_with_the_best(tmp_path) -> None:
    rows = table_of(
        [
            row(query=0, birrt_status="solved", birrt_time_ms=7.0, given_length_rad=3.0),
            row(query=1, length_rad=1.5, time_ms=4.0, birrt_status="not_found"),
            row(query=2, status="not_found", length_rad=np.nan, birrt_status="solved", time_ms=9.0),
            row(query=3, status="not_connected", **NOTHING, birrt_status="not_found", time_ms=9.0),
            row(table="first_path", query=0, time_ms=2500.0, **NOTHING),
            row(table="first_path", query=1, time_ms=1500.0, **NOTHING),
        ]
    )
    found = figures(rows)
    own = found["pose"]["A, free"]
    assert own == found["pose"]["all"]
    assert (own["queries"], own["solved"], own["not_connected"], own["solvable"]) == (4, 2, 1, 3)
    assert own["success"] == pytest.approx(2 / 3, abs=1e-6)
    assert (own["birrt_solved"], own["success_of_birrt"]) == (2, 0.5)
    assert (own["ratio_median"], own["ratio_max"], own["given_ratio_max"]) == (1.25, 1.5, 3.0)
    assert (own["time_ms_median"], own["time_all_ms_median"]) == (3.0, 6.5)
    assert found["first_path"]["all"] == {"first_s": 2.5, "again_s": 1.5}
    json.dumps(found, allow_nan=False)
    write_table(rows, tmp_path / "arms.csv", {"commit": "none"})
    texts = dict.fromkeys(("source", "birrt_status", "given_status"), "")
    again = pd.read_csv(tmp_path / "arms.csv", comment="#", float_precision="round_trip")
    assert figures(again.astype(dict.fromkeys(texts, object)).fillna(texts)) == found


def test_the_stage_gives_every_part_its_own_fingerprint(stage, params) -> None:
    first, again = (stage.fingerprinted(params, Layout(ROOT)) for _ in range(2))
    assert len({part.fingerprint for part in first}) == len(first)
    assert [part.fingerprint for part in again] == [part.fingerprint for part in first]
