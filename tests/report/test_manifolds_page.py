"""The page of learners: cells and sentences from figures that are known."""

import json

import pytest
from tests.report.study_fixtures import ORIGIN, RUN

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.manifolds_page import COLUMNS, SHARES, manifolds_markdown
from constraint_geodesics.report.results import studies_at_hand
from constraint_geodesics.studies.manifolds import LEARNERS


def same(value: float, deviation: float = 0.0) -> dict:
    return {"mean": value, "deviation": deviation}


def report() -> dict:
    """The GPLVM reproduces best, the GAN worst and draws most that is free."""
    errors = {"VAE": 0.02, "GPLVM": 0.01, "GAN": 0.3, "uniform joints": 0.0}
    free = {"VAE": 0.7, "GPLVM": 0.8, "GAN": 0.9, "uniform joints": 0.6}
    figures = [figure for _, figure, _ in COLUMNS] + [figure for _, figure in SHARES]
    learners = {
        name: dict.fromkeys(figures, same(1.5))
        | {"joint_error_mean_rad": same(errors[name], 0.005), "sample_free": same(free[name])}
        for name in LEARNERS
    }
    kept = {
        name: {
            "kept_before": same(0.125),
            "kept_after": same(1.0),
            "usable_after": same(free[name] / 2),
            "projected_us": same(3.25),
        }
        for name in LEARNERS
    }
    return {
        "learners": learners,
        "constraints": {"level": kept, "slide": kept},
        "rows": 43000,
        "held_out": 2000,
        "machine": RUN,
    }


@pytest.fixture
def layout(tmp_path) -> Layout:
    file = tmp_path / "reports" / "compare_manifolds.json"
    file.parent.mkdir()
    file.write_text(json.dumps(report()))
    return Layout(tmp_path)


def test_the_page_says_what_the_figures_say(params, layout) -> None:
    text = manifolds_markdown(params, layout)
    assert ORIGIN in text
    assert "best by the GPLVM, to 0.0100 rad" in text
    assert "worst by the GAN, to 0.3000 rad" in text
    assert "The GAN draws the most samples within the limits and free of collision, 90.0%" in text
    assert "against 60.0% of uniform joints" in text
    assert "45.0% can be used once projected, of uniform joints 12.5% and 30.0%" in text
    assert "1.500 (VAE), 1.500 (GPLVM), 1.500 (GAN) times as long" in text


def test_the_tables_have_a_row_a_learner_and_a_row_a_constraint(params, layout) -> None:
    lines = manifolds_markdown(params, layout).splitlines()
    first = [line.split("|")[1].strip() for line in lines if line.startswith("|")]
    assert [name for name in first if name in LEARNERS] == list(LEARNERS)
    assert [name for name in first if name in ("level", "slide")] == ["level", "slide"]
    assert any("0.0100 ± 0.0050" in line for line in lines)
    assert any("12.5% / 100.0% / 45.0%; 3.2 µs" in line for line in lines)


def test_the_budgets_stand_beside_the_figures(params, layout) -> None:
    text, own = manifolds_markdown(params, layout), params.compare_manifolds
    assert "the same 43,000 configurations" in text
    assert f"{own.gplvm.steps:,} steps of {own.gplvm.batch_size} rows" in text
    assert f"{own.gan.steps:,} steps of its generator" in text


def test_the_report_writes_it_where_the_study_was_run(params, layout, tmp_path) -> None:
    assert "manifolds" in studies_at_hand(params, layout)
    assert "manifolds" not in studies_at_hand(params, Layout(tmp_path / "other"))
