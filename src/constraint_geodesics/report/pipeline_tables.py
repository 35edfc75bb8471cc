"""The tables of a run's page: results and the paper's, metrics, ablations, the data card."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.cells import PUBLISHED, fixed, plus_minus, records, short
from constraint_geodesics.report.figures import PLANNERS, VARIANTS
from constraint_geodesics.report.page import Links, Recorded, Table, runs_link
from constraint_geodesics.report.results import (
    COLUMNS,
    COUNTED,
    LEARNED,
    metrics_of,
    read_comparison,
    read_metrics,
    studies_at_hand,
    table_cells,
)

PUBLISHED_AS = {"prm": "PRM", "rrt_star": "RRT* 10 s", "birrt": "BiRRT", LEARNED: "learned"}
"""Where the paper's Table I has the planners of this run."""


def published_table(params: Params, layout: Layout, table: pd.DataFrame, constraint: str) -> Table:
    """Table I of the paper and this run's; `×` is the average over the learned geodesic's."""
    manifolds = [m for m, c in params.searched_items if c == constraint]
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
        f"{params.constraints[constraint].description}. Lengths are measured on the manifold of "
        "their column (the paper's has no unit, here rad): compare within a column, or the ratios "
        "× to the learned geodesic's average."
    )
    links = _links(params, layout, manifolds[-1], constraint, shown)
    labels = [PLANNERS[planner].label for planner in shown]
    return Table(constraint, note, header, cells, groups, labels, links)


def _published_cells(planner: str) -> list[str]:
    if planner not in PUBLISHED_AS:
        return ["–"] * 4
    shortest, average, spread, time, time_spread = PUBLISHED[PUBLISHED_AS[planner]]
    ratio, times = average / PUBLISHED["learned"][1], plus_minus(time, time_spread, fixed)
    return [fixed(shortest), plus_minus(average, spread, fixed), fixed(ratio), times]


def _measured_cells(source: Mapping[str, Mapping[str, Any]], planner: str) -> list[str]:
    if planner not in source:
        return ["–"] * 5
    _, valid, _, shortest, average, _, times, *_ = table_cells(source[planner])
    ratio = source[planner]["latent_mean"] / source[LEARNED]["latent_mean"]
    return [shortest, average, fixed(ratio), times, valid]


def result_tables(params: Params, layout: Layout, table: pd.DataFrame) -> list[Table]:
    """The whole result table, one table a manifold and constraint."""
    tables = []
    for (manifold, constraint), rows in table.groupby(["manifold", "constraint"], sort=False):
        own = params.constraints[str(constraint)]
        # positions only where the constraint holds one
        more = {"worst [mm]": "violation_max_mm"} if own.may_hold_positions else {}
        shares = {"not connected": "not_connected", "refused": "refused"}
        header = [*COLUMNS[1:], *more, *shares]
        cells = []
        for row in records(rows):
            refused = (f"{row[key]:.0%}" for key in shares.values())
            cells.append([*table_cells(row), *(short(row[key]) for key in more.values()), *refused])
        note = f"{own.description}; lengths are those of {COUNTED[rows['counted'].iloc[0]]}"
        links = _links(params, layout, str(manifold), str(constraint), list(rows["planner"]))
        labels = [PLANNERS[name].label for name in rows["planner"]]
        title = f"{manifold}, {constraint}"
        tables.append(Table(title, note, header, cells, planners=labels, links=links))
    return tables


def _links(
    params: Params, layout: Layout, manifold: str, constraint: str, planners: Sequence[str]
) -> list[Links]:
    """Recordings and runs of these planners under one constraint; those that were searched, on one
    manifold.
    """
    recorded = recorded_paths(params, layout, manifold, constraint)
    sampled = runs_link("benchmark_planners", constraint)
    searched = runs_link("train_geodesics", f"{manifold}-{constraint}")
    runs: dict[str, str] = dict.fromkeys(params.benchmark.compared_kinds, sampled)
    return [Links(runs.get(name, searched), recorded.get(name, ())) for name in planners]


def recorded_paths(
    params: Params, layout: Layout, manifold: str, constraint: str
) -> dict[str, list[Recorded]]:
    """The recorded paths of every planner under one constraint."""
    rows, found = read_comparison(params, layout, manifold, constraint), dict[str, list[Recorded]]()
    for row in records(rows[rows["recording"] != ""]):
        verdict = "valid" if row["valid"] else f"not valid: {row['reason']}"
        off = short(np.degrees(row["max_violation_rad"]))
        text = f"query {row['query']}, seed {row['seed']}: {verdict}, "
        text += f"{fixed(row['length_rad'])} rad, violation {off}°"
        path = Recorded(in_checkout(row["recording"]), text)
        found.setdefault(row["planner"], []).append(path)
    return found


def metric_tables(
    params: Params, layout: Layout, manifolds: Mapping[str, Mapping[str, Any]]
) -> list[Table]:
    """The other stages' metrics, one row an item."""
    extracted = product(params.manifolds, params.constraints)
    analytic = metrics_of(layout, "train_analytic", params.geodesics.analytic)
    known = "Policy search where the answer is known (length over exact distance, a seed each)"
    named: tuple[tuple[str, str, Mapping[str, Mapping[str, Any]]], ...] = (
        ("train_manifold", "Learned manifolds, on held-out configurations", manifolds),
        _metrics_of(layout, "extract_submanifold", "Sub-manifolds", extracted),
        _metrics_of(layout, "train_geodesics", "Policy search", params.searched_items),
        ("train_analytic", known, analytic),
    )
    tables = []
    for stage, title, items in named:
        runs = [runs_link(stage, name.replace(", ", "-")) for name in items]
        tables += [_metric_table(title, f"reports/{stage}/", items, runs)] if items else []
    measured = "geometry" in studies_at_hand(params, layout)
    return [*tables, *(_geometry_tables(layout) if measured else [])]


def _geometry_tables(layout: Layout) -> list[Table]:
    """Rates of the geometry core, and the solvers of each manifold, from reports/geometry.json."""
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    link = runs_link("benchmark_geometry", geometry["manifold"])

    def rates(kind: str) -> dict[str, dict[str, Any]]:
        names = (kind, f"{kind}_retracted")
        return {
            name.replace("_", " "): {
                key: value for key, value in geometry[name].items() if not isinstance(value, dict)
            }
            for name in names
        }

    solvers = {
        f"{manifold}, {solver}": found
        for manifold, by_solver in geometry["solvers"].items()
        for solver, found in by_solver.items()
    }
    processor = geometry["machine"]["processor"]
    named = {
        f"Curve lengths a second, one thread of {processor}": rates("curve_length"),
        "Environment steps a second, PPO included": rates("environment"),
        "Solvers: length over the exact distance (learned: over the shortest found)": solvers,
    }
    return [
        _metric_table(title, "reports/geometry.json", items, [link] * len(items))
        for title, items in named.items()
    ]


def _metrics_of(
    layout: Layout, stage: str, title: str, items: Iterable[tuple[str, str]]
) -> tuple[str, str, dict[str, dict[str, Any]]]:
    found = {f"{m}, {c}": read_metrics(layout.report(stage, f"{m}-{c}")) for m, c in items}
    return stage, title, found


def _metric_table(
    title: str, source: str, items: Mapping[str, Mapping[str, Any]], runs: Sequence[str]
) -> Table:
    keys = list(dict.fromkeys(key for metrics in items.values() for key in metrics))
    rows = [[name, *(_metric(metrics.get(key)) for key in keys)] for name, metrics in items.items()]
    header = ["of", *(key.replace("_", " ") for key in keys)]
    return Table(title, f"from {source}", header, rows, links=[Links(link) for link in runs])


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


def ablation_tables(params: Params, layout: Layout) -> list[Table]:
    """What each choice is worth: the reward, the family of curves, the variance term of eq. 5."""
    learned = metrics_of(layout, "ablate_manifold", params.manifolds)
    searched = [_searched_table(params, layout)] if params.geodesics.analytic else []
    return [*searched, _variance_table(learned), _families_table(learned)]


def _searched_table(params: Params, layout: Layout) -> Table:
    header = ["manifold, variant", "excess over the exact distance [%], mean", "best seed"]
    header += ["worst seed", "seeds", "best curve of the family [%]"]
    rows, links = [], []
    for name in map(str, params.geodesics.analytic):
        ablated = read_metrics(layout.report("ablate_analytic", name))
        own = read_metrics(layout.report("train_analytic", name))["mean_ratio"]
        searched = {v: found["mean_ratio"] for v, found in ablated["policy_search"].items()}
        for variant, ratios in {"corrected_reward": own, **searched}.items():
            family = variant if variant.startswith("spline") else "polynomial"
            best = _percent(ablated["gradient"].get(family, {}).get("mean_ratio"))
            label = VARIANTS.get(variant, (variant.replace("_", " "), ""))[0]
            rows.append([f"{name}, {label}", *_excess(ratios), best])
            stage = "train_analytic" if ratios is own else "ablate_analytic"
            links.append(Links(runs_link(stage, name)))
    note = (
        "over unseen pairs, a policy a seed; the last column is what the gradient finds in the "
        "same family of curves, so what no search can pass. From reports/train_analytic/ and "
        "reports/ablate_analytic/"
    )
    title = "Reward and family of curves, where the answer is known"
    return Table(title, note, header, rows, links=links)


def _excess(ratios: Sequence[float]) -> list[str]:
    return [*(_percent(of(ratios)) for of in (np.mean, min, max)), str(len(ratios))]


def _percent(ratio: Any) -> str:
    """By how many per cent a ratio is above 1."""
    return "–" if ratio is None else f"{100 * (float(ratio) - 1):.3f}"


def _variance_table(learned: Mapping[str, Mapping[str, Any]]) -> Table:
    columns = {
        "pairs": "pairs",
        "collision_free": "geodesics free of collision",
        "collision_free_points": "points free of it",
        "length_rad": "joint length [rad]",
        "deviation_rad": "σ along the path [rad]",
    }
    rows = [
        [f"{manifold}, {label}", *(_metric(found[variant].get(key)) for key in columns)]
        for manifold, found in learned.items()
        for variant, label in WITH_VARIANCE.items()
    ]
    note = (
        "between configurations whose straight latent line collides; a dash where no such line was "
        "drawn. From reports/ablate_manifold/"
    )
    header = ["manifold, metric", *columns.values()]
    return Table("The variance term of eq. 5", note, header, rows, links=_ablated(rows))


def _families_table(learned: Mapping[str, Mapping[str, Any]]) -> Table:
    met = {name for found in learned.values() for name in found}
    families = [name for name in FAMILIES_OF_CURVES if name in met]
    rows = [
        [manifold, *(_metric(found.get(name, {}).get("mean_ratio_to_best")) for name in families)]
        for manifold, found in learned.items()
    ]
    header = ["manifold", *(FAMILIES_OF_CURVES[name] for name in families)]
    note = "length over the shortest that any family has of the same pair, mean. From "
    title, source = "Families of curves on the learned manifolds", "reports/ablate_manifold/"
    return Table(title, note + source, header, rows, links=_ablated(rows))


def _ablated(rows: Sequence[Sequence[str]]) -> list[Links]:
    return [Links(runs_link("ablate_manifold", row[0].partition(",")[0])) for row in rows]


def data_card_table(params: Params, layout: Layout) -> Table:
    """How each constraint's set was drawn, and what its rows touch."""
    columns = {
        "rejected_not_converged": "not converged",
        "rejected_outside_limits": "outside the limits",
        "self_collision": "touch the arm",
        "workcell_collision": "touch the workcell",
        "free": "touch nothing",
    }
    cards = metrics_of(layout, "label_joints", params.constraints)
    rows = []
    for name, card in cards.items():
        counts = [f"{card[key]:,}" for key in ("rows", "drawn")]
        rows.append([name, *counts, *(f"{card[key]:.1%}" for key in columns)])
    header = ("constraint", "rows", "drawn", *columns.values())
    note = "rejected: shares of the drawn; touching: shares of the rows. From reports/label_joints/"
    links = [Links(runs_link("label_joints", name)) for name in cards]
    return Table("Sets of configurations", note, header, rows, links=links)
