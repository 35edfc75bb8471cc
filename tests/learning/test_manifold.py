import json

import numpy as np
import pytest
import torch

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.learning.learned_manifold import LearnedManifold, ManifoldFileError
from constraint_geodesics.learning.submanifold import Surface, extract, submanifold_figures
from constraint_geodesics.learning.training import TrainingRun, train_manifold


def free_joints(scene, count):
    manifold = ConstraintManifold(scene.robot, Constraint((0, 0, 0, 0, 0, 0)))
    return draw_free(ShardTask(scene, manifold, count, (5,)))


def train(scene, params, name, folder, rows=6000, **changes):
    settings = params.manifolds[name].model_copy(
        update={
            "epochs": 6,
            "variance_epochs": 3,
            "variance_centres": 64,
            "batch_size": 64,
            **changes,
        }
    )
    joints = free_joints(scene, rows)
    return joints, train_manifold(
        joints, scene.robot, settings, TrainingRun(folder, lambda step, figures: None, False)
    )


@pytest.fixture(scope="module", params=["paper", "planner"])
def trained(request, scene, params, tmp_path_factory):
    return request.param, *train(
        scene, params, request.param, tmp_path_factory.mktemp(request.param)
    )


def test_the_metric_is_sound_on_the_data_and_grows_away_from_it(trained) -> None:
    _, joints, result = trained
    manifold = result.manifold
    z = manifold.encode(joints[:400])
    eigenvalues = torch.linalg.eigvalsh(manifold.metric(manifold.tensor(z)).double())
    assert torch.isfinite(eigenvalues).all()
    assert (eigenvalues[:, 0] > 0).all()
    assert (eigenvalues[:, -1] / eigenvalues[:, 0]).median() < 50
    assert eigenvalues[:, -1].max() < 1e4
    radius = np.quantile(np.linalg.norm(z, axis=1), 0.95)
    rays = z / np.linalg.norm(z, axis=1, keepdims=True)
    means = []
    for share in (1.0, 2.0, 4.0, 8.0, 16.0):
        metric = manifold.metric(manifold.tensor(share * radius * rays))
        means.append(float(metric.diagonal(dim1=-2, dim2=-1).sum(-1).mean()))
    assert (np.diff(means[1:]) > 0).all(), means
    assert means[-1] > 3 * means[0]


def test_the_six_dimensional_manifold_reaches_its_data(trained) -> None:
    name, _, result = trained
    if name == "planner":
        assert result.metrics["joint_error_mean_deg"] < 4.0
    assert result.history[0]["epoch"] == 0.0
    assert len(result.history) == 9


def test_saved_and_read_again_it_is_the_same(trained, tmp_path) -> None:
    _, joints, result = trained
    result.manifold.save(tmp_path)
    again = LearnedManifold.load(tmp_path)
    np.testing.assert_array_equal(
        again.embed_joints(joints[:9]), result.manifold.embed_joints(joints[:9])
    )
    z = result.manifold.encode(joints[:1500].reshape(2, 750, -1))
    plain = result.manifold.embed(result.manifold.tensor(z)).numpy()
    np.testing.assert_allclose(result.manifold.embed_points(z), plain, atol=1e-6)


def test_altered_weights_are_refused(trained, tmp_path) -> None:
    _, _, result = trained
    result.manifold.save(tmp_path)
    file = tmp_path / "weights.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(ManifoldFileError, match="checksum"):
        LearnedManifold.load(tmp_path)
    file.unlink()
    with pytest.raises(ManifoldFileError, match="not a saved manifold"):
        LearnedManifold.load(tmp_path)


def test_the_variance_phase_leaves_the_mean_alone(scene, params, tmp_path) -> None:
    _, short = train(
        scene, params, "planner", tmp_path / "a", rows=2000, epochs=2, variance_epochs=1
    )
    _, longer = train(
        scene, params, "planner", tmp_path / "b", rows=2000, epochs=2, variance_epochs=3
    )
    z = torch.randn(5, 6, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        short.manifold.vae.mean(z), longer.manifold.vae.mean(z), rtol=0, atol=0
    )
    assert not torch.equal(short.manifold.vae.deviation(z), longer.manifold.vae.deviation(z))


def test_seven_joints_train_and_keep_a_constraint(kuka_scene, params, tmp_path) -> None:
    joints, result = train(kuka_scene, params, "planner", tmp_path, latent_dim=7)
    result.manifold.save(tmp_path)
    assert json.loads((tmp_path / "manifold.json").read_text())["dof"] == 7
    pose = Pose.from_rpy([0.4, 0.0, 0.4], [np.pi / 2, 0.0, 0.0])
    level = ConstraintManifold(kuka_scene.robot, Constraint((0, 0, 0, 1, 1, 0), reference=pose))
    on_level = draw_free(ShardTask(kuka_scene, level, 600, (6,)))
    small = params.submanifold.model_copy(update={"nodes": 300})
    with kuka_scene.world() as world:
        surface = Surface(result.manifold, level, world.free)
        found = extract(surface, joints, on_level, small)
    figures = submanifold_figures(found, surface, joints, on_level, small)
    assert figures["largest_component_share"] > 0.5
    assert len(found.edges) > 100
