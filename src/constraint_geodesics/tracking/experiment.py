"""Runs in MLflow: one parent run a stage and matrix item, one child a seed.

The JSON and CSV files under reports/ are the truth; MLflow mirrors them.  Only MLflow's low-level
client is used: it has no active run that could be shared by accident, prints nothing, and sends a
report in one call.
"""

import json
import logging
import math
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean, pstdev
from threading import Timer
from typing import Any, Self

from pydantic import BaseModel

from constraint_geodesics.params import Params, RewardParams
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.left import hold, release
from constraint_geodesics.tracking.sending import CHILD, PROCESS, Sender, recover
from constraint_geodesics.tracking.store import (
    MOST_RUNS,
    TrackingError,
    client_of,
    dataset_of,
    explained,
    flat,
    impatient,
    log_params,
    open_store,
    source_tags,
    stable,
    store_name,
    stored,
    tracking_uri,
)

SYSTEM_AFTER_S, SYSTEM_EVERY_S = 15.0, 5.0
"""When processor, memory, disk and network begin to be logged, and how often: a stage that is done
by then needs no look at the machine, which takes a second to set up."""


@dataclass(frozen=True)
class Subject:
    """What a stage works on: tags by which its runs are found, and parameters by which they are
    compared.
    """

    tags: Mapping[str, str] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)


def subject_of(
    params: Params,
    *,
    constraint: str | None = None,
    manifold: str | None = None,
    reward: RewardParams | None = None,
) -> Subject:
    """The names of constraint, manifold and reward as tags; the constraint's entry in params.yaml
    as `constraint.*`.

    A reward has no name: its tag is what it is made of, eq. 15.
    """
    tags: dict[str, str] = {}
    values: dict[str, Any] = {}
    if constraint is not None:
        tags["constraint"], values["constraint"] = constraint, params.constraints[constraint]
    if manifold is not None:
        tags["manifold"] = manifold
    if reward is not None:
        weights = f"K_L={reward.length_weight:g} K_Δ={reward.reduction_weight:g}"
        tags["reward"] = f"{reward.form} b={reward.b:g} c={reward.c:g} {weights}"
    return Subject(tags, values)


@dataclass(frozen=True)
class MetricLogger:
    """Sends figures at a step to one run, in one call.  Picklable, so that a worker process can use
    it.

    run: its id, or CHILD and the name of one below the stage's.
    """

    send: Sender
    run: str

    def __call__(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log figures at an epoch or environment step; those that are not finite are left out."""
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self.send("metrics", self.run, step=step, metrics=finite)


@dataclass
class ChildRun:
    """One seed's run, sent to the process that works on the seed: it starts when entered there and
    ends when left.

    FINISHED, FAILED or KILLED, as the body ends.  A task that is run again on another worker makes
    another run.
    """

    send: Sender
    experiment_id: str
    tags: Mapping[str, str]
    params: Mapping[str, Any]
    run_id: str = field(default="", init=False)
    """Blank where the store did not take it yet."""

    def __enter__(self) -> Self:
        about = {"experiment": self.experiment_id, "tags": dict(self.tags)}
        self.run_id = self.send("begin", self._run, **about, params=dict(self.params))
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with nullcontext() if error is None else suppress(Exception):
            self.send("end", self._run, status=_status(error))

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Figures at an environment step."""
        MetricLogger(self.send, self._run)(step, metrics)

    @property
    def _run(self) -> str:
        return self.run_id or CHILD + self.tags["child"]


@dataclass(frozen=True)
class StageRun:
    """The run of one stage and matrix item."""

    tracking_uri: str
    experiment_id: str
    run_id: str
    tags: Mapping[str, str]
    params: Mapping[str, Any]
    children: list[str]
    """Names, in the order in which `child` was called."""
    folder: Path
    """Of what is kept on disk while the run lasts."""

    @property
    def send(self) -> Sender:
        """What tells the store."""
        return Sender(self.tracking_uri, self.folder, self.run_id)

    def report(self, metrics: Mapping[str, Any], file: Path) -> None:
        """Write figures as JSON, the truth, and mirror the numbers among them under names joined by
        "/".

        metrics: nested records of numbers, texts and lists; lists are not mirrored.  Numbers get 9
        digits, one that is not finite becomes null, keys are sorted: equal figures give equal
        bytes.
        """
        plain = stable(metrics)
        text = json.dumps(plain, indent=2, sort_keys=True, allow_nan=False, ensure_ascii=False)
        write_text(file, text + "\n")
        self.mirror(plain, file)

    def mirror(self, metrics: Mapping[str, Any], *files: Path) -> None:
        """Log the numbers among figures as `report` does, and keep copies of files that hold them,
        written already.
        """
        self.metric_logger()(0, _numbers(stable(metrics)))
        for file in files:
            self._keep(file, "reports")

    def metric_logger(self) -> MetricLogger:
        """Where a training loop reports."""
        return MetricLogger(self.send, self.run_id)

    def child(self, name: str, params: Mapping[str, Any]) -> ChildRun:
        """A run below this one, not yet started; its name must be new.

        params: what sets it apart, as tags and as parameters; those of this run are its own as
        well, so that children of different runs can be compared.
        """
        if name in self.children:
            raise ValueError(f"there is already a child run {name!r}")
        self.children.append(name)
        tags = {**self.tags, **{key: str(value) for key, value in params.items()}, "child": name}
        shown = name if self.tags["item"] == self.tags["stage"] else f"{self.tags['item']} {name}"
        tags |= {"mlflow.runName": _named(shown, self.tags), "mlflow.parentRunId": self.run_id}
        return ChildRun(self.send, self.experiment_id, tags, {**self.params, **params})

    def cells(self, table: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]]) -> None:
        """A child for each cell of a table: by its name, what sets it apart and its figures; where
        these are records by method, a child for each of them.
        """
        for name, (params, figures) in table.items():
            for method, own in _methods(figures).items():
                apart = {**params, "method": method} if method else params
                with self.child(f"{name}, {method}" if method else name, apart) as child:
                    child.log(0, _numbers(stable(own)))

    def summarise(
        self,
        figures: Sequence[Mapping[str, float]],
        curves: Sequence[Sequence[Mapping[str, float]]] = (),
    ) -> None:
        """Log the children's final figures, in their order: each on its child, mean and spread on
        this run.

        `final/<name>` on the child; `seeds/<name>_mean`, `_std` (over the seeds at hand: divided by
        their number) and `_count` on this run, of the seeds whose figure is finite.

        curves: each child's figures over its `steps`, which it has logged itself; their mean and
        spread at each step that all of them have is logged on this run, as a learning curve.
        """
        for name, row in zip(self.children, figures, strict=True):
            final = {f"final/{key}": value for key, value in row.items()}
            MetricLogger(self.send, CHILD + name)(0, final)
        self.metric_logger()(0, _spread(figures))
        for step, rows in _together(curves):
            spread = _spread(rows).items()
            self.metric_logger()(step, {n: v for n, v in spread if not n.endswith("_count")})

    def compared(self, figures: Sequence[Mapping[str, float]]) -> None:
        """Log what runs of all stages are compared by: the children's figures, in their order, each
        on its child, and their means on this run.

        figures: as `comparison.of_seeds` gives them.
        """
        for name, row in zip(self.children, figures, strict=True):
            MetricLogger(self.send, CHILD + name)(0, row)
        spread = _spread(figures)
        means = {name: spread.get(f"seeds/{name}_mean", math.nan) for name in figures[0]}
        self.metric_logger()(0, {name: float(f"{mean:.6g}") for name, mean in means.items()})

    def recordings(self, rows: Sequence[Mapping[str, Any]], shown: str = "") -> None:
        """Tell where paths are recorded: all of them in a file of this run and in its description;
        on each child, as the tag `recording`, the first one of its seed whose planner is `shown`.

        rows: with planner, query, seed, length_rad and recording, which is empty where there is
        none.
        """
        recorded = [row for row in rows if row["recording"]]
        if not recorded:
            return
        line = (
            "- {planner}, query {query}, seed {seed}, {length_rad:.3f} rad: "
            "`geodesics replay {recording}`"
        )
        lines = [line.format_map(row) for row in recorded]
        self.send("note", self.run_id, lines=["Recordings:", "", *lines])
        for name in self.children:
            own = [r for r in recorded if r["planner"] == shown and name == f"seed {r['seed']}"]
            if own:
                about = {"key": "recording", "value": str(own[0]["recording"])}
                self.send("tag", CHILD + name, **about)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "recordings.md"
            write_text(file, "\n".join(lines) + "\n")
            self._keep(file)

    def child_names(self) -> list[str]:
        """Of the runs below this one that were started, by whatever process, oldest first."""
        query, order = f"tags.`mlflow.parentRunId` = '{self.run_id}'", ["attributes.start_time ASC"]
        with explained(self.tracking_uri):
            client = client_of(self.tracking_uri)
            found = client.search_runs(
                [self.experiment_id], query, max_results=MOST_RUNS, order_by=order
            )
        return list(dict.fromkeys(run.data.tags["child"] for run in found))

    def figure(self, file: Path) -> None:
        """Keep a copy of a figure with the run."""
        self._keep(file, "figures")

    def _keep(self, file: Path, folder: str | None = None) -> None:
        self.send("copy", self.run_id, file=str(file.resolve()), into=folder)


@dataclass(frozen=True)
class Work:
    """What a stage does to one matrix item.

    settings: what it was asked, flattened to names joined by ".".  inputs: files and folders it
    reads, linked by DVC's MD5.  subject: what else to find the run and compare it by, as
    `subject_of` makes it.  watched: whether the machine is, which takes time of a stage that
    measures its own.
    """

    stage: str
    item: str
    settings: BaseModel | Mapping[str, Any] = field(default_factory=dict)
    inputs: Sequence[Path] = ()
    subject: Subject = Subject()
    watched: bool = True

    @property
    def name(self) -> str:
        """Of its run; a stage that has no items is its own."""
        return self.stage if self.item == self.stage else f"{self.stage} {self.item}"


@contextmanager
def tracked_stage(work: Work, experiment: str, root: Path) -> Iterator[StageRun]:
    """A run for the time of the stage: FINISHED, FAILED or KILLED, as the body ends; its children
    end with it.  What the machine does in a stage that takes long is logged as `system/...`.

    Raises TrackingError, one line, before any work: an input is missing, or the store can't be
    reached.  What the store does not take later is kept (`sending.py`), and the stage goes on.
    """
    run = begin_run(work, experiment, root)
    try:
        with _system_metrics(run.tracking_uri, run.run_id) if work.watched else nullcontext():
            yield run
    except BaseException as error:
        with suppress(Exception):  # the body's error is the one to see
            end_run(run, _status(error))
        raise
    end_run(run, "FINISHED")


def begin_run(work: Work, experiment: str, root: Path) -> StageRun:
    """A run that `end_run` ends.

    Raises TrackingError as `tracked_stage` does.
    """
    run = _run_of(work, experiment, root)
    shown = {"mlflow.runName": _named(work.name, run.tags)}
    shown["mlflow.note.content"] = _note(work.stage, run.tags)
    try:
        with explained(run.tracking_uri):
            client, tags = client_of(run.tracking_uri), {**run.tags, **shown}
            run = replace(run, run_id=client.create_run(run.experiment_id, tags=tags).info.run_id)
            log_params(client, run.run_id, run.params)
            client.log_inputs(run.run_id, [dataset_of(file, root) for file in work.inputs])
    except BaseException as error:
        if run.run_id:
            with suppress(Exception):
                end_run(run, _status(error))
        release(run.folder)
        raise
    return run


def continue_run(work: Work, experiment: str, root: Path) -> StageRun:
    """The last run of the same stage and item, open again whatever became of it; a new one where
    there is none.  `end_run` ends it.

    Raises TrackingError as `tracked_stage` does.
    """
    run = _run_of(work, experiment, root)
    with explained(run.tracking_uri):
        client = client_of(run.tracking_uri)
        own = f"tags.stage = '{work.stage}' and tags.item = '{work.item}'"
        found = client.search_runs(
            [run.experiment_id], own, order_by=["attributes.start_time DESC"]
        )
        parents = [old for old in found if "child" not in old.data.tags]
        if not parents:
            return begin_run(work, experiment, root)
        client.set_tag(parents[0].info.run_id, PROCESS, run.tags[PROCESS])
        client.update_run(parents[0].info.run_id, status="RUNNING")
    return replace(run, run_id=parents[0].info.run_id)


def end_run(run: StageRun, status: str) -> None:
    """End a run, and what workers that died left running below it.

    status: FINISHED, FAILED or KILLED.
    """
    try:
        run.send("end", run.run_id, status=status)
        with suppress(TrackingError), impatient():  # the store may be back
            run.send.tell_kept()
    finally:
        release(run.folder)


def log_figures(uri: str, run_id: str, figures: Mapping[str, float]) -> None:
    """Figures of a run that has ended.  Raises TrackingError if the store does not take them."""
    told = {"call": "metrics", "run": run_id, "time": round(1000 * time.time()), "step": 0}
    Sender(uri, Path(), run_id).tell({**told, "metrics": figures})


def _run_of(work: Work, experiment: str, root: Path) -> StageRun:
    """Without a run in the store yet."""
    uri, name = tracking_uri(root), work.name
    tags = {"stage": work.stage, "item": work.item, **work.subject.tags, **source_tags(root)}
    params = {**stored(work.settings), **stored(work.subject.params)}
    for file in work.inputs:
        if not file.exists():
            raise TrackingError(f"{name}: its input {file} does not exist")
    with explained(uri):
        _, experiment_id = open_store(uri, experiment)
    _end_left(root)
    folder = hold(root, name, store_name(uri, root))
    tags[PROCESS] = folder.name
    return StageRun(uri, experiment_id, "", tags, params, [], folder)


def _end_left(root: Path) -> None:
    """Runs of this checkout whose process was killed end now, and what they could not tell goes
    out.
    """
    with suppress(TrackingError):  # what there is to do now is another run's
        for line in recover(root):
            print(f"MLflow: {line}", file=sys.stderr, flush=True)


@contextmanager
def _system_metrics(uri: str, run_id: str) -> Iterator[None]:
    monitors = []

    def begin() -> None:
        from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

        # it tells of every start and end, and what it thinks of a store that is gone
        logging.getLogger(SystemMetricsMonitor.__module__).setLevel(logging.CRITICAL)
        monitor = SystemMetricsMonitor(run_id, SYSTEM_EVERY_S, tracking_uri=uri)
        monitor.start()
        monitors.append(monitor)

    timer = Timer(SYSTEM_AFTER_S, begin)
    timer.daemon = True
    timer.start()
    try:
        with impatient(tries=3, answer_s=30):  # it would wait for minutes, and this process for it
            yield
    finally:
        timer.cancel()
        with impatient():
            if timer.is_alive():
                timer.join()
            for monitor in monitors:
                monitor.finish()


def _named(name: str, tags: Mapping[str, str]) -> str:
    """A run's name; a run of an experiment is told from those of the pipeline by the experiment's
    name.
    """
    return f"{name} ({tags['dvc_experiment']})" if "dvc_experiment" in tags else name


def _note(stage: str, tags: Mapping[str, str]) -> str:
    again = (
        f"`dvc repro --single-item --force {tags['dvc_stage']}`"
        if "dvc_stage" in tags
        else f"`stages/{stage}.py`"
    )
    return f"Made by {again}; its figures are among the artifacts, as they stand in `reports/`."


def _status(error: BaseException | None) -> str:
    if error is None:
        return "FINISHED"
    return "KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED"


def _numbers(plain: Mapping[str, Any]) -> dict[str, float]:
    """Numbers among nested figures, under names that MLflow takes."""
    named = {re.sub(r"[^\w\-. :/]", "_", name): v for name, v in flat(plain, "/").items()}
    return {name: v for name, v in named.items() if isinstance(v, int | float)}


def _methods(figures: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
    """Figures by method; those that are no records are of one without a name."""
    are_records = bool(figures) and all(isinstance(own, Mapping) for own in figures.values())
    return figures if are_records else {"": figures}


def _spread(figures: Sequence[Mapping[str, float]]) -> dict[str, float]:
    spread: dict[str, float] = {}
    for name in figures[0]:
        values = [float(row[name]) for row in figures if math.isfinite(row[name])]
        spread[f"seeds/{name}_count"] = len(values)
        if values:
            spread |= {f"seeds/{name}_mean": fmean(values), f"seeds/{name}_std": pstdev(values)}
    return spread


def _together(
    curves: Sequence[Sequence[Mapping[str, float]]],
) -> list[tuple[int, list[dict[str, float]]]]:
    """The rows of all curves at each of their common steps."""
    by_step = [{int(row["steps"]): row for row in curve} for curve in curves]
    common = sorted(set.intersection(*map(set, by_step))) if by_step else []
    return [
        (step, [{n: v for n, v in rows[step].items() if n != "steps"} for rows in by_step])
        for step in common
    ]
