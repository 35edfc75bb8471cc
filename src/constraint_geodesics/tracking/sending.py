"""What runs tell their store, kept on disk where the store does not take it.

A stage that has begun does not fail with MLflow: what can't be sent is written into the run's
folder, in order, and goes out at the run's end, with the next stage, or by `geodesics recover`.
"""

import fcntl
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.left import SENT, UNSENT, Left, kept_calls, left_runs, taken
from constraint_geodesics.tracking.store import (
    MOST_RUNS,
    TrackingError,
    check_database,
    client_of,
    explained,
    impatient,
    keep_copy,
    log_params,
    mlflow_module,
    store_name,
    tracking_uri,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient

PROCESS = "process"
"""The tag of a run that names its folder."""
FILES = "files"
CHILD = "child:"
"""Before the name of a run that is looked up below its parent when it is told something."""


@dataclass(frozen=True)
class Sender:
    """Tells a store of a stage's run and those below it.  Picklable, so that a worker process can
    use it.

    folder: of the run, as `hold` makes it.  parent: the stage's run.
    """

    tracking_uri: str
    folder: Path
    parent: str

    def __call__(self, call: str, run: str, **about: Any) -> str:
        """One call of CALLS about a run, by its id or as CHILD and its name; kept if the store does
        not take it.  Returns the run's id, blank if it has none yet.
        """
        now = round(time.time() * 1000)
        told = {"call": call, "run": run, "parent": self.parent, "time": now, **about}
        unsent = self.folder / UNSENT
        if not unsent.exists():
            try:
                with impatient(tries=3, answer_s=30):
                    return self.tell(told)
            except TrackingError as error:
                if error.refused:  # what is told is wrong, and would be later
                    raise
                where = "what this run tells it is kept, and sent at its end or by"
                print(f"{error}; {where} `geodesics recover`", file=sys.stderr, flush=True)
        self._keep(unsent, told)
        return ""

    def tell(self, told: Mapping[str, Any]) -> str:
        """Raises TrackingError if the store does not take it."""
        with explained(self.tracking_uri):
            client, run_id = client_of(self.tracking_uri), str(told["run"])
            if told["call"] == "begin":
                return _begin(client, told)
            if run_id.startswith(CHILD):
                run_id = _child(client, told["parent"], run_id.removeprefix(CHILD))
            CALLS[told["call"]](client, self, run_id, told)
            return run_id

    def tell_kept(self) -> int:
        """What was kept, from where an earlier try stopped; returns how many calls.

        Raises TrackingError at the first that the store does not take.
        """
        calls, done = kept_calls(self.folder)
        for place, told in enumerate(calls[done:], done + 1):
            try:
                self.tell(told)
            except TrackingError as error:
                if not error.refused:
                    raise
                print(f"{error}; it is not told this again", file=sys.stderr)
            write_text(self.folder / SENT, str(place))
        (self.folder / UNSENT).unlink(missing_ok=True)
        return len(calls) - done

    def _keep(self, unsent: Path, told: dict[str, Any]) -> None:
        if told["call"] == "copy":  # the file may be another by then
            kept = self.folder / FILES / str(time.time_ns()) / Path(told["file"]).name
            kept.parent.mkdir(parents=True)
            shutil.copy2(told["file"], kept)
            told["file"] = str(kept.relative_to(self.folder))
        with unsent.open("a", encoding="utf-8") as lines:
            fcntl.flock(lines, fcntl.LOCK_EX)
            # each call begins a line: one that a kill cut short ends where the next begins
            lines.write("\n" + json.dumps(told, default=str))


def recover(root: Path) -> Iterator[str]:
    """Tell the store what runs of this checkout whose process is gone could not tell it, and end
    those that it still calls running as KILLED; yields a line for each that there was one.

    Those of other stores than the one that is named now stay as they are.
    Raises TrackingError if the store does not take it.
    """
    uri = tracking_uri(root)
    for left in left_runs(root):
        if left.store != store_name(uri, root):
            yield f"{left.name}: left as it is, for it is in the store {left.store}"
            continue
        with taken(left) as mine:
            if mine:
                yield from _recovered(left, uri)


def _recovered(left: Left, uri: str) -> list[str]:
    with explained(uri), impatient():
        check_database(uri)
        told = Sender(uri, left.folder, "").tell_kept()
        client = client_of(uri)
        experiments = [own.experiment_id for own in client.search_experiments()]
        wanted = f"tags.{PROCESS} = '{left.folder.name}' and attributes.status = 'RUNNING'"
        running = client.search_runs(experiments, wanted, max_results=MOST_RUNS)
        for run in running:
            client.set_terminated(run.info.run_id, "KILLED")
    shutil.rmtree(left.folder, ignore_errors=True)
    ended = f"ended as KILLED, {len(running)} of its runs were still running" if running else ""
    sent = f"told MLflow {told} things that it had not taken" if told else ""
    return [f"{left.name}: {', '.join(filter(None, (sent, ended)))}"] if sent or ended else []


def _begin(client: "MlflowClient", told: Mapping[str, Any]) -> str:
    made = client.create_run(told["experiment"], start_time=told["time"], tags=told["tags"])
    log_params(client, made.info.run_id, told["params"])
    return str(made.info.run_id)


def _child(client: "MlflowClient", parent: str, name: str) -> str:
    """The last run of a name below another."""
    experiment = client.get_run(parent).info.experiment_id
    quote = '"' if "'" in name else "'"
    own = f"tags.`mlflow.parentRunId` = '{parent}' and tags.child = {quote}{name}{quote}"
    order = ["attributes.start_time DESC"]
    found = client.search_runs([experiment], own, order_by=order, max_results=1)
    if not found:
        raise TrackingError(f"MLflow has no run {name!r} below {parent}", refused=True)
    return str(found[0].info.run_id)


def _metrics(client: "MlflowClient", _: Sender, run_id: str, told: Mapping[str, Any]) -> None:
    entity, figures = mlflow_module().entities.Metric, told["metrics"].items()
    batch = [entity(name, value, told["time"], told["step"]) for name, value in figures]
    client.log_batch(run_id, metrics=batch)


def _note(client: "MlflowClient", _: Sender, run_id: str, told: Mapping[str, Any]) -> None:
    """Lines below a run's description."""
    note = client.get_run(run_id).data.tags.get("mlflow.note.content", "")
    client.set_tag(run_id, "mlflow.note.content", "\n".join([note, "", *told["lines"]]))


def _tag(client: "MlflowClient", _: Sender, run_id: str, told: Mapping[str, Any]) -> None:
    client.set_tag(run_id, told["key"], told["value"])


def _copy(_: "MlflowClient", sender: Sender, run_id: str, told: Mapping[str, Any]) -> None:
    keep_copy(sender.tracking_uri, run_id, sender.folder / told["file"], told["into"])


def _end(client: "MlflowClient", _: Sender, run_id: str, told: Mapping[str, Any]) -> None:
    """A run, and what is left running below it."""
    experiment = client.get_run(run_id).info.experiment_id
    below = f"tags.`mlflow.parentRunId` = '{run_id}' and attributes.status = 'RUNNING'"
    for child in client.search_runs([experiment], below):
        left = "KILLED" if told["status"] == "FINISHED" else told["status"]
        client.set_terminated(child.info.run_id, left, told["time"])
    client.set_terminated(run_id, told["status"], told["time"])


Call = Callable[["MlflowClient", Sender, str, Mapping[str, Any]], None]
CALLS: Mapping[str, Call] = {
    "metrics": _metrics,
    "note": _note,
    "tag": _tag,
    "copy": _copy,
    "end": _end,
}
