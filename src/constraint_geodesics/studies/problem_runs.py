"""The planner and its baselines on problems in scenes of their own: one batch a scene, one row an
answer, and the figures of the rows.

All are asked the same problems, one after another in one process on one thread, and judged alike:
by the certifier, and by PyBullet at configurations DENSE_RAD apart on every path that is answered,
in a world of its own.  The baselines have the certifier's compiled check, and are asked again with
another seed and half their step until the certifier takes their path, as the planner does before it
answers; all of that is in their time.  A path counts that is there within the limit.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.arm_source import ArmSource, opened
from constraint_geodesics.benchmark.dense_check import watched
from constraint_geodesics.benchmark.problem_files import (
    Problem,
    require_different,
    told,
    told_of_arm,
)
from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.benchmark.row import KEY
from constraint_geodesics.benchmark.runner import (
    Baseline,
    QueryBatch,
    batch_rows,
    fingerprint,
    make_rows,
)
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.params import BaselineParams, Params
from constraint_geodesics.peers.baseline import BaselineError, BaselineSettings, Context
from constraint_geodesics.peers.making import made_together
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.peers.registry import after, kind_of, settings_of
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.planner import Planner
from constraint_geodesics.problem import PathPlanner
from constraint_geodesics.scene.scene import Scene

UNDISTURBED = 0.9
"""Share of a core that an answer must have had for its time to be taken as it is."""
MEASURED_BY = ("studies.problem_runs", "studies.problems", "studies.clutter")
"""The modules that draw, ask and judge: every row depends on what they import."""
COLUMNS = (
    *("scene", "constraint", "query", "planner", "settings", "status", "valid", "touches"),
    *("ends", "limit_s", "time_s", "scene_s", "length_rad", "best_known_rad", "looked_at"),
    *("iterations", "peak_memory_mb", "core_share", "reason"),
)
"""Of the table.  valid: the certifier's word; touches: PyBullet's, on the path; ends: what is wrong
with the ends, if anything; looked_at: configurations that PyBullet was asked about; core_share: of
a core that the process had meanwhile.
"""
_PREPARED: WeakKeyDictionary[Planner, set[Any]] = WeakKeyDictionary()
"""Constraints whose roadmaps a planner of this process has."""
_TAKEN_IN_S: dict[ArmSource, float] = {}
"""What the last change of its planner's scene took."""


@dataclass(frozen=True)
class Asked:
    """Who is asked.  planners: by name, as `benchmark.planners` of params.yaml has them.  limits_s:
    of a constraint by name; limit_s: of any other [s].  rows: the folder of kept rows.  code: a
    digest of the code that the rows depend on.
    """

    params: Params
    planners: Mapping[str, BaselineParams]
    limit_s: float
    limits_s: Mapping[str, float]
    rows: Path
    code: str

    def limit(self, constraint: str) -> float:
        """Of a query under a constraint [s]."""
        return self.limits_s.get(constraint, self.limit_s)


@dataclass(frozen=True)
class ProblemBuilder:
    """Makes planners for one scene after another of an arm whose planner stays open; picklable."""

    params: Params
    planners: Mapping[str, BaselineParams]
    arm: ArmSource
    limit_s: float

    @contextmanager
    def __call__(
        self, names: Sequence[str], scene: Scene, constraint: str, manifold: ConstraintManifold
    ) -> Iterator[tuple[Mapping[str, PathPlanner], Mapping[str, float]]]:
        """The planners of these names, and the seconds that each took to be ready for the scene:
        for the planner the change of its scene, whichever query of it came first.  Its roadmap,
        which knows no scene, is made before.
        """
        settings = {name: settings_of(name, self.planners[name]) for name in names}
        planner = opened(self.arm)
        began = time.perf_counter()
        if replace(scene, robot=planner.robot) != planner.scene.now:  # it came by pickle
            planner.scene.become(scene)
            _TAKEN_IN_S[self.arm] = time.perf_counter() - began
        changed_s = _TAKEN_IN_S.get(self.arm, 0.0)
        prepared = _PREPARED.setdefault(planner, set())
        if manifold.constraint.key not in prepared:
            planner.prepare(manifold.constraint)
            prepared.add(manifold.constraint.key)
        shared: dict[str, Any] = {"planner": planner}
        context = Context(scene, constraint, manifold, self.params, Layout(), shared)
        made, took = made_together(settings, context, self.limit_s)
        changed = {name: s + changed_s * settings[name].uses_bundle for name, s in took.items()}
        yield made, changed


def limited(entry: BaselineParams, limit_s: float) -> BaselineParams:
    """A planner that stops at the limit, where it can be told, and its entry does not say when."""
    can_stop = issubclass(kind_of(entry.kind), OmplSettings) and "budget_s" not in entry.settings
    more = {"budget_s": limit_s} if can_stop else {}
    return BaselineParams.model_validate(entry.model_dump() | more)


def batches(problems: Sequence[Problem], asked: Asked) -> list[QueryBatch]:
    """The problems in batches: those that follow each other in one scene under one constraint.

    Raises BaselineError for a planner that is made of what was trained for another arm,
    ProblemFileError for two problems whose rows would have one key.
    """
    require_different(problems)
    arms, found = dict[ArmSource, Mapping[str, Any]](), []
    for own in _together(problems):
        arm, robot = own[0].arm, own[0].scene.robot
        if arm not in arms:  # its meshes may be large
            arms[arm] = told_of_arm(robot)
        found.append(_batch(own, asked, arms[arm]))
    return found


def _together(problems: Sequence[Problem]) -> Iterator[list[Problem]]:
    own = list[Problem]()
    for problem in problems:
        if own and not (
            own[0].scene is problem.scene and own[0].constraint_name == problem.constraint_name
        ):
            yield own
            own = []
        own.append(problem)
    if own:
        yield own


def _batch(problems: Sequence[Problem], asked: Asked, arm: Mapping[str, Any]) -> QueryBatch:
    """arm: what is told of its files."""
    first, params = problems[0], asked.params
    name = first.constraint_name
    limit_s, robot = asked.limit(name), first.scene.robot
    planners = {own: limited(entry, limit_s) for own, entry in asked.planners.items()}
    settings = {own: settings_of(own, entry) for own, entry in planners.items()}
    parts = [
        asked.code,
        machine(),
        params.judge.model_dump(),
        arm,
        limit_s,
        *(told(problem) for problem in problems),
    ]
    return QueryBatch(
        scene=first.scene,
        manifold=ConstraintManifold(robot, first.constraint),
        queries=tuple(Query(name, own.group, own.number, own.start, own.goal) for own in problems),
        baselines=tuple(
            _baseline(own, entry.kind, settings, parts) for own, entry in planners.items()
        ),
        build=ProblemBuilder(params, planners, first.arm, limit_s),
        judge=params.judge,
        file=asked.rows / f"{_plain(name)}-{_plain(first.group)}-{first.number}.jsonl",
        watch=watched,
    )


def _plain(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def _baseline(
    name: str, kind: str, settings: Mapping[str, BaselineSettings], parts: Sequence[Any]
) -> Baseline:
    own = settings[name]
    if own.trained:
        raise BaselineError(f"{name!r} is made of what the pipeline trained: it has no such arm")
    about = [kind, own.model_dump(mode="json")]
    return Baseline(
        name=name,
        seeds=(0,),
        fingerprint=fingerprint(*about, *parts),
        kind=kind,
        settings=fingerprint(*about)[:8],
        after=after(name, settings),
        uses_clearance=own.uses_clearance or own.band,
    )


def answered(problems: Sequence[Problem], asked: Asked, description: str) -> pd.DataFrame:
    """The table of all rows, after those that are not there yet have been made.  description: names
    the work where its progress is shown.  Raises BaselineError and ProblemFileError as `batches`.
    """
    own = batches(problems, asked)
    make_rows(own, asked.params.compute, description)
    return table_of([row for batch in own for row in batch_rows(batch)], asked.limit)


def table_of(rows: Sequence[Mapping[str, Any]], limit: Callable[[str], float]) -> pd.DataFrame:
    """All rows, in the order of problems.  limit: of a constraint [s].  best_known_rad: the
    shortest certified path that PyBullet finds free, in whatever time.
    """
    if not rows:
        return pd.DataFrame(columns=list(COLUMNS))
    table = pd.DataFrame(rows)
    table["limit_s"] = table["constraint"].map(limit)
    numbers = ["time_s", "scene_s", "length_rad", "peak_memory_mb", "core_share"]
    table[numbers] = table[numbers].astype(float)
    assert not table.duplicated(list(KEY)).any()
    sound = table["valid"] & ~table["touches"]
    best = table["length_rad"].where(sound).groupby([table[k] for k in _ASKED])
    table["best_known_rad"] = best.transform("min")
    return table[list(COLUMNS)]


_ASKED = ["scene", "constraint", "query"]
"""What tells one problem from another."""


def figures(table: pd.DataFrame) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """By constraint and scene, and of all its scenes together ("all"), the figures of each planner
    by name; none of one that a constraint is not for.
    """
    found: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    table = table[table["status"] != "not_applicable"]
    counted = table.assign(
        solved=table["valid"] & ~table["touches"] & (table["time_s"] <= table["limit_s"])
    )
    counted["solvable"] = counted.groupby(_ASKED)["solved"].transform("any")
    for constraint, own in counted.groupby("constraint", sort=False):
        scenes = {str(scene): rows for scene, rows in own.groupby("scene", sort=False)}
        found[str(constraint)] = {
            scene: {
                str(name): figures_of(each) for name, each in rows.groupby("planner", sort=False)
            }
            for scene, rows in {**scenes, "all": own}.items()
        }
    return found


def figures_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Of one planner's rows, with the columns `solved` and `solvable`.

    apart: problems whose ends touch something or are out of limits; they count nowhere else.
    asked: the others.  solvable: of these, those that any planner solves.  late: paths that are
    sound, after the limit.  time: of what is solved [ms]; time_all: of what is solvable, a failure
    as the whole limit.  ratio: of the length to the best known.  wrongly_certified: paths that the
    certifier takes and PyBullet does not.  refused: paths that a planner answers and the certifier
    refuses.  ready_ms: preparation for the scene, in the median.  disturbed: share of the answers
    during which the process had less than UNDISTURBED of a core.
    """
    within = rows[rows["ends"] == ""]
    solved, solvable = within[within["solved"]], within[within["solvable"]]
    whole = (1e3 * solvable["limit_s"]).where(~solvable["solved"], 1e3 * solvable["time_s"])
    sound = within["valid"] & ~within["touches"]
    return {
        "problems": len(rows),
        "apart": len(rows) - len(within),
        "asked": len(within),
        "solvable": len(solvable),
        "solved": len(solved),
        "share": len(solved) / len(solvable) if len(solvable) else None,
        "late": int((sound & ~within["solved"]).sum()),
        **quantiles("time_ms", 1e3 * solved["time_s"]),
        **quantiles("time_all_ms", whole),
        **quantiles("ratio", solved["length_rad"] / solved["best_known_rad"]),
        "wrongly_certified": int((rows["valid"] & rows["touches"]).sum()),
        "refused": int(((within["status"] == "solved") & ~within["valid"]).sum()),
        "ready_ms": _number(1e3 * within["scene_s"].median()),
        "disturbed": _number((within["core_share"] < UNDISTURBED).mean()),
    }


def quantiles(name: str, values: pd.Series) -> dict[str, float | None]:
    """Median and 95th percentile under that name; None of no values."""
    found = {"median": values.median(), "p95": values.quantile(0.95)}
    return {f"{name}_{which}": _number(value) for which, value in found.items()}


def _number(value: Any) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None
