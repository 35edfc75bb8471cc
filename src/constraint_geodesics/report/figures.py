"""The figures of a run: arrays and tables in, matplotlib figures out, and small PNG files that are
the same each time.

Every figure is built on `Figure` itself, so that nothing depends on a global state or a screen.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import LinearSegmentedColormap, LogNorm, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

from constraint_geodesics.geometry.analytic import LevelSet, Sphere, Torus
from constraint_geodesics.geometry.manifold import pullback_metric
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GraphSubmanifold, GridSubmanifold
from constraint_geodesics.palette import BLACK as BLACK
from constraint_geodesics.palette import BLUE as BLUE
from constraint_geodesics.palette import GOAL as GOAL
from constraint_geodesics.palette import GREEN as GREEN
from constraint_geodesics.palette import GREY as GREY
from constraint_geodesics.palette import LIGHT as LIGHT
from constraint_geodesics.palette import ORANGE as ORANGE
from constraint_geodesics.palette import PURPLE as PURPLE
from constraint_geodesics.palette import SKY, YELLOW, planner_colour
from constraint_geodesics.palette import START as START
from constraint_geodesics.palette import VERMILION as VERMILION
from constraint_geodesics.recording.png import save_png as save_png

COMPONENTS = (SKY, PURPLE, BLUE, YELLOW, GREEN)
"""Colours of a sub-manifold's components, the largest first; the smaller ones behind them share
one.
"""
REST = "#6B6B6B"
NEAR = LinearSegmentedColormap.from_list("near", ["#9AA3AB", "#FFFFFF"])

ELEVATION, TUBE_ANGLE, HALF_WIDTH = np.pi / 6, np.pi / 6, np.radians(4.0)
"""Fig. 2: the level sets drawn on the sphere and the torus, and the tolerance they are held within
[rad].
"""

VIEW = (np.radians(24.0), np.radians(-58.0))
"""Elevation and azimuth that Fig. 2's surfaces are seen from: both circles of the torus must show
[rad].
"""

RAYS, RAY_REACH, RAY_STEPS = 64, 4.0, 65
"""Directions, reach in data radii and points of the rays that a metric is followed along."""


@dataclass(frozen=True)
class PlannerStyle:
    """How one planner is shown, in every figure alike."""

    label: str
    marker: str

    @property
    def colour(self) -> str:
        """That of the planner on every page and in every recording."""
        return planner_colour(self.label)


PLANNERS = {
    "prm": PlannerStyle("PRM", "s"),
    "rrt_star": PlannerStyle("RRT*", "^"),
    "birrt": PlannerStyle("BiRRT", "v"),
    "straight_latent_line": PlannerStyle("straight latent line", "D"),
    "random_curves": PlannerStyle("random curves", "P"),
    "learned_geodesic": PlannerStyle("learned geodesic", "o"),
}
"""The planners of a table, in the order they are shown."""


@dataclass(frozen=True)
class LatentCurves:
    """Curves of one query in a latent plane, one a seed (S, T, 2), and the straight line (T, 2)."""

    learned: Float[np.ndarray, "S T 2"]
    straight: Float[np.ndarray, "T 2"]


def analytic_submanifolds() -> Figure:
    """Fig. 2: the sphere with one level set of its elevation, the torus with one of the angle
    around its tube.
    """
    sphere, torus = Sphere(), Torus()
    around, along = np.linspace(-np.pi, np.pi, 121), np.linspace(-np.pi / 2, np.pi / 2, 61)
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    elevation = LevelSet(sphere, 0, (ELEVATION,), HALF_WIDTH)
    tube_angle = LevelSet(torus, 1, (TUBE_ANGLE, -TUBE_ANGLE), HALF_WIDTH)
    _surface_row(figure, 0, elevation, (along, around), sphere.elevation, "sphere, elevation")
    _surface_row(figure, 1, tube_angle, (around, around), torus.tube_angle, "torus, tube angle")
    return _tidied(figure)


def plane_search(sampled: Float[np.ndarray, "n T 2"], learned: Float[np.ndarray, "T 2"]) -> Figure:
    """Fig. 3: curves met by policy search in the plane, the learned one, and the line it should
    find.
    """
    figure = Figure(figsize=(6.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.add_collection(
        LineCollection(list(sampled), colors=GREY, linewidths=0.6, alpha=0.4, label="sampled paths")
    )
    axes.plot(
        *learned[[0, -1]].T,
        color=BLACK,
        linestyle="--",
        linewidth=1.2,
        label="exact geodesic",
        zorder=4,
    )
    axes.plot(*learned.T, color=ORANGE, linewidth=2.6, label="learned path", zorder=3)
    _draw_ends(axes, learned[0], learned[-1])
    axes.set(xlabel="x", ylabel="y", aspect="equal")
    axes.autoscale_view()
    _legend(axes, loc="best")
    return _tidied(figure)


def latent_metric(
    chart: LearnedManifold, data: Float[np.ndarray, "n 2"], points: int = 140
) -> Figure:
    """Fig. 4a: volume √det M of the metric over the latent plane (log colours), and the encoded
    data.

    data: latent coordinates of configurations that the manifold was trained on.  points: a side of
    the grid.
    """
    low, high = np.quantile(data, 0.002, axis=0), np.quantile(data, 0.998, axis=0)
    margin = 0.2 * (high - low)
    first, second = (np.linspace(low[k] - margin[k], high[k] + margin[k], points) for k in range(2))
    volume = metric_figures(
        chart, np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)
    ).volume
    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.add_subplot()
    limits = np.quantile(volume, [0.005, 0.995])
    image = axes.pcolormesh(
        first, second, volume.T, norm=LogNorm(*limits), cmap="viridis", rasterized=True
    )
    inside = ((data >= [first[0], second[0]]) & (data <= [first[-1], second[-1]])).all(axis=1)
    _dots(axes, data[inside][:2500], s=1.2, color="white", alpha=0.55, linewidths=0)
    axes.set(xlabel="z₁", ylabel="z₂")
    _colour_bar(figure, image, axes, "√det M(z)   [rad²]")
    return _tidied(figure)


def submanifolds_in_plane(
    panels: Mapping[str, GridSubmanifold], in_degrees: Mapping[str, bool]
) -> Figure:
    """Fig. 4b: the inclusion map ι of each constraint over the latent plane, and the components
    where it is kept.

    panels: by the constraint's name.  in_degrees: whether ι holds angles alone, so that it can be
    shown in degrees.
    """
    figure = Figure(figsize=(4.6 * len(panels), 4.6), layout="constrained")
    for axes, (name, plane) in zip(_row_of_axes(figure, len(panels)), panels.items(), strict=True):
        scale, unit = (180 / np.pi, "°") if in_degrees[name] else (1.0, "rad or m")
        image = axes.pcolormesh(
            plane.first_axis,
            plane.second_axis,
            scale * plane.inclusion.T,
            cmap=NEAR,
            vmin=0,
            rasterized=True,
        )
        _draw_components(axes, plane)
        count, share = plane.labels.max() + 1, (plane.labels >= 0).mean()
        axes.set_title(f"{name}: {count} {_plural('component', count)}, {share:.1%} of the plane")
        axes.set(xlabel="z₁", ylabel="z₂")
        _colour_bar(figure, image, axes, f"ι(z)   [{unit}]")
    return _tidied(figure)


def geodesics_in_plane(panels: Mapping[str, tuple[GridSubmanifold, LatentCurves]]) -> Figure:
    """Fig. 4c: the geodesic that each seed found for one query, and the straight line, on the
    sub-manifold.
    """
    figure = Figure(figsize=(4.6 * len(panels), 4.6), layout="constrained")
    for axes, (name, (plane, curves)) in zip(
        _row_of_axes(figure, len(panels)), panels.items(), strict=True
    ):
        axes.pcolormesh(
            plane.first_axis,
            plane.second_axis,
            plane.inclusion.T,
            cmap=NEAR,
            vmin=0,
            rasterized=True,
        )
        _draw_components(axes, plane)
        style = PLANNERS["straight_latent_line"]
        axes.plot(
            *curves.straight.T,
            color=style.colour,
            linestyle="--",
            linewidth=1.6,
            label=style.label,
            zorder=3,
        )
        for k, curve in enumerate(curves.learned):
            label = "learned geodesic, one a seed" if k == 0 else None
            axes.plot(
                *curve.T, color=PLANNERS["learned_geodesic"].colour, linewidth=2.0, label=label
            )
        _draw_ends(axes, curves.straight[0], curves.straight[-1])
        count = len(curves.learned)
        axes.set_title(f"{name}: {count} {_plural('geodesic', count)} found")
        axes.set(xlabel="z₁", ylabel="z₂")
        axes.set(xlim=plane.first_axis[[0, -1]], ylim=plane.second_axis[[0, -1]])
        _legend(axes, loc="best")
    return _tidied(figure)


def components_in_principal_axes(
    panels: Mapping[str, GraphSubmanifold], data: Float[np.ndarray, "n N"]
) -> Figure:
    """The graph of each constraint's sub-manifold, its components in colours, over the encoded data
    in grey.

    All panels show the same plane, the first two principal axes of `data`: one learned manifold,
    many constraints.
    """
    centre = data.mean(axis=0)
    axes_of_data = np.linalg.svd(data - centre, full_matrices=False)[2][:2]
    axes_of_data *= np.sign(axes_of_data[range(2), np.abs(axes_of_data).argmax(axis=1)])[:, None]
    background = (data - centre) @ axes_of_data.T
    figure, grid = _panels(len(panels), (3.0, 2.6))
    for axes, (name, graph) in zip(grid, panels.items(), strict=True):
        nodes = (graph.latent - centre) @ axes_of_data.T
        _dots(axes, background, s=1.5, color=LIGHT, linewidths=0)
        edges = nodes[graph.edges[:: max(len(graph.edges) // 700, 1)]]
        axes.add_collection(
            LineCollection(list(edges), colors="#B9B9B9", linewidths=0.25, alpha=0.6)
        )
        order = np.argsort(graph.labels, kind="stable")
        _dots(
            axes,
            nodes[order],
            s=3,
            c=_component_colours(graph.labels[order]),
            linewidths=0,
            zorder=3,
        )
        count = len(np.unique(graph.labels))
        axes.set_title(f"{name}: {count} {_plural('component', count)}")
        axes.set_axis_off()
    return _tidied(figure)


@dataclass(frozen=True)
class MetricFigures:
    """Of a metric M = JμᵀJμ + JσᵀJσ at points (*batch): √det M, tr M, and the part of tr M that σ
    adds.
    """

    volume: Float[np.ndarray, "*batch"]
    trace: Float[np.ndarray, "*batch"]
    deviation_trace: Float[np.ndarray, "*batch"]


def metric_figures(
    chart: LearnedManifold, z: Float[np.ndarray, "*batch N"], piece: int = 2048
) -> MetricFigures:
    """The metric of a learned manifold in figures [rad² for the traces, rad^N for the volume]."""
    parts = []
    for points in chart.tensor(z).reshape(-1, chart.dim).split(piece):
        eigenvalues = torch.linalg.eigvalsh(chart.metric(points).double()).clamp_min(0)
        deviation = pullback_metric(chart.vae.deviation, points).double().diagonal(dim1=-2, dim2=-1)
        parts.append(
            torch.stack([eigenvalues.prod(-1).sqrt(), eigenvalues.sum(-1), deviation.sum(-1)])
        )
    volume, trace, deviation_trace = torch.cat(parts, dim=-1).numpy().reshape(3, *z.shape[:-1])
    return MetricFigures(volume, trace, deviation_trace)


@dataclass(frozen=True)
class MetricGrowth:
    """tr M along rays out of the data [rad²]: whole and the part of σ (steps, rays), and the
    largest on the data.

    distance: (steps,) in radii that hold 95 % of the data.
    """

    latent_dim: int
    distance: Float[np.ndarray, "steps"]
    trace: Float[np.ndarray, "steps rays"]
    deviation_trace: Float[np.ndarray, "steps rays"]
    largest_on_data: float


def follow_rays(chart: LearnedManifold, data: Float[np.ndarray, "n N"]) -> MetricGrowth:
    """The metric from the middle of the encoded training configurations `data` to far beyond
    them.
    """
    centre = data.mean(axis=0)
    radius = np.quantile(np.linalg.norm(data - centre, axis=1), 0.95)
    directions = np.random.default_rng(0).normal(size=(RAYS, chart.dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = np.linspace(0.0, RAY_REACH, RAY_STEPS)
    along = metric_figures(chart, centre + radius * distance[:, None, None] * directions)
    largest = float(metric_figures(chart, data[:2000]).trace.max())
    return MetricGrowth(chart.dim, distance, along.trace, along.deviation_trace, largest)


def metric_growth(growths: Mapping[str, MetricGrowth]) -> Figure:
    """Trace of each manifold's metric along rays: bounded on the data, growing away from it."""
    figure = Figure(figsize=(4.4 * len(growths), 3.6), layout="constrained")
    for axes, (name, growth) in zip(
        _row_of_axes(figure, len(growths)), growths.items(), strict=True
    ):
        distance, largest = growth.distance, growth.largest_on_data
        axes.axvspan(0, 1, color=LIGHT, linewidth=0)
        axes.text(
            0.5,
            0.02,
            "95 % of the data",
            transform=axes.get_xaxis_transform(),
            ha="center",
            fontsize=8,
        )
        low, high = np.quantile(growth.trace, [0.05, 0.95], axis=1)
        axes.fill_between(distance, low, high, color=SKY, alpha=0.45, linewidth=0)
        axes.plot(
            distance, np.median(growth.trace, axis=1), color=BLUE, label="tr M, median and 5–95 %"
        )
        deviation = np.median(growth.deviation_trace, axis=1)
        axes.plot(distance, deviation, color=VERMILION, linestyle="--", label="part of σ, median")
        axes.axhline(
            largest, color=BLACK, linewidth=0.8, linestyle=":", label="largest on the data"
        )
        axes.set(yscale="log", ylim=(largest * 1e-4, None), xlim=(0, distance[-1]))
        axes.set(
            xlabel="distance from the centre [radius of 95 % of the data]",
            ylabel="trace of the metric [rad²]",
        )
        axes.set_title(f"{name}, N = {growth.latent_dim}")
        _legend(axes, loc="lower right", bbox_to_anchor=(1.0, 0.06))
    return _tidied(figure)


def training_curves(histories: Mapping[str, pd.DataFrame]) -> Figure:
    """Loss of each manifold's two phases, mean and variance, on training and held-out
    configurations.

    histories: columns epoch, and loss and held_out_loss under each phase's name; empty where the
    other phase ran.
    """
    figure, grid = _panels(2 * len(histories), (3.2, 2.2), columns=2)
    panels = [
        (name, history, phase)
        for name, history in histories.items()
        for phase in ("mean", "variance")
    ]
    for axes, (name, history, phase) in zip(grid, panels, strict=True):
        columns = ["epoch", f"{phase}_loss", f"{phase}_held_out_loss"]
        # a phase of one epoch has no training loss yet when its row is written
        ran = history.reindex(columns=columns).dropna(subset=columns[2:])
        axes.plot(ran["epoch"], ran[f"{phase}_loss"], color=GREY, linewidth=1.0, label="training")
        axes.plot(ran["epoch"], ran[f"{phase}_held_out_loss"], color=BLUE, label="held out")
        axes.set(xlabel="epoch", ylabel="loss")
        axes.set_title(f"{name}, {phase}")
        _legend(axes, loc="upper right")
    return _tidied(figure)


def learning_curves(panels: Mapping[str, Mapping[str, pd.DataFrame]]) -> Figure:
    """How much shorter than the straight line a policy's best curve is while it learns, over its
    seeds.

    panels: constraint → manifold → table with seed, steps and saving (a share of the cost).
    """
    figure, grid = _panels(len(panels), (3.0, 2.3), share=True)
    names = dict.fromkeys(name for tables in panels.values() for name in tables)
    colours = dict(zip(names, (ORANGE, VERMILION), strict=False))
    for axes, (constraint, tables) in zip(grid, panels.items(), strict=True):
        for name, table in tables.items():
            saving = table.pivot_table(index="steps", columns="seed", values="saving")
            mean, spread = saving.mean(axis=1), saving.std(axis=1, ddof=0)
            colour = colours.get(name, GREY)
            axes.fill_between(
                saving.index, mean - spread, mean + spread, color=colour, alpha=0.25, linewidth=0
            )
            axes.plot(saving.index, mean, color=colour, label=f"{name}, {saving.shape[1]} seeds")
        axes.set_title(constraint)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
        _legend(axes, loc="lower right")
    figure.supxlabel("environment steps", fontsize=9)
    figure.supylabel("cost saved against the straight line", fontsize=9)
    return _tidied(figure)


RULES = {
    "chords": ("chords", GREY, "s"),
    "gauss_legendre": ("Gauss-Legendre on J γ̇", BLUE, "^"),
    "collocation": ("collocation (the default)", ORANGE, "o"),
}
"""Rules of a curve's length: label, colour and marker."""

VARIANTS = {
    "corrected_reward": ("corrected reward, cubic", ORANGE),
    "printed_reward": ("reward as printed", BLUE),
    "spline_2": ("2 segments", SKY),
    "spline_4": ("4 segments", PURPLE),
}
"""Variants of policy search where the answer is known: label and colour; others are grey."""


def length_rules(table: pd.DataFrame, tolerance: float) -> Figure:
    """Error of a curve's length against what it costs, for every rule: 95th percentile, and up to
    the worst curve.

    table: rows of `quadrature_rows`.  tolerance: the error that is asked for by default.
    """
    figure = Figure(figsize=(6.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for rule, (label, colour, marker) in RULES.items():
        rows = table[table["rule"] == rule].sort_values("points")
        axes.plot(
            rows["microseconds"],
            rows["error_p95"],
            color=colour,
            marker=marker,
            markersize=4,
            label=label,
        )
        axes.fill_between(
            rows["microseconds"],
            rows["error_p95"],
            rows["error_max"],
            color=colour,
            alpha=0.15,
            linewidth=0,
        )
    axes.axhline(tolerance, color=BLACK, linewidth=0.8, linestyle=":")
    axes.text(
        0.01,
        tolerance * 1.15,
        "default tolerance",
        fontsize=8,
        transform=axes.get_yaxis_transform(),
    )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="cost of a curve [µs]",
        ylabel="relative error, p95 to worst",
    )
    _legend(axes, loc="lower left")
    return _tidied(figure)


def ablation(
    searched: Mapping[str, Mapping[str, Sequence[float]]],
    reached: Mapping[str, Mapping[str, float]],
    metrics: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> Figure:
    """What each choice is worth: excess length of policy search and of each curve family, and the
    variance term.

    searched: manifold → variant → ratio of every seed.  reached: manifold → family → ratio of its
    best curves.
    metrics: learned manifold → variant → figures of its geodesics.
    """
    figure = Figure(figsize=(9.6, 3.5), layout="constrained")
    search, reach, variance = _row_of_axes(figure, 3)
    _draw_searched(search, searched)
    families = list(dict.fromkeys(name for ratios in reached.values() for name in ratios))
    for k, family in enumerate(families):
        excess = [max(ratios.get(family, np.nan) - 1, 1e-8) for ratios in reached.values()]
        x = np.arange(len(reached)) + 0.8 * ((k + 0.5) / len(families) - 0.5)
        colour = VARIANTS.get(family, ("", ORANGE))[1]
        reach.bar(
            x,
            excess,
            width=0.7 / len(families),
            color=colour,
            label=family.replace("spline_", "segments: "),
        )
    reach.set(yscale="log", ylabel="best curve / exact − 1")
    reach.set_ylim(1e-8, 30 * reach.get_ylim()[1])  # room for the legend
    reach.set_xticks(range(len(reached)), list(reached))
    reach.set_title("what a family can reach")
    _legend(reach, loc="upper left")
    _draw_variance(variance, metrics)
    return _tidied(figure)


def _draw_searched(axes: Axes, searched: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    variants = list(dict.fromkeys(name for ratios in searched.values() for name in ratios))
    for k, variant in enumerate(variants):
        label, colour = VARIANTS.get(variant, (variant.replace("_", " "), GREY))
        for place, ratios in enumerate(searched.values()):
            values = np.maximum(np.array(ratios.get(variant, [])) - 1, 1e-6)
            x = place + 0.8 * ((k + 0.5) / len(variants) - 0.5)
            axes.scatter(
                np.full(len(values), x),
                values,
                s=12,
                color=colour,
                label=label if place == 0 else None,
            )
    axes.axhline(0.01, color=BLACK, linewidth=0.8, linestyle=":")
    axes.set(yscale="log", ylabel="learned path / exact − 1")
    axes.set_xticks(range(len(searched)), list(searched))
    axes.set_title("policy search, one mark a seed")
    _legend(axes, loc="lower right")


def _draw_variance(axes: Axes, metrics: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    shown = {
        "with_variance": ("with", ORANGE),
        "without_variance": ("without", BLUE),
        "straight_latent_line": ("line", PLANNERS["straight_latent_line"].colour),
    }
    for k, (variant, (label, colour)) in enumerate(shown.items()):
        x = np.arange(len(metrics)) + 0.8 * ((k + 0.5) / len(shown) - 0.5)
        share = [figures[variant]["collision_free"] for figures in metrics.values()]
        bars = axes.bar(x, [value or 0.0 for value in share], width=0.24, color=colour, label=label)
        axes.bar_label(
            bars, ["none" if value is None else f"{value:.0%}" for value in share], fontsize=7
        )
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set(ylim=(0, 1), ylabel="geodesics free of collision")
    axes.set_xticks(range(len(metrics)), list(metrics))
    axes.set_title("variance term of eq. 5")
    _legend(axes, loc="upper left", ncols=3)


def planner_comparison(table: pd.DataFrame) -> Figure:
    """Success, length over the shortest known, and time of every planner under every constraint.

    table: rows of `summarise` with a column `constraint`.  Points are medians, lines reach to the
    95th percentile.
    """
    constraints, planners = list(dict.fromkeys(table["constraint"])), _ordered(table["planner"])
    figure = Figure(figsize=(8.6, 0.8 + 0.72 * len(constraints)), layout="constrained")
    success, length, time = (figure.add_subplot(1, 3, k + 1) for k in range(3))
    for k, planner in enumerate(planners):
        rows = table[table["planner"] == planner].set_index("constraint").reindex(constraints)
        y = np.arange(len(constraints)) + 0.78 * (k / max(len(planners) - 1, 1) - 0.5)
        style = PLANNERS[planner]
        success.barh(y, rows["success"], height=0.13, color=style.colour, label=style.label)
        _median_to_p95(length, y, rows["over_best_median"], rows["over_best_p95"], style)
        _median_to_p95(time, y, rows["time_median_s"], rows["time_p95_s"], style)
    success.set(xlim=(0, 1), xlabel="valid paths")
    success.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    length.set(xlabel="joint length / shortest known", xscale="log", xlim=(0.97, None))
    length.set_xticks([1, 1.5, 2, 3, 4], ["1", "1.5", "2", "3", "4"], minor=False)
    length.set_xticks([], minor=True)
    length.axvline(1.0, color=BLACK, linewidth=0.8, linestyle=":", zorder=0)
    time.set(xlabel="time [s]", xscale="log")
    for axes in (success, length, time):
        axes.set(
            ylim=(len(constraints) - 0.5, -0.5), yticks=range(len(constraints)), yticklabels=[]
        )
        axes.grid(axis="x", color=LIGHT, linewidth=0.6)
        axes.set_axisbelow(True)
        for edge in range(1, len(constraints)):
            axes.axhline(edge - 0.5, color=LIGHT, linewidth=0.8)
    success.set_yticklabels(constraints)
    figure.legend(
        *success.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=6,
        fontsize=8,
        frameon=False,
    )
    return _tidied(figure)


def data_histograms(card: Mapping[str, Any], units: Callable[[str], str]) -> Figure:
    """Histograms of one constraint's set, from its data card.  units: the unit of a column."""
    histograms = {
        name: entry
        for name, entry in card["histograms"].items()
        if not name.startswith("quaternion")
    }
    figure, grid = _panels(len(histograms), (1.75, 1.25), columns=5)
    for axes, (name, entry) in zip(grid, histograms.items(), strict=True):
        edges = np.linspace(entry["first"], entry["last"], len(entry["counts"]) + 1)
        if edges[-1] - edges[0] > 1e-5:
            axes.stairs(entry["counts"], edges, fill=True, color=BLUE)
        else:
            axes.axvline(0.0, color=BLUE, linewidth=3)
            axes.set(
                xlim=(-1, 1),
                xticks=[0],
                xticklabels=[f"{edges[0]:.4g}" if abs(edges[0]) > 1e-5 else "0"],
            )
            axes.text(0.2, 0.5, "held", fontsize=8, transform=axes.get_yaxis_transform())
        axes.set_title(f"{name} [{units(name)}]")
        axes.set(yticks=[])
    return _tidied(figure)


def _surface_row(
    figure: Figure,
    row: int,
    held: LevelSet,
    lines: tuple[np.ndarray, np.ndarray],
    function: Callable[[torch.Tensor], torch.Tensor],
    name: str,
) -> None:
    """A surface coloured by a function of the chart, and beside it the components of a level set,
    as in the paper: one sign of the level on the sphere, both on the torus.

    lines: of the chart's grid, along both axes.
    """
    corners = held.manifold.embed(_on_grid(lines)).numpy()
    middles = _on_grid([(line[1:] + line[:-1]) / 2 for line in lines])
    values, labels = function(middles).numpy(), held.component_of(middles).numpy()
    count, level = len(held.components()), abs(held.levels[0])
    shown = ScalarMappable(cmap="viridis")
    shown.set_array(np.degrees(values))
    left = _surface(figure, 2 * row + 1, corners, shown.to_rgba(np.degrees(values)))
    right = _surface(figure, 2 * row + 2, corners, _component_colours(labels))
    left.set_title(f"{name} [°]")
    figure.colorbar(shown, ax=left, shrink=0.7, location="left").ax.tick_params(labelsize=8)
    sign = "±" if len(held.levels) > 1 else ""
    right.set_title(
        f"{name} = {sign}{np.degrees(level):.0f}°: {count} {_plural('component', count)}"
    )


def _on_grid(lines: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1))


def _surface(figure: Figure, place: int, corners: np.ndarray, faces: np.ndarray) -> Axes3D:
    axes = figure.add_subplot(2, 2, place, projection="3d")
    assert isinstance(axes, Axes3D)
    x, y, z = np.moveaxis(corners, -1, 0)
    lit = np.concatenate([faces[..., :3] * _light(corners)[..., None], faces[..., 3:]], axis=-1)
    axes.plot_surface(
        x, y, z, facecolors=lit, rstride=1, cstride=1, linewidth=0, antialiased=False, shade=False
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    axes.set(
        xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), proj_type="ortho"
    )
    axes.set_box_aspect(high - low, zoom=1.35)
    axes.view_init(*np.degrees(VIEW))
    axes.set_axis_off()
    return axes


def _light(corners: Float[np.ndarray, "n m 3"]) -> Float[np.ndarray, "n-1 m-1"]:
    """Brightness of each face, 1 where it looks at the viewer; weak, so that colours still match
    their bar.
    """
    normals = np.cross(corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    elevation, azimuth = VIEW
    ring = np.cos(elevation)
    viewer = np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), np.sin(elevation)])
    return 0.65 + 0.35 * np.abs(normals @ viewer)


def _component_colours(labels: Int[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape 4"]:
    """Largest components in colours of their own, the rest in one, outside light."""
    palette = to_rgba_array([*COMPONENTS, REST, LIGHT])
    place = np.where(labels < 0, len(COMPONENTS) + 1, np.minimum(labels, len(COMPONENTS)))
    return palette[place]


def _draw_components(axes: Axes, plane: GridSubmanifold) -> None:
    colours = _component_colours(plane.labels)
    colours[plane.labels < 0] = 0.0
    first, second = plane.first_axis, plane.second_axis
    axes.pcolormesh(first, second, colours.transpose(1, 0, 2), rasterized=True)


def _draw_ends(axes: Axes, start: np.ndarray, goal: np.ndarray) -> None:
    for name, point, colour, marker in (("start", start, START, "o"), ("goal", goal, GOAL, "*")):
        size = 70 if marker == "o" else 150
        _dots(
            axes,
            point[None],
            s=size,
            color=colour,
            edgecolors="white",
            marker=marker,
            label=name,
            zorder=5,
        )


def _dots(axes: Axes, points: Float[np.ndarray, "n 2"], **style: Any) -> None:
    axes.scatter(points[:, 0], points[:, 1], **style)


def _median_to_p95(
    axes: Axes, y: np.ndarray, median: pd.Series, p95: pd.Series, style: PlannerStyle
) -> None:
    axes.hlines(y, median, p95, color=style.colour, linewidth=2.0)
    axes.scatter(
        median,
        y,
        s=22,
        color=style.colour,
        marker=style.marker,
        edgecolors="white",
        linewidths=0.4,
        zorder=3,
    )


def _panels(
    count: int, size: tuple[float, float], columns: int = 3, share: bool = False
) -> tuple[Figure, list[Axes]]:
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share).ravel()
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, list(grid[:count])


def _row_of_axes(figure: Figure, count: int) -> list[Axes]:
    return [figure.add_subplot(1, count, k + 1) for k in range(count)]


def _colour_bar(figure: Figure, image: QuadMesh, axes: Axes, label: str) -> None:
    figure.colorbar(image, ax=axes, pad=0.02).set_label(label, fontsize=9)


def _legend(axes: Axes, **where: Any) -> None:
    axes.legend(fontsize=7.5, framealpha=0.85, edgecolor="none", **where)


def _tidied(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.tick_params(labelsize=8)
        axes.title.set_fontsize(9.5)
        axes.xaxis.label.set_fontsize(9)
        axes.yaxis.label.set_fontsize(9)
        if not isinstance(axes, Axes3D):
            axes.spines[["top", "right"]].set_visible(False)
    return figure


def _ordered(planners: pd.Series) -> list[str]:
    present = set(planners)
    return [name for name in PLANNERS if name in present]


def _plural(noun: str, count: int) -> str:
    return noun if count == 1 else noun + "s"
