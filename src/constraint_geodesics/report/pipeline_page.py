"""The report of a run: the result table, the figures, and one page that opens offline
(reports/index.html).
"""

from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report import figures
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.report.page import Picture, write_page
from constraint_geodesics.report.pipeline_figures import Drawn, draw_data_cards, draw_figures
from constraint_geodesics.report.pipeline_tables import (
    ablation_blocks,
    data_card_block,
    metric_blocks,
    published_block,
    result_blocks,
)
from constraint_geodesics.report.results import (
    LEARNED,
    ReportError,
    compare_planners,
    findings,
    geometry_table,
    read_metrics,
    result_table,
)
from constraint_geodesics.report.study_report import (
    execution_block,
    execution_markdown,
    policies_markdown,
    policy_blocks,
)

ABLATION = "ablation"
"""The figure that stands with the ablations' tables, not among the others."""


def write_report(params: Params, layout: Layout) -> list[Path]:
    """Write reports/table.csv, *.md (README's tables), figures/*.png and index.html; returns the
    figures' files.

    Raises ReportError naming the first file that is missing or can't be used.
    """
    try:
        table = compare_planners(params, layout)
        content = page_content(params, layout, table)
        cards, drawn = draw_data_cards(params, layout), draw_figures(params, layout, table)
    except FileNotFoundError as error:
        raise ReportError(f"{error.filename or error}: missing; `dvc repro` makes it") from None
    reports = layout.root / "reports"
    table.to_csv(reports / "table.csv", index=False, float_format="%.6g")
    (reports / "table.md").write_text(result_table(layout))
    (reports / "geometry.md").write_text(geometry_table(layout))
    (reports / "execution.md").write_text(execution_markdown(params, layout))
    (reports / "policies.md").write_text(policies_markdown(params, layout))
    pictures = [save_figure(layout, entry) for entry in drawn]
    described = [save_figure(layout, entry) for entry in cards]
    ablated, others = (
        [p for p in pictures if (p.name == ABLATION) is wanted] for wanted in (True, False)
    )
    write_page(layout, "index", drawn=others, ablated=ablated, cards=described, **content)
    return [picture.file for picture in (*pictures, *described)]


def save_figure(layout: Layout, entry: Drawn) -> Picture:
    """Write a figure where it belongs; returns it as the page shows it."""
    file = layout.root / "reports" / "figures" / f"{entry.name}.png"
    figures.save_png(entry.figure, file)
    return Picture(entry.name, entry.title, entry.caption, entry.alt or entry.title, file)


def page_content(params: Params, layout: Layout, table: pd.DataFrame) -> dict[str, Any]:
    """What the page says beside its figures."""
    metrics = {
        name: read_metrics(layout.report("train_manifold", name)) for name in params.manifolds
    }
    compared = params.geodesics.illustrated_constraints[:1]
    return {
        "params": params,
        "learned": PLANNERS[LEARNED].label,
        "findings": findings(params, table, metrics),
        "published": [
            published_block(params, layout, table, constraint) for constraint in compared
        ],
        "executed": [execution_block(params, layout)],
        "proposals": policy_blocks(params, layout),
        "results": result_blocks(params, layout, table),
        "ablations": ablation_blocks(params, layout),
        "metrics": metric_blocks(params, layout, metrics),
        "data": data_card_block(params, layout),
    }
