"""The tables of a run's report as texts: results beside the paper's, the stages' metrics,
ablations, the data card.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.blocks import Block, Look, Recorded, runs_link
from constraint_geodesics.report.figures import PLANNERS, VARIANTS
from constraint_geodesics.report.results import (
    COLUMNS,
    COUNTED,
    LEARNED,
    fixed,
    plus_minus,
    read_comparison,
    read_metrics,
    records,
    searched_items,
    short,
    table_cells,
)

PUBLISHED = {
    "prm": (499.42, 530.89, 24.43, 9.75, 1.53),
    "rrt_star": (134.80, 155.28, 17.84, 5.21, 1.38),
    "birrt": (53.00, 84.65, 25.52, 2.903, 0.16),
    "learned_geodesic": (70.56, 79.81, 7.64, 3.8, 1.81),
}
"""Table I of the paper: shortest path, average, its ±, planning time [s], its ±."""


def published_block(params: Params, layout: Layout, table: pd.DataFrame, constraint: str) -> Block:
    """Table I of the paper beside its counterparts of this run; `×` is the average over the learned
    geodesic's.
    """
    manifolds = [m for m, c in searched_items(params) if c == constraint]
    manifolds.sort(key=lambda name: params.manifolds[name].latent_dim)
    header = ["method", "shortest", "average ± std", "×", "time [s]"]
    groups = [("Table I of the paper", 4)]
    sources = []
    for name in manifolds:
        header += ["shortest", "average ± std", "×", "time [s]", "valid"]
        groups.append((f"this run: {name}, N = {params.manifolds[name].latent_dim}", 5))
        rows = table[(table["manifold"] == name) & (table["constraint"] == constraint)]
        sources.append({row["planner"]: row for row in records(rows)})
    shown = [planner for planner in PLANNERS if any(planner in source for source in sources)]
    cells = [
        [PLANNERS[planner].label, *_published_cells(planner)]
        + [cell for source in sources for cell in _measured_cells(source, planner)]
        for planner in shown
    ]
    note = (
        f"{params.constraints[constraint].description}. Lengths are measured on the manifold "
        f"of their column (the "
        "paper's has no unit, here rad): compare within a column, or the ratios × to the "
        "learned geodesic's average."
    )
    looks = _looks(params, layout, manifolds[-1], constraint, shown)
    return Block(
        constraint,
        note,
        header,
        cells,
        groups,
        [PLANNERS[planner].label for planner in shown],
        looks,
    )


def _published_cells(planner: str) -> list[str]:
    if planner not in PUBLISHED:
        return ["–"] * 4
    shortest, average, spread, time, time_spread = PUBLISHED[planner]
    ratio = average / PUBLISHED[LEARNED][1]
    return [
        fixed(shortest),
        plus_minus(average, spread, fixed),
        fixed(ratio),
        plus_minus(time, time_spread, fixed),
    ]


def _measured_cells(source: Mapping[str, Mapping[str, Any]], planner: str) -> list[str]:
    if planner not in source:
        return ["–"] * 5
    row = source[planner]
    learned = source[LEARNED]["latent_mean"]
    return [
        fixed(row["latent_shortest"]),
        plus_minus(row["latent_mean"], row["latent_std"], fixed),
        fixed(row["latent_mean"] / learned),
        plus_minus(row["time_mean_s"], row["time_std_s"], short),
        f"{row['success']:.0%}",
    ]


def result_blocks(params: Params, layout: Layout, table: pd.DataFrame) -> list[Block]:
    """The whole result table, one block a manifold and constraint."""
    blocks = []
    for (manifold, constraint), rows in table.groupby(["manifold", "constraint"], sort=False):
        positions = any(params.constraints[str(constraint)].axes[:3])
        header = [*COLUMNS[1:], *(["worst [mm]"] if positions else []), "not connected", "refused"]
        cells = [
            [
                *table_cells(row),
                *([short(row["violation_max_mm"])] if positions else []),
                f"{row['not_connected']:.0%}",
                f"{row['refused']:.0%}",
            ]
            for row in records(rows)
        ]
        description = params.constraints[str(constraint)].description
        note = f"{description}; lengths are those of {COUNTED[rows['counted'].iloc[0]]}"
        looks = _looks(params, layout, str(manifold), str(constraint), rows["planner"])
        labels = [PLANNERS[name].label for name in rows["planner"]]
        blocks.append(
            Block(f"{manifold}, {constraint}", note, header, cells, planners=labels, looks=looks)
        )
    return blocks


def _looks(
    params: Params, layout: Layout, manifold: str, constraint: str, planners: Iterable[str]
) -> list[Look]:
    """Recordings and runs of these planners under one constraint; those that were searched, on one
    manifold.
    """
    recorded = recorded_paths(params, layout, manifold, constraint)
    sampled, searched = (
        runs_link(stage, item)
        for stage, item in (
            ("benchmark_planners", constraint),
            ("train_geodesics", f"{manifold}-{constraint}"),
        )
    )
    return [
        Look(
            sampled if planner in params.benchmark.compared_kinds else searched,
            recorded.get(planner, ()),
        )
        for planner in planners
    ]


def recorded_paths(
    params: Params, layout: Layout, manifold: str, constraint: str
) -> dict[str, list[Recorded]]:
    """The recorded paths of every planner under one constraint."""
    rows, found = read_comparison(params, layout, manifold, constraint), dict[str, list[Recorded]]()
    for row in records(rows[rows["recording"] != ""]):
        found.setdefault(row["planner"], []).append(
            Recorded(in_checkout(row["recording"]), _told(row))
        )
    return found


def _told(row: Mapping[str, Any]) -> str:
    verdict = "valid" if row["valid"] else f"not valid: {row['reason']}"
    lengths = (
        f"{fixed(row['length_rad'])} rad, violation {short(np.degrees(row['max_violation_rad']))}°"
    )
    return f"query {row['query']}, seed {row['seed']}: {verdict}, {lengths}"


def metric_blocks(
    params: Params, layout: Layout, manifolds: Mapping[str, Mapping[str, Any]]
) -> list[Block]:
    """The other stages' metrics, one row an item."""
    extracted = [(m, c) for m in params.manifolds for c in params.constraints]
    named: tuple[tuple[str, str, Mapping[str, Mapping[str, Any]]], ...] = (
        ("train_manifold", "Learned manifolds, on held-out configurations", manifolds),
        (
            "extract_submanifold",
            "Sub-manifolds",
            _metrics_of(layout, "extract_submanifold", extracted),
        ),
        (
            "train_geodesics",
            "Policy search",
            _metrics_of(layout, "train_geodesics", searched_items(params)),
        ),
        (
            "train_analytic",
            "Policy search where the answer is known (length over exact distance, a seed each)",
            {
                str(name): read_metrics(layout.report("train_analytic", name))
                for name in params.geodesics.analytic
            },
        ),
    )
    blocks = [
        _metric_block(
            title,
            f"reports/{stage}/",
            items,
            [runs_link(stage, name.replace(", ", "-")) for name in items],
        )
        for stage, title, items in named
        if items
    ]
    return [*blocks, *_geometry_blocks(layout)]


def _geometry_blocks(layout: Layout) -> list[Block]:
    """Rates of the geometry core, and the solvers of each manifold, from reports/geometry.json."""
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    lengths = {name: geometry[name] for name in ("curve_length", "curve_length_retracted")}
    rates = {
        name.replace("_", " "): {
            key: value for key, value in found.items() if not isinstance(value, dict)
        }
        for name, found in lengths.items()
    }
    steps = {
        name.replace("_", " "): geometry[name] for name in ("environment", "environment_retracted")
    }
    solvers = {
        f"{manifold}, {solver}": found
        for manifold, by_solver in geometry["solvers"].items()
        for solver, found in by_solver.items()
    }
    named = {
        f"Curve lengths a second, one thread of {geometry['machine']['processor']}": rates,
        "Environment steps a second, PPO included": steps,
        "Solvers: length over the exact distance (learned: over the shortest found)": solvers,
    }
    link = runs_link("benchmark_geometry", geometry["manifold"])
    return [
        _metric_block(title, "reports/geometry.json", items, [link] * len(items))
        for title, items in named.items()
    ]


def _metrics_of(
    layout: Layout, stage: str, items: Iterable[tuple[str, str]]
) -> dict[str, dict[str, Any]]:
    return {f"{m}, {c}": read_metrics(layout.report(stage, f"{m}-{c}")) for m, c in items}


def _metric_block(
    title: str, source: str, items: Mapping[str, Mapping[str, Any]], runs: Sequence[str]
) -> Block:
    keys = list(dict.fromkeys(key for metrics in items.values() for key in metrics))
    rows = [[name, *(_metric(metrics.get(key)) for key in keys)] for name, metrics in items.items()]
    header = ["of", *(key.replace("_", " ") for key in keys)]
    return Block(title, f"from {source}", header, rows, looks=[Look(link) for link in runs])


def _metric(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_metric, value))
    if value is None or isinstance(value, str):
        return value or "–"
    return f"{value:,.0f}" if float(value).is_integer() or abs(value) >= 1e4 else f"{value:.4g}"


FAMILIES_OF_CURVES = {"polynomial": "cubic", "spline_2": "2 segments", "spline_4": "4 segments"}
WITH_VARIANCE = {
    "with_variance": "with the variance term",
    "without_variance": "without it",
    "straight_latent_line": "straight latent line",
}


def ablation_blocks(params: Params, layout: Layout) -> list[Block]:
    """What each choice is worth: the reward, the family of curves, and the variance term of eq.
    5.
    """
    learned = {
        name: read_metrics(layout.report("ablate_manifold", name)) for name in params.manifolds
    }
    blocks = [_searched_block(params, layout)] if params.geodesics.analytic else []
    return [*blocks, _variance_block(learned), _families_block(learned)]


def _searched_block(params: Params, layout: Layout) -> Block:
    header = (
        "manifold, variant",
        "excess over the exact distance [%], mean",
        "best seed",
        "worst seed",
        "seeds",
        "best curve of the family [%]",
    )
    rows, looks = [], []
    for name in map(str, params.geodesics.analytic):
        ablated = read_metrics(layout.report("ablate_analytic", name))
        own = read_metrics(layout.report("train_analytic", name))["mean_ratio"]
        searched = {
            variant: found["mean_ratio"] for variant, found in ablated["policy_search"].items()
        }
        for variant, ratios in {"corrected_reward": own, **searched}.items():
            reached = ablated["gradient"].get(
                variant if variant.startswith("spline") else "polynomial", {}
            )
            told = VARIANTS.get(variant, (variant.replace("_", " "), ""))[0]
            rows.append([f"{name}, {told}", *_excess(ratios), _percent(reached.get("mean_ratio"))])
            looks.append(
                Look(runs_link("train_analytic" if ratios is own else "ablate_analytic", name))
            )
    note = (
        "over unseen pairs, a policy a seed; the last column is what the gradient finds in "
        "the same family of curves, "
        "so what no search can pass. From reports/train_analytic/ and reports/ablate_analytic/"
    )
    return Block(
        "Reward and family of curves, where the answer is known", note, header, rows, looks=looks
    )


def _excess(ratios: Sequence[float]) -> list[str]:
    return [*(_percent(of(ratios)) for of in (np.mean, min, max)), str(len(ratios))]


def _percent(ratio: Any) -> str:
    """By how many per cent a ratio is above 1."""
    return "–" if ratio is None else f"{100 * (float(ratio) - 1):.3f}"


def _variance_block(learned: Mapping[str, Mapping[str, Any]]) -> Block:
    columns = {
        "pairs": "pairs",
        "collision_free": "geodesics free of collision",
        "collision_free_points": "points free of it",
        "length_rad": "joint length [rad]",
        "deviation_rad": "σ on the way [rad]",
    }
    rows = [
        [f"{manifold}, {told}", *(_metric(found[variant].get(key)) for key in columns)]
        for manifold, found in learned.items()
        for variant, told in WITH_VARIANCE.items()
    ]
    note = (
        "between configurations whose straight latent line collides; a dash where no such "
        "line was drawn. From "
        "reports/ablate_manifold/"
    )
    return Block(
        "The variance term of eq. 5",
        note,
        ["manifold, metric", *columns.values()],
        rows,
        looks=_ablated(rows),
    )


def _families_block(learned: Mapping[str, Mapping[str, Any]]) -> Block:
    families = [
        name for name in FAMILIES_OF_CURVES if any(name in found for found in learned.values())
    ]
    rows = [
        [manifold, *(_metric(found.get(name, {}).get("mean_ratio_to_best")) for name in families)]
        for manifold, found in learned.items()
    ]
    header = ["manifold", *(FAMILIES_OF_CURVES[name] for name in families)]
    note = (
        "length over the shortest that any family has of the same pair, mean. From "
        "reports/ablate_manifold/"
    )
    return Block(
        "Families of curves on the learned manifolds", note, header, rows, looks=_ablated(rows)
    )


def _ablated(rows: Sequence[Sequence[str]]) -> list[Look]:
    return [Look(runs_link("ablate_manifold", row[0].partition(",")[0])) for row in rows]


def data_card_block(params: Params, layout: Layout) -> Block:
    """How each constraint's set was drawn, and what its rows touch."""
    header = (
        "constraint",
        "rows",
        "drawn",
        "not converged",
        "outside the limits",
        "touch the arm",
        "touch the workcell",
        "touch nothing",
    )
    shares = (
        "rejected_not_converged",
        "rejected_outside_limits",
        "self_collision",
        "workcell_collision",
        "free",
    )
    cards = {name: read_metrics(layout.report("label_joints", name)) for name in params.constraints}
    rows = [
        [
            name,
            f"{card['rows']:,}",
            f"{card['drawn']:,}",
            *(f"{card[share]:.1%}" for share in shares),
        ]
        for name, card in cards.items()
    ]
    note = "rejected: shares of the drawn; touching: shares of the rows. From reports/label_joints/"
    looks = [Look(runs_link("label_joints", name)) for name in cards]
    return Block("Sets of configurations", note, header, rows, looks=looks)
