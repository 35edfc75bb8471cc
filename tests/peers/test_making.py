"""What randomised baselines are made of: the second attempt of OMPL's has half the step."""

from pathlib import Path
from typing import Any

import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, problem

from constraint_geodesics.params import BaselineParams, load_params
from constraint_geodesics.peers.baseline import Context
from constraint_geodesics.peers.making import made_together
from constraint_geodesics.peers.registry import kinds, settings_of
from constraint_geodesics.peers.wrappers import BandAfter, Remembered, Restarted, UntilSound
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.problem import PlanningProblem

PARAMS = load_params(Path(__file__).parents[2] / "params.yaml")


def made(**entries: dict) -> dict:
    planner = packaged_planner()
    context = Context(planner.scene.now, "free", manifold_of(planner, "free"), PARAMS, Layout(), {})
    settings = {
        name: settings_of(name, BaselineParams.model_validate({"kind": "birrt", **own}))
        for name, own in entries.items()
    }
    return made_together(settings, context)[0]


def test_a_second_attempt_has_half_the_step_with_a_band_or_without() -> None:
    found = made(plain={}, band={"band": True})
    for name in ("plain", "band"):
        asked = found[name]
        assert isinstance(asked, UntilSound)
        first, second = asked.inner, asked.second
        if name == "band":
            assert isinstance(first, BandAfter)
            assert isinstance(second, BandAfter)
            first, second = first.inner, second.inner
            assert isinstance(first, Remembered)
            assert isinstance(second, Remembered)
            first, second = first.inner, second.inner
        assert first.settings.delta_rad == 2.0 * second.settings.delta_rad


def test_a_band_takes_the_path_as_it_was_found_and_no_search_is_done_twice() -> None:
    found = made(plain={}, band={"band": True}, raw={"simplify": False})
    plain, band, raw = found["plain"].inner, found["band"].inner.inner, found["raw"].inner
    assert plain.settings.simplify
    assert not band.inner.settings.simplify
    assert band is raw
    assert plain.searches is band.inner.searches
    with packaged_planner().scene.world() as world:
        asked = problem(world, "free", 0)
        assert_same_search(asked, plain, raw)


def assert_same_search(asked: PlanningProblem, plain: Any, raw: Any) -> None:
    first, second = plain.plan(asked, 0), raw.plan(asked, 0)
    assert plain.plan(asked, 0).time_s > 0.5 * first.time_s  # a search holds its time
    assert second.iterations == first.iterations
    (searched,) = plain.searches._found.values()
    assert min(first.time_s, second.time_s) > searched.time_s


def test_restarts_keep_their_step_and_their_own_limit() -> None:
    found = made(restarted={"restarts_s": 0.2})["restarted"]
    assert isinstance(found, Restarted)
    assert found.budget_s == 0.2


@pytest.mark.parametrize("kind", kinds())
def test_half_of_a_step_is_all_that_changes(kind) -> None:
    own = settings_of(kind, BaselineParams.model_validate({"kind": kind}))
    changed = {
        name: value
        for name, value in own.with_half_step.model_dump().items()
        if value != own.model_dump()[name]
    }
    step = getattr(own, "delta_rad", None)
    assert changed == ({} if step is None else {"delta_rad": step / 2.0})
    assert own.model_copy(update={"restarts_s": 60.0}).given_s == 60.0
