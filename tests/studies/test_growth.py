"""Exponents of power laws are found exactly; a small real measurement has every axis, size and
planner asked for.
"""

from contextlib import redirect_stderr
from dataclasses import replace
from io import StringIO
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import linregress
from tests.planner_fixtures import packaged_planner

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.report.growth_figure import LABELS, growth_figure, slopes_markdown
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import World
from constraint_geodesics.studies import growth
from constraint_geodesics.studies.growth import (
    AWAY_M,
    AXES,
    CONSTRAINT,
    HELD,
    PLANNER,
    BandAndTrees,
    GrowthSizes,
    Subject,
    epoch_seconds,
    measure_growth,
    place_spheres,
    slopes,
)

SIZES = GrowthSizes(
    references=1,
    queries_each=1,
    codimensions=(0, 3),
    spheres=(0, 2),
    layouts=1,
    obstacle_queries_each=1,
    batches=(1, 3),
    peer_batches=(1, 2),
    batch_repeats=2,
    batch_queries=3,
    latent_dims=(2, 5),
    curves=8,
    length_repeats=3,
    rows=(600, 1200),
    epochs=1,
    training_repeats=2,
    nodes=(20, 40),
    roadmap_repeats=2,
)
PEER = "BiRRT, tangent bundle"
PLANNERS = {"trees + band", "straight + band", PEER}
ASKED = {
    "joints": {name: {6, 7} for name in PLANNERS},
    "codimension": {name: set(SIZES.codimensions) for name in PLANNERS},
    "obstacles": {name: set(SIZES.spheres) for name in PLANNERS},
    "queries": {PLANNER: set(SIZES.batches), PEER: set(SIZES.peer_batches)},
    "latent dimension": {"8 curve lengths": set(SIZES.latent_dims)},
    "dataset rows": {
        "training epoch, mean": set(SIZES.rows),
        "training epoch, variance": set(SIZES.rows),
        "roadmap": set(SIZES.nodes),
    },
}


def law(values, seconds, axis="queries", what="one"):
    told = {"axis": axis, "value": values, "what": what, "seconds": seconds}
    return pd.DataFrame(told | {"solved": np.nan})


@given(
    st.floats(-3.0, 3.0),
    st.floats(1e-6, 1e3),
    st.lists(st.integers(1, 10_000), min_size=3, max_size=8, unique=True),
)
@settings(max_examples=50)
def test_a_power_law_s_exponent_is_exact(exponent, at_1, values):
    values = np.array(values, float)
    fit = slopes(law(values, at_1 * values**exponent)).iloc[0]
    assert fit["slope"] == pytest.approx(exponent, abs=1e-6)
    assert fit["seconds_at_1"] == pytest.approx(at_1, rel=1e-5)
    assert fit["standard_error"] == pytest.approx(0.0, abs=1e-6)
    assert fit["points"] == len(values)


def test_the_standard_error_is_that_of_the_textbook():
    rng = np.random.default_rng(0)
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    seconds = 0.3 * values**1.5 * np.exp(rng.normal(scale=0.2, size=6))
    fit = slopes(law(values, seconds)).iloc[0]
    textbook = linregress(np.log(values), np.log(seconds))
    assert fit["slope"] == pytest.approx(textbook.slope)
    assert fit["standard_error"] == pytest.approx(textbook.stderr)


def test_there_is_one_row_for_each_axis_and_what():
    values = np.array([1.0, 2.0, 4.0])
    tables = [
        law(values, values**p, axis, what)
        for p, axis, what in ((1, "a", "x"), (2, "a", "y"), (3, "b", "x"))
    ]
    fits = slopes(pd.concat(tables))
    assert fits[["axis", "what"]].to_numpy().tolist() == [["a", "x"], ["a", "y"], ["b", "x"]]
    np.testing.assert_allclose(fits["slope"], [1.0, 2.0, 3.0])


def test_what_has_no_logarithm_is_left_out():
    fit = slopes(law([0, 1, 2, 3, 4, 8], [100.0, 1.0, 4.0, np.nan, 16.0, 0.0])).iloc[0]
    assert fit["slope"] == pytest.approx(2.0)
    assert fit["points"] == 3


def test_sizes_of_which_too_few_are_solved_are_left_out():
    known = law([1, 2, 4, 8], [1.0, 2.0, 4.0, 2.0])
    fit = slopes(known.assign(solved=[1.0, 0.95, 0.9, 0.5])).iloc[0]
    assert fit["slope"] == pytest.approx(1.0)
    assert fit["points"] == 3


def test_two_points_have_a_slope_without_an_error():
    fit = slopes(law([6, 7], [6.0**3, 7.0**3])).iloc[0]
    assert fit["slope"] == pytest.approx(3.0)
    assert np.isnan(fit["standard_error"])


@pytest.mark.parametrize("values", [[5], [5, 5, 5], [0, 5], [0, 0]])
def test_fewer_than_two_sizes_have_no_slope(values):
    fit = slopes(law(values, np.linspace(1.0, 2.0, len(values)))).iloc[0]
    assert np.isnan([fit["slope"], fit["standard_error"], fit["seconds_at_1"]]).all()


def test_the_table_has_a_line_for_each_exponent_that_more_than_two_sizes_give():
    sizes = np.array([1.0, 2.0, 4.0])
    pair = law([3, 6], [0.1, 0.2], axis="joints")
    fits = slopes(pd.concat([law(sizes, 0.1 * sizes**2), pair]))
    assert len(fits) == 2
    (line,) = slopes_markdown(fits).splitlines()[2:]
    assert [cell.strip() for cell in line.split("|")][3:6] == ["2.00", "0.00", "3"]


def test_held_axes_are_as_many_as_they_are_listed_for():
    assert [sum(axes) for axes in HELD] == list(range(6))
    for fewer, more in pairwise(HELD[2:]):
        assert all(a <= b for a, b in zip(fewer, more, strict=True))


@pytest.fixture(scope="module")
def batches():
    """Sizes of the batches that were asked for."""
    return []


@pytest.fixture(scope="module")
def measured(params, scene, kuka, batches, tmp_path_factory):
    own = BandAndTrees()
    birrt = OmplSettings(space="tangent_bundle", budget_s=60.0, iterations=300)
    planners = {
        own.name: own,
        "straight + band": StraightBand(),
        PEER: SamplingPlanner("birrt", birrt),
    }

    def batch(starts, goals):
        batches.append(len(starts))
        return [
            path.status == "solved"
            for path in packaged_planner().plan_batch(starts, goals, CONSTRAINT)
        ]

    joints = scene.robot.sample(max(SIZES.rows), np.random.default_rng(0))
    scratch = tmp_path_factory.mktemp("growth")
    said = StringIO()
    with redirect_stderr(said):
        table = measure_growth(
            Subject(params, scene, kuka, planners, batch, PEER, joints, scratch), SIZES
        )
    table.attrs["said"] = said.getvalue()
    return table


def test_every_axis_size_and_planner_was_measured_once(measured):
    assert tuple(dict.fromkeys(measured["axis"])) == AXES
    found = {
        axis: {what: set(rows["value"]) for what, rows in own.groupby("what")}
        for axis, own in measured.groupby("axis")
    }
    assert found == ASKED
    assert not measured.duplicated(["axis", "value", "what"]).any()


def test_progress_comes_to_its_end_and_not_further(measured):
    assert (
        measured.attrs["said"]
        .splitlines()[-1]
        .startswith(f"growth: {SIZES.steps}/{SIZES.steps}, took")
    )


def test_axes_and_sizes_are_in_order(measured):
    for _, own in measured.groupby("axis"):
        assert own["value"].is_monotonic_increasing


def test_a_planner_never_meets_the_same_problem_twice(params, scene, kuka, tmp_path):
    """Some planners remember the last problems that they answered, as objects."""

    class Remembers:
        name = PEER
        met: ClassVar[list] = []

        def plan(self, problem, seed):
            assert not any(problem is other for other in self.met)
            self.met.append(problem)
            return StraightBand().plan(problem, seed)

    joints = scene.robot.sample(max(SIZES.rows), np.random.default_rng(0))
    planners = {PEER: Remembers()}
    measure_growth(
        Subject(
            params, scene, kuka, planners, lambda a, b: [True] * len(a), PEER, joints, tmp_path
        ),
        SIZES,
        "",
    )
    assert len(Remembers.met) >= 20


def test_seconds_are_positive(measured):
    assert (measured["low"] > 0).all()
    assert np.isfinite(measured["high"]).all()
    assert (measured["mean"] > 0).all()


def test_the_table_has_median_quartiles_mean_and_the_share_solved():
    timed = ((4.0, 1.0), (1.0, 1.0), (10.0, 0.0), (2.0, 1.0), (3.0, 1.0))
    table = growth._summary([growth.Sample("queries", 3, "one", *each) for each in timed])
    (row,) = table.to_dict("records")
    size = {"axis": "queries", "value": 3, "what": "one", "repeats": 5, "solved": 0.8}
    assert row == size | {"seconds": 3.0, "low": 2.0, "high": 4.0, "mean": 4.0}


def test_repeats_are_as_asked(measured):
    found = measured.groupby("axis")["repeats"].agg(set)
    assert found["joints"] == found["codimension"] == {1}
    assert found["obstacles"] == {1}
    assert found["queries"] == {3, 2}
    assert found["latent dimension"] == {3}
    assert found["dataset rows"] == {2}


def test_only_queries_are_solved(measured):
    asked = measured["axis"].isin(AXES[:4])
    assert measured.loc[asked, "solved"].between(0.0, 1.0).all()
    assert measured.loc[~asked, "solved"].isna().all()
    easy = measured[(measured["axis"] == "codimension") & (measured["value"] == 0)]
    assert (easy["solved"] == 1.0).all()  # without a constraint the straight line does


def test_batches_are_asked_whole_after_one_that_does_not_count(measured, batches):
    assert batches[0] == max(SIZES.batches)
    assert sorted(batches[1:]) == SIZES.turns(1) * [1] + SIZES.turns(3) * [3]
    assert (SIZES.turns(1), SIZES.turns(3)) == (3, 2)


def test_the_figure_shows_what_was_measured(measured, tmp_path):
    fits = slopes(measured)
    figure = growth_figure(measured, fits)
    assert [panel.get_xlabel() for panel in figure.axes] == [LABELS[axis] for axis in AXES]
    for panel, (_, own) in zip(figure.axes, measured.groupby("axis", sort=False), strict=True):
        assert panel.get_yscale() == "log"
        assert panel.get_xscale() == ("symlog" if own["value"].min() == 0 else "log")
        np.testing.assert_array_equal(panel.get_xticks(), np.unique(own["value"]))
        entries = {text.get_text() for text in panel.get_legend().get_texts()}
        assert len(entries) == own["what"].nunique()
        for fit in fits[fits["what"].isin(own["what"]) & fits["axis"].isin(own["axis"])].to_dict(
            "records"
        ):
            shown = "no slope" if np.isnan(fit["slope"]) else f"slope {fit['slope']:.2f}"
            assert any(entry.startswith(f"{fit['what']}: {shown}") for entry in entries)
        drawn = [
            line.get_ydata() for line in panel.get_lines() if not line.get_label().startswith("_")
        ]
        np.testing.assert_array_equal(np.sort(np.concatenate(drawn)), np.sort(own["seconds"]))
    save_png(figure, tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 0


def test_fitted_lines_go_through_a_law_s_points():
    values = np.array([0.0, 1.0, 2.0, 4.0])
    table = law(values, 0.5 * np.maximum(values, 0.1) ** 2, "obstacles").assign(
        low=0.01, high=9.0, solved=[1.0, 0.9, 0.4, np.nan]
    )
    panel = growth_figure(table, slopes(table)).axes[0]
    (fitted,) = [line for line in panel.get_lines() if line.get_label().startswith("_")]
    np.testing.assert_allclose(fitted.get_xdata(), [1.0, 4.0])
    np.testing.assert_allclose(fitted.get_ydata(), [0.5, 8.0])
    insides = next(c for c in panel.collections if len(c.get_offsets()) == 4).get_facecolors()
    assert [bool((inside[:3] == 1.0).all()) for inside in insides] == [
        False,
        False,
        True,
        False,
    ]  # hollow: white


def test_epochs_are_counted_without_what_surrounds_them(params, scene, tmp_path):
    joints = scene.robot.sample(600, np.random.default_rng(1))
    found = epoch_seconds(joints, scene.robot, params.manifolds["planner"], 2, tmp_path)
    assert set(found) == {"mean", "variance"}
    for seconds in found.values():
        assert len(seconds) == 2
        assert min(seconds) > 0.0


@pytest.fixture(scope="module")
def queries(params, scene):
    return draw_queries(
        scene, constraint_manifold(scene.robot, params.constraints[CONSTRAINT]), CONSTRAINT, 4, 3
    )


def test_spheres_leave_room_around_both_ends(scene, queries):
    spheres = place_spheres(scene, queries, 5, 0.06, np.random.default_rng(2))
    assert len({sphere.centre_m for sphere in spheres}) == len(spheres) == 5
    assert spheres == place_spheres(scene, queries, 5, 0.06, np.random.default_rng(2))
    wider = [replace(sphere, radius_m=sphere.radius_m + 0.9 * AWAY_M) for sphere in spheres]
    with World(scene.robot, (*scene.workcell, *wider)) as world:
        assert world.free(np.concatenate([queries.starts, queries.goals])).all()


def test_spheres_that_do_not_fit_are_an_error(scene, queries, monkeypatch):
    monkeypatch.setattr(growth, "TRIES", 10)
    with pytest.raises(
        ValueError, match="no room for 3 spheres of 1.0 m near the ends of 4 queries"
    ):
        place_spheres(scene, queries, 3, 1.0, np.random.default_rng(2))


@pytest.fixture(scope="module")
def problems(params, scene, queries):
    manifold = constraint_manifold(scene.robot, params.constraints[CONSTRAINT])
    with scene.world() as world:
        clearance = clearance_model(scene)
        pairs = zip(queries.starts, queries.goals, strict=True)
        yield [
            PlanningProblem(start, goal, manifold, world.is_free, clearance)
            for start, goal in pairs
        ]


def test_band_and_trees_keep_the_constraint_between_exact_ends(scene, problems):
    planner = BandAndTrees()
    with Certifier(scene, Limits()) as judge:
        for problem in problems:
            found = planner.plan(problem, 0)
            assert found.status == "solved"
            np.testing.assert_array_equal(found.joints[[0, -1]], [problem.start, problem.goal])
            assert judge.certify(
                found.joints, problem.manifold.constraint, problem.start, problem.goal
            ).valid
            middle = 0.5 * (found.joints[1:] + found.joints[:-1])
            assert problem.manifold.violation(np.concatenate([found.joints, middle])).max() <= 1e-4
            np.testing.assert_array_equal(planner.plan(problem, 7).joints, found.joints)


def test_band_and_trees_go_round_what_stops_the_straight_band(scene, problems):
    gone_round = 0
    for problem in problems:
        path = StraightBand().plan(problem, 0).joints
        x, y, z = scene.robot.forward(path[len(path) // 2])[0].tolist()
        among = replace(scene, workcell=(*scene.workcell, Sphere("on the way", (x, y, z), 0.06)))
        with among.world() as world, Certifier(among, Limits()) as judge:
            assert not world.free(path).all()
            if not (world.is_free(problem.start) and world.is_free(problem.goal)):
                continue
            blocked = replace(problem, is_free=world.is_free, clearance=clearance_model(among))
            found = BandAndTrees().plan(blocked, 0)
            assert found.status == "solved"
            assert judge.certify(
                found.joints, problem.manifold.constraint, problem.start, problem.goal
            ).valid
            gone_round += 1
    assert gone_round >= 2


def test_band_and_trees_refuse_bad_ends(problems):
    problem = problems[0]
    found = BandAndTrees().plan(replace(problem, start=problem.start + 0.1), 0)
    assert (found.status, len(found.joints)) == ("start_violates", 0)
    standing = BandAndTrees().plan(replace(problem, goal=problem.start), 0)
    assert (standing.status, len(standing.joints)) == ("solved", 2)
