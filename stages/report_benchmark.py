"""Stage: the benchmark's summary, tables, figures and the database for Planner Arena."""

import json
import sys
from collections.abc import Mapping

import pandas as pd

from constraint_geodesics.benchmark.planner_arena import export_arena
from constraint_geodesics.benchmark.runner import KEEP_OUT, TABLE, read_table
from constraint_geodesics.benchmark.statistics import (
    all_constraints,
    benchmark_summary,
    break_even_table,
    ours_against_peers,
)
from constraint_geodesics.params import Params, PeerParams
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report import benchmark_figures
from constraint_geodesics.report.benchmark_tables import (
    ahead_markdown,
    asks_in_python,
    benchmark_markdown,
    break_even_markdown,
    overview_markdown,
    table_i_markdown,
)
from constraint_geodesics.report.figures import save_png

BUDGETS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 20.0)
"""Time budgets at which the planner is held against its peers [s]."""
SERVES = 0.5
"""Valid rows of all that a planner must have to be drawn among those that serve queries."""


def main(params: Params, layout: Layout) -> None:
    """Write reports/benchmark/ and data/benchmark.db."""
    folder, planners = layout.root / "reports" / "benchmark", params.bench.planners
    rows, about = read_table(layout.benchmark_table)
    orders = {
        "planner": list(planners),
        "constraint": list(params.constraints),
        "scene": [TABLE, KEEP_OUT],
    }
    rows = rows.sort_values(
        list(orders),
        key=lambda names: names.map({name: k for k, name in enumerate(orders[str(names.name)])}),
        kind="stable",
    )
    reference = next(iter(planners))
    folder.mkdir(parents=True, exist_ok=True)

    summary = benchmark_summary(rows, reference)
    summary.to_csv(folder / "summary.csv", index=False, float_format="%.6g")
    (folder / "summary.md").write_text(benchmark_markdown(summary))
    overview = benchmark_summary(all_constraints(rows), reference)
    overview.to_csv(folder / "overview.csv", index=False, float_format="%.6g")
    in_python = asks_in_python(planners)
    (folder / "overview.md").write_text(overview_markdown(overview, in_python))

    shown = overview[overview["planner"].isin(params.bench.drawn)]
    (folder / "drawn.md").write_text(overview_markdown(shown, in_python))

    illustrated = params.geodesics.illustrated_constraints[0]
    case = rows[(rows["constraint"] == illustrated) & (rows["scene"] == TABLE)]
    (folder / "table_i.md").write_text(table_i_markdown(case))
    ours, own = own_names(planners)
    ahead = ours_against_peers(rows, ours, own, BUDGETS)
    ahead.to_csv(folder / "budgets.csv", index=False, float_format="%.6g")
    (folder / "budgets.md").write_text(ahead_markdown(ahead))
    costs = break_even_table(rows, training_times(params, layout), reference)
    costs.to_csv(folder / "break_even.csv", index=False, float_format="%.6g")
    (folder / "break_even.md").write_text(break_even_markdown(costs))

    drawn = [name for name in params.bench.drawn if name in planners]
    pooled = all_constraints(rows)
    for name, figure in (
        ("success_over_budget", benchmark_figures.success_over_budget(rows, drawn)),
        ("length_over_budget", benchmark_figures.length_over_budget(rows, drawn)),
        ("ratio_distributions", benchmark_figures.ratio_distributions(rows, drawn)),
        ("overview", benchmark_figures.overview(pooled, drawn)),
        ("break_even", benchmark_figures.break_even(costs[costs["success"] >= SERVES], drawn)),
    ):
        save_png(figure, folder / f"{name}.png")
    settings = {name: json.dumps(entry.model_dump()) for name, entry in planners.items()}
    export_arena(rows, layout.root / "data" / "benchmark.db", about, settings)
    (folder / "about.json").write_text(json.dumps(about, indent=2) + "\n")


def own_names(planners: Mapping[str, PeerParams]) -> tuple[dict[str, float], list[str]]:
    """The planner's names with the budget [s] of each, 0 for the first answer; and those of it
    without some part, but for those that nothing learned is left of: they are peers.
    """
    own = {
        name: dict(entry.settings) for name, entry in planners.items() if entry.kind == "planner"
    }
    ours = {
        name: float(given.get("budget_s", 0.0))
        for name, given in own.items()
        if not set(given) - {"budget_s"}
    }
    learned = [name for name in own if not _learns_nothing(planners[name])]
    return ours, [name for name in learned if name not in ours]


def training_times(params: Params, layout: Layout) -> dict[str, float]:
    """Seconds that stages took to make what each planner needs, from data to files; 0 for those
    that learn nothing.
    """
    frame = pd.read_csv(layout.stage_times)
    seconds = dict(zip(frame["stage"], frame["seconds"], strict=True))
    searched = params.geodesics.searched[0]

    def total(*stages: str) -> float:
        return sum(
            value
            for name, value in seconds.items()
            if any(name.startswith(stage) for stage in stages)
        )

    manifold = total("label_joints free", f"train_manifold {searched}")
    graph = (
        manifold
        + total("label_joints", f"extract_submanifold {searched}")
        - total("label_joints free")
    )
    whole = graph + total(f"train_policies {searched}", "build_planner")
    paper = total("label_joints", "train_manifold paper", "extract_submanifold paper")
    needs = {
        "planner": whole,
        "gradient_geodesic": manifold,
        "straight_latent": manifold,
        "decoder_sampling": manifold,
        "latent_graph": graph,
        "latent_grid": paper,
        "many_bands": graph,
    }
    nothing = {name for name, entry in params.bench.planners.items() if _learns_nothing(entry)}
    return {
        name: 0.0 if name in nothing else needs.get(entry.kind, 0.0)
        for name, entry in params.bench.planners.items()
    }


def _learns_nothing(entry: PeerParams) -> bool:
    """Whether it is the planner with neither graph nor policies."""
    parts = entry.settings
    return (
        entry.kind == "planner" and not parts.get("graph", True) and not parts.get("policy", True)
    )


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
