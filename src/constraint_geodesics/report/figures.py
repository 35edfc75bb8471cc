"""The figures of a run: arrays and tables in, matplotlib figures out, and small PNG files that are
the same each time.

Every figure is built on `Figure` itself, so that nothing depends on a global state or a screen.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

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
from constraint_geodesics.palette import (
    BLACK,
    BLUE,
    GOAL,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    SKY,
    START,
    VERMILION,
    YELLOW,
    planner_colour,
)
from constraint_geodesics.recording.recorder import principal_plane

COMPONENTS = (SKY, PURPLE, BLUE, YELLOW, GREEN)
"""Colours of a sub-manifold's components, the largest first; the smaller ones share REST."""
REST = "#6B6B6B"
NEAR = LinearSegmentedColormap.from_list("near", ["#9AA3AB", "#FFFFFF"])
REFERENCE: dict[str, Any] = {"color": BLACK, "lw": 0.8, "ls": ":"}
"""Of a line that values are compared with."""
SHARE = PercentFormatter(1.0, decimals=0)

ELEVATION, TUBE_ANGLE, HALF_WIDTH = np.pi / 6, np.pi / 6, np.radians(4.0)
"""Fig. 2: the level sets on the sphere and the torus, held within a tolerance [rad]."""

VIEW = (np.radians(24.0), np.radians(-58.0))
"""Elevation and azimuth of Fig. 2 [rad]: both circles of the torus must show."""

RAYS, RAY_REACH, RAY_STEPS = 64, 4.0, 65
"""Directions, reach in data radii and points of the rays that a metric is followed along."""


class PlannerStyle(NamedTuple):
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


class LatentCurves(NamedTuple):
    """Curves of one query in a latent plane, one a seed (S, T, 2), and the straight line (T, 2)."""

    learned: Float[np.ndarray, "S T 2"]
    straight: Float[np.ndarray, "T 2"]


def analytic_submanifolds() -> Figure:
    """Fig. 2: the sphere with a level set of elevation, the torus with one of the tube's angle."""
    sphere, torus = Sphere(), Torus()
    around, along = np.linspace(-np.pi, np.pi, 121), np.linspace(-np.pi / 2, np.pi / 2, 61)
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    elevation = LevelSet(sphere, 0, (ELEVATION,), HALF_WIDTH)
    tube_angle = LevelSet(torus, 1, (TUBE_ANGLE, -TUBE_ANGLE), HALF_WIDTH)
    ball = _Surface(elevation, (along, around), sphere.elevation, "sphere, elevation")
    ring = _Surface(tube_angle, (around, around), torus.tube_angle, "torus, tube angle")
    for row, surface in enumerate((ball, ring)):
        _surface_row(figure, row, surface)
    return _tidied(figure)


def plane_search(sampled: Float[np.ndarray, "n T 2"], learned: Float[np.ndarray, "T 2"]) -> Figure:
    """Fig. 3: curves met by policy search in the plane, the learned one, and the exact line."""
    figure, axes = _single(6.0, 4.2)
    _strips(axes, sampled, colors=GREY, linewidths=0.6, alpha=0.4, label="sampled paths")
    ends = learned[[0, -1]]
    axes.plot(*ends.T, color=BLACK, ls="--", lw=1.2, label="exact geodesic", zorder=4)
    axes.plot(*learned.T, color=ORANGE, lw=2.6, label="learned path", zorder=3)
    _draw_ends(axes, *ends)
    axes.set(xlabel="x", ylabel="y", aspect="equal")
    axes.autoscale_view()
    _legend(axes, loc="best")
    return _tidied(figure)


def latent_metric(
    learned: LearnedManifold, data: Float[np.ndarray, "n 2"], points: int = 140
) -> Figure:
    """Fig. 4a: volume √det M of the metric over the latent plane (log colours), and the encoded
    data.

    data: latent coordinates of configurations that the manifold was trained on.  points: a side of
    the grid.
    """
    low, high = np.quantile(data, [0.002, 0.998], axis=0)
    margin = 0.2 * (high - low)
    first, second = np.linspace(low - margin, high + margin, points, axis=1)
    grid = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)
    volume = metric_figures(learned, grid).volume
    figure, axes = _single(6.4, 4.8)
    norm = LogNorm(*np.quantile(volume, [0.005, 0.995]))
    image = axes.pcolormesh(first, second, volume.T, norm=norm, cmap="viridis", rasterized=True)
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
    figure, grid = _panels(len(panels), (4.6, 4.6), columns=len(panels))
    for axes, (name, plane) in zip(grid, panels.items(), strict=True):
        scale, unit = (180 / np.pi, "°") if in_degrees[name] else (1.0, "rad or m")
        image = _draw_plane(axes, plane, scale)
        components = _counted("component", plane.labels.max() + 1)
        share = (plane.labels >= 0).mean()
        axes.set_title(f"{name}: {components}, {share:.1%} of the plane")
        _colour_bar(figure, image, axes, f"ι(z)   [{unit}]")
    return _tidied(figure)


def geodesics_in_plane(panels: Mapping[str, tuple[GridSubmanifold, LatentCurves]]) -> Figure:
    """Fig. 4c: the geodesic of each seed for one query, and the straight line."""
    figure, grid = _panels(len(panels), (4.6, 4.6), columns=len(panels))
    straight, learned = PLANNERS["straight_latent_line"], PLANNERS["learned_geodesic"]
    for axes, (name, (plane, curves)) in zip(grid, panels.items(), strict=True):
        _draw_plane(axes, plane)
        line: Any = {"color": straight.colour, "ls": "--", "lw": 1.6, "label": straight.label}
        axes.plot(*curves.straight.T, **line, zorder=3)
        for k, curve in enumerate(curves.learned):
            label = "learned geodesic, one a seed" if k == 0 else None
            axes.plot(*curve.T, color=learned.colour, lw=2.0, label=label)
        _draw_ends(axes, *curves.straight[[0, -1]])
        axes.set_title(f"{name}: {_counted('geodesic', len(curves.learned))} found")
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
    centre, principal = principal_plane(data)
    figure, grid = _panels(len(panels), (3.0, 2.6))
    for axes, (name, graph) in zip(grid, panels.items(), strict=True):
        nodes = (graph.latent - centre) @ principal.T
        _dots(axes, (data - centre) @ principal.T, s=1.5, color=LIGHT, linewidths=0)
        edges = nodes[graph.edges[:: max(len(graph.edges) // 700, 1)]]
        _strips(axes, edges, colors="#B9B9B9", linewidths=0.25, alpha=0.6)
        order = np.argsort(graph.labels, kind="stable")
        colours = _component_colours(graph.labels[order])
        _dots(axes, nodes[order], s=3, c=colours, linewidths=0, zorder=3)
        axes.set_title(f"{name}: {_counted('component', len(np.unique(graph.labels)))}")
        axes.set_axis_off()
    return _tidied(figure)


class MetricFigures(NamedTuple):
    """Of M = JμᵀJμ + JσᵀJσ at points (*batch): √det M, tr M, and the part of tr M from σ."""

    volume: Float[np.ndarray, "*batch"]
    trace: Float[np.ndarray, "*batch"]
    deviation_trace: Float[np.ndarray, "*batch"]


def metric_figures(
    learned: LearnedManifold, z: Float[np.ndarray, "*batch N"], piece: int = 2048
) -> MetricFigures:
    """The metric of a learned manifold in figures [rad² for the traces, rad^N for the volume]."""
    parts = []
    for points in learned.tensor(z).reshape(-1, learned.dim).split(piece):
        eigenvalues = torch.linalg.eigvalsh(learned.metric(points).double()).clamp_min(0)
        deviation = (
            pullback_metric(learned.vae.deviation, points).double().diagonal(dim1=-2, dim2=-1)
        )
        own = (eigenvalues.prod(-1).sqrt(), eigenvalues.sum(-1), deviation.sum(-1))
        parts.append(torch.stack(own))
    return MetricFigures(*torch.cat(parts, dim=-1).numpy().reshape(3, *z.shape[:-1]))


class MetricGrowth(NamedTuple):
    """tr M along rays out of the data [rad²]: whole and the part of σ (steps, rays), and the
    largest on the data.

    distance: (steps,) in radii that hold 95 % of the data.
    """

    latent_dim: int
    distance: Float[np.ndarray, "steps"]
    trace: Float[np.ndarray, "steps rays"]
    deviation_trace: Float[np.ndarray, "steps rays"]
    largest_on_data: float


def follow_rays(learned: LearnedManifold, data: Float[np.ndarray, "n N"]) -> MetricGrowth:
    """The metric from the middle of the encoded configurations `data` to far beyond them."""
    centre = data.mean(axis=0)
    radius = np.quantile(np.linalg.norm(data - centre, axis=1), 0.95)
    directions = np.random.default_rng(0).normal(size=(RAYS, learned.dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = np.linspace(0.0, RAY_REACH, RAY_STEPS)
    along = metric_figures(learned, centre + radius * distance[:, None, None] * directions)
    largest = float(metric_figures(learned, data[:2000]).trace.max())
    return MetricGrowth(learned.dim, distance, along.trace, along.deviation_trace, largest)


def metric_growth(growths: Mapping[str, MetricGrowth]) -> Figure:
    """Trace of each manifold's metric along rays: bounded on the data, growing away from it."""
    figure, grid = _panels(len(growths), (4.4, 3.6), columns=len(growths))
    for axes, (name, growth) in zip(grid, growths.items(), strict=True):
        distance, largest = growth.distance, growth.largest_on_data
        axes.axvspan(0, 1, color=LIGHT, lw=0)
        middle: Any = {"transform": axes.get_xaxis_transform(), "ha": "center"}
        axes.text(0.5, 0.02, "95 % of the data", fontsize=8, **middle)
        low, median, high = np.quantile(growth.trace, [0.05, 0.5, 0.95], axis=1)
        _fill(axes, (distance, low, high), SKY, 0.45)
        axes.plot(distance, median, color=BLUE, label="tr M, median and 5–95 %")
        deviation = np.median(growth.deviation_trace, axis=1)
        axes.plot(distance, deviation, color=VERMILION, ls="--", label="part of σ, median")
        axes.axhline(largest, **REFERENCE, label="largest on the data")
        axes.set(yscale="log", ylim=(largest * 1e-4, None), xlim=(0, distance[-1]))
        axes.set_xlabel("distance from the centre [radius of 95 % of the data]")
        axes.set_ylabel("trace of the metric [rad²]")
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
    panels = product(histories.items(), ("mean", "variance"))
    for axes, ((name, history), phase) in zip(grid, panels, strict=True):
        columns = ["epoch", f"{phase}_loss", f"{phase}_held_out_loss"]
        # a phase of one epoch has no training loss yet when its row is written
        ran = history.reindex(columns=columns).dropna(subset=columns[2:])
        epoch, training, held_out = (ran[column] for column in columns)
        axes.plot(epoch, training, color=GREY, lw=1.0, label="training")
        axes.plot(epoch, held_out, color=BLUE, label="held out")
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
            _fill(axes, (saving.index, mean - spread, mean + spread), colour)
            axes.plot(saving.index, mean, color=colour, label=f"{name}, {saving.shape[1]} seeds")
        axes.set_title(constraint)
        axes.yaxis.set_major_formatter(SHARE)
        axes.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:g}k")
        _legend(axes, loc="lower right")
    figure.supxlabel("environment steps", fontsize=9)
    figure.supylabel("cost saved against the straight line", fontsize=9)
    return _tidied(figure)


def length_rules(table: pd.DataFrame, tolerance: float) -> Figure:
    """Error of a curve's length against what it costs, for every rule: 95th percentile, and up to
    the worst curve.

    table: rows of `quadrature_rows`.  tolerance: the error that is asked for by default.
    """
    figure, axes = _single(6.2, 4.0)
    for rule, (label, colour, marker) in RULES.items():
        rows = table[table["rule"] == rule].sort_values("points")
        cost, usual, worst = (rows[name] for name in ("microseconds", "error_p95", "error_max"))
        axes.plot(cost, usual, color=colour, marker=marker, markersize=4, label=label)
        _fill(axes, (cost, usual, worst), colour, 0.15)
    axes.axhline(tolerance, **REFERENCE)
    left: Any = {"fontsize": 8, "transform": axes.get_yaxis_transform()}
    axes.text(0.01, tolerance * 1.15, "default tolerance", **left)
    axes.set(xscale="log", yscale="log", xlabel="cost of a curve [µs]")
    axes.set_ylabel("relative error, p95 to worst")
    _legend(axes, loc="lower left")
    return _tidied(figure)


def charts(panels: Mapping[str, Mapping[str, Sequence[tuple[int, float, float, float]]]]) -> Figure:
    """Two figures of a search against the chart's dimension, a line for what it is learned from.

    panels: "solved" and "ratio_p95" → data → dimension, mean, least and largest.  What has one
    dimension alone is drawn across.
    """
    figure, axes = _panels(2, (3.6, 3.2))
    titles = {"solved": "solved", "ratio_p95": "length over the shortest, p95"}
    for panel, (name, found) in zip(axes, panels.items(), strict=True):
        for (data, rows), colour in zip(found.items(), (GREY, BLUE, ORANGE), strict=False):
            dim, mean, least, largest = np.array(rows, float).T
            if len(dim) == 1:
                panel.axvline(dim[0], **REFERENCE)
                panel.axhline(mean[0], color=colour, lw=1.6, label=data)
                continue
            panel.plot(dim, mean, color=colour, marker="o", markersize=4, label=f"{data} data")
            panel.fill_between(dim, least, largest, color=colour, alpha=0.15, lw=0)
            panel.set_xticks(dim)
        panel.set(xlabel="latent dimensions", title=titles[name])
    axes[0].yaxis.set_major_formatter(SHARE)
    _legend(axes[0], loc="lower right")
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
    figure, (search, reach, variance) = _panels(3, (3.2, 3.5))
    _draw_searched(search, searched)
    families = list(dict.fromkeys(name for ratios in reached.values() for name in ratios))
    for k, family in enumerate(families):
        excess = [max(ratios.get(family, np.nan) - 1, 1e-8) for ratios in reached.values()]
        colour, label = (
            VARIANTS.get(family, ("", ORANGE))[1],
            family.replace("spline_", "segments: "),
        )
        x, width = _places(len(reached), k, len(families)), 0.7 / len(families)
        reach.bar(x, excess, width=width, color=colour, label=label)
    reach.set(yscale="log", ylabel="best curve / exact − 1")
    reach.set_ylim(1e-8, 30 * reach.get_ylim()[1])  # room for the legend
    reach.set_xticks(range(len(reached)), list(reached))
    reach.set_title("what a family can reach")
    _legend(reach, loc="upper left")
    _draw_variance(variance, metrics)
    return _tidied(figure)


def _places(groups: int, k: int, count: int) -> Float[np.ndarray, "groups"]:
    """Of the k-th of `count` marks in every group."""
    return np.arange(groups) + 0.8 * ((k + 0.5) / count - 0.5)


def _draw_searched(axes: Axes, searched: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    variants = list(dict.fromkeys(name for ratios in searched.values() for name in ratios))
    for k, variant in enumerate(variants):
        label, colour = VARIANTS.get(variant, (variant.replace("_", " "), GREY))
        places = _places(len(searched), k, len(variants))
        for x, ratios in zip(places, searched.values(), strict=True):
            values = np.maximum(np.array(ratios.get(variant, [])) - 1, 1e-6)
            named = label if x == places[0] else None
            axes.scatter(np.full(len(values), x), values, s=12, color=colour, label=named)
    axes.axhline(0.01, **REFERENCE)
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
        share = [figures[variant]["collision_free"] for figures in metrics.values()]
        x, heights = _places(len(metrics), k, len(shown)), [value or 0.0 for value in share]
        bars = axes.bar(x, heights, width=0.24, color=colour, label=label)
        texts = ["none" if value is None else f"{value:.0%}" for value in share]
        axes.bar_label(bars, texts, fontsize=7)
    axes.yaxis.set_major_formatter(SHARE)
    axes.set(ylim=(0, 1), ylabel="geodesics free of collision")
    axes.set_xticks(range(len(metrics)), list(metrics))
    axes.set_title("variance term of eq. 5")
    _legend(axes, loc="upper left", ncols=3)


def planner_comparison(table: pd.DataFrame) -> Figure:
    """Success, length over the shortest known, and time of every planner under every constraint.

    table: rows of `summarise` with a column `constraint`.  Points are medians, lines reach to the
    95th percentile.
    """
    constraints = list(dict.fromkeys(table["constraint"]))
    planners = [name for name in PLANNERS if name in set(table["planner"])]
    figure = Figure(figsize=(8.6, 0.8 + 0.72 * len(constraints)), layout="constrained")
    success, length, time = (figure.add_subplot(1, 3, k + 1) for k in range(3))
    for k, planner in enumerate(planners):
        rows = table[table["planner"] == planner].set_index("constraint").reindex(constraints)
        y = np.arange(len(constraints)) + 0.78 * (k / max(len(planners) - 1, 1) - 0.5)
        style = PLANNERS[planner]
        success.barh(y, rows["success"], height=0.13, color=style.colour, label=style.label)
        for axes, median, p95 in (
            (length, rows["over_best_median"], rows["over_best_p95"]),
            (time, rows["time_median_s"], rows["time_p95_s"]),
        ):
            axes.hlines(y, median, p95, color=style.colour, lw=2.0)
            mark: Any = {"marker": style.marker, "edgecolors": "white", "linewidths": 0.4}
            axes.scatter(median, y, s=22, color=style.colour, zorder=3, **mark)
    success.set(xlim=(0, 1), xlabel="valid paths")
    success.xaxis.set_major_formatter(SHARE)
    length.set(xlabel="joint length / shortest known", xscale="log", xlim=(0.97, None))
    length.set_xticks([1, 1.5, 2, 3, 4], ["1", "1.5", "2", "3", "4"], minor=False)
    length.set_xticks([], minor=True)
    length.axvline(1.0, **REFERENCE, zorder=0)
    time.set(xlabel="time [s]", xscale="log")
    for axes in (success, length, time):
        axes.set(ylim=(len(constraints) - 0.5, -0.5))
        axes.set_yticks(range(len(constraints)), constraints if axes is success else [])
        axes.grid(axis="x", color=LIGHT, lw=0.6)
        axes.set_axisbelow(True)
        for edge in range(1, len(constraints)):
            axes.axhline(edge - 0.5, color=LIGHT, lw=0.8)
    where: Any = {"loc": "outside upper center", "ncols": 6, "fontsize": 8, "frameon": False}
    figure.legend(*success.get_legend_handles_labels(), **where)
    return _tidied(figure)


def data_histograms(histograms: Mapping[str, Any], units: Callable[[str], str]) -> Figure:
    """Histograms of one constraint's set, by its columns.  units: the unit of a column."""
    shown = {n: own for n, own in histograms.items() if not n.startswith("quaternion")}
    figure, grid = _panels(len(shown), (1.75, 1.25), columns=5)
    for axes, (name, entry) in zip(grid, shown.items(), strict=True):
        edges = np.linspace(entry["first"], entry["last"], len(entry["counts"]) + 1)
        if edges[-1] - edges[0] > 1e-5:
            axes.stairs(entry["counts"], edges, fill=True, color=BLUE)
        else:
            axes.axvline(0.0, color=BLUE, lw=3)
            axes.set_xlim(-1, 1)
            axes.set_xticks([0], [f"{edges[0]:.4g}" if abs(edges[0]) > 1e-5 else "0"])
            axes.text(0.2, 0.5, "held", fontsize=8, transform=axes.get_yaxis_transform())
        axes.set_title(f"{name} [{units(name)}]")
        axes.set(yticks=[])
    return _tidied(figure)


class _Surface(NamedTuple):
    """A surface, lines of its chart's grid along both axes, and a named function of the chart."""

    held: LevelSet
    lines: tuple[np.ndarray, np.ndarray]
    function: Callable[[torch.Tensor], torch.Tensor]
    name: str


def _surface_row(figure: Figure, row: int, surface: _Surface) -> None:
    """A surface coloured by its function, and to the right of it the components of a level set, as
    in the paper: one sign of the level on the sphere, both on the torus.
    """
    held, lines, function, name = surface
    corners = held.manifold.embed(_on_grid(lines)).numpy()
    middles = _on_grid([(line[1:] + line[:-1]) / 2 for line in lines])
    values, labels = np.degrees(function(middles).numpy()), held.component_of(middles).numpy()
    shown = ScalarMappable(cmap="viridis")
    shown.set_array(values)
    left = _surface(figure, 2 * row + 1, corners, shown.to_rgba(values))
    right = _surface(figure, 2 * row + 2, corners, _component_colours(labels))
    left.set_title(f"{name} [°]")
    figure.colorbar(shown, ax=left, shrink=0.7, location="left").ax.tick_params(labelsize=8)
    sign, level = "±" if len(held.levels) > 1 else "", np.degrees(abs(held.levels[0]))
    right.set_title(f"{name} = {sign}{level:.0f}°: {_counted('component', len(held.components()))}")


def _on_grid(lines: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1))


def _surface(figure: Figure, place: int, corners: np.ndarray, faces: np.ndarray) -> Axes3D:
    axes = figure.add_subplot(2, 2, place, projection="3d")
    assert isinstance(axes, Axes3D)
    lit = np.concatenate([faces[..., :3] * _light(corners)[..., None], faces[..., 3:]], axis=-1)
    plain = {"rstride": 1, "cstride": 1, "linewidth": 0, "antialiased": False, "shade": False}
    axes.plot_surface(*np.moveaxis(corners, -1, 0), facecolors=lit, **plain)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    for name, ends in zip("xyz", zip(low, high, strict=True), strict=True):
        axes.set(**{f"{name}lim": ends})
    axes.set_proj_type("ortho")
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


def _draw_plane(axes: Axes, plane: GridSubmanifold, scale: float = 1.0) -> QuadMesh:
    """ι over the latent plane, times a scale, and the components over it; returns the former."""
    colours = _component_colours(plane.labels)
    colours[plane.labels < 0] = 0.0
    sides, values = (plane.first_axis, plane.second_axis), scale * plane.inclusion.T
    image = axes.pcolormesh(*sides, values, cmap=NEAR, vmin=0, rasterized=True)
    axes.pcolormesh(*sides, colours.transpose(1, 0, 2), rasterized=True)
    axes.set(xlabel="z₁", ylabel="z₂")
    return image


def _draw_ends(axes: Axes, start: np.ndarray, goal: np.ndarray) -> None:
    shown = {"edgecolors": "white", "zorder": 5}
    _dots(axes, start[None], s=70, color=START, marker="o", label="start", **shown)
    _dots(axes, goal[None], s=150, color=GOAL, marker="*", label="goal", **shown)


def _dots(axes: Axes, points: Float[np.ndarray, "n 2"], **style: Any) -> None:
    axes.scatter(points[:, 0], points[:, 1], **style)


def _strips(axes: Axes, strips: Float[np.ndarray, "n T 2"], **style: Any) -> None:
    axes.add_collection(LineCollection(list(strips), **style))


def _fill(axes: Axes, band: tuple[Any, Any, Any], colour: str, alpha: float = 0.25) -> None:
    """band: x, low and high."""
    axes.fill_between(*band, color=colour, alpha=alpha, linewidth=0)


def _single(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


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


def _counted(noun: str, count: int) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
