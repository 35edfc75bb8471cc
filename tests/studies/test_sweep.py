"""What decides whether a seed is trained again, and what is kept of it; the rest is in
tests/end_to_end/test_sweep.py.
"""

import json
import shutil
from pathlib import Path

import pytest
from tests.conftest import ROOT

from constraint_geodesics.errors import ParamsError
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import SWEEP_FOLDER, Layout
from constraint_geodesics.studies.search_space import SearchSpace
from constraint_geodesics.studies.sweep import (
    configuration,
    configuration_figures,
    configurations_of,
)
from constraint_geodesics.studies.sweep_seed import Pace

CONSTRAINT = {"feasible": [True], "length_rad": [2.0], "optimum_rad": [1.0], "time_ms": [4.0]}
RESULT = {"steps_per_second": float("nan"), "constraints": {"level_cup": CONSTRAINT}}


@pytest.fixture
def layout(tmp_path, monkeypatch) -> Layout:
    """Files where the data and the manifold are; only their contents' digests are looked at."""
    monkeypatch.delenv(SWEEP_FOLDER, raising=False)
    shutil.copy(ROOT / "params.yaml", tmp_path)
    layout = Layout(tmp_path)
    for name in load_params(ROOT / "params.yaml").constraints:
        layout.joints(name).parent.mkdir(parents=True)
        layout.joints(name).write_text(name)
    layout.manifold("planner").mkdir(parents=True)
    return layout


def key(layout: Layout, **changes: object) -> str:
    entries = {name.replace("__", "."): value for name, value in changes.items()}
    return configuration(load_params(layout.root / "params.yaml", entries), layout, {}).key


def test_a_seed_is_trained_again_for_what_it_depends_on_alone(layout, tmp_path) -> None:
    own = key(layout)
    for changes in (
        {"policies__reward__c": 7.0},
        {"geodesics__degree": 4},
        {"sweep__steps": 100},
        {"sweep__query_seed": 5},
        {"constraints__slide__reference__position_m": [0.4, 0.0, 0.25]},
    ):
        assert key(layout, **changes) != own, changes
    for changes in (
        {"sweep__seeds": [0, 1, 2, 3]},
        {"policies__steps": 7},
        {"geodesics__seeds": [9]},
        {"policies__reward__c": load_params().policies.reward.c},
        {"benchmark__queries": 7},
    ):
        assert key(layout, **changes) == own, changes
    other = Layout(tmp_path / "other")
    shutil.copytree(layout.root / "data", other.root / "data")
    shutil.copy(ROOT / "params.yaml", other.root)
    assert key(other) == own, "wherever the checkout is"
    again = Layout(tmp_path / "again")
    shutil.copytree(other.root, again.root)
    again.joints("slide").write_text("others")
    assert key(again) != own


def test_the_first_configuration_is_that_of_params_and_none_is_there_twice(layout) -> None:
    own = load_params(ROOT / "params.yaml").policies.reward.b
    space = SearchSpace(search="grid", space={"policies.reward.b": [3.0, own, 3]})
    assert [found.label for found in configurations_of(space, layout)] == [
        "as in params.yaml",
        "b=3",
    ]
    drawn = SearchSpace(
        search="random", configurations=3, space={"policies.reward.b": {"low": 2, "high": 9}}
    )
    found = configurations_of(drawn, layout)
    assert len({own.name for own in found}) == 3
    with pytest.raises(ParamsError, match=r"policies.reward.b=-1"):
        configurations_of(SearchSpace(search="grid", space={"policies.reward.b": [-1]}), layout)


def test_what_is_kept_is_read_again_and_counts_as_done(layout) -> None:
    own = configuration(load_params(ROOT / "params.yaml"), layout, {})
    assert own.seeds_left(layout) == [0, 1, 2]
    own.keep(layout, 1, RESULT)
    assert own.seeds_left(layout) == [0, 2]
    (result,) = own.results(layout)
    assert (result["seed"], result["steps_per_second"]) == (1, None)
    assert json.loads(json.dumps(result["constraints"])) == RESULT["constraints"]
    figures = configuration_figures(own, layout)
    assert (figures["seeds"], figures["efficiency"], figures["ratio_p50"]) == (1, 0.5, 2.0)
    assert figures["each_seed"]["time_ms"] == [4.0]
    (kept,) = layout.sweep.rglob("seed-1.json")
    kept.write_text(kept.read_text()[:-20])
    assert own.seeds_left(layout) == [0, 1, 2], "a damaged one is made again"


def test_a_sweep_without_data_names_the_file_and_what_makes_it(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=r"joints.parquet: .*`make repro` makes it"):
        configuration(load_params(ROOT / "params.yaml"), Layout(tmp_path), {})


def test_an_experiment_finds_what_the_sweep_that_started_it_has(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv(SWEEP_FOLDER, str(tmp_path))
    assert Layout(Path("elsewhere")).sweep == tmp_path


def test_the_pace_is_that_between_the_first_report_and_the_last(monkeypatch) -> None:
    clock = iter([10.0, 11.0, 15.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    pace, told = Pace(), []
    report = pace.also(lambda step, figures: told.append((step, figures)))
    for step in (50_000, 50_100, 50_200):
        report(step, {"saving": 0.1})
    assert pace.steps_per_second == 200 / 5.0
    assert [step for step, _ in told] == [50_000, 50_100, 50_200]
