import pickle

import pytest
import torch

from constraint_geodesics.geometry.analytic import Torus
from constraint_geodesics.geometry.manifold import (
    GeometryError,
    NonFiniteError,
    pullback_metric,
    require_dim,
    require_finite,
)


def test_pullback_of_a_linear_map_is_its_gram_matrix():
    linear = torch.nn.Linear(3, 5, dtype=torch.float64)
    gram = linear.weight.T @ linear.weight
    torch.testing.assert_close(
        pullback_metric(linear, torch.ones(2, 3, dtype=torch.float64)), gram.expand(2, 3, 3)
    )


def test_pullback_is_differentiable():
    torus = Torus(2.0, 1.0)
    z = torch.tensor([0.3, 0.7], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(pullback_metric(torus.embed, z)[0, 0], z)
    expected = -2 * (2 + torch.cos(z[1])) * torch.sin(z[1])
    torch.testing.assert_close(gradient, torch.stack([torch.zeros_like(expected), expected]))


def test_pullback_takes_no_points():
    assert pullback_metric(Torus().embed, torch.zeros(0, 2)).shape == (0, 2, 2)


def test_non_finite_error_names_the_first_entry_and_survives_a_process_boundary():
    values = torch.zeros(2, 3)
    values[1, 0], values[1, 2] = torch.inf, torch.nan
    with pytest.raises(NonFiniteError, match=r"phi\[1, 0\] = inf: must be finite") as caught:
        require_finite(values, "phi")
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.what, copy.index, copy.value) == ("phi", (1, 0), float("inf"))
    assert str(copy) == str(caught.value)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 0)])
def test_wrong_dimension_is_refused(shape):
    with pytest.raises(
        GeometryError, match=rf"z has shape \({', '.join(map(str, shape))}.*must have 2 entries"
    ):
        require_dim(torch.zeros(shape), 2, "z")
