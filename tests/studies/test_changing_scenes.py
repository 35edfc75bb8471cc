"""The study of scenes that change, small, on the real planner; its figures on known rows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.planner_fixtures import packaged_bundle, packaged_planner

from constraint_geodesics.params import Params
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.studies import changing_scenes as study
from constraint_geodesics.studies.clutter import MAKERS
from constraint_geodesics.text_files import write_text

NAME = "level_cup"


def test_every_sphere_is_on_the_way_and_no_answer_touches_it() -> None:
    planner, before = packaged_planner(), packaged_planner().scene.now
    rows = pd.DataFrame(study.beside_a_sphere(planner, NAME, 2, seed=3))
    assert len(rows) == 2 * len(study.BUDGETS_S)
    assert set(rows.status) == {"solved"}
    assert not rows.touches.any()
    assert planner.scene.now == before


def test_what_a_path_or_a_stop_touches_is_seen_whatever_the_path_says_stands_there() -> None:
    planner = packaged_planner()
    path = next(study._long_paths(planner, NAME, 3))
    tool, _ = planner.robot.forward(path.at(0.5))
    around = planner.scene.now.adding(Sphere("ball", tuple(tool.tolist()), 0.03))
    stop = path.stop(0.4 * float(path.times[-1]))
    assert stop.status == "stopped"
    for own in (path, stop):
        assert not study.touches(own, own.scene)
    assert study.touches(path, around)
    whole = replace(stop, joints=path.joints)
    assert study.touches(whole, around)


def test_roadmaps_are_made_anew_once_a_first_shape_is_gone() -> None:
    with Planner(packaged_bundle(), "packaged") as planner:
        before = planner.nodes(NAME)
        (row,) = study.after_a_first_shape(planner, [NAME])
        assert row["ms"] > 0.0
        assert "table" not in planner.scene.now.names
        assert not np.array_equal(planner.nodes(NAME), before)


def test_a_query_that_no_budget_solves_is_asked_for_longer_and_in_no_budget_s_figures() -> None:
    kinds = {0.0: np.nan, 30.0: np.nan, 100.0: np.nan, 500.0: np.nan, 10_000.0: 2.0}
    rows = pd.DataFrame(
        [
            {"constraint": NAME, "query": 0, "budget_ms": budget, "ms": 1.0, "touches": False}
            | {"length_rad": length, "status": "solved" if length == length else "not_found"}
            for budget, length in kinds.items()
        ]
    )
    found = study.sphere_figures(rows)
    assert set(found["all"]) == {"first answer", "30 ms", "100 ms", "500 ms"}
    assert {own["solved"] for own in found["all"].values()} == {0}
    assert {own["queries"] for own in found["all"].values()} == {1}
    assert found["solved with no budget"] == 0


def test_the_cup_is_carried_while_it_is_asked_and_gone_after(params: Params) -> None:
    planner, before = packaged_planner(), packaged_planner().scene.now
    rows = study.loaded(planner, Scene.from_params(params, NAME), NAME, 3, seed=3)
    first = next(rows)
    assert "cup" in planner.scene.now.names
    table = pd.DataFrame([first, *rows])
    assert planner.scene.now == before
    assert table.status.tolist() == ["solved"] * 3
    assert not table.touches.any()


def test_a_motion_is_answered_when_a_sphere_comes_up() -> None:
    planner, before = packaged_planner(), packaged_planner().scene.now
    rows = pd.DataFrame(study.sudden(planner, NAME, 3, seed=3))
    assert len(rows) == 3
    assert set(rows.status) <= {"solved", "stopped"}
    assert (rows.status == "solved").any(), "a stop alone is no way round"
    assert rows.certified.all()
    assert planner.scene.now == before


def test_changes_of_shapes_of_each_kind_are_timed_and_taken_back() -> None:
    planner, before = packaged_planner(), packaged_planner().scene.now
    found = study.change_figures(pd.DataFrame(study.changes(planner, 2, 1, seed=3)))["2"]
    kinds = ("add", "move", "remove", "attach", "detach")
    assert set(found) == {*kinds, *(f"{kind}_p95" for kind in kinds), "by_shape"}
    assert set(found["by_shape"]) == set(MAKERS)
    assert all(set(own) == set(kinds) for own in found["by_shape"].values())
    assert min(found[kind] for kind in kinds) > 0.0
    assert planner.scene.now == before


def test_figures_of_changes_are_medians_and_95th_percentiles() -> None:
    times = {("box", 2): (1.0, 2.0, 6.0), ("ball", 2): (3.0, 4.0), ("box", 5): (7.0,)}
    rows = pd.DataFrame(
        {"shape": shape, "among": among, "change": "add", "ms": ms}
        for (shape, among), own in times.items()
        for ms in own
    )
    found = study.change_figures(rows)
    by_shape = {"ball": {"add": 3.5}, "box": {"add": 2.0}}
    assert found["2"] == {"add": 3.0, "add_p95": pytest.approx(5.6), "by_shape": by_shape}
    assert found["5"] == {"add": 7.0, "add_p95": 7.0, "by_shape": {"box": {"add": 7.0}}}


def test_meshes_of_5000_triangles_are_new_to_the_process_each_time(monkeypatch) -> None:
    planner, before, written = packaged_planner(), packaged_planner().scene.now, list[str]()

    def write(file: Path, text: str) -> None:
        written.append(text)
        write_text(file, text)

    monkeypatch.setattr(study, "write_text", write)
    rows = pd.DataFrame(study.large_meshes(planner, 2, seed=3))
    assert rows.triangles.tolist() == [5000] * 4
    assert len(set(written)) == len(written) == 4
    assert (rows.ms > 0.0).all()
    assert planner.scene.now == before


def test_figures_of_meshes_are_medians_and_95th_percentiles() -> None:
    times = {"ball": (1.0, 2.0, 3.0), "ring": (10.0, 20.0, 60.0)}
    rows = pd.DataFrame(
        {"mesh": mesh, "triangles": 5000, "ms": ms} for mesh, own in times.items() for ms in own
    )
    assert study.mesh_figures(rows) == {
        "ball": {"triangles": 5000, "ms_median": 2.0, "ms_p95": 2.9},
        "ring": {"triangles": 5000, "ms_median": 20.0, "ms_p95": 56.0},
    }


def test_stops_are_certified_on_the_paths_lines_or_once_they_are_looked_at() -> None:
    rows = pd.DataFrame(study.stops(packaged_planner(), NAME, 6, seed=3))
    assert len(rows) == 6
    found = study.by_constraint(rows)
    assert found["all"] == found[NAME]
    assert set(found[NAME]["statuses"]) <= {"on the path's lines", "drawn anew"}
    assert "ms_median" not in found[NAME]


def test_lengths_are_over_the_best_and_what_nobody_solves_is_counted_apart() -> None:
    lengths = {(0, 0.0): 2.2, (0, 30.0): 2.0, (1, 0.0): 3.0, (1, 30.0): np.nan, (2, 0.0): np.nan}
    rows = pd.DataFrame(
        {
            "constraint": NAME,
            "query": query,
            "budget_ms": budget,
            "status": "not_found" if np.isnan(length) else "solved",
            "ms": 5.0,
            "length_rad": length,
            "touches": False,
        }
        for (query, budget), length in lengths.items()
    )
    found = study.sphere_figures(rows)
    assert found["solved with no budget"] == 1
    first, more = found[NAME]["first answer"], found[NAME]["30 ms"]
    assert (first["queries"], first["solved"], more["solved"]) == (2, 2, 1)
    assert first["ratio_median"] == pytest.approx(1.05)
    assert more["ratio_p95"] == pytest.approx(1.0)
    assert found["all"] == found[NAME]
