"""The report of a run: the result table, the figures, and one page that opens offline
(reports/index.html).
"""

from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.learning.dataset import DatasetError
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.report import pipeline_tables, study_report
from constraint_geodesics.report.arms_page import arm_tables, arms_markdown
from constraint_geodesics.report.charts_page import charts_markdown
from constraint_geodesics.report.demonstrations_page import demonstrations_markdown
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.report.front import learning, opening, planner_row
from constraint_geodesics.report.manifolds_page import manifolds_markdown
from constraint_geodesics.report.page import Picture, write_page
from constraint_geodesics.report.pipeline_figures import Drawn, draw_data_cards, draw_figures
from constraint_geodesics.report.results import (
    LEARNED,
    ReportError,
    compare_planners,
    findings,
    geometry_table,
    metrics_of,
    result_table,
    studies_at_hand,
)
from constraint_geodesics.text_files import write_text, written

HEADS = {
    "table": (
        "Planners on the pipeline's queries",
        "Rows of the pipeline's planners and of the policies it trains, a block for each manifold.",
    ),
    "geometry": (
        "Curve lengths and solvers",
        "How fast lengths are measured, and how far solvers end above exact distances. One "
        "thread; the usual way is the full Jacobian at 101 points, a curve at a time, and one "
        "scalar environment a copy.",
    ),
    "execution": (
        "Paths executed in simulation",
        "What following a path does to what a cup holds, and to the arm.",
    ),
    "policies": (
        "What policies propose",
        "Policies beside the same search without one, path diffusion and random curves.",
    ),
}
"""Title and first sentence of reports that pages of docs/ quote from the next paragraph on."""
ABLATION = "ablation"
"""The figure that stands with the ablations' tables, not among the others."""


def write_report(params: Params, layout: Layout) -> list[Path]:
    """Write reports/table.csv, *.md that docs quote, figures/*.png and index.html; returns the
    figures' files.

    Raises ReportError naming the first file that is missing or can't be used.
    """
    try:
        table = compare_planners(params, layout)
        content = page_content(params, layout, table)
        cards, drawn = draw_data_cards(params, layout), draw_figures(params, layout, table)
    except FileNotFoundError as error:
        raise ReportError(f"{error.filename or error}: missing; `dvc repro` makes it") from None
    except DatasetError as error:
        raise ReportError(f"{error}; `dvc repro` makes it") from None
    reports = layout.root / "reports"
    with written(reports / "table.csv") as part:
        table.to_csv(part, index=False, float_format="%.6g")
    studies = studies_at_hand(params, layout)
    told = {
        "table": result_table(layout),
        "execution": study_report.execution_markdown(params, layout),
    }
    if "geometry" in studies:
        told["geometry"] = geometry_table(layout)
    if "policies" in studies:
        told["policies"] = study_report.policies_markdown(params, layout)
    for name, text in told.items():
        title, about = HEADS[name]
        write_text(reports / f"{name}.md", f"# {title}\n\n{about}\n\n{text}")
    if "arms" in studies:
        write_text(reports / "arms.md", arms_markdown(layout))
    if "manifolds" in studies:
        write_text(reports / "manifolds.md", manifolds_markdown(params, layout))
    if "charts" in studies:
        write_text(reports / "charts.md", charts_markdown(params, layout))
    if "demonstrations" in studies:
        write_text(reports / "demonstrations.md", demonstrations_markdown(params, layout))
    pictures, described = ([save_figure(layout, one) for one in own] for own in (drawn, cards))
    ablated = [picture for picture in pictures if picture.name == ABLATION]
    others = [picture for picture in pictures if picture.name != ABLATION]
    write_page(layout, "index", drawn=others, ablated=ablated, cards=described, **content)
    return [picture.file for picture in (*pictures, *described)]


def save_figure(layout: Layout, entry: Drawn) -> Picture:
    """Write a figure where it belongs; returns it as the page shows it."""
    file = layout.root / "reports" / "figures" / f"{entry.name}.png"
    save_png(entry.figure, file)
    return Picture(entry.name, entry.title, entry.caption, entry.alt or entry.title, file)


def page_content(params: Params, layout: Layout, table: pd.DataFrame) -> dict[str, Any]:
    """What the page says besides its figures."""
    metrics = metrics_of(layout, "train_manifold", params.manifolds)
    compared = params.geodesics.illustrated_constraints[:1]
    studies = studies_at_hand(params, layout)
    return {
        "params": params,
        "opening": opening(layout, "benchmark" in studies),
        "ahead": [planner_row(layout)] if "benchmark" in studies else [],
        "learning": learning(params, layout) if "policies" in studies else None,
        "learned": PLANNERS[LEARNED].label,
        "findings": findings(params, table, metrics),
        "published": [
            pipeline_tables.published_table(params, layout, table, name) for name in compared
        ],
        "executed": [study_report.execution_block(params, layout)],
        "proposals": study_report.policy_blocks(params, layout) if "policies" in studies else [],
        "learning_adds": (
            study_report.what_learning_adds(params, layout) if "policies" in studies else {}
        ),
        "arms": arm_tables(layout) if "arms" in studies else [],
        "results": pipeline_tables.result_tables(params, layout, table),
        "ablations": (
            pipeline_tables.ablation_tables(params, layout) if "ablations" in studies else []
        ),
        "metrics": pipeline_tables.metric_tables(params, layout, metrics),
        "data": pipeline_tables.data_card_table(params, layout),
    }
