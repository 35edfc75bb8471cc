"""A sweep over settings of policies: what is to be done, what is done, and who does the rest.

A configuration is known by a digest of all that its policies depend on.  Each of its seeds is kept
as it comes; a sweep that was killed goes on where it stopped, and after a change only what it
touches is done again.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from constraint_geodesics.benchmark.runner import fingerprint
from constraint_geodesics.params import Params, load_params
from constraint_geodesics.pipeline.code import code_digest
from constraint_geodesics.pipeline.compute import as_finished
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.studies.search_space import Changes, SearchSpace, label_of
from constraint_geodesics.studies.sweep_ranking import FIGURES, seed_figures
from constraint_geodesics.text_files import kept_json, reading, write_text
from constraint_geodesics.tracking.experiment import (
    StageRun,
    Subject,
    Work,
    continue_run,
    end_run,
    log_figures,
    subject_of,
)
from constraint_geodesics.tracking.store import dvc_md5, stable

if TYPE_CHECKING:
    from constraint_geodesics.studies.sweep_seed import SweepTask

STAGE = "sweep_policies"
SEARCHED_BY = "studies.sweep_seed"
"""Beside this one: what it imports decides what is done again after a change of the code."""

Record = dict[str, Any]


@dataclass(frozen=True)
class Configuration:
    """Some settings of policies, and what they change in params.yaml.

    key: a digest of all that the policies and their figures depend on, the seeds apart.
    """

    changes: Changes
    params: Params
    key: str

    @property
    def name(self) -> str:
        """Of its experiment and its folder."""
        return f"sweep-{self.key[:10]}"

    @property
    def label(self) -> str:
        """What a person tells it by."""
        return label_of(self.changes)

    def seeds_left(self, layout: Layout) -> list[int]:
        """Those that are not done, or whose file is damaged."""
        return [s for s in self.params.sweep.seeds if kept_json(self._file(layout, s)) is None]

    def keep(self, layout: Layout, seed: int, result: Mapping[str, Any]) -> None:
        """Write one seed's result; an interruption leaves all of it or nothing."""
        about = {"configuration": self.name, "changes": self.changes, "seed": seed}
        _write(self._file(layout, seed), about | dict(result))

    def results(self, layout: Layout) -> list[Record]:
        """Those of the seeds that are done."""
        files = [self._file(layout, seed) for seed in self.params.sweep.seeds]
        return [_read(file) for file in files if file.is_file()]

    def _file(self, layout: Layout, seed: int) -> Path:
        return layout.sweep / self.name / f"seed-{seed}.json"


@dataclass(frozen=True)
class Sweep:
    """Configurations to be trained on the data of one checkout.

    finished: called with each configuration when all of its seeds are done, those that were done
    before among them.
    """

    configurations: Sequence[Configuration]
    layout: Layout
    finished: Callable[[Configuration], None]

    @property
    def params(self) -> Params:
        """Of any configuration: where work runs, and how it is tracked."""
        return self.configurations[0].params

    @property
    def tracked(self) -> tuple[str, Path]:
        """MLflow's experiment, and the checkout whose store has it."""
        return self.params.tracking.experiment, self.layout.root


def configurations_of(space: SearchSpace, layout: Layout) -> list[Configuration]:
    """params.yaml's own configuration, then those of the space, none twice; of a random search as
    many as it names, the own one included.

    Raises ParamsError where the space names an entry or a value that params.yaml cannot have.
    """
    found: dict[str, Configuration] = {}
    file = layout.root / "params.yaml"
    for changes in [{}, *space.changes()]:
        own = configuration(load_params(file, changes), layout, changes)
        found.setdefault(own.key, own)
    most = space.configurations if space.search == "random" else len(found)
    return list(found.values())[:most]


def configuration(params: Params, layout: Layout, changes: Changes) -> Configuration:
    """A configuration that params describe, with what it changes in params.yaml."""
    # another seed changes nothing of those that are done, and a sweep has steps of its own
    trained = params.policies.model_dump(mode="json", exclude={"seeds", "steps"})
    trained["degree"] = params.geodesics.degree
    judged = params.sweep.model_dump(include={"steps", "queries", "query_seed"})
    judged |= params.judge.model_dump(mode="json")
    return Configuration(changes, params, fingerprint(trained, judged, _shared(params, layout)))


def run_sweep(sweep: Sweep) -> None:
    """Train and judge what is not done, all configurations' seeds together in parallel.

    Each configuration is a run in MLflow with its seeds below it.
    """
    left = [(own, seed) for own in sweep.configurations for seed in own.seeds_left(sweep.layout)]
    started = {own.key for own, _ in left}
    for own in sweep.configurations:
        if own.key not in started:
            _finish(own, sweep)
    if left:
        _run_seeds(sweep, left)


def _run_seeds(sweep: Sweep, left: Sequence[tuple[Configuration, int]]) -> None:
    from constraint_geodesics.studies.sweep_seed import train_and_judge

    optima = _optima(sweep, [own for own, _ in left])
    runs = {own.key: continue_run(_work(own, sweep.layout), *sweep.tracked) for own, _ in left}
    try:
        tasks = [_task(sweep, own, seed, optima[own.key], runs[own.key]) for own, seed in left]
        outcomes = as_finished(train_and_judge, tasks, sweep.params.compute, description="sweep")
        for place, result in outcomes:
            own, seed = left[place]
            own.keep(sweep.layout, seed, result)
            shutil.rmtree(tasks[place].scratch, ignore_errors=True)
            if not own.seeds_left(sweep.layout):
                _finish(own, sweep)
                del runs[own.key]
    except BaseException as error:
        for run in runs.values():
            end_run(run, "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise


def configuration_figures(own: Configuration, layout: Layout) -> Record:
    """What DVC and MLflow show of a configuration: means over its seeds, and what each seed has, in
    their order.
    """
    seeds = [seed_figures(result) for result in own.results(layout)]
    each = {name: [figures[name] for figures in seeds] for name in FIGURES}
    means = {name: sum(values) / len(values) for name, values in each.items() if values}
    return means | {"seeds": len(seeds), "each_seed": each}


def tell_ranks(sweep: Sweep, ranked: Sequence[Mapping[str, Any]]) -> None:
    """Scores and ranks, which hang on all configurations, to the run of each that is done.

    ranked: rows of `sweep_ranking.ranking`.
    """
    shown = ("rank", "score", "score_low", "score_high")
    rows = {row["configuration"]: {name: row[name] for name in shown} for row in ranked}
    for own in sweep.configurations:
        file = _told(own, sweep.layout)
        told = kept_json(file)
        if told is not None and own.name in rows:
            log_figures(told["tracking_uri"], told["run_id"], rows[own.name])


def _finish(own: Configuration, sweep: Sweep) -> None:
    """Of a configuration whose seeds are done: what MLflow is to know, unless it does, and what the
    caller makes of it.
    """
    told, seeds = _told(own, sweep.layout), list(own.params.sweep.seeds)
    known = kept_json(told)
    if known is None or known["seeds"] != seeds:
        run = _tell(own, sweep)
        _write(told, {"seeds": seeds, "tracking_uri": run.tracking_uri, "run_id": run.run_id})
    sweep.finished(own)


def _told(own: Configuration, layout: Layout) -> Path:
    """Which seeds MLflow was told of, and which run they are."""
    return layout.sweep / own.name / "told.json"


def _tell(own: Configuration, sweep: Sweep) -> StageRun:
    """What the seeds are worth together.  Those that the store does not know, as one that was begun
    anew, get their run now.
    """
    layout, run = sweep.layout, continue_run(_work(own, sweep.layout), *sweep.tracked)
    names, there = [f"seed {seed}" for seed in own.params.sweep.seeds], run.child_names()
    for seed, name in zip(own.params.sweep.seeds, names, strict=True):
        if name not in there:
            with run.child(name, {"seed": seed}):
                pass
    run.children[:] = names
    run.summarise([seed_figures(result) for result in own.results(layout)])
    run.report(configuration_figures(own, layout), layout.sweep / own.name / "configuration.json")
    end_run(run, "FINISHED")
    return run


def _task(
    sweep: Sweep, own: Configuration, seed: int, optimum: Mapping[str, Any], run: StageRun
) -> "SweepTask":
    from constraint_geodesics.studies.sweep_seed import SweepTask

    scratch = sweep.layout.sweep / own.name / f"seed-{seed}"
    child = run.child(f"seed {seed}", {"seed": seed})
    return SweepTask(own.params, sweep.layout, seed, optimum, scratch, child)


def _optima(sweep: Sweep, owners: Iterable[Configuration]) -> dict[str, dict[str, Any]]:
    """The best lengths of each configuration's family, by its key and constraint; of each family
    they are computed once.
    """
    from constraint_geodesics.studies.sweep_seed import (
        OptimumTask,
        judged_constraints,
        optimum_lengths,
    )

    layout, files, left = sweep.layout, dict[str, dict[str, Path]](), dict[Path, OptimumTask]()
    for own in owners:
        for name in judged_constraints(own.params):
            task, key = OptimumTask(own.params, layout, name), _family(own.params, layout, name)
            file = layout.sweep / f"optimum-{name}-{key[:10]}.json"
            files.setdefault(own.key, {})[name] = file
            if not file.is_file():
                left[file] = task
    places, tasks = list(left), list(left.values())
    compute, name = sweep.params.compute, "shortest curves"
    for place, lengths in as_finished(optimum_lengths, tasks, compute, description=name):
        _write(places[place], {"optimum_rad": lengths})
    return {key: {name: _lengths(file) for name, file in own.items()} for key, own in files.items()}


def _family(params: Params, layout: Layout, constraint: str) -> str:
    """A digest of what the shortest curves depend on."""
    geodesics = params.policy_settings().model_dump(include={"degree", "length_degree"})
    judged = params.sweep.model_dump(include={"queries", "query_seed"})
    return fingerprint(constraint, geodesics, judged, _shared(params, layout))


def _shared(params: Params, layout: Layout) -> list[Any]:
    """What all configurations depend on: robot, scene, constraints, data, code."""
    described = params.model_dump(
        mode="json", include={"robot", "workcell", "carried", "constraints"}
    )
    return [described, _contents(tuple(_inputs(params, layout)))]


@cache
def _contents(inputs: tuple[Path, ...]) -> str:
    """A digest of the data and of the code, read once."""
    return fingerprint([dvc_md5(file) for file in inputs], code_digest(SEARCHED_BY), machine())


def _inputs(params: Params, layout: Layout) -> list[Path]:
    chart = params.policies.chart
    manifold = [layout.manifold(chart)] if chart in params.manifolds else []
    files = [*manifold, *(layout.joints(name) for name in params.constraints)]
    for file in files:
        if not file.exists():
            raise FileNotFoundError(f"{file}: policies are trained on it; `make repro` makes it")
    return files


def _work(own: Configuration, layout: Layout) -> Work:
    params, settings = own.params, own.params.policy_settings()
    known = subject_of(params, manifold=params.policies.chart, reward=settings.reward)
    about = Subject({**known.tags, "configuration": own.name}, known.params)
    trained = settings.of_training("length_degree") | params.sweep.model_dump(mode="json")
    item = f"{own.label} ({own.key[:10]})"
    return Work(STAGE, item, trained, _inputs(params, layout), about)


def _lengths(file: Path) -> list[float]:
    found = json.loads(file.read_text())["optimum_rad"]
    return [float("nan") if length is None else length for length in found]


def _read(file: Path) -> Record:
    with reading(file):
        found: Record = json.loads(file.read_text())
        return found


def _write(file: Path, content: Mapping[str, Any]) -> None:
    write_text(file, json.dumps(stable(content), allow_nan=False) + "\n")
