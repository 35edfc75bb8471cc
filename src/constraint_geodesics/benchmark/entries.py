"""What the benchmark runs: the planners of params.yaml on some queries, in batches, and the table
of their rows.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.dense_check import watched
from constraint_geodesics.benchmark.queries import Query, read_queries
from constraint_geodesics.benchmark.recorder import PathRecorder, first_queries
from constraint_geodesics.benchmark.row import table_of
from constraint_geodesics.benchmark.runner import (
    Baseline,
    QueryBatch,
    Recorder,
    batch_rows,
    fingerprint,
    make_rows,
)
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import BaselineParams, Params
from constraint_geodesics.peers.baseline import BaselineError, BaselineSettings
from constraint_geodesics.peers.registry import BaselineBuilder, after, all_settings
from constraint_geodesics.pipeline.code import code_digest, data_digest
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.scene.arm import mesh_digests
from constraint_geodesics.scene.scene import Scene, robot_from
from constraint_geodesics.scene.urdf import find_urdf
from constraint_geodesics.text_files import kept_json

JUDGED_BY = ("benchmark.runner", "benchmark.dense_check")
"""The modules that ask the planners and judge their answers: every row depends on what they import.
"""
UNSEEN_SHARE = 0.1
"""Of a planner's queries, asked under a constraint that is unseen: these rows show that planners
work there, the others how well.
"""


@dataclass(frozen=True)
class Run:
    """All planners of `params.benchmark`, each on the first of its queries.

    queries: in the order they are asked.  rows: folder in which rows are kept as they come.
    learned: manifolds on which the paths' lengths are measured as well.
    """

    params: Params
    layout: Layout
    queries: Sequence[Query]
    rows: Path
    learned: Sequence[str]
    record: Recorder | None = None

    @cached_property
    def measured_on(self) -> list[str]:
        """Those that there are: a few planners are asked without them, too."""
        return [name for name in self.learned if self.layout.manifold(name).is_dir()]

    @cached_property
    def settings(self) -> dict[str, BaselineSettings]:
        """The planners' settings."""
        return all_settings(self.params)


def committed_run(params: Params, layout: Layout, rows: Path, recordings: Path) -> Run:
    """The benchmark on the queries in git, of the pipeline's constraints and of unseen ones.

    Raises BaselineError if the pipeline has not been run, QueryError if a constraint's queries have
    not been drawn.
    """
    if not (layout.planner / "planner.json").is_file():
        raise BaselineError(
            "data/planner is missing, which the benchmark's planners are made of: `dvc repro "
            "build_planner` makes it, `make repro` what is learned too"
        )
    queries = [
        query
        for constraint in params.all_constraints
        for query in read_queries(layout.benchmark_queries(constraint))
    ]
    record = PathRecorder(
        layout.root,
        recordings.resolve(),
        params.benchmark.recorded,
        first_queries(queries),
        params.recording.frames,
        params.judge.violation_tolerance,
    )
    return Run(params, layout, queries, rows, params.geodesics.searched[:1], record)


def answered(run: Run) -> pd.DataFrame:
    """The table of all rows, after those that are not there yet have been made."""
    batches = batches_of(run)
    make_rows(batches, run.params.compute, "benchmark")
    return table_of([row for batch in batches for row in batch_rows(batch)])


def batches_of(run: Run) -> list[QueryBatch]:
    """The run in batches of a few queries of one constraint and scene.

    The first of each has all planners, the slow ones too: they are spread, so that what is done
    tells how long the rest will take.
    """
    params, settings = run.params, run.params.benchmark
    learned = {name: LearnedManifold.load(run.layout.manifold(name)) for name in run.measured_on}
    build = BaselineBuilder(params, run.layout.root)
    shared, found = _shared_parts(run), list[tuple[int, QueryBatch]]()
    made_of = {name: _made_of(run, name) for name in run.settings}
    for (constraint, name), own in _by_case(run.queries).items():
        described, scene = params.all_constraints[constraint], Scene.from_params(params, constraint)
        ends = [[q.number, *q.start.tolist(), *q.goal.tolist(), repr(q.obstacle)] for q in own]
        parts = [*shared, described.model_dump(), repr(scene.attached), ends]
        for first in range(0, min(settings.queries, len(own)), settings.batch):
            baselines = _baselines(run, constraint, first, made_of, parts)
            if not baselines:
                continue
            batch = QueryBatch(
                scene=scene,
                manifold=constraint_manifold(scene.robot, described),
                queries=tuple(own[first : min(first + settings.batch, settings.queries)]),
                baselines=baselines,
                build=build,
                judge=params.judge,
                file=run.rows / f"{constraint}-{name}-{first}.jsonl",
                learned=learned,
                record=run.record,
                watch=watched,
            )
            found.append((first // settings.batch, batch))
    return spread(found)


def _by_case(queries: Sequence[Query]) -> dict[tuple[str, str], list[Query]]:
    cases: dict[tuple[str, str], list[Query]] = {}
    for query in queries:
        cases.setdefault((query.constraint, query.scene), []).append(query)
    return cases


def _made_of(run: Run, name: str) -> list[str]:
    """Digests of a planner's code and of its files."""
    kind = run.params.benchmark.planners[name].kind
    return [code_digest(f"peers.{kind}", "peers.making"), _data_of(run, run.settings[name])]


def _baselines(
    run: Run,
    constraint: str,
    first: int,
    made_of: Mapping[str, Sequence[str]],
    parts: Sequence[Any],
) -> tuple[Baseline, ...]:
    """The planners that answer a constraint's queries from the one at `first` on.  made_of: digests
    of each; parts: of all fingerprints.
    """
    bench, found = run.params.benchmark, []
    for name, own in run.settings.items():
        entry = bench.planners[name]
        count = entry.queries or bench.queries
        if constraint in run.params.unseen:
            count = 0 if _needs_submanifold(own) else math.ceil(UNSEEN_SHARE * count)
        if first >= count:
            continue
        about = [entry.kind, own.model_dump(mode="json")]
        found.append(
            Baseline(
                name=name,
                seeds=tuple(range(seeds_of(entry, own, bench.seeds))),
                fingerprint=fingerprint(*about, *made_of[name], *parts),
                kind=entry.kind,
                settings=fingerprint(*about)[:8],
                queries=count - first,
                after=after(name, run.settings),
                uses_clearance=own.uses_clearance or own.band,
            )
        )
    return tuple(found)


def _needs_submanifold(settings: BaselineSettings) -> bool:
    """Whether a planner searches a sub-manifold that was extracted for its constraint: none is for
    those that are unseen.  The learned method makes a roadmap where it has none.
    """
    stages = {stage.split()[0] for stage in settings.trained}
    return "extract_submanifold" in stages and "build_learned" not in stages


def seeds_of(entry: BaselineParams, settings: BaselineSettings, seeds: int) -> int:
    """How many seeds a planner is asked with: one where chance plays no part."""
    return (entry.seeds or seeds) if settings.random else 1


def _shared_parts(run: Run) -> list[Any]:
    """What all rows depend on."""
    params, layout = run.params, run.layout
    return [
        params.judge.model_dump(),
        params.robot.model_dump(),
        params.workcell.model_dump(),
        find_urdf(params.robot.urdf).read_bytes(),
        mesh_digests(robot_from(params.robot)),
        code_digest(*JUDGED_BY),
        machine(),
        data_digest(*(layout.manifold(name) for name in run.measured_on)),
    ]


def _data_of(run: Run, settings: BaselineSettings) -> str:
    """Of the planner's files and of trained ones, where the planner is made of any."""
    layout, folders = run.layout, []
    if settings.uses_bundle:
        folders.append(layout.planner)
    if "train_path_diffusion" in settings.trained:
        folders.append(layout.path_diffusion)
    elif settings.trained:
        folders += [layout.manifold(name) for name in run.params.manifolds]
        folders += [layout.submanifolds, layout.learned]
    return data_digest(*folders)


def training_times(params: Params, layout: Layout) -> dict[str, float]:
    """Seconds that stages took to make what each planner needs, from data to files: training, and
    the roadmaps of those that have any; 0 for those that need nothing.  Of policies, which are
    trained with many seeds, one is used.
    """
    settings, frame = all_settings(params), pd.read_csv(layout.stage_times)
    seconds = dict(zip(frame["stage"], frame["seconds"], strict=True))
    told = kept_json(layout.report("train_policies", params.policies.chart))
    if told is not None:
        policies = [stage for stage in seconds if stage.split()[0] == "train_policies"]
        seconds |= dict.fromkeys(policies, float(told["seconds_mean"]))
    searched = params.geodesics.searched[0]
    needed = {
        name: (*own.trained, *["build_planner"] * own.uses_roadmaps)
        for name, own in settings.items()
    }
    return {
        name: sum(
            spent
            for stage, spent in seconds.items()
            if stage.startswith(tuple(first.format(searched=searched) for first in own))
        )
        for name, own in needed.items()
    }


def spread(numbered: Sequence[tuple[int, QueryBatch]]) -> list[QueryBatch]:
    """Batches, each with its number within its constraint and scene, so that equal numbers stand
    evenly apart.
    """
    numbers = [number for number, _ in numbered]
    count, cases, turn, placed = 1 + max(numbers, default=0), numbers.count(0), -1, []
    for number, batch in numbered:
        turn += number == 0
        placed.append(((number + turn * count // cases) % count, turn, batch))
    return [batch for *_, batch in sorted(placed, key=lambda entry: entry[:2])]


def with_planners(params: Params, planners: Mapping[str, BaselineParams]) -> Params:
    """The parameters with these planners in the benchmark."""
    benchmark = params.benchmark.model_copy(update={"planners": dict(planners)})
    return params.model_copy(update={"benchmark": benchmark})


def at_most(entry: BaselineParams, queries: int, seeds: int) -> BaselineParams:
    """A planner on fewer queries with fewer seeds."""
    less = {
        "queries": min(queries, entry.queries or queries),
        "seeds": min(seeds, entry.seeds or seeds),
    }
    return entry.model_copy(update=less)


def fewer(
    params: Params,
    queries: int,
    seeds: int,
    constraints: Sequence[str] | None = None,
    planners: Sequence[str] | None = None,
    longest_s: float = 2.0,
) -> tuple[Params, list[str]]:
    """The parameters of a smaller benchmark: so many queries and seeds, some constraints and
    planners (None: all), and no planner that is given more than `longest_s` for a query.  Returns
    the names of those left out for their time as well.

    Raises BaselineError if a constraint or planner does not exist, or none is left.
    """
    known_planners = params.benchmark.planners
    for kind, wanted, known in (
        ("constraint", constraints, params.all_constraints),
        ("planner", planners, known_planners),
    ):
        for name in wanted or ():
            if name not in known:
                raise BaselineError(
                    f"there is no {kind} {name!r}: must be one of {', '.join(known)}"
                )
    settings = all_settings(params)
    named = [name for name in known_planners if planners is None or name in planners]
    slow = [name for name in named if settings[name].given_s > longest_s]
    kept = {
        name: at_most(known_planners[name], queries, seeds) for name in named if name not in slow
    }
    if not kept:
        raise BaselineError(
            f"no planner is left: all of them are given more than {longest_s:g} s a query"
        )
    less = {"planners": kept, "queries": queries, "batch": 1, "recorded": tuple(kept)}
    changed: dict[str, Any] = {"benchmark": params.benchmark.model_copy(update=less)}
    for block, described in (("constraints", params.constraints), ("unseen", params.unseen)):
        some = described if constraints is None else constraints
        changed[block] = {name: one for name, one in described.items() if name in some}
    return params.model_copy(update=changed), slow
