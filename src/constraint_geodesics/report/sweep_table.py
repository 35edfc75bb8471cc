"""The ranking of a sweep's configurations, as `geodesics results --experiments` prints it."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import Cells, fixed, markdown_table, share, short
from constraint_geodesics.studies.sweep import STAGE, Configuration
from constraint_geodesics.studies.sweep_ranking import ranking, seed_rows
from constraint_geodesics.text_files import write_text, written

HEADER = (
    *("", "configuration", "seeds", "score", "95 %", "above own", "feasible"),
    *("length p50", "p95", "time [ms]", "steps/s"),
)
NOTE = """\
Score: success weighted by path length on queries drawn for the sweep, interquartile mean over
seeds and constraints, with its 95 % bootstrap interval over the seeds.  Above own: the probability
that a seed of the configuration scores higher than one of params.yaml's own.  Length: of feasible
answers, over the best of the curve family."""


def write_ranking(configurations: Sequence[Configuration], layout: Layout) -> list[dict[str, Any]]:
    """Write `seeds` and `ranking` as CSV and the ranking as Markdown, of all configurations that
    have a finished seed; the first one is params.yaml's own.  Returns the ranking's rows.
    """
    found = {own.name: own.results(layout) for own in configurations}
    rows = seed_rows({name: results for name, results in found.items() if results})
    labels = {own.name: own.label for own in configurations}
    ranked = [
        {**row, "changes": labels[row["configuration"]]}
        for row in ranking(rows, configurations[0].name)
    ]
    for name, table in (("seeds", rows), ("ranking", ranked)):
        with written(layout.report(STAGE, name, "csv")) as part:
            pd.DataFrame(table).to_csv(part, index=False)
    text = f"{ranking_markdown(ranked)}\n\n{NOTE}\n"
    write_text(layout.report(STAGE, "ranking", "md"), text)
    return ranked


def ranking_markdown(ranked: Sequence[Mapping[str, Any]]) -> str:
    """Rows of `ranking` with their `changes` as a table."""
    table: Cells = [HEADER]
    for row in ranked:
        interval = f"{fixed(row['score_low'], 3)} to {fixed(row['score_high'], 3)}"
        score = (str(row["seeds"]), fixed(row["score"], 3), interval)
        figures = (fixed(row["above_reference"]), share(row["feasible"]))
        lengths = (fixed(row["ratio_p50"], 3), fixed(row["ratio_p95"], 3))
        costs = (short(row["time_ms"]), fixed(row["steps_per_second"], 0))
        table.append((str(row["rank"]), row["changes"], *score, *figures, *lengths, *costs))
    return markdown_table(table)
