"""Relations with a B-spline of the tool's position, bounded along straight joint lines.

With r = c + wᵀy + s(p) ρ, ρ = c′ + w′ᵀy, on a piece q(t) = q₀ + t d of a straight joint line

    r″ = wᵀy″ + s″ ρ + 2 s′ ρ′ + s ρ″,  |s′| ≤ G P,  |s″| ≤ H P² + G Q.

P and Q bound the tip's motion, W and W² that of the tool's axes (certification/polynomial.py).
G and H bound gradient and Hessian of s where the tip can be on the piece: derivatives of a B-spline
are B-splines whose coefficients are differences of its own, and a B-spline lies between the least
and the largest of those that it is made of at a place.  Beyond the domain nothing is proven.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import NdBSpline
from scipy.ndimage import maximum_filter

from constraint_geodesics.certification.chain import Chain
from constraint_geodesics.certification.kept import Asked, Kept
from constraint_geodesics.certification.pieces import kept_by
from constraint_geodesics.certification.polynomial import features, motions

AROUND = 1
"""Cells beyond its own that a piece may reach into for a bound of its neighbourhood."""


def kept(asked: Asked) -> Kept:
    """How well the relations are kept at the rows and on the whole path."""
    relations = asked.constraint.relations
    looks = {id(own): _Bounded.of(own) for own in asked.constraint.splines}
    return kept_by(asked, lambda stations: _bounds(asked.chain, stations, relations, looks))


class _Bounded(NamedTuple):
    """A spline with what bounds its derivatives.

    around, anywhere: the largest sizes of value, gradient, second and third derivatives near each
    cell (4, cells…), and of all cells (4,).
    """

    spline: Any
    around: np.ndarray
    anywhere: Float[np.ndarray, "4"]

    @classmethod
    def of(cls, spline: Any) -> "_Bounded":
        """Sizes of tensors of derivatives, as the roots of their entries' squares summed up."""
        squares = []
        for order in range(4):
            total: np.ndarray = np.zeros(1)
            for orders, times in _orders(_active(spline), order):
                total = total + times * _largest(spline, orders) ** 2
            squares.append(np.sqrt(total))
        cells = np.stack([np.broadcast_to(own, squares[0].shape) for own in squares])
        size = (1, *(2 * AROUND + 1 for _ in range(3)))
        return cls(spline, maximum_filter(cells, size=size), cells.max(axis=(1, 2, 3)))

    def sizes(
        self, positions: Float[np.ndarray, "S 3"], reach: Float[np.ndarray, "S"]
    ) -> Float[np.ndarray, "4 S"]:
        """What value and derivatives are at most within reach of positions [m]; infinite where
        that is beyond the domain.
        """
        own, active = self.spline, list(_active(self.spline))
        x = _coordinates(own, positions)
        cells = np.zeros((3, len(x)), dtype=np.int64)
        count = np.array(self.around.shape[1:])[:, None]
        found = np.floor((x - own.lower) / own.spacing).T
        cells[active] = np.clip(found, 0, count - 1)[active].astype(np.int64)
        near = reach < AROUND * own.spacing[active].min()
        sizes = np.where(near, self.around[:, *cells], self.anywhere[:, None])
        low = (x - own.lower)[:, active].min(axis=1)
        inside = np.minimum(low, (_upper(own) - x)[:, active].min(axis=1)) > reach
        return np.where(inside, sizes, np.inf)

    def values(self, positions: Float[np.ndarray, "S 3"], derivative: int) -> np.ndarray:
        """Value or a derivative, by another code than the search's."""
        own, active = self.spline, _active(self.spline)
        inside = np.clip(_coordinates(own, positions), own.lower, _upper(own))
        x = inside[:, list(active)]
        if derivative >= 0 and derivative not in active:
            return np.zeros(len(x))
        shape = [own.coefficients.shape[k] for k in active]
        knots = [
            own.lower[k]
            + own.spacing[k] * np.arange(-own.degrees[k], own.coefficients.shape[k] + 1)
            for k in active
        ]
        spline = NdBSpline(
            tuple(knots), own.coefficients.reshape(shape), tuple(own.degrees[k] for k in active)
        )
        return np.asarray(spline(x, nu=[int(k == derivative) for k in active]))


def _active(spline: Any) -> tuple[int, ...]:
    """The coordinates that a spline depends on."""
    return tuple(k for k in range(3) if spline.degrees[k])


def _coordinates(spline: Any, positions: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3"]:
    """A spline's own of positions."""
    found: np.ndarray = (positions - spline.origin) @ spline.frame.T
    return found


def _upper(spline: Any) -> Float[np.ndarray, "3"]:
    """Where a spline's domain ends [m]."""
    cells = np.array(spline.coefficients.shape) - np.array(spline.degrees)
    found: np.ndarray = spline.lower + cells * spline.spacing
    return found


def _orders(active: tuple[int, ...], order: int) -> list[tuple[tuple[int, int, int], int]]:
    """Partial derivatives of an order, and how often each stands in the tensor of all."""
    counted: dict[tuple[int, int, int], int] = {}
    for which in np.ndindex(*(len(active),) * order):
        orders = [0, 0, 0]
        for k in which:
            orders[active[k]] += 1
        key = (orders[0], orders[1], orders[2])
        counted[key] = counted.get(key, 0) + 1
    return list(counted.items())


def _largest(spline: Any, orders: tuple[int, int, int]) -> np.ndarray:
    """The largest size of a partial derivative's coefficients that count in each cell."""
    found = spline.coefficients
    for k, order in enumerate(orders):
        if order > spline.degrees[k]:
            return np.zeros(np.array(found.shape) - [d or 0 for d in spline.degrees])
        found = np.diff(found, order, axis=k) / spline.spacing[k] ** order
    found = np.abs(found)
    for k, order in enumerate(orders):
        width = spline.degrees[k] - order + 1
        windows = np.lib.stride_tricks.sliding_window_view(found, width, axis=k)
        found = windows.max(axis=-1)
    return found


def _bounds(
    chain: Chain, stations: Float[np.ndarray, "S D"], relations: tuple, looks: dict[int, _Bounded]
) -> tuple[Float[np.ndarray, "S m"], Float[np.ndarray, "S-1 m"]]:
    """Residuals at stations, and K/8 of the pieces between them."""
    y = features(chain, stations)
    steps = np.abs(np.diff(stations, axis=0))
    turning = np.where(chain.prismatic, 0.0, steps).sum(axis=1)
    first, second = motions(chain, stations, steps)
    sizes = {key: own.sizes(y[:-1, :3], first) for key, own in looks.items()}
    values, added = [], []
    for own in relations:
        value, most = own.constant + y @ own.linear, _most(own.linear, second, turning**2)
        if own.term is not None:
            spline, a, constant, linear = own.term
            look = looks[id(spline)]
            s, rho = look.values(y[:, :3], a), constant + y @ linear
            value = value + s * rho
            order = 0 if a < 0 else 1
            size, steep, bent = sizes[id(spline)][order : order + 3]
            moved, twice = _most(linear, first, turning), _most(linear, second, turning**2)
            # ρ on the piece is at most that at its first row and how it moves
            most = most + (bent * first**2 + steep * second) * (np.abs(rho[:-1]) + moved)
            most = most + 2.0 * steep * first * moved + size * twice
        values.append(value)
        # beyond a domain: an infinite bound times a step of nothing is none
        added.append(np.where(np.isnan(most), np.inf, 0.125 * most))
    return np.stack(values, axis=1), np.stack(added, axis=1)


def _most(
    linear: Float[np.ndarray, "12"], tip: Float[np.ndarray, "S"], axes: Float[np.ndarray, "S"]
) -> Float[np.ndarray, "S"]:
    """What wᵀ moves by where the tip and the tool's axes move by so much."""
    norms = np.linalg.norm(np.reshape(linear, (4, 3)), axis=1)
    found: np.ndarray = norms[0] * tip + norms[1:].sum() * axes
    return found
