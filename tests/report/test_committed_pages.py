"""Committed pages of studies say what the committed figures say."""

import pytest
from tests.conftest import ROOT

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.arms_page import arms_markdown
from constraint_geodesics.report.charts_page import charts_markdown
from constraint_geodesics.report.demonstrations_page import demonstrations_markdown
from constraint_geodesics.report.manifolds_page import manifolds_markdown

PAGES = {
    "arms": lambda params, layout: arms_markdown(layout),
    "charts": charts_markdown,
    "demonstrations": demonstrations_markdown,
    "manifolds": manifolds_markdown,
}


@pytest.mark.parametrize("name", PAGES)
def test_a_committed_page_is_written_from_the_committed_figures(name, params):
    committed = (ROOT / "reports" / f"{name}.md").read_text()
    assert PAGES[name](params, Layout(ROOT)) == committed, "`dvc repro -sf report`"
