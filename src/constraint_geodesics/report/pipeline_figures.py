"""The figures of a run's report with titles and captions, from its tables, metrics and data."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float
from matplotlib.figure import Figure

from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import TOLERANCE
from constraint_geodesics.learning.dataset import UNITS, read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    GridSubmanifold,
    load_submanifold,
)
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report import figures
from constraint_geodesics.report.cells import short
from constraint_geodesics.report.charts_page import cases, chart_figures
from constraint_geodesics.report.figures import LatentCurves
from constraint_geodesics.report.results import (
    LEARNED,
    metrics_of,
    read_metrics,
    read_paths,
    studies_at_hand,
)
from constraint_geodesics.studies.proposals import POLICY

DRAWN_QUERY = 0
"""The query whose geodesics Fig. 4c shows: the first, which is also recorded."""
DATA_POINTS = 5000
"""Training configurations encoded for the figures."""
CURVE_POINTS = 101


class Drawn(NamedTuple):
    """A figure of the report: file's name, title, how to read it; alt: said where it isn't seen."""

    name: str
    title: str
    caption: str
    figure: Figure
    alt: str = ""


def draw_figures(params: Params, layout: Layout, table: pd.DataFrame) -> list[Drawn]:
    """The counterparts of the paper's figures, and those that show how far to trust them.

    A figure that needs a latent plane or a policy search that params.yaml does not ask for is left
    out.
    """
    free = read_joints(layout.joints("free")).free_joints[:DATA_POINTS]
    learned = {name: LearnedManifold.load(layout.manifold(name)) for name in params.manifolds}
    data = {name: manifold.encode(free) for name, manifold in learned.items()}
    drawn = [_draw_analytic_submanifolds()]
    if "plane" in params.geodesics.analytic:
        drawn.append(_draw_plane_search(layout))
    studies = studies_at_hand(params, layout)
    drawn += [_draw_length_rules(layout)] if "geometry" in studies else []
    drawn += _draw_ablation(params, layout) if "ablations" in studies else []
    drawn += [_draw_charts(params, layout)] if "charts" in studies else []
    planes = [name for name in params.geodesics.illustrated if learned[name].dim == 2]
    if planes and params.geodesics.illustrated_constraints:
        drawn += _draw_plane(params, layout, planes[0], learned[planes[0]], data[planes[0]])
    drawn += [_draw_growth(learned, data), _draw_training(params, layout)]
    for name in params.geodesics.searched:
        drawn.append(_draw_comparison(table, name))
        if learned[name].dim > 2:
            drawn.append(_draw_components(params, layout, name, data[name]))
    if params.searched_items:
        drawn.append(_draw_learning(params, layout))
    return drawn


def draw_data_cards(params: Params, layout: Layout) -> list[Drawn]:
    """Histograms of every constraint's set."""
    return [_draw_data_card(layout, name) for name in params.constraints]


def _draw_analytic_submanifolds() -> Drawn:
    caption = (
        "Left: the surfaces with the function that a constraint holds. Right: where it is held, "
        "coloured by connected component: one circle on the sphere, a set of circles on the torus. "
        "Nothing is learned here."
    )
    title = "Fig. 2: sub-manifolds of the sphere and the torus"
    return Drawn("fig2_analytic_submanifolds", title, caption, figures.analytic_submanifolds())


def _draw_plane_search(layout: Layout) -> Drawn:
    with np.load(layout.analytic("plane") / "curves.npz", allow_pickle=False) as arrays:
        sampled, learned = arrays["sampled"], arrays["learned"]
    ratio = read_metrics(layout.report("train_analytic", "plane"))["mean_ratio"]
    caption = (
        "Curves met while the policy searches between one pair of points (grey) and the one it "
        "ends with (orange). The exact answer is the straight line. Over unseen pairs the learned "
        f"path is {np.mean(ratio):.4f} times as long as it, mean over {len(ratio)} seeds."
    )
    figure = figures.plane_search(sampled, learned)
    return Drawn("fig3_plane_search", "Fig. 3: policy search in the plane", caption, figure)


def _draw_length_rules(layout: Layout) -> Drawn:
    table = pd.read_csv(layout.report("benchmark_geometry", "quadrature", "csv"))
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    length, error = geometry["curve_length"], geometry["curve_length"]["error"]
    caption = (
        f"Relative error against {error['reference_points']:,} chords of lengths by a fixed number "
        f"of points, over {error['curves']:.0f} random curves on the manifold "
        f"{geometry['manifold']}; lines: 95th percentile, bands: up to the worst curve. By default "
        "curves are measured by collocation with 9 points, and again with 17, 33 and 65 where the "
        f"error estimate asks for it: error {short(error['median'])} (median), "
        f"{short(error['max'])} (worst), {length['per_second']:,.0f} lengths a second in batches "
        f"of {length['batch']}, {length['ratio_to_naive']:.0f} times as many as with the full "
        "Jacobian at 101 points, a curve at a time."
    )
    title = "Length of a curve: error against cost"
    return Drawn("length_rules", title, caption, figures.length_rules(table, TOLERANCE))


def _draw_charts(params: Params, layout: Layout) -> Drawn:
    found, own = chart_figures(layout), params.compare_charts
    caption = (
        f"One certified curve for {own.constraint}, by a policy trained with {own.steps:,} steps "
        f"in each chart; lines: mean over {len(own.seeds)} seeds, bands: least to largest. Left: "
        "share of the queries that are solved in any chart. Right: length over the shortest answer "
        "of all, 95th percentile. Joint space has as many dimensions as the vertical line tells "
        "(reports/charts.md)."
    )
    title = "What a learned manifold adds to the search for a curve"
    panels: dict[str, dict[str, list[tuple[int, float, float, float]]]] = {}
    for figure in ("solved", "ratio_p95"):
        for data, dim, methods in cases(found["charts"]):
            spread = methods[POLICY][figure]
            values = [spread[name] for name in ("mean", "least", "largest")]
            mean, least, largest = (float("nan") if v is None else v for v in values)
            row = dim, mean, least, largest
            panels.setdefault(figure, {}).setdefault(data, []).append(row)
    return Drawn("charts", title, caption, figures.charts(panels))


def _draw_ablation(params: Params, layout: Layout) -> list[Drawn]:
    names = [str(name) for name in params.geodesics.analytic]
    if not names:
        return []
    searched: dict[str, dict[str, list[float]]] = {}
    reached: dict[str, dict[str, float]] = {}
    for name in names:
        own = read_metrics(layout.report("train_analytic", name))["mean_ratio"]
        ablated = read_metrics(layout.report("ablate_analytic", name))
        searched[name] = {"corrected_reward": own, **_ratios(ablated["policy_search"])}
        reached[name] = _ratios(ablated["gradient"])
    learned = metrics_of(layout, "ablate_manifold", params.manifolds)
    excess = "; ".join(
        f"{name}: {np.mean(ratios['corrected_reward']) - 1:.2%} against "
        f"{np.mean(ratios['printed_reward']) - 1:.2%}"
        for name, ratios in searched.items()
    )
    free = "; ".join(
        f"{name}: {_share(found['with_variance'])} with it, "
        f"{_share(found['without_variance'])} without"
        for name, found in learned.items()
    )
    caption = (
        "Left: how much longer than the exact distance the learned path is, over unseen pairs. "
        "Mean excess with the corrected reward against that of eq. 15 as printed: "
        f"{excess}. Middle: the same for the best curve of each family, found by the gradient: "
        "what a search could reach. Right: geodesics whose decoded joints touch nothing, between "
        f"configurations whose straight latent line collides: {free}."
    )
    figure = figures.ablation(searched, reached, learned)
    return [Drawn("ablation", "What each choice is worth", caption, figure)]


def _ratios(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {name: own["mean_ratio"] for name, own in found.items()}


def _share(found: Mapping[str, Any]) -> str:
    share = found["collision_free"]
    return "none to avoid" if share is None else f"{share:.0%}"


def _draw_plane(
    params: Params,
    layout: Layout,
    name: str,
    manifold: LearnedManifold,
    data: Float[np.ndarray, "n 2"],
) -> list[Drawn]:
    """Fig. 4 a to c."""
    names = params.geodesics.illustrated_constraints
    loaded = {own: load_submanifold(layout.submanifold(name, own)) for own in names}
    planes = {own: plane for own, plane in loaded.items() if isinstance(plane, GridSubmanifold)}
    angles_only = {own: not params.constraints[own].may_hold_positions for own in planes}
    curves = {
        own: (plane, latent_curves(params, layout, manifold, name, own))
        for own, plane in planes.items()
    }
    metric = (
        "Volume √det M of the metric of eq. 5 over the latent plane, on a logarithmic scale, and "
        "encoded training configurations (white). No constraint is involved."
    )
    kept = (
        "Inclusion map ι of eqs. 7-8 at the decoded pose (grey), and the connected components "
        "where it is zero (colours); what is held exactly counts as kept within "
        f"{np.degrees(params.submanifold.resolution_rad):.1f}° and "
        f"{1e3 * params.submanifold.resolution_m:.0f} mm. The manifold is that of Fig. 4a, not "
        "trained again."
    )
    found = (
        f"Query {DRAWN_QUERY} of each constraint: the curve that every seed's policy found, and "
        "the straight line. The ends are encoded configurations that keep the constraint exactly; "
        "where they lie off the coloured components, the plane does not represent them well enough."
    )
    volume = figures.latent_metric(manifold, data)
    components = figures.submanifolds_in_plane(planes, angles_only)
    geodesics = figures.geodesics_in_plane(curves)
    titles = (f"metric of the manifold {name}", "sub-manifolds of the same plane")
    return [
        Drawn("fig4a_latent_metric", f"Fig. 4a: {titles[0]}", metric, volume),
        Drawn("fig4b_submanifolds", f"Fig. 4b: {titles[1]}", kept, components),
        Drawn("fig4c_geodesics", "Fig. 4c: learned geodesics in the plane", found, geodesics),
    ]


def latent_curves(
    params: Params, layout: Layout, manifold: LearnedManifold, name: str, constraint: str
) -> LatentCurves:
    """The curves that the seeds found for the drawn query, and the straight line."""
    file = layout.geodesics(name, constraint) / "curves.npz"
    with np.load(file, allow_pickle=False) as arrays:
        phi, seeds = arrays["phi"][:, DRAWN_QUERY], arrays["seeds"]
        ends = [manifold.encode(arrays[end][DRAWN_QUERY]) for end in ("starts", "goals")]
    rows = read_paths(layout.report("train_geodesics", f"{name}-{constraint}", "csv"), name)
    learned = rows[(rows["planner"] == LEARNED) & (rows["status"] == "solved")]
    found = phi[np.isin(seeds, learned.loc[learned["query"] == DRAWN_QUERY, "seed"])]
    curve = PinnedPolynomial(manifold.dim, params.geodesics.degree)
    t = torch.linspace(0.0, 1.0, CURVE_POINTS, dtype=torch.float64)
    start, goal = (torch.from_numpy(end) for end in ends)
    straight = torch.zeros(curve.coefficients, dtype=torch.float64)
    coefficients = (torch.from_numpy(found), straight)
    return LatentCurves(*(curve.evaluate(own, start, goal, t)[0].numpy() for own in coefficients))


def _draw_growth(
    manifolds: Mapping[str, LearnedManifold], data: Mapping[str, Float[np.ndarray, "n N"]]
) -> Drawn:
    growths = {name: figures.follow_rays(own, data[name]) for name, own in manifolds.items()}
    measured = []
    for name, growth in growths.items():
        trace, deviation = np.median(growth.trace[-1]), np.median(growth.deviation_trace[-1])
        measured.append(
            f"{name}: at most {short(growth.largest_on_data)} rad² on the data, "
            f"{short(float(trace))} rad² at {growth.distance[-1]:g} radii (median), "
            f"{deviation / trace:.0%} of it from σ"
        )
    caption = (
        f"Trace of the metric along {figures.RAYS} random rays out of the data, and the part of it "
        "that the decoder's standard deviation σ adds, which grows without end where no "
        f"configuration was seen. {'; '.join(measured)}."
    )
    title = "The metric on the data and away from it"
    return Drawn("metric_growth", title, caption, figures.metric_growth(growths))


def _draw_training(params: Params, layout: Layout) -> Drawn:
    histories = {
        name: pd.read_csv(layout.report("train_manifold", name, "csv")) for name in params.manifolds
    }
    caption = (
        "Loss of eq. 4 a sample: first the encoder and the decoder's mean, then its variance with "
        "both frozen. The epoch with the lowest held-out loss is kept."
    )
    figure = figures.training_curves(histories)
    return Drawn("training_curves", "Training of the manifolds", caption, figure)


def _draw_comparison(table: pd.DataFrame, manifold: str) -> Drawn:
    caption = (
        "Share of valid paths; joint length of valid paths over the shortest valid path that any "
        "planner found for the same query; time of every row of queries that any planner solves, "
        "failures included. Marks are medians, lines reach to the 95th percentile. The straight "
        "line takes no search, so it has no time."
    )
    title = f"Success, length and time: {manifold}"
    figure = figures.planner_comparison(table[table["manifold"] == manifold])
    return Drawn(f"comparison_{manifold}", title, caption, figure)


def _draw_components(
    params: Params, layout: Layout, manifold: str, data: Float[np.ndarray, "n N"]
) -> Drawn:
    loaded = {
        name: load_submanifold(layout.submanifold(manifold, name)) for name in params.constraints
    }
    graphs = {name: graph for name, graph in loaded.items() if isinstance(graph, GraphSubmanifold)}
    caption = (
        "Encoded configurations of each constraint in the first two principal axes of the same "
        f"manifold, in {data.shape[1]} dimensions; those that checked edges join have one colour. "
        "Grey: what the manifold was trained on. Ends in different components are not connected "
        "within the joint limits, as far as the graph knows."
    )
    figure = figures.components_in_principal_axes(graphs, data[:1500])
    title = f"One manifold, every constraint: {manifold}"
    return Drawn(f"submanifolds_{manifold}", title, caption, figure)


def _draw_learning(params: Params, layout: Layout) -> Drawn:
    chart, own = params.policies.chart, dict[str, dict[str, pd.DataFrame]]()
    shared = pd.read_csv(layout.report("train_policies", f"{chart}-learning", "csv"))
    panels = {"all constraints": {chart: shared}}
    for manifold, constraint in params.searched_items:
        if not params.manifolds[manifold].retract:
            file = layout.report("train_geodesics", f"{manifold}-{constraint}-learning", "csv")
            own.setdefault(constraint, {})[manifold] = pd.read_csv(file)
    panels |= own
    caption = (
        "How much less the best curve of an episode costs than the straight line, mean over the "
        "episodes since the row before; line and band: mean and standard deviation over the seeds."
    )
    figure = figures.learning_curves(panels)
    return Drawn("learning_curves", "Policy search while it learns", caption, figure)


def _draw_data_card(layout: Layout, constraint: str) -> Drawn:
    card = read_metrics(layout.report("label_joints", constraint))
    caption = (
        f"{card['rows']:,} rows kept of {card['drawn']:,} drawn: "
        f"{card['rejected_not_converged']:.1%} did not reach the constraint, "
        f"{card['rejected_outside_limits']:.1%} left the joint limits. "
        f"{card['self_collision']:.1%} of the rows touch the arm itself, "
        f"{card['workcell_collision']:.1%} the workcell; {card['free']:.1%} touch nothing."
    )
    histograms = read_metrics(layout.report("label_joints", f"{constraint}-histograms"))
    figure = figures.data_histograms(histograms, _unit)
    alt = f"Histograms of joints and tool poses of the set {constraint}"
    return Drawn(f"data_{constraint}", constraint, caption, figure, alt)


def _unit(column: str) -> str:
    return UNITS.get(column) or UNITS.get(column.split("_")[0], "rad")
