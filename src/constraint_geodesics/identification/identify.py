"""Identification: from simple relations to rich ones, each kept only if it also holds on
demonstrations that it was not found on.

The order is positions, orientations, the whole pose, then quadrics of the position, and last what
is not held but bounded; what is held already is taken out of the gradients of what comes next, so
that nothing is found twice.  Where a form has a name (forms.py) it stands in place of the
combination that was found.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.both import Both, both
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.relations import RelationsConstraint
from constraint_geodesics.constraints.spline import Spline, SplineConstraint, SplineRelation
from constraint_geodesics.constraints.tool_features import FEATURES
from constraint_geodesics.identification import freeform
from constraint_geodesics.identification.bounds import Bound, bounds_of
from constraint_geodesics.identification.demonstrations import demonstrations_from, nearest_turns
from constraint_geodesics.identification.forms import (
    POSE,
    POSITION,
    PRODUCT,
    QUADRIC,
    ROUND,
    TURNED,
    Form,
    Round,
    circle,
    named,
)
from constraint_geodesics.identification.support import Support, support_of
from constraint_geodesics.identification.vanishing import (
    APART,
    AT_MOST_RAD,
    GOOD,
    METRES,
    AnyRelation,
    Sample,
    better_rms,
    most_rad,
    near,
    rank,
    trimmed,
    vanishing,
    without,
)
from constraint_geodesics.progress import saying_late
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Placement

SURELY_RAD = 6e-3
"""Freeform relations hold where left-out demonstrations are no further off: there are gaps between
demonstrations, and what has no formula is less sure there.
"""
WORST_FOLD_RAD = 0.05
"""And not by more in any part of them."""
WORTH = 0.8
"""What is freeform takes a formula's place where left-out demonstrations are nearer by this."""
WORSE, FINE_RAD = 1.25, 2e-5
"""A form may be off by so many times what the combination is that it stands for, and by so much."""
LOOSE_RAD = 0.008
"""Relations that are held no better may be tolerances."""
ROUNDS = 4
VARIED, FAR, VARIED_RAD = 5.0, 25.0, 1e-3
"""Demonstrations vary in every direction that is left free by so many times the rows' distance from
the relations, in their farthest by so many times, and by so much [rad].
"""
SAME_RAD = 1e-7
"""Relations from which all rows' distances differ by no more are the same."""
SAME_M = 1e-9
"""Joints whose origins are no further apart have the same place."""
_COLUMNS = {POSITION: np.arange(3), TURNED: np.arange(3, 12), POSE: np.arange(12)}
_SCALE = np.array([METRES] * 3 + [1.0] * 9)
_FIRST, _SECOND = np.triu_indices(3)
_ONES = np.ones((1, FEATURES))
TIP = "the tool's tip"
"""Whose place relations are of, in words."""

Found = Callable[[Sample], tuple[AnyRelation, ...]]
"""Relations as they are found on rows."""


class Whose(NamedTuple):
    """A robot's name, its tool link, and where that is in the frame of the last joint."""

    name: str
    tool_link: str
    tool: Placement


@dataclass(frozen=True)
class Identified:
    """What demonstrations keep to.

    constraint: None where nothing was identified.  relations: in words, each with the rms by which
    it is missed on left-out demonstrations, and bounds, with the rms by which these are beyond.
    codim: dimensions that relations take.  noise_rad: rms distance of the rows from the constraint
    manifold, along each direction that is held; nan without one.  left_out: rms
    of each row of the residual on left-out demonstrations, in its unit.  missing: what was seen but
    not supported, or why there is nothing.  dropped: rows that were taken to be wrong.  robot: of
    whose tool all this is said.  support: the region where demonstrations
    were; `supported` keeps a path in it.  bounds: how many of the relations are tolerances.
    rounded: the same with axes and round numbers that left-out demonstrations are no further from,
    None if there are none; is_rounded: whether these are taken.  loosely: by how many times what
    relations are missed by the constraint is looser (`held_loosely`).
    """

    constraint: Constraint | None
    relations: tuple[str, ...]
    codim: int
    noise_rad: float
    left_out: tuple[float, ...]
    missing: str
    rows: int
    demonstrations: int
    dropped: int
    robot: Whose
    support: Support | None = None
    bounds: int = 0
    rounded: "Identified | None" = None
    is_rounded: bool = False
    loosely: float = 0.0

    @property
    def supported(self) -> Constraint | None:
        """The constraint, and that the tip stays where it was shown."""
        if self.constraint is None or self.support is None:
            return self.constraint
        region = SplineConstraint((self.support.relation,), (0.0,))
        return both(self.constraint, region)

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
            "bounds": self.bounds,
            "noise_rad": self.noise_rad if self.codim else None,
            "left_out_error": self.left_out_error,
            "where_shown": None if self.support is None else self.support.words,
            "is_rounded": self.is_rounded,
            "loosely": self.loosely,
            "rounded": None if self.rounded is None else list(self.rounded.relations),
            "rows": self.rows,
            "demonstrations": self.demonstrations,
            "dropped": self.dropped,
        }

    def held_loosely(self, times: float) -> "Identified":
        """The same with a constraint that is looser (`with_tolerance`) than what was identified."""
        if self.constraint is None:
            return self
        wider = with_tolerance(self.constraint, times - self.loosely)
        return replace(self, constraint=wider, loosely=times)

    def save(self, file: str | Path, where_shown: bool = False) -> None:
        """Write the constraint as YAML (`files.save_constraint`)."""
        from constraint_geodesics.identification.files import save_constraint

        save_constraint(self, file, where_shown)

    @property
    def explanation(self) -> str:
        """All of it in one line."""
        told = "; ".join(self.relations) or "nothing is identified"
        dropped = f"; {self.dropped} wrong rows left out" if self.dropped else ""
        line = f"{told}{dropped}{': ' if not self.relations else '. '}{self.missing}".rstrip(". ")
        if self.loosely:
            line += f". Held looser by {self.loosely:g} times what they are missed by"
        if self.rounded is None:
            return line
        rounder = [own for own in self.rounded.relations if own not in self.relations]
        return f"{line}. Within the noise: {'; '.join(rounder)}"


def identify(demonstrations: Any, robot: SerialRobot) -> Identified:
    """The constraint that demonstrations keep to.

    demonstrations: rows (n, D), or (demonstrations, T, D), or a list of (T, D) [rad], or a file:
    CSV (a first column more is the demonstration's number) or parquet as LeRobot writes it.  What
    is shown twice counts once.
    Raises DemonstrationError, one line, for what nothing can be learned from.
    """
    shown, motions = demonstrations_from(demonstrations, robot)
    with saying_late("looking what the demonstrations keep to"):
        return _identified(shown, motions, robot)


def _identified(shown: list[np.ndarray], motions: bool, robot: SerialRobot) -> Identified:
    sample = Sample.of_joints(robot, shown, motions)
    kept, search = np.ones(len(sample), dtype=bool), _searched(sample)
    if not search.relations:
        kept = _likely(sample)
        search = search if kept.all() else _searched(sample[kept])
    for _ in range(ROUNDS):
        if not search.relations:
            break
        off = sample.distances(search.relations)
        right = near(off, off[kept])
        if (right == kept).all():
            break
        if right.mean() < GOOD:  # that many are not wrong, they say something else
            search.missing.append(
                f"{1.0 - right.mean():.0%} of the rows are further off than the others: not all "
                f"demonstrations are of one kind"
            )
            break
        kept, search = right, _searched(sample[right])
    q = np.concatenate(shown)
    if not search.relations and search.folds:
        search = _of_joints(search, sample, robot, q)
    of_all = len(search.sample) == len(q)
    search = _varied(search, nearest_turns(q if of_all else q[kept], robot))
    if search.joint is None:
        search = _bounded(search, sample)
    dropped = len(sample) - len(search.sample)
    found, rounded = _told(search, robot, len(shown), dropped), _rounded(search)
    if rounded is None:
        return found
    taken = replace(_told(rounded, robot, len(shown), dropped), is_rounded=True)
    return replace(found, rounded=taken)


def _likely(sample: Sample) -> Bool[np.ndarray, "n"]:
    """Rows that keep to a relation that GOOD of them keep to; all if there is none."""
    for name in (*_COLUMNS, QUADRIC):
        least, off = trimmed(*_features(sample, name), GOOD)
        right = near(off, off)
        if least <= AT_MOST_RAD and right.mean() >= GOOD:
            return right
    return np.ones(len(sample), dtype=bool)


@dataclass(frozen=True, eq=False)
class _Step:
    """Relations that were found together.  again: how they are found on other rows.  sides: which
    of opposite sides of theirs is shown.  form: whose `numbers` they are of, if they have a name,
    rounded to `digits`, if they are.
    """

    again: Found
    relations: tuple[AnyRelation, ...]
    sides: tuple[AnyRelation, ...] = ()
    form: Form | None = None
    numbers: Float[np.ndarray, "p"] | None = None
    digits: Round | None = None

    @classmethod
    def of_form(cls, form: Form, numbers: Float[np.ndarray, "p"], digits: Round | None) -> "_Step":
        """What numbers of a form make."""
        if digits is not None:
            numbers = form.rounded(numbers, digits)
        again, made = partial(_fitted, form), form.relations(numbers)
        return cls(again, made, form.sides(numbers), form, numbers, digits)

    def on(self, sample: Sample) -> "_Step":
        """The same as it is found on other rows."""
        if self.form is None:
            return replace(self, relations=self.again(sample))
        return self.of_form(self.form, self.form.fitted(sample), self.digits)


@dataclass
class _Search:
    """What is found so far, how, and what was seen but not supported.  joint: whose place it is
    about, None for the tool.  bounds: what is not held but bounded.
    """

    sample: Sample
    folds: Sequence[Bool[np.ndarray, "n"]]
    best_rad: float = 0.0
    steps: list[_Step] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    joint: int | None = None
    bounds: tuple[Bound, ...] = ()
    _on_others: dict[int, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def relations(self) -> tuple[AnyRelation, ...]:
        """All that are found."""
        return tuple(own for step in self.steps for own in step.relations)

    @property
    def sides(self) -> tuple[AnyRelation, ...]:
        """All of them."""
        return tuple(own for step in self.steps for own in step.sides)

    @property
    def on_others(self) -> list[tuple[Sample, tuple["_Step", ...]]]:
        """The rows of each fold, and each step as it is found on all others."""
        count = len(self.steps)  # they become more
        if count not in self._on_others:
            self._on_others[count] = [
                (self.sample[out], tuple(step.on(self.sample[~out]) for step in self.steps))
                for out in self.folds
            ]
        found: list[tuple[Sample, tuple[_Step, ...]]] = self._on_others[count]
        return found


def _searched(sample: Sample) -> _Search:
    search = _Search(sample, sample.folds())
    names = (*_COLUMNS, QUADRIC)
    least = [vanishing(*_features(sample, name), []).found_rad for name in names]
    search.best_rad = min((float(own[0]) for own in least if len(own)), default=np.inf)
    for name in names:
        _look(search, name)
    search = _with_freeform(search) if search.folds else search
    _look(search, PRODUCT)
    return search


def _bounded(search: _Search, sample: Sample) -> _Search:
    """The same with bounds on what is free, and in place of relations that are only nearly held and
    whose residuals fill an interval or disc.

    sample: all rows, of which those that were wrong for such relations may be right.
    """
    if not search.folds:
        return search
    held, loose = dict[str, list[_Step]](rad=[], m=[]), dict[str, list[_Step]](rad=[], m=[])
    for step in search.steps:
        near = _distance(search.sample, step.relations) <= LOOSE_RAD * len(step.relations) ** 0.5
        turned = any(np.any(own.gradients(_ONES)[:, 3:]) for own in step.relations)
        placed = any(map(_holds_the_tip, step.relations))
        for unit, what in (("rad", turned), ("m", placed)):
            if what:
                (held if near or (turned and placed) else loose)[unit].append(step)

    def look(rows: Sample) -> tuple[tuple[Bound, ...], list[_Step]]:
        found = bounds_of(rows, bool(held["rad"]), bool(held["m"]), rows.folds())
        instead = [step for own in found for step in loose[own.relation.unit]]
        return found, [step for step in search.steps if step not in instead]

    rows = search.sample if any(held.values()) else sample
    found, steps = look(rows)
    if steps and rows is not search.sample:  # what is wrong for a relation that stays, is wrong
        rows = search.sample
        found, steps = look(rows)
    if not found:
        return search
    right = np.logical_and.reduce([own.right for own in found])
    kept = rows[right]
    return _Search(kept, kept.folds(), search.best_rad, steps, search.missing, None, found)


def _varied(search: _Search, q: Float[np.ndarray, "n D"]) -> _Search:
    """Nothing of what was found, where demonstrations hardly differ in what it leaves free: then
    it is a lack of variation and no relation.
    """
    if not search.relations:
        return search
    count = len(search.relations)
    noise = better_rms(search.sample.distances(search.relations)) / np.sqrt(count)
    spreads = np.linalg.svd(q - np.median(q, axis=0), compute_uv=False) / np.sqrt(len(q))
    free = max(q.shape[1] - count, 1)
    least = spreads[min(free, len(spreads)) - 1]
    if least >= max(VARIED * noise, VARIED_RAD) and spreads[0] >= FAR * noise:
        return search
    missing = (
        f"what seems to be held varies by {noise:.2g} rad, and what seems to be free by only "
        f"{least:.2g} to {spreads[0]:.2g}: show more demonstrations that differ from each other"
    )
    return _Search(search.sample, [], missing=[missing])


def _of_joints(
    search: _Search, sample: Sample, robot: SerialRobot, q: Float[np.ndarray, "n D"]
) -> _Search:
    """Where nothing of the tool is held: what the place of a joint keeps to, of the first joint
    whose place no other has.
    """
    seen = [sample.position]
    for joint in range(1, robot.dof):
        own = sample.of_joint(robot, q, joint)
        if any(np.abs(own.position - other).max() < SAME_M for other in seen):
            continue
        seen.append(own.position)
        found = _Search(own, own.folds(), missing=list(search.missing), joint=joint)
        least = [vanishing(*_features(own, name), []).found_rad for name in (POSITION, QUADRIC)]
        found.best_rad = min((float(rad[0]) for rad in least if len(rad)), default=np.inf)
        for name in (POSITION, QUADRIC):
            _look(found, name)
        if found.relations:
            return found
    return search


def _features(sample: Sample, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Features of order 1 and their gradients."""
    y, slopes = sample.pose
    y, slopes = y / _SCALE, slopes / _SCALE[:, None]
    if name in _COLUMNS:
        return y[:, _COLUMNS[name]], slopes[:, _COLUMNS[name]]
    if name == PRODUCT:
        p, turned = y[:, :3], y[:, 3:]
        products = (p[:, :, None] * turned[:, None]).reshape(len(y), -1)
        moved = p[:, :, None, None] * slopes[:, None, 3:]
        moved = moved + turned[:, None, :, None] * slopes[:, :3, None]
        moved = moved.reshape(len(y), -1, slopes.shape[2])
        return np.hstack([y, products]), np.concatenate([slopes, moved], axis=1)
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
                search.steps.append(_Step.of_form(form, numbers, None))
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
        search.steps.append(_Step(again, again(search.sample)))


def _with_freeform(search: _Search) -> _Search:
    """Freeform relations beside those that have a formula, or in place of some of them, where
    these only come near what is shown.
    """
    flat = sum(map(_is_flat, search.relations))
    tip = sum(map(_holds_the_tip, search.relations))
    if tip == flat < 2:
        found = _look_for_tip(search, np.inf)
        _look_for_axes(search, found)
        if found is not None or not flat:
            return search
    off = _tip_left_out_rad(search)
    if off < FINE_RAD or flat > 1:
        return search
    other = _Search(search.sample, search.folds, best_rad=search.best_rad)
    for step in search.steps:
        # a plane stays, unless it is what is in question
        kept = [not _holds_the_tip(own) or (tip > 1 and _is_flat(own)) for own in step.relations]
        if all(kept):
            other.steps.append(step)
    found = _look_for_tip(other, off)
    if found is None:
        return search
    _look_for_axes(other, found)
    return other


def _holds_the_tip(own: AnyRelation) -> bool:
    return bool(np.any(own.gradients(_ONES)[:, :3]))


def _is_flat(own: AnyRelation) -> bool:
    """A plane."""
    slopes = own.gradients(_ONES)
    return isinstance(own, Relation) and not own.matrix.any() and not np.any(slopes[:, 3:])


def _look_for_tip(search: _Search, off: float) -> freeform.Freeform | None:
    """Add a freeform line or surface where nothing holds the tip but a plane, if left-out
    demonstrations are nearer to it than `off` [rad].
    """
    sample = search.sample
    flat = _flat_normal(search)
    found = _better(search, None, freeform.line(sample, flat))
    if found is None and flat is None:
        found = _better(search, None, freeform.surface(sample))
        if found is not None and found.left_out_rad < WORTH * off and not _turned(search):
            found = _better(search, found, freeform.along_normal(sample, found))
    if found is None or found.left_out_rad >= WORTH * off:
        return None
    search.steps.append(_Step(found.again, found.relations, found.sides))
    return found


def _look_for_axes(search: _Search, tip: freeform.Freeform | None) -> None:
    """Add axes that turn with the place, over what holds the tip or a plane that does."""
    sample, held = search.sample, _turned(search)
    flat = _flat_normal(search)
    if tip is not None:
        place = tip.model.grid
    elif flat is not None:
        place = freeform.plane_grid(sample, flat)
    else:
        return
    if held > 2:
        return
    off, axes = freeform.axes_of_place(sample, place, search.folds)
    small = int((off < freeform.HOPELESS_RAD).sum())
    models = []
    if held == 2 and small == 3:
        along = tip is not None and tip.model.axis is not None
        known = tip.axis if tip is not None and along else freeform.least_moving(sample)
        models.append(freeform.turning(sample, place, None, known))
    elif held == 0 and small == 3:
        models.append(freeform.turning(sample, place, axes[0], axes[0]))
    if held == 0 and small:
        models.append(freeform.turning(sample, place, axes[0], None))
    if held == 1 and small:
        # an angle is held, which is one of the two rows of an axis
        both_rows = freeform.turning(sample, place, axes[0], None)
        models.append(
            both_rows if _independent(search, both_rows) == 2 else _rest(search, place, axes[0])
        )
    found = next(filter(None, (_better(search, None, model) for model in models)), None)
    if found is not None:
        search.steps.append(_Step(found.again, found.relations))


def _rest(search: _Search, place: Spline, axis: Float[np.ndarray, "3"]) -> freeform.Model:
    """Of the two rows of an axis that which what is held leaves open."""
    models = [freeform.turning(search.sample, place, axis, None, only) for only in range(2)]
    return max(models, key=lambda own: float(np.square(_left_open(search, own)).sum()))


def _independent(search: _Search, model: freeform.Model) -> int:
    """How many rows of a model are independent of what is held, with flat splines."""
    sizes = np.linalg.svd(_left_open(search, model), compute_uv=False)
    rms = np.sqrt((sizes**2).mean(axis=0))
    return int((rms > APART * rms[0]).sum())


def _left_open(search: _Search, model: freeform.Model) -> Float[np.ndarray, "n k D"]:
    """Slopes of a model's rows along what is held leaves free, with flat splines."""
    flat = model.relations([model.grid] * model.splines, np.zeros(3))
    slopes = search.sample.slopes(flat)
    return without(slopes, search.sample.slopes(search.relations))


def _flat_normal(search: _Search) -> Float[np.ndarray, "3"] | None:
    """The normal of a plane that holds the tip, if one does."""
    return next((own.linear[:3] for own in search.relations if _is_flat(own)), None)


def _turned(search: _Search) -> int:
    """How many relations hold the tool's orientation."""
    slopes = [own.gradients(_ONES)[:, 3:] for own in search.relations]
    return sum(bool(np.any(own)) for own in slopes)


def _better(
    search: _Search, found: freeform.Freeform | None, model: freeform.Model
) -> freeform.Freeform | None:
    """A richer model where left-out demonstrations support it, else what is found already."""
    own = freeform.fitted(model, search.sample, search.folds)
    enough = max(most_rad(min(search.best_rad, own.found_rad)), SURELY_RAD)
    if own.left_out_rad <= enough and own.worst_fold_rad <= WORST_FOLD_RAD:
        return own
    if own.found_rad <= 0.5 * min(own.left_out_rad, enough):
        search.missing.append(
            f"{own.relations[-1].name} to {own.found_rad:.2g} rad on the demonstrations that it "
            f"was found on, to {own.left_out_rad:.2g} on others: show more demonstrations"
        )
    return found


def _again(
    name: str, count: int, known: tuple[AnyRelation, ...], sample: Sample
) -> tuple[AnyRelation, ...]:
    """The least varying combinations themselves, where they have no name."""
    psi, slopes = _features(sample, name)
    found = vanishing(psi, without(slopes, sample.slopes(known)), [])
    return _generic(name, found.weights[:, :count], sample)


def _fitted(form: Form, sample: Sample) -> tuple[AnyRelation, ...]:
    """A form's relations, fitted to other rows."""
    return form.relations(form.fitted(sample))


def _generic(name: str, weights: np.ndarray, sample: Sample) -> tuple[AnyRelation, ...]:
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
        elif name == PRODUCT:
            linear[:] = w[:12]
            product = w[12:].reshape(3, 9) / METRES
            full[:3, 3:], full[3:, :3] = product, product.T
        else:
            linear[_COLUMNS[name]] = w
        count = "a relation" if weights.shape[1] == 1 else f"{weights.shape[1]} relations"
        words = f"{count} of the tool's {name} without a name"
        centred = middle if name == QUADRIC else np.zeros(FEATURES)
        own = Relation(words, "rad", 0.0, linear / _SCALE - full @ centred, full)
        relations.append(replace(own, constant=-float(own.values(y).mean())))
    return tuple(relations)


def _supported(form: Form, search: _Search) -> bool:
    """Whether a form holds on demonstrations that its numbers were not read off."""
    off = [
        _distance(search.sample[out], _fitted(form, search.sample[~out])) for out in search.folds
    ]
    return bool(off) and float(np.sqrt(np.mean(np.square(off)))) <= most_rad(search.best_rad)


def _distance(sample: Sample, relations: Sequence[AnyRelation]) -> float:
    """The rms distance of the better GOOD of the rows from the relations' manifold [rad]."""
    return better_rms(sample.distances(relations))


def _rounded(search: _Search) -> _Search | None:
    """The same with rounder numbers, where left-out demonstrations are no further from what is
    found without them and rounded than from what is not; None where there are none.
    """
    steps: list[_Step] = []
    for k, step in enumerate(search.steps):
        steps.append(step)
        form, numbers = step.form, step.numbers
        if form is None or numbers is None:
            continue
        others = [(own, found[k]) for own, found in search.on_others]
        off = sum(_distance(own, found.relations) ** 2 for own, found in others)
        known = [x for x in (found.numbers for _, found in others) if x is not None]
        if form.flat and steps[:-1] != search.steps[:k]:  # about the normal of a plane that moved
            form = circle(next(r.linear[:3] for s in steps for r in s.relations if _is_flat(r)))
            numbers = form.fitted(search.sample)
            steps[-1] = _Step.of_form(form, numbers, None)
            known = [form.fitted(search.sample[~out]) for out in search.folds]
        for digits in ROUND:
            rounded = _Step.of_form(form, numbers, digits)
            first, second = (search.sample.distances(own.relations) for own in (steps[-1], rounded))
            if np.abs(first - second).max() < SAME_RAD:
                break  # they are round already
            fits = [_Step.of_form(form, x, digits) for x in known]
            pairs = zip(others, fits, strict=True)
            if sum(_distance(own, fit.relations) ** 2 for (own, _), fit in pairs) <= off:
                steps[-1] = rounded
                break
    if all(own is step for own, step in zip(steps, search.steps, strict=True)):
        return None
    return replace(search, steps=steps)


def _told(search: _Search, robot: SerialRobot, demonstrations: int, dropped: int) -> Identified:
    missing, counts = "; ".join(search.missing), (len(search.sample), demonstrations, dropped)
    whose = Whose(robot.name, robot.tool_link, Placement.of_matrix(robot.chain.tool))
    if not search.relations and not search.bounds:
        missing = missing or "the demonstrations keep to no relation, the motion is free"
        return Identified(None, (), 0, np.nan, (), missing, *counts, whose)
    held = _left_out(search).tolist()
    left_out = [*held, *(own.left_out for own in search.bounds)]
    bounds = [own.relation for own in search.bounds]
    worst: dict[str, dict[str, float]] = {}
    for own, value in zip((*search.relations, *bounds), left_out, strict=True):
        by_unit = worst.setdefault(own.name, {})
        by_unit[own.unit] = max(by_unit.get(own.unit, 0.0), value)
    told = tuple(
        f"{name} (± {', '.join(_amount(unit, value) for unit, value in by_unit.items())})"
        for name, by_unit in worst.items()
    )
    noise_rad = np.nan
    if search.relations:
        noise = search.sample.distances(search.relations)
        noise_rad = float(np.sqrt((noise**2).mean() / len(search.relations)))
    # a side is no relation that is missed: it only tells two sets of the same zeros apart
    about = (*left_out, *(0.0 for _ in search.sides))
    region = None
    if search.joint is None:
        region = support_of(search.sample, search.relations, search.folds)
    else:
        origin = f"the origin of {robot.joint_names[search.joint]}"
        told = tuple(words.replace(TIP, origin) for words in told)
    rows = (*search.relations, *bounds, *search.sides)
    if search.joint is not None:
        rows = tuple(replace(own, name=own.name.replace(TIP, origin)) for own in rows)
    constraint, about = _constraint(rows, about, search.joint)
    codim = len(search.relations)
    return Identified(
        constraint, told, codim, noise_rad, about, missing, *counts, whose, region, len(bounds)
    )


def _constraint(
    relations: tuple[AnyRelation, ...], left_out: tuple[float, ...], joint: int | None
) -> tuple[Constraint, tuple[float, ...]]:
    """Relations as a constraint, those of a kind together, and what its rows are off by."""
    pairs = list(zip(relations, left_out, strict=True))
    rows = [(own, off) for own, off in pairs if isinstance(own, Relation)]
    more = [(own, off) for own, off in pairs if isinstance(own, SplineRelation)]
    parts: list[Constraint] = []
    if rows:
        named, off = zip(*rows, strict=True)
        parts.append(PolynomialConstraint(named, off, joint))
    if more:
        parts.append(SplineConstraint(*zip(*more, strict=True)))
    found = parts[0] if len(parts) == 1 else Both(*parts)
    return found, tuple(off for _, off in (*rows, *more))


def _left_out(search: _Search) -> Float[np.ndarray, "m"]:
    """The rms of each row on demonstrations that its relation was not found on."""
    squares = [
        [float((r.values(sample.pose[0]) ** 2).mean()) for step in steps for r in step.relations]
        for sample, steps in search.on_others
    ]
    return np.sqrt(np.mean(squares, axis=0))


def _tip_left_out_rad(search: _Search) -> float:
    """The rms distance of the better GOOD of the rows from what holds the tip, along each direction
    that it holds, on demonstrations that it was not found on.
    """
    holds = [
        tuple(r for step in steps for r in step.relations if _holds_the_tip(r))
        for _, steps in search.on_others
    ]
    off = [own.distances(tip) for (own, _), tip in zip(search.on_others, holds, strict=True)]
    return better_rms(np.concatenate(off)) / float(np.sqrt(len(holds[0])))


def _amount(unit: str, value: float) -> str:
    return f"{1e3 * value:.2g} mm" if unit == "m" else f"{np.degrees(value):.2g}°"


def with_tolerance(constraint: Constraint, loosely: float) -> Constraint:
    """The same, each row looser by so many times what left-out demonstrations miss it by."""
    if isinstance(constraint, Both):
        parts = constraint.first, constraint.second
        return Both(*(with_tolerance(own, loosely) for own in parts))
    assert isinstance(constraint, RelationsConstraint)
    return constraint.widened(loosely)
