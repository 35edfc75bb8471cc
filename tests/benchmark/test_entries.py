"""What the benchmark runs: planners by name, fewer of them, and what makes a row out of date."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, pairs_of

from constraint_geodesics.benchmark.entries import (
    Run,
    batches_of,
    code_digest,
    committed_run,
    data_digest,
    fewer,
    seeds_of,
    spread,
    training_times,
    with_planners,
)
from constraint_geodesics.benchmark.queries import read_queries
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.palette import FAMILIES
from constraint_geodesics.params import BaselineParams, Params
from constraint_geodesics.peers.baseline import BaselineError
from constraint_geodesics.peers.registry import BaselineBuilder, after, all_settings, kind_of, kinds
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.peers.wrappers import Remembered
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import note_stage_time
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.text_files import write_text


def with_planner(params: Params, **entry: object) -> Params:
    return with_planners(params, {"mine": BaselineParams.model_validate(entry)})


def build(params: Params, name: str, root: Path) -> None:
    planner = packaged_planner()
    with BaselineBuilder(params, root)(
        [name], planner.scene.now, "level_cup", manifold_of(planner, "level_cup")
    ):
        pass


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"kind": "teleport"}, "mine: no kind 'teleport': must be one of bayesian_optimisation, "),
        ({"kind": "straight_band", "glue": 2}, "mine.glue=2: there is no such parameter"),
        ({"kind": "birrt", "budget_s": -1.0}, "mine.budget_s=-1.0: input should be greater than 0"),
        ({"kind": "birrt", "space": "flat"}, "mine.space='flat': input should be 'projected', "),
    ],
)
def test_a_planner_that_can_not_be_made_is_named(params, tmp_path, entry, message) -> None:
    with pytest.raises(BaselineError, match=message):
        build(with_planner(params, **entry), "mine", tmp_path)
    with pytest.raises(BaselineError, match="has no 'other': must be one of mine"):
        build(with_planner(params, **entry), "other", tmp_path)


def test_the_benchmark_asks_for_the_pipeline_first(params, tmp_path) -> None:
    with pytest.raises(BaselineError, match="make repro"):
        committed_run(params, Layout(tmp_path), tmp_path, tmp_path)


def test_every_kind_of_the_parameters_exists_and_every_band_follows_its_planner(params) -> None:
    planners, settings = params.benchmark.planners, all_settings(params)
    assert {entry.kind for entry in planners.values()} == set(kinds())
    assert after("BiRRT + band", settings) == "BiRRT, raw"
    assert after("PRM + band", settings) == ""  # of its path as it is found there is no row
    for name in ("BiRRT", "BiRRT + band, 1 s", "planner"):
        assert after(name, settings) == ""
    assert set(params.benchmark.recorded) | set(params.benchmark.drawn) <= set(planners)


def test_a_kind_is_loaded_without_the_libraries_of_others() -> None:
    """A file of peers/ is all there is to know of a kind: nothing lists them."""
    script = (
        "import sys; from constraint_geodesics.peers.registry import kind_of, kinds; kinds();"
        "assert not {'ompl', 'torch', 'bayes_opt'} & set(sys.modules);"
        "kind_of('birrt'); kind_of('straight_band');"
        "assert not {'ompl', 'torch', 'bayes_opt'} & set(sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize("kind", kinds())
def test_every_kind_says_what_is_known_of_it(kind) -> None:
    own = kind_of(kind)
    assert own.family in FAMILIES
    assert own() == own.model_validate_json(own().model_dump_json(), strict=True)
    assert own(restarts_s=1.0).given_s == 1.0
    assert own(restarts_s=1.0).ends_by_counting is False


def test_chance_asks_for_seeds(params) -> None:
    planners, settings = params.benchmark.planners, all_settings(params)
    for name, seeds in (("planner", 1), ("BiRRT", 5), ("latent grid", 1), ("SLSQP", 5)):
        assert seeds_of(planners[name], settings[name], 5) == seeds
    few = planners["BiRRT"].model_copy(update={"seeds": 2})
    assert seeds_of(few, settings["BiRRT"], 5) == 2


def test_fewer_planners_queries_and_constraints(params) -> None:
    some, left_out = fewer(params, 2, 1, ["slide"])
    assert list(some.all_constraints) == ["slide"]
    assert {"RRT* 10 s", "PRM* 3 s"} <= set(left_out)
    kept = some.benchmark.planners
    assert not set(left_out) & set(kept)
    assert set(left_out) | set(kept) == set(params.benchmark.planners)
    assert all(entry.queries <= 2 and entry.seeds == 1 for entry in kept.values())
    assert set(some.benchmark.recorded) == set(kept), "what is asked for is there to be replayed"
    assert fewer(params, 1, 1, None, ["RRT* 10 s"], 20.0)[1] == []


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ((["upside_down"],), "no constraint 'upside_down': must be one of free, level_cup"),
        ((None, ["RRT"]), "no planner 'RRT': must be one of planner"),
        ((None, ["RRT* 10 s"]), "no planner is left"),
    ],
)
def test_what_is_not_there_can_not_be_benchmarked(params, wanted, message) -> None:
    with pytest.raises(BaselineError, match=message):
        fewer(params, 1, 1, *wanted)


def test_a_row_depends_on_the_code_that_makes_it_and_on_no_other() -> None:
    """The band's modules are not those of Bayesian optimisation."""
    digests = {kind: code_digest(f"peers.{kind}") for kind in kinds()}
    assert len(set(digests.values())) == len(digests)
    assert code_digest("peers.straight_band") == digests["straight_band"]


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
    assert file.read_text() == "stage,seconds\nlabel,3.0\ntrain a,1.0\ntrain b,5.0\n"


def test_planners_that_a_clock_may_stop_are_not_asked_for_the_same_path_twice(params) -> None:
    settings = all_settings(params)
    counted = {name for name, own in settings.items() if own.ends_by_counting}
    some = {"planner", "without graph", "BiRRT", "BiRRT + band", "PRM", "latent grid", "SLSQP"}
    assert some <= counted
    timed = {"planner 1 s", "RRT* 1 s", "PRM* 3 s", "BiRRT + band, 1 s"}
    assert not counted & (timed | {"band from many starts, 1 s"})
    clearance = {name for name, own in settings.items() if own.uses_clearance or own.band}
    assert {"straight + band", "BiRRT + band", "SLSQP"} <= clearance
    assert not clearance & {"planner", "BiRRT", "PRM", "BiRRT, decoded samples"}


def test_nobody_is_asked_under_a_constraint_that_it_has_no_submanifold_of(params, tmp_path) -> None:
    layout, asked = Layout(Path(__file__).parents[2]), {}
    for constraint in ("level_cup", "shelf"):
        queries = read_queries(layout.benchmark_queries(constraint))
        batches = batches_of(Run(params, layout, queries, tmp_path, (), None))
        asked[constraint] = {own.name for batch in batches for own in batch.baselines}
    assert asked["level_cup"] == set(params.benchmark.planners)
    grids = {"latent grid", "latent grid, constraint's nodes alone"}
    assert asked["level_cup"] - asked["shelf"] == {"latent graph", *grids}


def test_blocks_with_all_planners_stand_evenly_apart() -> None:
    """Three cases of four blocks each."""
    numbered = [(number, f"{case}{number}") for case in "abc" for number in range(4)]
    order = spread(numbered)  # type: ignore[arg-type]
    assert sorted(map(str, order)) == sorted(name for _, name in numbered)
    firsts = [k for k, name in enumerate(order) if str(name).endswith("0")]
    assert np.ptp(np.diff(firsts)) <= 4
    assert firsts[-1] - firsts[0] >= 6


def test_the_planner_answers_in_the_scene_of_its_query_and_in_no_other(params, tmp_path) -> None:
    shutil.copytree(PACKAGED, Layout(tmp_path).planner, ignore=shutil.ignore_patterns("learned"))
    planner, manifold = packaged_planner(), manifold_of(packaged_planner(), "free")
    start, goal = pairs_of("free", 1, seed=4)[0]
    place = planner.scene.robot.forward(goal)[0]
    before, build = planner.scene.now, BaselineBuilder(params, tmp_path)
    blocked = before.adding(Sphere("at the goal", tuple(place.tolist()), 0.1))
    problem = PlanningProblem(start, goal, manifold, lambda q: True)
    for scene, status in ((before, "solved"), (blocked, "in_collision"), (before, "solved")):
        with build(["planner"], scene, "free", manifold) as (made, _):
            assert made["planner"].plan(problem, 0).status == status


def test_the_planner_without_a_part_is_a_baseline_and_its_roadmaps_cost_time(
    params, tmp_path
) -> None:
    file = Path(__file__).resolve().parents[2] / "stages" / "report_benchmark.py"
    spec = importlib.util.spec_from_file_location("report_benchmark", file)
    assert spec is not None
    assert spec.loader is not None
    stage = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(stage)
    ours = stage.whole_planner(all_settings(params))
    assert ours == {"planner": 0.0, "planner 0.1 s": 0.1, "planner 1 s": 1.0}
    layout = Layout(tmp_path)
    for name, seconds in (("build_planner", 5.0), ("build_learned", 2.0), ("train_policies", 9.0)):
        note_stage_time(layout.stage_times, name, (), seconds)
    spent = training_times(params, layout)
    assert spent["planner"] == spent["band from many starts"] == 5.0
    assert spent["without graph"] == spent["BiRRT"] == 0.0
    assert spent["learned"] == 16.0
    write_text(layout.report("train_policies", params.policies.chart), '{"seconds_mean": 1.5}')
    assert training_times(params, layout)["learned"] == 8.5, "of one seed"
