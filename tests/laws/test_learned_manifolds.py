"""What every learned manifold of joint space must satisfy: the VAE's, the GPLVM's, the GAN's, and
the identity's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.problem import ChartProblem, Samples
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.manifold import EmbeddedManifold
from constraint_geodesics.learning.gan import Generator, train_gan
from constraint_geodesics.learning.gplvm import GaussianProcessDecoder, train_gplvm
from constraint_geodesics.learning.inference import ManifoldFileError
from constraint_geodesics.learning.latent_manifold import JointDecoder, LatentManifold
from constraint_geodesics.learning.learned_manifold import JointManifold, LearnedManifold

BATCHES = ((), (3,), (2, 4))
GPLVM = {"hidden": (16,), "inducing": 16, "steps": 40, "batch_size": 64, "centres": 32}
GAN = {"hidden": (16,), "steps": 30, "batch_size": 32, "encoder_steps": 100}


@dataclass(frozen=True)
class Member:
    """A manifold, the rows that it was trained on, and how it is read from a folder."""

    manifold: EmbeddedManifold
    joints: np.ndarray
    load: Callable[[Path], EmbeddedManifold] | None = None


@pytest.fixture(scope="module")
def small(params):
    own = params.compare_manifolds
    return own.gplvm.model_copy(update=GPLVM), own.gan.model_copy(update=GAN)


@pytest.fixture(scope="module")
def members(trained, xarm, small) -> dict[str, Member]:
    rows = trained.joints
    gplvm, gan = train_gplvm(rows, xarm, small[0], 0), train_gan(rows, xarm, small[1], 0)
    return {
        "vae": Member(trained.manifold.double(), rows, LearnedManifold.load),
        "gplvm": Member(gplvm, rows, lambda f: LatentManifold.load(f, GaussianProcessDecoder)),
        "gan": Member(gan, rows, lambda f: LatentManifold.load(f, Generator)),
        "joints": Member(JointManifold.of(rows), rows),
    }


every_member = pytest.mark.parametrize("name", ["vae", "gplvm", "gan", "joints"])
every_peer = pytest.mark.parametrize("name", ["gplvm", "gan"])
every_batch = pytest.mark.parametrize("batch", BATCHES, ids=str)


@every_member
@every_batch
def test_everything_has_the_promised_shape(members, name, batch) -> None:
    member = members[name]
    manifold, count = member.manifold, int(np.prod(batch))
    q = member.joints[:count].reshape(*batch, -1)
    z = manifold.encode(q)
    assert z.shape == (*batch, manifold.dim)
    assert manifold.decode(z).shape == q.shape
    points = torch.from_numpy(z)
    embedded = manifold.embed(points)
    assert embedded.shape == (*batch, manifold.ambient_dim)
    assert manifold.metric(points).shape == (*batch, manifold.dim, manifold.dim)
    np.testing.assert_allclose(embedded[..., : q.shape[-1]].numpy(), manifold.decode(z), atol=1e-12)
    np.testing.assert_allclose(manifold.embed_points(z), embedded.numpy(), atol=1e-12)
    np.testing.assert_allclose(manifold.embed_joints(q), embedded.numpy(), atol=1e-12)


@every_member
def test_the_metric_is_that_of_finite_differences_and_positive(members, name) -> None:
    manifold, step = members[name].manifold, 1e-5
    z = torch.from_numpy(manifold.encode(members[name].joints[:40]))
    shifts = step * torch.eye(manifold.dim, dtype=torch.float64)
    ahead, behind = (manifold.embed(z[:, None] + sign * shifts) for sign in (1, -1))
    columns = (ahead - behind) / (2 * step)
    metric = manifold.metric(z)
    torch.testing.assert_close(metric, columns @ columns.mT, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(metric, metric.mT, rtol=1e-12, atol=1e-12)
    assert (torch.linalg.eigvalsh(metric) > 5e-5).all()


@pytest.mark.parametrize("name", ["vae", "gplvm", "gan"])
def test_saved_and_read_again_it_is_the_same(members, trained, name, tmp_path) -> None:
    joints, load = members[name].joints[:9], members[name].load
    manifold = trained.manifold if name == "vae" else members[name].manifold  # in its own precision
    manifold.save(tmp_path)
    again, z = load(tmp_path), manifold.encode(joints)
    np.testing.assert_array_equal(again.embed_points(z), manifold.embed_points(z))
    np.testing.assert_array_equal(again.encode(joints), z)


@every_peer
def test_what_is_altered_or_of_another_kind_is_refused(members, name, tmp_path) -> None:
    member = members[name]
    other: type[JointDecoder] = Generator if name == "gplvm" else GaussianProcessDecoder
    member.manifold.save(tmp_path)
    with pytest.raises(ManifoldFileError, match=r"kind = .*: must be"):
        LatentManifold.load(tmp_path, other)
    file = tmp_path / "weights.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(ManifoldFileError, match="checksum"):
        member.load(tmp_path)
    file.unlink()
    with pytest.raises(ManifoldFileError, match="not a saved manifold"):
        member.load(tmp_path)


@every_peer
def test_a_seed_gives_one_manifold_and_leaves_other_chances_alone(
    members, name, xarm, small
) -> None:
    train, settings = {"gplvm": (train_gplvm, small[0]), "gan": (train_gan, small[1])}[name]
    state = torch.get_rng_state()
    again = train(members[name].joints, xarm, settings, 0)
    other = train(members[name].joints, xarm, settings, 1)
    assert torch.equal(torch.get_rng_state(), state)
    first = members[name].manifold.decoder.state_dict()
    assert all(torch.equal(first[k], v) for k, v in again.decoder.state_dict().items())
    assert not all(torch.equal(first[k], v) for k, v in other.decoder.state_dict().items())
    drawn = [again.sample(50, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert (drawn[0] != drawn[2]).any()


@every_member
def test_what_it_decodes_is_encoded_to_where_it_is_decoded_from(members, name) -> None:
    manifold = members[name].manifold
    reproduced = manifold.decode(manifold.encode(members[name].joints[:60]))
    again = manifold.decode(manifold.encode(reproduced))
    apart = np.abs(again - reproduced).mean(axis=1)
    assert np.median(apart) < {"vae": 0.3, "gplvm": 0.3, "gan": 1e-6, "joints": 1e-12}[name]


@every_member
def test_geodesics_are_no_longer_than_straight_latent_lines(members, name) -> None:
    manifold = members[name].manifold
    z = manifold.encode(members[name].joints[:8])
    problem = ChartProblem(manifold, PinnedPolynomial(manifold.dim, 3), Samples(z))
    found = geodesics_between(GradientSolver(starts=1), problem, z[:4], z[4:])
    assert all(own.found for own in found)
    assert all(own.length <= own.straight_length * (1 + 1e-6) for own in found)
