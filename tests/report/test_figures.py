"""Figures are read back: what is drawn is what was computed, and the files are small and the same
each time.
"""

import itertools

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from PIL import Image

from constraint_geodesics.geometry.graph import components_on_grid
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GraphSubmanifold, GridSubmanifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.palette import GREY, LIGHT, ORANGE
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.report import figures
from constraint_geodesics.report.figures import PLANNERS, LatentCurves

SCALES = (3.0, 0.5)


def chart(latent_dim=2, dof=3):
    """μ(z) = diag(3, ½) z and a σ that falls off a single centre: the metric of μ is known."""
    torch.manual_seed(0)
    vae = JointVae(dof, latent_dim, (4,), 1)
    with torch.no_grad():
        for layers in (vae.encoder, vae.decoder):
            for parameter in layers.parameters():
                parameter.zero_()
        vae.decoder.linear.weight[:2, :2] = torch.diag(torch.tensor(SCALES))
        vae.precision.place(torch.zeros(1, latent_dim), torch.ones(1), 1.0, 2.0, 1e4)
    return LearnedManifold(vae.eval().requires_grad_(False))


def plane(side=40):
    axis = np.linspace(-2, 2, side)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    inclusion = np.maximum(np.abs(np.abs(x) - 1.0) - 0.2, 0.0) + 0.05 * np.abs(y)
    return GridSubmanifold(
        axis, axis, inclusion, components_on_grid(inclusion < 0.09, (False, False))
    )


def graph(sizes=(6, 3)):
    rng = np.random.default_rng(0)
    latent = rng.normal(size=(sum(sizes), 4))
    labels = np.repeat(np.arange(len(sizes)), sizes)
    return GraphSubmanifold(latent, latent, np.array([[0, 1], [1, 2]]), np.ones(2), labels)


def comparison():
    measures = dict.fromkeys(
        ("over_best_median", "over_best_p95", "time_median_s", "time_p95_s"), 2.0
    )
    rows = [
        {"constraint": c, "planner": p, "success": 0.25, **measures}
        for c in ("free", "cup")
        for p in PLANNERS
    ]
    rows[0] |= dict.fromkeys(measures, np.nan) | {"success": 0.0}  # a planner that found nothing
    return pd.DataFrame(rows)


def learning(scale=1.0):
    rows = [
        {"seed": s, "steps": t, "saving": scale * t * (s + 1)} for s in (0, 2) for t in (10, 20, 30)
    ]
    return pd.DataFrame(rows)


def test_files_are_small_palettes_without_metadata_and_equal_for_equal_figures(tmp_path):
    for name in ("one", "two"):
        save_png(
            figures.latent_metric(chart(), np.random.default_rng(1).normal(size=(500, 2)), 40),
            tmp_path / name,
        )
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert len((tmp_path / "one").read_bytes()) < 150_000
    with Image.open(tmp_path / "one") as image:
        assert image.format == "PNG"
        assert image.mode == "P"
        assert not image.info.keys() - {"transparency"}
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_the_sphere_has_one_component_and_the_torus_two(tmp_path):
    figure = figures.analytic_submanifolds()
    titles = [axes.get_title() for axes in figure.axes]
    assert "sphere, elevation = 30°: 1 component" in titles
    assert "torus, tube angle = ±30°: 2 components" in titles
    save_png(figure, tmp_path / "fig2.png")
    with Image.open(tmp_path / "fig2.png") as image:
        drawn = np.asarray(image.convert("RGB")).astype(float)
    # both of the torus' circles can be seen from where it is looked at, in their colours
    right_half = drawn[drawn.shape[0] // 2 :, drawn.shape[1] // 2 :]
    for colour in figures.COMPONENTS[:2]:
        hue = np.array(to_rgb(colour)) / max(to_rgb(colour))
        brightness = right_half.max(axis=-1, keepdims=True)
        close = np.abs(right_half / np.maximum(brightness, 1) - hue).max(axis=-1) < 0.06
        assert close.sum() > 100


def test_the_plane_search_shows_samples_grey_and_the_learned_path_orange():
    t = np.linspace(0, 1, 20)[:, None]
    learned = t * [1.0, 2.0]
    sampled = np.stack([learned + k * np.sin(np.pi * t) for k in (0.1, 0.2, 0.3)])
    axes = figures.plane_search(sampled, learned).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["learned path"].get_xydata(), learned)
    assert lines["learned path"].get_color() == ORANGE
    np.testing.assert_array_equal(lines["exact geodesic"].get_xydata(), learned[[0, -1]])
    grey = next(c for c in axes.collections if c.get_label() == "sampled paths")
    assert len(grey.get_segments()) == 3
    assert to_hex(grey.get_colors()[0]) == GREY.lower()


def test_metric_figures_of_a_known_metric():
    z = np.random.default_rng(0).normal(size=(4, 5, 2))
    found = figures.metric_figures(chart(), z, piece=7)
    embedded = chart().metric(chart().tensor(z)).double().numpy()
    np.testing.assert_allclose(found.trace, np.trace(embedded, axis1=-2, axis2=-1), rtol=1e-5)
    np.testing.assert_allclose(found.volume, np.sqrt(np.linalg.det(embedded)), rtol=1e-4)
    np.testing.assert_allclose(
        found.trace - found.deviation_trace, SCALES[0] ** 2 + SCALES[1] ** 2, rtol=1e-4
    )


def test_rays_leave_the_data_and_meet_a_growing_metric():
    data = np.random.default_rng(0).normal(size=(2000, 2))
    growth = figures.follow_rays(chart(), data)
    assert growth.trace.shape == (figures.RAY_STEPS, figures.RAYS)
    constant = SCALES[0] ** 2 + SCALES[1] ** 2
    np.testing.assert_allclose(growth.trace[0], constant, rtol=1e-2)
    np.testing.assert_allclose(growth.trace - growth.deviation_trace, constant, rtol=1e-3)
    far = growth.deviation_trace[-20:].mean(axis=1)
    assert (np.diff(far) > 0).all()
    axes = figures.metric_growth({"toy": growth}).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(
        lines["tr M, median and 5–95 %"].get_ydata(), np.median(growth.trace, axis=1)
    )
    assert lines["largest on the data"].get_ydata()[0] == growth.largest_on_data


def test_the_latent_metric_covers_the_data_and_ignores_what_lies_far_out():
    data = np.vstack([np.random.default_rng(0).normal(size=(2000, 2)), [[500.0, 0.0]]])
    axes = figures.latent_metric(chart(), data, points=20).axes[0]
    assert axes.get_xlim()[1] < 10
    dots = next(c for c in axes.collections if isinstance(c, PathCollection))
    assert 1900 < len(dots.get_offsets()) <= 2000


def test_the_plane_names_its_components_and_its_unit():
    figure = figures.submanifolds_in_plane(
        {"cup": plane(), "slide": plane()}, {"cup": True, "slide": False}
    )
    count, share = plane().labels.max() + 1, (plane().labels >= 0).mean()
    assert count == 2
    assert figure.axes[0].get_title() == f"cup: 2 components, {share:.1%} of the plane"
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert any("[°]" in label for label in labels)
    assert any("[rad or m]" in label for label in labels)
    in_degrees, in_radians = (figure.axes[k].collections[0].get_array().max() for k in (0, 1))
    assert in_degrees == pytest.approx(np.degrees(in_radians))


def test_a_component_is_drawn_where_it_lies():
    # one cell far up the first axis: if the axes were swapped it would be drawn elsewhere
    axis = np.arange(10.0)
    labels = np.full((10, 10), -1)
    labels[8, 2] = 0
    found = figures.submanifolds_in_plane(
        {"x": GridSubmanifold(axis, axis, labels + 1.0, labels)}, {"x": False}
    )
    overlay = found.axes[0].collections[1].get_array().reshape(10, 10, 4)
    rows, columns = np.nonzero(overlay[..., 3])
    assert (rows.tolist(), columns.tolist()) == ([2], [8])  # y, x
    assert to_hex(overlay[2, 8]) == figures.COMPONENTS[0].lower()


def test_geodesics_run_from_start_to_goal():
    t = np.linspace(0, 1, 30)[:, None]
    straight = t * [1.0, 0.5]
    learned = np.stack([straight + k * t * (1 - t) for k in (1.0, -1.0)])
    axes = figures.geodesics_in_plane({"cup": (plane(), LatentCurves(learned, straight))}).axes[0]
    assert axes.get_title() == "cup: 2 geodesics found"
    orange = [line for line in axes.lines if line.get_color() == ORANGE]
    for line, curve in zip(orange, learned, strict=True):
        np.testing.assert_array_equal(line.get_xydata(), curve)
    none = figures.geodesics_in_plane({"cup": (plane(), LatentCurves(learned[:0], straight))}).axes[
        0
    ]
    assert none.get_title() == "cup: 0 geodesics found"


def test_every_graph_is_drawn_in_the_plane_of_the_same_data():
    data = np.random.default_rng(1).normal(size=(300, 4)) * [5.0, 3.0, 0.1, 0.1]
    figure = figures.components_in_principal_axes({"one": graph((4,)), "two": graph()}, data)
    assert [axes.get_title() for axes in figure.axes] == ["one: 1 component", "two: 2 components"]
    nodes = figure.axes[1].collections[-1]
    shown = np.abs(np.asarray(nodes.get_offsets()))
    centred = np.abs(graph().latent - data.mean(axis=0))[:, :2]
    np.testing.assert_allclose(
        shown, centred, atol=0.1
    )  # the long axes of the data, up to a small turn
    colours = {to_hex(colour) for colour in nodes.get_facecolors()}
    assert colours == {colour.lower() for colour in figures.COMPONENTS[:2]}


def test_training_curves_show_each_phase_where_it_ran():
    nan = np.nan
    history = pd.DataFrame(
        {
            "epoch": [0, 1, 2, 3],
            "mean_loss": [3, 2, nan, nan],
            "mean_held_out_loss": [4, 3, nan, nan],
            "variance_loss": [nan, nan, 1, 0],
            "variance_held_out_loss": [nan, nan, 2, 1],
        }
    )
    mean, variance = figures.training_curves({"toy": history}).axes
    assert (mean.get_title(), variance.get_title()) == ("toy, mean", "toy, variance")
    np.testing.assert_array_equal(mean.lines[0].get_xydata(), [[0, 3], [1, 2]])
    np.testing.assert_array_equal(variance.lines[1].get_xydata(), [[2, 2], [3, 1]])
    short = figures.training_curves({"toy": history.drop(columns="mean_loss")}).axes[0]
    assert short.lines[1].get_ydata().tolist() == [4, 3]


def test_learning_curves_show_the_mean_over_the_seeds():
    figure = figures.learning_curves(
        {"cup": {"planner": learning(), "paper": learning(2.0)}, "free": {"planner": learning()}}
    )
    planner, paper = figure.axes[0].lines
    np.testing.assert_allclose(
        planner.get_xydata(), [[10, 20], [20, 40], [30, 60]]
    )  # of (s + 1) t, s = 0 and 2
    np.testing.assert_allclose(paper.get_ydata(), [40, 80, 120])
    assert figure.axes[1].lines[0].get_color() == planner.get_color()
    assert planner.get_color() != paper.get_color()


def test_the_comparison_has_a_bar_for_every_planner_in_its_colour():
    figure = figures.planner_comparison(comparison())
    bars = figure.axes[0].containers
    assert [bar.get_label() for bar in bars] == [style.label for style in PLANNERS.values()]
    for bar, style in zip(bars, PLANNERS.values(), strict=True):
        assert {to_hex(patch.get_facecolor()) for patch in bar.patches} == {style.colour.lower()}
    assert [patch.get_width() for patch in bars[0].patches] == [0.0, 0.25]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["free", "cup"]


def test_planners_differ_in_colour_and_marker():
    for one, two in itertools.combinations(PLANNERS.values(), 2):
        assert one.marker != two.marker
        assert np.abs(np.array(to_rgb(one.colour)) - to_rgb(two.colour)).max() > 0.2
    assert LIGHT not in {style.colour for style in PLANNERS.values()}


def test_histograms_show_every_column_but_quaternions_and_say_what_is_held():
    histograms = {
        "joint_1": {"first": -1.0, "last": 1.0, "counts": [1, 2, 3, 4]},
        "roll": {"first": np.pi / 2, "last": np.pi / 2 + 1e-9, "counts": [10, 0, 0, 0]},
        "quaternion_x": {"first": 0.0, "last": 1.0, "counts": [1, 1, 1, 7]},
    }
    figure = figures.data_histograms(histograms, lambda _: "rad")
    assert [axes.get_title() for axes in figure.axes] == ["joint_1 [rad]", "roll [rad]"]
    counts, edges, _ = figure.axes[0].patches[0].get_data()
    assert (counts.tolist(), edges.tolist()) == ([1, 2, 3, 4], [-1.0, -0.5, 0.0, 0.5, 1.0])
    assert [label.get_text() for label in figure.axes[1].get_xticklabels()] == ["1.571"]


def test_rules_are_drawn_against_their_cost():
    rows = [
        {"rule": rule, "points": n, "microseconds": n, "error_p95": 1 / n, "error_max": 2 / n}
        for rule in figures.RULES
        for n in (8, 4)
    ]
    axes = figures.length_rules(pd.DataFrame(rows), 1e-3).axes[0]
    for line in axes.lines[:3]:
        assert line.get_xdata().tolist() == [4, 8], "in the order of the points"
        assert line.get_ydata().tolist() == [1 / 4, 1 / 8]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        label for label, _, _ in figures.RULES.values()
    ]


def test_an_ablation_without_collisions_says_none():
    searched = {"plane": {"corrected_reward": [1.001, 1.002], "printed_reward": [1.05, 1.06]}}
    learned = {
        "flat": {
            name: {"collision_free": None}
            for name in ("with_variance", "without_variance", "straight_latent_line")
        }
    }
    figure = figures.ablation(searched, {"plane": {"polynomial": 1.001, "spline_2": 1.0}}, learned)
    search, reach, variance = figure.axes
    offsets = np.concatenate([marks.get_offsets() for marks in search.collections])
    np.testing.assert_allclose(sorted(offsets[:, 1]), [0.001, 0.002, 0.05, 0.06])
    assert [bar.get_height() for bar in reach.patches] == pytest.approx([0.001, 1e-8])
    assert {text.get_text() for text in variance.texts} == {"none"}


@pytest.mark.parametrize(
    "draw",
    [
        figures.analytic_submanifolds,
        lambda: figures.planner_comparison(comparison()),
        lambda: figures.submanifolds_in_plane({"cup": plane()}, {"cup": True}),
    ],
)
def test_no_figure_is_left_in_a_global_list(draw):
    from matplotlib import _pylab_helpers

    before = len(_pylab_helpers.Gcf.figs)
    assert isinstance(draw(), Figure)
    assert len(_pylab_helpers.Gcf.figs) == before
