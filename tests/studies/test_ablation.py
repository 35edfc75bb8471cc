import numpy as np
import torch

from constraint_geodesics.geometry.curves import PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.manifold import EmbeddedManifold
from constraint_geodesics.studies.ablation import (
    LearnedAblation,
    MeanManifold,
    by_variant,
    family_ratios,
    path_figures,
    policy_variants,
)


def test_each_variant_changes_one_thing(params) -> None:
    variants = policy_variants(params.geodesics)
    assert list(variants) == ["printed_reward", "spline_2", "spline_4"]
    family, printed = variants["printed_reward"]
    assert family == PinnedPolynomial(2, params.geodesics.degree)
    assert printed.reward.form == "printed"
    assert printed.model_copy(update={"reward": params.geodesics.reward}) == params.geodesics
    assert variants["spline_4"] == (PinnedSpline(2, 4), params.geodesics)


def test_richer_families_reach_further(params) -> None:
    ratios = family_ratios("sphere", params.geodesics)
    assert 1 - 1e-6 <= ratios["spline_4"] <= ratios["spline_2"] <= ratios["polynomial"] < 1.003


def test_the_metric_without_variance_is_that_of_the_mean(trained) -> None:
    manifold = MeanManifold(trained.manifold)
    assert isinstance(manifold, EmbeddedManifold)
    z = torch.from_numpy(trained.manifold.encode(trained.joints[:5]))
    whole, mean = trained.manifold.metric(z), manifold.metric(z)
    assert (torch.linalg.eigvalsh(whole - mean) > -1e-4).all(), "the variance only adds"
    assert torch.equal(manifold.embed(z), trained.manifold.embed(z)[:, : manifold.ambient_dim])


def test_figures_of_paths_are_those_of_their_joints(trained, scene) -> None:
    z = trained.manifold.encode(trained.joints[:6]).reshape(2, 3, -1)
    decoded = trained.manifold.decode(z)
    with scene.world() as world:
        figures = path_figures(trained.manifold, z, world.free)
        touched = ~world.free(decoded.reshape(6, -1)).reshape(2, 3)
    length = np.linalg.norm(np.diff(decoded, axis=1), axis=-1).sum(1).mean()
    assert np.isclose(figures["length_rad"], length, rtol=1e-5)
    assert np.isclose(figures["collision_free"], 1 - touched.any(axis=1).mean())
    assert figures["collision_free"] <= figures["collision_free_points"]


def test_the_variance_is_ablated_between_pairs_whose_line_collides(trained, params) -> None:
    def free(q):
        return np.abs(q[:, 0]) > 0.05  # a wall across the first joint

    figures = LearnedAblation(trained.manifold, trained.joints, params.geodesics, 3, free).figures()
    assert set(figures) == {
        "polynomial",
        "spline_2",
        "spline_4",
        "with_variance",
        "without_variance",
        "straight_latent_line",
    }
    with_it, without, straight = (
        figures[name] for name in ("with_variance", "without_variance", "straight_latent_line")
    )
    assert straight["collision_free"] == 0.0
    assert with_it["pairs"] == 3
    assert with_it["deviation_rad"] <= without["deviation_rad"] * (1 + 1e-3)
    assert without["length_rad"] <= straight["length_rad"] * (1 + 1e-6)
    assert (
        min(figures[name]["mean_ratio_to_best"] for name in ("polynomial", "spline_2", "spline_4"))
        < 1.001
    )


def test_where_nothing_collides_there_is_nothing_to_ablate(trained, params) -> None:
    def free(q):
        return np.ones(len(q), dtype=bool)

    figures = LearnedAblation(trained.manifold, trained.joints, params.geodesics, 2, free).figures()
    assert figures["with_variance"]["pairs"] == 0
    assert np.isnan(figures["with_variance"]["collision_free"])


def test_the_metrics_file_holds_a_list_a_variant() -> None:
    found = by_variant({"printed_reward": [1.1, 1.2]}, {"polynomial": 1.01})
    assert found == {
        "policy_search": {"printed_reward": {"mean_ratio": [1.1, 1.2]}},
        "gradient": {"polynomial": {"mean_ratio": 1.01}},
    }
