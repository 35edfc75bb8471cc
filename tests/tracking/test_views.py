"""Views of the runs: what is kept of them, and that their searches find runs in a real store.

That the dashboard shows them is in tests/browser/test_mlflow.py.
"""

import json

import pytest
from mlflow.utils.search_utils import SearchUtils

from constraint_geodesics.tracking import views
from constraint_geodesics.tracking.views import COMPARED, VIEWS, View, experiment_tags, outdated

each_view = pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.key)


@each_view
def test_a_view_is_a_saved_view_of_the_dashboard(view: View) -> None:
    kept = json.loads(experiment_tags()[view.tag])
    assert set(kept) == {"name", "createdAt", "updatedAt", "state"}
    assert kept["name"] == view.name
    state = json.loads(kept["state"])
    assert state["selectedColumns"] == view.columns
    assert set(view.columns) <= set(state["columnOrder"]) >= {"attributes.`Run Name`", "duration"}


@each_view
def test_a_view_s_search_is_one_that_mlflow_understands(view: View) -> None:
    assert SearchUtils.parse_search_filter(view.search)


def test_the_menu_has_the_views_in_their_order_and_the_first_has_what_matters() -> None:
    made = [json.loads(experiment_tags()[view.tag])["createdAt"] for view in VIEWS]
    assert made == sorted(made, reverse=True), "the menu begins with the youngest"
    told = ["constraint", "scene", "planner", "seed", *COMPARED]
    assert [*VIEWS[0].tags, *VIEWS[0].metrics] == told
    assert len({view.key for view in VIEWS} | {view.name for view in VIEWS}) == 2 * len(VIEWS)


def test_no_view_has_figures_of_the_machine() -> None:
    assert "system/" not in json.dumps(experiment_tags())


def test_a_tag_is_no_longer_than_any_store_takes() -> None:
    assert max(map(len, experiment_tags().values())) <= 5000


def test_the_description_names_every_view() -> None:
    note = experiment_tags()[views.NOTE]
    assert all(f"**{view.name}**" in note for view in VIEWS)


def test_tags_are_written_again_only_when_the_views_are_others() -> None:
    tags = experiment_tags()
    assert outdated({}) == tags
    assert list(tags)[-1] == views.MADE, "what says that they are all there comes last"
    changed = tags | {VIEWS[0].tag: "somebody's own"}
    assert outdated(changed) == {}
    assert outdated(tags | {views.MADE: "older"}) == tags
