"""The report of a run: the result table, the figures, and one page that opens offline (reports/index.html)."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from constraint_geodesics.constraints.submanifold import GraphSubmanifold, GridSubmanifold, load_submanifold
from constraint_geodesics.evaluation import figures
from constraint_geodesics.evaluation.figures import PLANNERS, LatentCurves
from constraint_geodesics.evaluation.plan_report import (
    execution_block,
    plan_blocks,
    plans_markdown,
    policies_markdown,
    policy_blocks,
)
from constraint_geodesics.evaluation.results import (
    COLUMNS,
    COUNTED,
    LEARNED,
    Block,
    ReportError,
    compare_planners,
    findings,
    fixed,
    geometry_table,
    plus_minus,
    read_metrics,
    read_paths,
    records,
    result_table,
    searched_items,
    short,
    table_cells,
)
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import TOLERANCE
from constraint_geodesics.learning.dataset import UNITS, read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.paths import Layout

DRAWN_QUERY = 0
"""The query whose geodesics Fig. 4c shows: the first, which is also recorded."""
DATA_POINTS = 5000
"""Training configurations encoded for the figures."""

PUBLISHED = {
    "prm": (499.42, 530.89, 24.43, 9.75, 1.53),
    "rrt_star": (134.80, 155.28, 17.84, 5.21, 1.38),
    "birrt": (53.00, 84.65, 25.52, 2.903, 0.16),
    "learned_geodesic": (70.56, 79.81, 7.64, 3.8, 1.81),
}
"""Table I of the paper: shortest path, average, its ±, planning time [s], its ±."""


@dataclass(frozen=True)
class Drawn:
    """A figure of the report: its file's name, what it shows, and how to read it."""

    name: str
    title: str
    caption: str
    figure: Figure


def write_report(params: Params, layout: Layout) -> list[Path]:
    """Write reports/table.csv, *.md (README's tables), figures/*.png and index.html; returns the figures' files.

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
    (reports / "plans.md").write_text(plans_markdown(params, layout))
    (reports / "policies.md").write_text(policies_markdown(params, layout))
    for entry in (*drawn, *cards):
        figures.save_png(entry.figure, figure_file(layout, entry))
    (reports / "index.html").write_text(_page(layout, drawn=drawn, cards=cards, **content))
    return [figure_file(layout, entry) for entry in (*drawn, *cards)]


def figure_file(layout: Layout, entry: Drawn) -> Path:
    """Where a figure lies."""
    return layout.root / "reports" / "figures" / f"{entry.name}.png"


def draw_figures(params: Params, layout: Layout, table: pd.DataFrame) -> list[Drawn]:
    """The counterparts of the paper's figures, and those that show how far to trust them.

    A figure that needs a latent plane or a policy search that params.yaml does not ask for is left out.
    """
    free = read_joints(layout.joints("free")).free_joints[:DATA_POINTS]
    charts = {name: LearnedManifold.load(layout.manifold(name)) for name in params.manifolds}
    data = {name: chart.encode(free) for name, chart in charts.items()}
    drawn = [_draw_analytic_submanifolds()]
    if "plane" in params.geodesics.analytic:
        drawn.append(_draw_plane_search(layout))
    drawn += [_draw_length_rules(layout), *_draw_ablation(params, layout)]
    planes = [name for name in params.geodesics.illustrated if charts[name].dim == 2]
    if planes and params.geodesics.illustrated_constraints:
        drawn += _draw_plane(params, layout, planes[0], charts[planes[0]], data[planes[0]])
    drawn += [_draw_growth(charts, data), _draw_training(params, layout)]
    for name in params.geodesics.searched:
        drawn.append(_draw_comparison(table, name))
        if charts[name].dim > 2:
            drawn.append(_draw_components(params, layout, name, data[name]))
    if searched_items(params):
        drawn.append(_draw_learning(params, layout))
    return drawn


def draw_data_cards(params: Params, layout: Layout) -> list[Drawn]:
    """Histograms of every constraint's set."""
    return [_draw_data_card(layout, name) for name in params.constraints]


def _draw_analytic_submanifolds() -> Drawn:
    caption = (
        "Left: the surfaces with the function that a constraint holds. Right: where it is held, coloured by connected "
        "component: one circle on the sphere, a set of circles on the torus. Nothing is learned here."
    )
    title = "Fig. 2: sub-manifolds of the sphere and the torus"
    return Drawn("fig2_analytic_submanifolds", title, caption, figures.analytic_submanifolds())


def _draw_plane_search(layout: Layout) -> Drawn:
    with np.load(layout.analytic("plane") / "curves.npz", allow_pickle=False) as arrays:
        sampled, learned = arrays["sampled"], arrays["learned"]
    ratio = read_metrics(layout.report("train_analytic", "plane"))["mean_ratio"]
    caption = (
        f"Curves met while the policy searches between one pair of points (grey) and the one it ends with (orange). "
        f"The exact answer is the straight line. Over unseen pairs the learned path is {_mean_of(ratio):.4f} times as "
        f"long as it, mean over {len(ratio)} seeds."
    )
    title = "Fig. 3: policy search in the plane"
    return Drawn("fig3_plane_search", title, caption, figures.plane_search(sampled, learned))


def _draw_length_rules(layout: Layout) -> Drawn:
    table = pd.read_csv(layout.report("benchmark_geometry", "quadrature", "csv"))
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    length, error = geometry["curve_length"], geometry["curve_length"]["error"]
    caption = (
        f"Relative error against {error['reference_points']:,} chords of lengths by a fixed number of points, over "
        f"{error['curves']:.0f} random curves on the manifold {geometry['manifold']}; lines: 95th percentile, bands: "
        "up to the worst curve. By default curves are measured by collocation with 9 points, and again with 17, 33 "
        f"and 65 where the error estimate asks for it: error {short(error['median'])} (median), "
        f"{short(error['max'])} (worst), {length['per_second']:,.0f} lengths a second in batches of "
        f"{length['batch']}, {length['ratio_to_naive']:.0f} times as many as with the full Jacobian at 101 points, a "
        "curve at a time."
    )
    title = "Length of a curve: error against cost"
    return Drawn("length_rules", title, caption, figures.length_rules(table, TOLERANCE))


def _draw_ablation(params: Params, layout: Layout) -> list[Drawn]:
    names = [str(name) for name in params.geodesics.analytic]
    if not names:
        return []
    ablated = {name: read_metrics(layout.report("ablate_analytic", name)) for name in names}
    searched = {
        name: {"corrected_reward": read_metrics(layout.report("train_analytic", name))["mean_ratio"]}
        | {variant: found["mean_ratio"] for variant, found in ablated[name]["policy_search"].items()}
        for name in names
    }
    reached = {
        name: {family: found["mean_ratio"] for family, found in ablated[name]["gradient"].items()} for name in names
    }
    learned = {name: read_metrics(layout.report("ablate_manifold", name)) for name in params.manifolds}
    told = "; ".join(
        f"{name}: {_mean_of(ratios['corrected_reward']) - 1:.2%} against {_mean_of(ratios['printed_reward']) - 1:.2%}"
        for name, ratios in searched.items()
    )
    free = "; ".join(
        f"{name}: {_share(found['with_variance'])} with it, {_share(found['without_variance'])} without"
        for name, found in learned.items()
    )
    caption = (
        f"Left: how much longer than the exact distance the learned path is, over unseen pairs. Mean excess with the "
        f"corrected reward against that of eq. 15 as printed: {told}. Middle: the same for the best curve of each "
        "family, found by the gradient: what a search could reach. Right: geodesics whose decoded joints touch "
        f"nothing, between configurations whose straight latent line collides: {free}."
    )
    return [Drawn("ablation", "What each choice is worth", caption, figures.ablation(searched, reached, learned))]


def _share(found: Mapping[str, Any]) -> str:
    share = found["collision_free"]
    return "none to avoid" if share is None else f"{share:.0%}"


def _draw_plane(
    params: Params, layout: Layout, manifold: str, chart: LearnedManifold, data: Float[np.ndarray, "n 2"]
) -> list[Drawn]:
    """Fig. 4 a to c."""
    names = params.geodesics.illustrated_constraints
    loaded = {name: load_submanifold(layout.submanifold(manifold, name)) for name in names}
    planes = {name: plane for name, plane in loaded.items() if isinstance(plane, GridSubmanifold)}
    angles_only = {name: not any(params.constraints[name].axes[:3]) for name in planes}
    curves = {name: (plane, latent_curves(params, layout, chart, manifold, name)) for name, plane in planes.items()}
    resolution = np.degrees(params.submanifold.resolution_rad)
    return [
        Drawn(
            "fig4a_latent_metric", f"Fig. 4a: metric of the manifold {manifold}",
            "Volume √det M of the metric of eq. 5 over the latent plane, on a logarithmic scale, and encoded training "
            "configurations (white). No constraint is involved.",
            figures.latent_metric(chart, data),
        ),
        Drawn(
            "fig4b_submanifolds", "Fig. 4b: sub-manifolds of the same plane",
            "Inclusion map ι of eqs. 7-8 at the decoded pose (grey), and the connected components where it is zero "
            f"(colours); what is held exactly counts as kept within {resolution:.1f}° and "
            f"{1e3 * params.submanifold.resolution_m:.0f} mm. The manifold is that of Fig. 4a, not trained again.",
            figures.submanifolds_in_plane(planes, angles_only),
        ),
        Drawn(
            "fig4c_geodesics", "Fig. 4c: learned geodesics in the plane",
            f"Query {DRAWN_QUERY} of each constraint: the curve that every seed's policy found, and the straight line. "
            "The ends are encoded configurations that keep the constraint exactly; where they lie off the coloured "
            "components, the plane does not represent them well enough.",
            figures.geodesics_in_plane(curves),
        ),
    ]  # fmt: skip


def latent_curves(
    params: Params, layout: Layout, chart: LearnedManifold, manifold: str, constraint: str, points: int = 101
) -> LatentCurves:
    """The curves that the seeds found for the drawn query, and the straight line."""
    with np.load(layout.geodesics(manifold, constraint) / "curves.npz", allow_pickle=False) as arrays:
        phi, seeds = arrays["phi"][:, DRAWN_QUERY], arrays["seeds"]
        ends = [chart.encode(arrays[name][DRAWN_QUERY]) for name in ("starts", "goals")]
    rows = read_paths(layout.report("train_geodesics", f"{manifold}-{constraint}", "csv"), manifold)
    mine = rows[(rows["planner"] == LEARNED) & (rows["query"] == DRAWN_QUERY) & (rows["status"] == "solved")]
    found = phi[np.isin(seeds, mine["seed"])]
    curve = PinnedPolynomial(chart.dim, params.geodesics.degree)
    t = torch.linspace(0.0, 1.0, points, dtype=torch.float64)
    start, goal = (torch.from_numpy(end) for end in ends)
    straight = torch.zeros(curve.coefficients, dtype=torch.float64)
    learned = curve.evaluate(torch.from_numpy(found), start, goal, t)[0].numpy()
    return LatentCurves(learned, curve.evaluate(straight, start, goal, t)[0].numpy())


def _draw_growth(charts: Mapping[str, LearnedManifold], data: Mapping[str, Float[np.ndarray, "n N"]]) -> Drawn:
    growths = {name: figures.follow_rays(chart, data[name]) for name, chart in charts.items()}
    told = "; ".join(
        f"{name}: at most {short(growth.largest_on_data)} rad² on the data, "
        f"{short(float(np.median(growth.trace[-1])))} rad² at {growth.distance[-1]:g} radii (median), "
        f"{np.median(growth.deviation_trace[-1]) / np.median(growth.trace[-1]):.0%} of it from σ"
        for name, growth in growths.items()
    )
    caption = (
        f"Trace of the metric along {figures.RAYS} random rays out of the data, and the part of it that the decoder's "
        f"standard deviation σ adds, which grows without end where no configuration was seen. {told}."
    )
    title = "The metric on the data and away from it"
    return Drawn("metric_growth", title, caption, figures.metric_growth(growths))


def _draw_training(params: Params, layout: Layout) -> Drawn:
    histories = {name: pd.read_csv(layout.report("train_manifold", name, "csv")) for name in params.manifolds}
    caption = (
        "Loss of eq. 4 a sample: first the encoder and the decoder's mean, then its variance with both frozen. The "
        "epoch with the lowest held-out loss is kept."
    )
    return Drawn("training_curves", "Training of the manifolds", caption, figures.training_curves(histories))


def _draw_comparison(table: pd.DataFrame, manifold: str) -> Drawn:
    caption = (
        "Share of valid paths; joint length of valid paths over the shortest valid path that any planner found for the "
        "same query; time of every row, failures included. Marks are medians, lines reach to the 95th percentile. "
        "The straight latent line takes no search, so it has no time."
    )
    rows = table[table["manifold"] == manifold]
    title = f"Success, length and time: {manifold}"
    return Drawn(f"comparison_{manifold}", title, caption, figures.planner_comparison(rows))


def _draw_components(params: Params, layout: Layout, manifold: str, data: Float[np.ndarray, "n N"]) -> Drawn:
    loaded = {name: load_submanifold(layout.submanifold(manifold, name)) for name in params.constraints}
    graphs = {name: graph for name, graph in loaded.items() if isinstance(graph, GraphSubmanifold)}
    caption = (
        f"Encoded configurations of each constraint in the first two principal axes of the same manifold, in "
        f"{data.shape[1]} dimensions; those that checked edges join have one colour. Grey: what the manifold was "
        "trained on. Ends in different components are not connected within the joint limits, as far as the graph knows."
    )
    drawn = figures.components_in_principal_axes(graphs, data[:1500])
    return Drawn(f"submanifolds_{manifold}", f"One manifold, every constraint: {manifold}", caption, drawn)


def _draw_learning(params: Params, layout: Layout) -> Drawn:
    panels: dict[str, dict[str, pd.DataFrame]] = {}
    for manifold, constraint in searched_items(params):
        file = layout.report("train_geodesics", f"{manifold}-{constraint}-learning", "csv")
        panels.setdefault(constraint, {})[manifold] = pd.read_csv(file)
    caption = (
        "How much less the best curve of an episode costs than the straight line, mean over the episodes of a rollout; "
        "line and band: mean and standard deviation over the seeds."
    )
    return Drawn("learning_curves", "Policy search while it learns", caption, figures.learning_curves(panels))


def _draw_data_card(layout: Layout, constraint: str) -> Drawn:
    card = read_metrics(layout.report("label_joints", constraint))
    caption = (
        f"{card['rows']:,} rows kept of {card['drawn']:,} drawn: {card['rejected_not_converged']:.1%} did not reach "
        f"the constraint, {card['rejected_outside_limits']:.1%} left the joint limits. "
        f"{card['self_collision']:.1%} of the rows touch the arm itself, {card['workcell_collision']:.1%} the "
        f"workcell; {card['free']:.1%} touch nothing."
    )
    return Drawn(f"data_{constraint}", constraint, caption, figures.data_histograms(card, _unit))


def _unit(column: str) -> str:
    return UNITS[column] if column in UNITS else UNITS[column.split("_")[0]]


def _mean_of(values: Sequence[float]) -> float:
    return float(np.mean(values))


def page_content(params: Params, layout: Layout, table: pd.DataFrame) -> dict[str, Any]:
    """What the page says beside its figures."""
    metrics = {name: read_metrics(layout.report("train_manifold", name)) for name in params.manifolds}
    return {
        "params": params,
        "learned": PLANNERS[LEARNED].label,
        "findings": findings(params, table, metrics),
        "published": [published_block(params, table, c) for c in params.geodesics.illustrated_constraints[:1]],
        "plans": [*plan_blocks(params, layout), execution_block(params, layout)],
        "proposals": policy_blocks(params, layout),
        "results": result_blocks(params, table),
        "metrics": metric_blocks(params, layout, metrics),
        "recordings": recorded_paths(params, layout),
    }


def _page(layout: Layout, **content: Any) -> str:
    environment = Environment(
        loader=PackageLoader("constraint_geodesics.evaluation", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["png"] = lambda entry: _embedded(layout, entry)
    return environment.get_template("report.html.j2").render(content)


def _embedded(layout: Layout, entry: Drawn) -> str:
    content = base64.b64encode(figure_file(layout, entry).read_bytes()).decode()
    return f"data:image/png;base64,{content}"


def published_block(params: Params, table: pd.DataFrame, constraint: str) -> Block:
    """Table I of the paper beside its counterparts of this run; `×` is the average over the learned geodesic's."""
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
    cells = []
    for planner, style in PLANNERS.items():
        row = [style.label, *_published_cells(planner)]
        for source in sources:
            row += _measured_cells(source, planner)
        if any(planner in source for source in sources):
            cells.append(row)
    note = (
        f"{params.constraints[constraint].description}. Lengths are measured on the manifold of their column (the "
        "paper's has no unit, here rad): compare within a column, or the ratios × to the learned geodesic's average."
    )
    return Block(constraint, note, header, cells, groups)


def _published_cells(planner: str) -> list[str]:
    if planner not in PUBLISHED:
        return ["–"] * 4
    shortest, average, spread, time, time_spread = PUBLISHED[planner]
    ratio = average / PUBLISHED[LEARNED][1]
    return [fixed(shortest), plus_minus(average, spread, fixed), fixed(ratio), plus_minus(time, time_spread, fixed)]


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


def result_blocks(params: Params, table: pd.DataFrame) -> list[Block]:
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
        blocks.append(Block(f"{manifold}, {constraint}", note, header, cells))
    return blocks


def metric_blocks(params: Params, layout: Layout, manifolds: Mapping[str, Mapping[str, Any]]) -> list[Block]:
    """The other stages' metrics, one row an item."""
    extracted = [(m, c) for m in params.manifolds for c in params.constraints]
    named: tuple[tuple[str, str, Mapping[str, Mapping[str, Any]]], ...] = (
        ("train_manifold", "Learned manifolds, on held-out configurations", manifolds),
        ("extract_submanifold", "Sub-manifolds", _metrics_of(layout, "extract_submanifold", extracted)),
        ("train_geodesics", "Policy search", _metrics_of(layout, "train_geodesics", searched_items(params))),
        (
            "train_analytic", "Policy search where the answer is known (length over exact distance, a seed each)",
            {str(name): read_metrics(layout.report("train_analytic", name)) for name in params.geodesics.analytic},
        ),
        *_geometry_blocks(layout),
    )  # fmt: skip
    return [
        _metric_block(title, f"reports/{stage}" + ("" if stage.endswith(".json") else "/"), items)
        for stage, title, items in named
        if items
    ]


def _geometry_blocks(layout: Layout) -> list[tuple[str, str, Mapping[str, Mapping[str, Any]]]]:
    """Rates of the geometry core, and the solvers of each manifold, from reports/geometry.json."""
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    lengths = {name: geometry[name] for name in ("curve_length", "curve_length_retracted")}
    rates = {
        name.replace("_", " "): {key: value for key, value in found.items() if not isinstance(value, dict)}
        for name, found in lengths.items()
    }
    steps = {name.replace("_", " "): geometry[name] for name in ("environment", "environment_retracted")}
    solvers = {
        f"{manifold}, {solver}": found
        for manifold, by_solver in geometry["solvers"].items()
        for solver, found in by_solver.items()
    }
    processor = geometry["machine"]["processor"]
    return [
        ("geometry.json", f"Curve lengths a second, one thread of {processor}", rates),
        ("geometry.json", "Environment steps a second, PPO included", steps),
        ("geometry.json", "Solvers: length over the exact distance (learned: over the shortest found)", solvers),
    ]


def _metrics_of(layout: Layout, stage: str, items: Iterable[tuple[str, str]]) -> dict[str, dict[str, Any]]:
    return {f"{m}, {c}": read_metrics(layout.report(stage, f"{m}-{c}")) for m, c in items}


def _metric_block(title: str, folder: str, items: Mapping[str, Mapping[str, Any]]) -> Block:
    keys = list(dict.fromkeys(key for metrics in items.values() for key in metrics))
    rows = [[name, *(_metric(metrics.get(key)) for key in keys)] for name, metrics in items.items()]
    return Block(title, f"from {folder}", ["", *(key.replace("_", " ") for key in keys)], rows)


def _metric(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_metric, value))
    if value is None or isinstance(value, str):
        return value or "–"
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.4g}"


@dataclass(frozen=True)
class RecordedPath:
    """One line of the list of recordings: where it lies from the page, and what it shows."""

    link: str
    file: str
    text: str


def recorded_paths(params: Params, layout: Layout) -> dict[str, list[RecordedPath]]:
    """The recorded paths of every constraint, sampled and learned."""
    found: dict[str, list[RecordedPath]] = {}
    for constraint in params.constraints:
        sources = [("benchmark_planners", constraint, next(iter(params.manifolds)))]
        sources += [("train_geodesics", f"{m}-{c}", m) for m, c in searched_items(params) if c == constraint]
        for stage, item, manifold in sources:
            rows = read_paths(layout.report(stage, item, "csv"), manifold)
            recorded = records(rows[rows["recording"] != ""])
            where = f" on {manifold}" if stage == "train_geodesics" else ""
            found.setdefault(constraint, []).extend(_recorded_path(layout, row, where) for row in recorded)
    return found


def _recorded_path(layout: Layout, row: Mapping[str, Any], where: str) -> RecordedPath:
    file = Path(row["recording"])
    if file.is_absolute():
        file = file.relative_to(layout.root.resolve())
    verdict = "valid" if row["valid"] else f"not valid: {row['reason']}"
    lengths = f"{fixed(row['length_rad'])} rad, violation {short(np.degrees(row['max_violation_rad']))}°"
    text = f"{PLANNERS[row['planner']].label}{where}, query {row['query']}, seed {row['seed']}: {verdict}, {lengths}"
    return RecordedPath(f"../{file.as_posix()}", file.as_posix(), text)
