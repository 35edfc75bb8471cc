"""Identification: from simple relations to rich ones, each kept only if it also holds on
demonstrations that it was not found on.

The order is positions, orientations, the whole pose, then quadrics of the position; what is held
already is taken out of the gradients of what comes next, so that nothing is found twice.  Where a
form has a name (forms.py) it stands in place of the combination that was found.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.polynomial import FEATURES, PolynomialConstraint, Relation
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.forms import POSE, POSITION, QUADRIC, TURNED, Form, named
from constraint_geodesics.identification.vanishing import (
    AT_MOST_RAD,
    METRES,
    Sample,
    most_rad,
    rank,
    trimmed,
    vanishing,
    without,
)
from constraint_geodesics.robot.kinematics import SerialRobot

WORSE, FINE_RAD = 1.25, 2e-5
"""A form may be off by so many times what the combination is that it stands for, and by so much."""
WRONG, LEAST_WRONG_RAD = 5.0, 1e-6
"""Rows that are further off than so many times the median are wrong, and left out."""
ROUNDS = 4
GOOD = 0.9
"""Share of the rows that a distance is taken over: some may be wrong."""
_COLUMNS = {POSITION: np.arange(3), TURNED: np.arange(3, 12), POSE: np.arange(12)}
_SCALE = np.array([METRES] * 3 + [1.0] * 9)
_FIRST, _SECOND = np.triu_indices(3)

Found = Callable[[Sample], tuple[Relation, ...]]
"""Relations as they are found on rows."""


@dataclass(frozen=True)
class Identified:
    """What demonstrations keep to.

    constraint: None where nothing was identified.  relations: in words, each with the rms by which
    it is missed on left-out demonstrations.  codim: dimensions that they take.  noise_rad: rms
    distance of the rows from the constraint manifold, along each direction that is held; nan
    without a constraint.  left_out: rms
    of each row of the residual on left-out demonstrations, in its unit.  missing: what was seen but
    not supported, or why there is nothing.  dropped: rows that were taken to be wrong.  robot: its
    name and tool link, of whose tool all this is said.
    """

    constraint: PolynomialConstraint | None
    relations: tuple[str, ...]
    codim: int
    noise_rad: float
    left_out: tuple[float, ...]
    missing: str
    rows: int
    demonstrations: int
    dropped: int
    robot: tuple[str, str]

    @property
    def left_out_error(self) -> dict[str, float]:
        """The largest rms on left-out demonstrations, by unit: {"m": …, "rad": …}."""
        found: dict[str, float] = {}
        if self.constraint is not None:
            for unit, value in zip(self.constraint.units, self.left_out, strict=True):
                found[unit] = max(found.get(unit, 0.0), value)
        return found

    def summary(self) -> dict[str, Any]:
        """All but the numbers of the relations, as JSON takes it."""
        identified = self.constraint is not None
        return {
            "identified": identified,
            "relations": list(self.relations),
            "missing": self.missing,
            "codim": self.codim,
            "noise_rad": self.noise_rad if identified else None,
            "left_out_error": self.left_out_error,
            "rows": self.rows,
            "demonstrations": self.demonstrations,
            "dropped": self.dropped,
        }

    def save(self, file: str | Path) -> None:
        """Write the constraint as YAML (`files.save_constraint`)."""
        from constraint_geodesics.identification.files import save_constraint

        save_constraint(self, file)

    @property
    def explanation(self) -> str:
        """All of it in one line."""
        told = "; ".join(self.relations) or "nothing is identified"
        dropped = f"; {self.dropped} wrong rows left out" if self.dropped else ""
        return f"{told}{dropped}{': ' if not self.relations else '. '}{self.missing}".rstrip(". ")


def identify(demonstrations: Any, robot: SerialRobot) -> Identified:
    """The constraint that demonstrations keep to.

    demonstrations: rows (n, D), or (demonstrations, T, D), or a list of (T, D) [rad], or a file:
    CSV (a first column more is the demonstration's number) or parquet as LeRobot writes it.
    Raises DemonstrationError, one line, for what nothing can be learned from.
    """
    shown, motions = demonstrations_from(demonstrations, robot)
    sample = Sample.of_joints(robot, shown, motions)
    kept, search = np.ones(len(sample), dtype=bool), _searched(sample)
    if not search.relations:
        kept = _likely(sample)
        search = search if kept.all() else _searched(sample[kept])
    for _ in range(ROUNDS):
        if not search.relations:
            break
        near = _near(sample.distances(search.relations), kept)
        if (near == kept).all():
            break
        if near.mean() < GOOD:  # that many are not wrong, they say something else
            search.missing.append(
                f"{1.0 - near.mean():.0%} of the rows are further off than the others: not all "
                f"demonstrations are of one kind"
            )
            break
        kept, search = near, _searched(sample[near])
    return _told(search, robot, len(shown), int((~kept).sum()))


def _likely(sample: Sample) -> Bool[np.ndarray, "n"]:
    """Rows that keep to a relation that GOOD of them keep to; all if there is none."""
    everything = np.ones(len(sample), dtype=bool)
    for name in (*_COLUMNS, QUADRIC):
        least, off = trimmed(*_features(sample, name), GOOD)
        near = _near(off, everything)
        if least <= AT_MOST_RAD and near.mean() >= GOOD:
            return near
    return everything


def _near(off: Float[np.ndarray, "n"], kept: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Rows that are not further off than WRONG times the median of those that are kept."""
    return off <= max(WRONG * float(np.median(off[kept])), LEAST_WRONG_RAD)


@dataclass
class _Search:
    """What is found so far, how, and what was seen but not supported."""

    sample: Sample
    folds: Sequence[Bool[np.ndarray, "n"]]
    relations: tuple[Relation, ...] = ()
    sides: tuple[Relation, ...] = ()
    best_rad: float = 0.0
    found: list[Found] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def keep(self, found: Found, relations: tuple[Relation, ...]) -> None:
        """Take relations in, and how they are found on other rows."""
        self.found.append(found)
        self.relations += relations


def _searched(sample: Sample) -> _Search:
    search = _Search(sample, sample.folds())
    names = (*_COLUMNS, QUADRIC)
    least = [vanishing(*_features(sample, name), []).found_rad for name in names]
    search.best_rad = min((float(own[0]) for own in least if len(own)), default=np.inf)
    for name in names:
        _look(search, name)
    return search


def _features(sample: Sample, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Features of order 1 and their gradients."""
    y, slopes = sample.pose
    y, slopes = y / _SCALE, slopes / _SCALE[:, None]
    if name != QUADRIC:
        return y[:, _COLUMNS[name]], slopes[:, _COLUMNS[name]]
    p, own = y[:, :3] - y[:, :3].mean(axis=0), slopes[:, :3]
    steep = p[:, _FIRST, None] * own[:, _SECOND] + p[:, _SECOND, None] * own[:, _FIRST]
    return np.hstack([p, p[:, _FIRST] * p[:, _SECOND]]), np.concatenate([own, steep], axis=1)


def _look(search: _Search, name: str) -> None:
    """Add what vanishes of these features beyond what is found already."""
    psi, slopes = _features(search.sample, name)
    free = without(slopes, search.sample.slopes(search.relations))
    if np.abs(free).max() < 1e-6:
        return
    found = vanishing(psi, free, search.folds)
    seeming, held = found.seeming(search.best_rad), found.held(search.best_rad)
    for count in dict.fromkeys((seeming, held)):
        if not count:
            continue
        independent = rank(free, found.weights[:, :count])
        off = _distance(search.sample, _generic(name, found.weights[:, :count], search.sample))
        for form in named(name, independent, search.relations):
            if _distance(search.sample, form.roughly(search.sample)) > 4.0 * off + FINE_RAD:
                continue
            numbers = form.fitted(search.sample)
            relations = form.relations(numbers)
            good = _distance(search.sample, relations) <= WORSE * off + FINE_RAD
            if good and (count == held or _supported(form, search)):
                search.keep(partial(_fitted, form), relations)
                search.sides += form.sides(numbers)
                return
    if held < seeming and found.found_rad[held] < 0.5 * found.left_out_rad[held]:
        on_others = found.left_out_rad[held]
        seen = f"to {on_others:.2g} on others" if np.isfinite(on_others) else "there are no others"
        search.missing.append(
            f"a relation of the {name} holds to {found.found_rad[held]:.2g} rad on the "
            f"demonstrations that it was found on, {seen}: show more demonstrations"
        )
    if held:
        again = partial(_again, name, rank(free, found.weights[:, :held]), search.relations)
        search.keep(again, again(search.sample))


def _again(
    name: str, count: int, known: tuple[Relation, ...], sample: Sample
) -> tuple[Relation, ...]:
    """The least varying combinations themselves, where they have no name."""
    psi, slopes = _features(sample, name)
    found = vanishing(psi, without(slopes, sample.slopes(known)), [])
    return _generic(name, found.weights[:, :count], sample)


def _fitted(form: Form, sample: Sample) -> tuple[Relation, ...]:
    """A form's relations, fitted to other rows."""
    return form.relations(form.fitted(sample))


def _generic(name: str, weights: np.ndarray, sample: Sample) -> tuple[Relation, ...]:
    """Combinations as relations, zero in the mean of the rows, in joint space's radians."""
    relations, (y, _) = [], sample.pose
    middle = np.concatenate([sample.position.mean(axis=0), np.zeros(9)])
    for w in weights.T:
        linear, full = np.zeros(FEATURES), np.zeros((FEATURES, FEATURES))
        if name == QUADRIC:
            linear[:3] = w[:3]
            for i, j, value in zip(_FIRST, _SECOND, w[3:] / METRES**2, strict=True):
                full[i, j] += value
                full[j, i] += value
        else:
            linear[_COLUMNS[name]] = w
        count = "a relation" if weights.shape[1] == 1 else f"{weights.shape[1]} relations"
        words = f"{count} of the tool's {name} without a name"
        own = Relation(words, "rad", 0.0, linear / _SCALE - full @ middle, full)
        relations.append(replace(own, constant=-float(own.values(y).mean())))
    return tuple(relations)


def _supported(form: Form, search: _Search) -> bool:
    """Whether a form holds on demonstrations that its numbers were not read off."""
    off = [
        _distance(search.sample[out], _fitted(form, search.sample[~out])) for out in search.folds
    ]
    return bool(off) and float(np.sqrt(np.mean(np.square(off)))) <= most_rad(search.best_rad)


def _distance(sample: Sample, relations: Sequence[Relation]) -> float:
    """The rms distance of the better GOOD of the rows from the relations' manifold [rad]."""
    off = np.sort(sample.distances(relations))
    return float(np.sqrt(np.mean(off[: max(1, int(GOOD * len(off)))] ** 2)))


def _told(search: _Search, robot: SerialRobot, demonstrations: int, dropped: int) -> Identified:
    missing, counts = "; ".join(search.missing), (len(search.sample), demonstrations, dropped)
    whose = robot.name, robot.tool_link
    if not search.relations:
        missing = missing or "the demonstrations keep to no relation, the motion is free"
        return Identified(None, (), 0, np.nan, (), missing, *counts, whose)
    left_out = _left_out(search)
    worst: dict[tuple[str, str], float] = {}
    for own, value in zip(search.relations, left_out.tolist(), strict=True):
        key = own.name, own.unit
        worst[key] = max(worst.get(key, 0.0), value)
    told = tuple(f"{name} (± {_amount(unit, value)})" for (name, unit), value in worst.items())
    noise = search.sample.distances(search.relations)
    noise_rad = float(np.sqrt((noise**2).mean() / len(search.relations)))
    # a side is no relation that is missed: it only tells two sets of the same zeros apart
    about = (*left_out.tolist(), *(0.0 for _ in search.sides))
    constraint = PolynomialConstraint((*search.relations, *search.sides), about)
    codim = len(search.relations)
    return Identified(constraint, told, codim, noise_rad, about, missing, *counts, whose)


def _left_out(search: _Search) -> Float[np.ndarray, "m"]:
    """The rms of each row on demonstrations that its relation was not found on."""
    squares = []
    for out in search.folds:
        rest, own = search.sample[~out], search.sample[out]
        relations = [one for found in search.found for one in found(rest)]
        squares.append([float((one.values(own.pose[0]) ** 2).mean()) for one in relations])
    return np.sqrt(np.mean(squares, axis=0))


def _amount(unit: str, value: float) -> str:
    return f"{1e3 * value:.2g} mm" if unit == "m" else f"{np.degrees(value):.2g}°"


def with_tolerance(constraint: PolynomialConstraint, loosely: float) -> PolynomialConstraint:
    """The same, each row as loose as so many times what it is missed by on left-out
    demonstrations.
    """
    relations = zip(constraint.relations, constraint.left_out, strict=True)
    wider = tuple(
        replace(own, tolerance=max(own.tolerance, loosely * off)) for own, off in relations
    )
    return replace(constraint, relations=wider)
