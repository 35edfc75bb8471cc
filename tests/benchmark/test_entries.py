"""What the benchmark runs: planners by name, fewer of them, and what makes a row out of date."""

from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, pairs_of

from constraint_geodesics.benchmark.entries import (
    after,
    blocks_of,
    code_digest,
    data_digest,
    ends_by_counting,
    fewer,
    spread,
    uses_clearance,
)
from constraint_geodesics.params import Params, PeerParams
from constraint_geodesics.peers.elastic_band import StraightBand
from constraint_geodesics.peers.registry import KINDS, PeerBuilder, PeerError, Remembered
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import note_stage_time
from constraint_geodesics.problem import PlanningProblem


def with_planner(params: Params, **peer: object) -> Params:
    bench = params.bench.model_copy(update={"planners": {"mine": PeerParams.model_validate(peer)}})
    return params.model_copy(update={"bench": bench})


def build(params: Params, name: str, root: Path) -> None:
    planner = packaged_planner()
    with PeerBuilder(params, root)(
        [name], planner.scene, "level_cup", manifold_of(planner, "level_cup")
    ):
        pass


@pytest.mark.parametrize(
    ("peer", "message"),
    [
        (
            {"kind": "teleport", "queries": 1, "seeds": 1},
            "no kind 'teleport': must be one of planner, ompl",
        ),
        (
            {"kind": "straight_band", "queries": 1, "seeds": 1, "settings": {"glue": 2}},
            "mine.settings: .*glue",
        ),
        (
            {"kind": "ompl", "queries": 1, "seeds": 1, "settings": {"glue": 2}},
            "there is no setting glue",
        ),
    ],
)
def test_a_planner_that_can_not_be_made_is_named(params, tmp_path, peer, message) -> None:
    with pytest.raises(PeerError, match=message):
        build(with_planner(params, **peer), "mine", tmp_path)
    with pytest.raises(PeerError, match="has no 'other': must be one of mine"):
        build(with_planner(params, **peer), "other", tmp_path)


def test_the_benchmark_asks_for_the_pipeline_first(params, tmp_path) -> None:
    with pytest.raises(PeerError, match="make repro"):
        blocks_of(params, Layout(tmp_path), tmp_path, tmp_path)


def test_every_kind_of_the_parameters_exists_and_every_band_follows_its_planner(params) -> None:
    planners = params.bench.planners
    assert {peer.kind for peer in planners.values()} == set(KINDS)
    assert after("BiRRT + band", planners) == "BiRRT"
    assert after("BiRRT, decoded samples + band", planners) == "BiRRT, decoded samples"
    assert (
        after("BiRRT", planners)
        == after("BiRRT + band, 1 s", planners)
        == after("planner", planners)
        == ""
    )
    assert set(params.bench.recorded) | set(params.bench.placed_by) | set(
        params.bench.drawn
    ) <= set(planners)


def test_fewer_planners_queries_and_constraints(params) -> None:
    some, left_out = fewer(params, 2, 1, ["slide"], None, 2.0)
    assert list(some.constraints) == ["slide"]
    assert {"RRT* 10 s", "PRM* 3 s"} <= set(left_out)
    assert not set(left_out) & set(some.bench.planners)
    assert set(left_out) | set(some.bench.planners) == set(params.bench.planners)
    assert all(peer.queries <= 2 and peer.seeds == 1 for peer in some.bench.planners.values())
    assert fewer(params, 1, 1, None, ["RRT* 10 s"], 20.0)[1] == []


@pytest.mark.parametrize(
    ("constraints", "planners", "longest", "message"),
    [
        (["upside_down"], None, 2.0, "no constraint 'upside_down': must be one of free, level_cup"),
        (None, ["RRT"], 2.0, "no planner 'RRT': must be one of planner"),
        (None, ["RRT* 10 s"], 2.0, "no planner is left"),
    ],
)
def test_what_is_not_there_can_not_be_benchmarked(
    params, constraints, planners, longest, message
) -> None:
    with pytest.raises(PeerError, match=message):
        fewer(params, 1, 1, constraints, planners, longest)


def test_a_row_depends_on_the_code_that_makes_it_and_on_no_other() -> None:
    """Kinds that share their modules share a digest, the band's are not those of Bayesian
    optimisation.
    """
    digests = {kind: code_digest(*made.modules) for kind, made in KINDS.items()}
    assert digests["straight_latent"] == digests["gradient_geodesic"]
    assert (
        len(
            {
                digests[kind]
                for kind in ("straight_band", "ompl", "bayesian_optimisation", "latent_grid")
            }
        )
        == 4
    )
    assert code_digest("planners.elastic_band") == digests["straight_band"]


def test_data_is_told_apart_by_names_and_content(tmp_path) -> None:
    (tmp_path / "a").write_text("1")
    first = data_digest(tmp_path)
    (tmp_path / "a").write_text("2")
    second = data_digest(tmp_path)
    (tmp_path / "a").rename(tmp_path / "b")
    assert len({first, second, data_digest(tmp_path)}) == 3


def test_a_remembered_answer_is_that_of_the_same_problem_and_seed() -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    problem = PlanningProblem(
        start, goal, manifold_of(packaged_planner(), "level_cup"), lambda q: True
    )
    again = PlanningProblem(start, goal, problem.manifold, problem.is_free)
    planner = Remembered(StraightBand())
    answer = planner.plan(problem, 0)
    assert planner.plan(problem, 0) is answer
    assert planner.plan(problem, 1) is not answer
    assert planner.plan(problem, 0) is answer
    assert planner.plan(again, 0) is not answer


def test_the_last_time_of_each_stage_is_kept(tmp_path) -> None:
    file = tmp_path / "reports" / "stage_times.csv"
    for stage, names, seconds in (
        ("train", ["b"], 2.0),
        ("train", ["a"], 1.04),
        ("label", [], 3.0),
        ("train", ["b"], 5.0),
    ):
        note_stage_time(file, stage, names, seconds)
    assert file.read_text().splitlines() == [
        "stage,seconds",
        "label,3.0",
        "train a,1.0",
        "train b,5.0",
    ]


def test_planners_that_a_clock_may_stop_are_not_asked_for_the_same_path_twice(params) -> None:
    counted = {name for name, peer in params.bench.planners.items() if ends_by_counting(peer)}
    assert {
        "planner",
        "without graph",
        "BiRRT",
        "BiRRT + band",
        "PRM",
        "latent grid",
        "SLSQP",
    } <= counted
    assert not counted & {
        "planner 1 s",
        "RRT* 1 s",
        "PRM* 3 s",
        "BiRRT + band, 1 s",
        "band from many starts, 1 s",
    }
    clearance = {name for name, peer in params.bench.planners.items() if uses_clearance(peer)}
    assert {"straight + band", "BiRRT + band", "SLSQP"} <= clearance
    assert not clearance & {"planner", "BiRRT", "PRM", "BiRRT, decoded samples"}


def test_blocks_with_all_planners_stand_evenly_apart() -> None:
    """Three cases of four blocks each."""
    numbered = [(number, f"{case}{number}") for case in "abc" for number in range(4)]
    order = spread(numbered)  # type: ignore[arg-type]
    assert sorted(map(str, order)) == sorted(name for _, name in numbered)
    firsts = [k for k, name in enumerate(order) if str(name).endswith("0")]
    assert np.ptp(np.diff(firsts)) <= 4
    assert firsts[-1] - firsts[0] >= 6
