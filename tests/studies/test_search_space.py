"""Grids and random searches over entries of params.yaml."""

from pathlib import Path

import pytest

from constraint_geodesics.errors import ParamsError
from constraint_geodesics.params import load_params
from constraint_geodesics.studies.search_space import SearchSpace, label_of, read_space

ROOT = Path(__file__).resolve().parents[2]
OWN = ROOT / "stages" / "sweep" / "space.yaml"
TOGETHER = "policies.reward.length_weight, policies.reward.reduction_weight"


def written(folder: Path, text: str) -> Path:
    file = folder / "space.yaml"
    file.write_text(text)
    return file


def test_a_grid_is_every_combination(tmp_path) -> None:
    space = read_space(
        written(
            tmp_path,
            f"search: grid\nspace:\n  policies.reward.b: [1.0, 3.0]\n  geodesics.degree: [2, 3]\n"
            f"  {TOGETHER}: [[0.5, 0.5], [0.8, 0.2]]\n",
        )
    )
    found = space.changes()
    assert len(found) == 8
    assert len({label_of(changes) for changes in found}) == 8
    assert found[0] == {
        "policies.reward.b": 1.0,
        "geodesics.degree": 2,
        "policies.reward.length_weight": 0.5,
        "policies.reward.reduction_weight": 0.5,
    }
    assert label_of(found[-1]) == "b=3 degree=3 K_L=0.8 K_Δ=0.2"
    assert label_of({}) == "as in params.yaml"


def test_a_random_search_stays_in_its_ranges_and_hangs_on_its_seed() -> None:
    text = {
        "search": "random",
        "configurations": 200,
        "space": {
            "policies.reward.b": {"low": 0.01, "high": 100.0, "scale": "log"},
            "policies.reward.c": {"low": 5.0, "high": 10.0},
        },
    }
    found = SearchSpace(**text).changes()
    assert len(found) == 200
    b = [changes["policies.reward.b"] for changes in found]
    c = [changes["policies.reward.c"] for changes in found]
    assert all(0.01 <= value <= 100 for value in b)
    assert all(5 <= value <= 10 for value in c)
    assert 60 < sum(value < 1 for value in b) < 140, "half of a log range is below its middle"
    assert all(len(f"{value:.6g}".replace(".", "").lstrip("0")) <= 3 for value in b if value < 100)
    assert SearchSpace(**text).changes() == found
    assert SearchSpace(**text, seed=1).changes() != found


def test_a_small_space_is_exhausted_not_drawn_for_ever() -> None:
    space = {"policies.episode_steps": [4, 8], "geodesics.degree": [2, 3]}
    found = SearchSpace(search="random", configurations=24, space=space).changes()
    assert len(found) == 4
    assert len({label_of(changes) for changes in found}) == 4


def test_every_configuration_of_the_project_s_space_can_be_trained() -> None:
    space = read_space(OWN)
    found = space.changes()
    assert len(found) == space.configurations == 24
    for changes in found[::4]:
        params = load_params(ROOT / "params.yaml", changes)
        assert params.policies.reward.b == changes["policies.reward.b"]
        assert params.sweep.steps == changes["sweep.steps"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("search: grid\nspace: {}", "space="),
        ("search: best\nspace: {policies.steps: [1]}", "search='best'"),
        ("search: grid\nspace: {labels.seed: [1]}", r"space.labels.seed: must begin with"),
        ("search: grid\nspace: {geodesics.ppo.gamma: [0.3]}", r"gamma: must begin with"),
        ("search: grid\nspace: {policies.steps: [9]}", r"policies.steps: a sweep has its own"),
        ("search: grid\nspace: {policies.steps: {low: 1, high: 2}}", "a grid needs a list"),
        ("search: grid\nspace: {policies.steps: []}", "policies.steps"),
        (f"search: grid\nspace: {{'{TOGETHER}': [[0.5]]}}", r"needs 2 values"),
        (
            "search: random\nspace: {policies.reward.b: {low: 2, high: 1}}",
            r"high=1.0: must be above low, 2.0",
        ),
        (
            "search: random\nspace: {policies.reward.b: {low: 0, high: 1, scale: log}}",
            r"low=0.0: must be above 0 where the scale is log",
        ),
        ("search: [", "not YAML"),
    ],
)
def test_a_bad_space_is_one_line_with_the_entry(tmp_path, text, said) -> None:
    with pytest.raises(ParamsError, match=said) as error:
        read_space(written(tmp_path, text))
    assert str(error.value).startswith(f"{tmp_path / 'space.yaml'}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"policies.reward.q": 1}, "policies.reward.q=1: there is no such parameter"),
        ({"policies.steps.more": 1}, "policies.steps.more=1: there is no such parameter"),
        ({"policies.reward.b": -1}, "policies.reward.b=-1: "),
        ({"geodesics.degree": 3.5}, "geodesics.degree=3.5: "),
        ({"policies.reward.length_weight": 0.9}, "must lie in"),
    ],
)
def test_a_value_that_params_cannot_have_is_one_line(changes, said) -> None:
    with pytest.raises(ParamsError) as error:
        load_params(ROOT / "params.yaml", changes)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_no_space_is_an_error_that_names_the_file(tmp_path) -> None:
    with pytest.raises(ParamsError, match=r"nowhere.yaml: No such file"):
        read_space(tmp_path / "nowhere.yaml")
