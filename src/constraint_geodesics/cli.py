"""The command `geodesics`."""

import atexit
import gc
import json
import math
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from constraint_geodesics import cli_demo, cli_identify, cli_planning, completion
from constraint_geodesics.cli_problems import ProblemOptions, bench_problems
from constraint_geodesics.errors import ParamsError
from constraint_geodesics.extras import require
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import SHOWN, WRONG_USAGE, complain
from constraint_geodesics.pipeline.threads import ONE_THREAD
from constraint_geodesics.progress import waiting
from constraint_geodesics.text_files import is_number, write_text

if TYPE_CHECKING:
    import pandas as pd

    from constraint_geodesics.recording.catalogue import Filter, Listed

LONGEST_S = 2.0
JSON = typer.Option(False, "--json", help="Print the answer as one JSON object.")
OF_CONSTRAINT: dict[str, Any] = {"shell_complete": completion.listed_constraints}

app = typer.Typer(
    help="Shortest robot paths that keep a task constraint.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help starts in half the time, and keeps the units' brackets
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if not wanted:
        return
    from importlib import metadata

    try:
        about = metadata.metadata("constraint-geodesics")
    except metadata.PackageNotFoundError:
        line = "the package is not installed, only found by PYTHONPATH: it has no version"
        raise RuntimeError(line) from None
    print(about["Name"], about["Version"])
    raise typer.Exit


@app.callback()
def options(
    version: bool = typer.Option(
        False, "--version", callback=_say_version, is_eager=True, help="Print name and version."
    ),
) -> None:
    """What `geodesics` takes before the name of a command."""


app.command("plan", context_settings={"allow_extra_args": False})(cli_planning.plan)
app.command("check")(cli_planning.check)
app.command("robot")(cli_planning.show_robot)
app.command("ik")(cli_planning.inverse_kinematics)
app.command("identify")(cli_identify.identify_constraint)
app.command("demo")(cli_demo.demo)


def main() -> None:
    """Entry point of the command: an error of the user's is one line, not a traceback."""
    # before anything heavy is loaded: answers are the same whoever calls
    os.environ.update(ONE_THREAD)
    atexit.register(
        gc.freeze
    )  # or Python looks for garbage in all that numba has loaded, for 0.4 s
    _require_quotes(sys.argv[1:])
    try:
        app()
    except SHOWN as error:
        raise SystemExit(complain(error)) from None


VECTORS = {"--start", "--goal", "--goal-pose", "--goal-tolerance", "--pose", "--tool-pose"}
"""Options that take several numbers."""


def _require_quotes(words: Sequence[str]) -> None:
    """Say which option stands before several numbers, of which it would get the first alone."""
    for option, *numbers in zip(words, words[1:], words[2:], strict=False):
        if option in VECTORS and all(map(is_number, numbers)):
            line = f'{option} takes its numbers in quotes: {option} "{numbers[0]} …"'
            raise SystemExit(complain(ValueError(line), WRONG_USAGE))


@app.command("package")
def package() -> None:
    """Copy what the pipeline built into the package, for those who install it: the planner, and the
    learned method where there is one.
    """
    import shutil
    import tempfile

    layout = Layout()
    if not (layout.planner / "planner.json").is_file():
        raise OSError(f"{layout.planner}: holds no planner; `dvc repro build_planner` makes it")
    target = layout.pretrained
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(".part", ".", target.parent) as beside:
        made, before = Path(beside) / "made", Path(beside) / "before"
        if target.is_dir():  # what these folders have no new file of stays
            shutil.copytree(target, made)
        shutil.copytree(layout.planner, made, dirs_exist_ok=True)
        if layout.learned.is_dir():
            shutil.copytree(layout.learned, made / "learned", dirs_exist_ok=True)
        _swap(made, target, before)
    print(f"{layout.planner} -> {layout.pretrained}")


def _swap(made: Path, target: Path, before: Path) -> None:
    """A folder in the place of another, which goes to `before`; if it can't be put there, the other
    is put back.
    """
    if target.is_dir():
        target.rename(before)
    try:
        made.rename(target)
    except OSError:
        if before.is_dir():
            before.rename(target)
        raise


@app.command("params")
def check_params(
    file: Path = typer.Argument(Path("params.yaml"), help="The file to check."),
    as_json: bool = JSON,
) -> None:
    """Check a params.yaml and the files it names: one line with the first bad entry, or "ok".

    Exit code 0: good; 2: bad.
    """
    require("bench")  # the settings of every planner in params.yaml are looked at
    from constraint_geodesics.gate import check_params as check
    from constraint_geodesics.params import load_params

    try:
        with waiting(f"checking {file}"):
            check(load_params(file))
    except ParamsError as error:
        if not as_json:
            raise
        print(json.dumps({"file": str(file), "valid": False, "error": str(error)}))
        raise SystemExit(WRONG_USAGE) from None
    verdict = {"file": str(file), "valid": True, "error": None}
    print(json.dumps(verdict) if as_json else f"{file}: ok")


@app.command("doctor")
def look_for_trouble(as_json: bool = JSON) -> None:
    """Look for what is wrong with this checkout and its environment, and say the mend.  Exit code
    1: a problem.
    """
    from constraint_geodesics import doctor

    with waiting("looking at this checkout"):
        findings = doctor.examine(Path())
    raise SystemExit(doctor.show(findings, json_wanted=as_json))


@app.command("recover")
def recover(as_json: bool = JSON) -> None:
    """Put right what killed stages left: end their runs in MLflow, send what MLflow did not take,
    and mend a dvc.lock that is cut short.
    """
    require("pipeline")
    from constraint_geodesics.pipeline.lock_files import recover_locks
    from constraint_geodesics.tracking.left import left_runs

    root, done = Path().resolve(), list[str]()

    def say(lines: Iterable[str]) -> None:
        for line in lines:  # at once: MLflow may fail after the next
            done.append(line)
            if not as_json:
                print(line, flush=True)

    say(recover_locks(root))
    if left_runs(root):  # else MLflow need not be loaded
        from constraint_geodesics.tracking.sending import recover as recover_runs

        say(recover_runs(root))
    if as_json:
        print(json.dumps({"done": done}))
    elif not done:
        print("nothing was left")


@app.command("constraints")
def list_constraints(
    planner: str | None = typer.Option(None, help="Where the planner comes from, as for `plan`."),
    as_json: bool = JSON,
) -> None:
    """List the constraints that `plan` knows by name."""
    from constraint_geodesics.bundle import open_bundle

    constraints = open_bundle(planner)[0].constraints
    if as_json:
        print(json.dumps({name: own.model_dump(mode="json") for name, own in constraints.items()}))
        return
    for name, constraint in constraints.items():
        print(f"{name:20s} {constraint.summary}  {constraint.description}")


@app.command("warmup")
def warm_up(
    jobs: int | None = typer.Option(None, help="Processes; by default one a core.", min=1),
    as_json: bool = JSON,
) -> None:
    """Compile all kernels now, once for this environment, so that no plan waits for it."""
    from constraint_geodesics import warmup

    began, done_before = time.perf_counter(), warmup.is_done()
    warmup.ensure(jobs)
    seconds = time.perf_counter() - began
    if as_json:
        print(json.dumps({"compiled": not done_before, "seconds": round(seconds, 1)}))
    elif done_before:
        print("all is compiled already")
    else:
        print(f"compiled in {seconds:.0f} s; the next plan starts at once")


@app.command("bench")
def bench(
    queries: int = typer.Option(1, help="Queries of each constraint and scene.", min=1),
    seeds: int = typer.Option(1, help="Seeds of each planner that chance plays a part in.", min=1),
    constraint: list[str] | None = typer.Option(None, help="By default all.", **OF_CONSTRAINT),
    planner: list[str] | None = typer.Option(
        None, help="By default all.", shell_complete=completion.benchmarked_planners
    ),
    longest: float = typer.Option(LONGEST_S, help="Leave out planners with more seconds a query."),
    out: Path = typer.Option(Path(".geodesics/bench"), help="Folder of rows, table and summary."),
    problems: Path | None = typer.Option(
        None,
        help="A file of problems instead: MotionBenchMaker's as JSON, or a folder of MoveIt's "
        "planning scenes and requests. docs/problems.md.",
    ),
    every: int = typer.Option(
        1, help="Which of each scene's --problems: 1 all, 10 each tenth.", min=1
    ),
    tilted: int = typer.Option(
        0, help="Queries with a held tilt, drawn in each scene of --problems.", min=0
    ),
    time_limit: float | None = typer.Option(
        None, help="Seconds of every query of --problems; by default those of params.yaml."
    ),
    urdf: cli_planning.Urdf = None,
    tool_link: cli_planning.ToolLink = None,
    srdf: cli_planning.Srdf = None,
    hold: cli_planning.Hold = None,
    as_json: bool = JSON,
) -> None:
    """Hold planners against each other on a few of the benchmark's queries, or on the problems of a
    file; what is done is not done again.
    """
    require("bench")
    if problems is not None:
        if constraint or queries != 1 or seeds != 1 or longest != LONGEST_S:
            line = "--problems goes without --constraint, --queries, --seeds and --longest: its "
            line += "file says what is held, --every how many, --time-limit how long"
            raise SystemExit(complain(ValueError(line), WRONG_USAGE))
        if time_limit is not None and not 0.0 < time_limit < math.inf:
            line = f"--time-limit {time_limit:g}: must be a positive number of seconds"
            raise SystemExit(complain(ValueError(line), WRONG_USAGE))
        arm = (urdf, tool_link, srdf, hold)
        asked = (problems, planner, every, tilted, time_limit)
        bench_problems(ProblemOptions(*asked, *arm, out, as_json))
        return
    if any((urdf, tool_link, srdf, hold, tilted, time_limit is not None)) or every != 1:
        line = "--every, --tilted, --time-limit, --urdf, … go with --problems alone"
        raise SystemExit(complain(ValueError(line), WRONG_USAGE))
    from constraint_geodesics.benchmark.entries import answered, committed_run, fewer
    from constraint_geodesics.benchmark.row import write_table
    from constraint_geodesics.benchmark.statistics import all_constraints, benchmark_summary
    from constraint_geodesics.params import load_params
    from constraint_geodesics.peers.baseline import BaselineError
    from constraint_geodesics.peers.registry import all_settings
    from constraint_geodesics.pipeline.machine import run_header
    from constraint_geodesics.report.benchmark_tables import asks_in_python, overview_markdown

    params, layout = load_params(), Layout()
    some, left_out = fewer(params, queries, seeds, constraint, planner, longest)
    table = answered(committed_run(some, layout, out / "rows", out / "recordings"))
    if table.empty:
        raise BaselineError("none of these planners is asked for any of these queries")
    write_table(table, out / "benchmark.csv", run_header(layout.root))
    order = {name: k for k, name in enumerate(some.benchmark.planners)}
    table = table.sort_values("planner", key=lambda names: names.map(order), kind="stable")
    first = next(iter(some.benchmark.planners))
    summary = benchmark_summary(all_constraints(table), first)
    text = overview_markdown(summary, asks_in_python(all_settings(some)), first)
    write_text(out / "overview.md", text)
    rows = out / "benchmark.csv"
    if as_json:
        answer = {"rows": str(rows), "overview": _records(summary), "left_out": left_out}
        print(json.dumps(answer))
        return
    print(text)
    if left_out:
        why = f"as they are given more than {longest:g} s a query (--longest)"
        print(f"left out, {why}: {', '.join(left_out)}")
    print(f"rows: {rows}")


@app.command("results")
def show_results(
    experiments: bool = typer.Option(
        False, "--experiments", help="The ranking of `make sweep`'s configurations instead."
    ),
    as_json: bool = JSON,
) -> None:
    """Print the committed result table and how to look further."""
    name, made_by = ("sweep_policies/ranking", "sweep") if experiments else ("table", "repro")
    table = Layout().root / "reports" / f"{name}.{'csv' if as_json else 'md'}"
    if not table.is_file():
        raise FileNotFoundError(f"{table}: no results yet; run `make {made_by}`")
    if as_json:
        require("pipeline")
        import pandas as pd

        print(json.dumps({"rows": _records(pd.read_csv(table, float_precision="round_trip"))}))
        return
    from constraint_geodesics.recording.catalogue import catalogue, unread

    print(table.read_text().rstrip())
    print("\nOpen the runs in MLflow:    make ui")
    if experiments:
        print("Compare them in DVC:        dvc exp show --only-changed")
        return
    recordings = catalogue(Path(), unread)
    if recordings:
        print(f"Replay a path in Rerun:     make replay FILE={recordings[0].file}")
    print("Read the report offline:    reports/index.html")


@app.command("replay")
def replay(
    recordings: list[str] | None = typer.Argument(
        None,
        help="Files to open, or their numbers in the list; none lists them.",
        shell_complete=completion.recordings,
    ),
    constraint: str | None = typer.Option(None, help="Only of this constraint.", **OF_CONSTRAINT),
    query: int | None = typer.Option(None, help="Only of this query.", min=0),
    planner: list[str] | None = typer.Option(None, help="Only of this planner; repeatable."),
    scene: str | None = typer.Option(None, help="Only in this scene of the benchmark."),
    manifold: str | None = typer.Option(None, help="Only of paths on this learned manifold."),
    seed: list[int] | None = typer.Option(None, help="Only of this seed; repeatable."),
    apart: bool = typer.Option(False, "--side-by-side", help="Each recording in its own view."),
    web: bool = typer.Option(False, "--web", help="Open in a local browser, not a window."),
    web_port: int = typer.Option(9090, help="Port of the page on 127.0.0.1.", min=1, max=65535),
    save: Path | None = typer.Option(None, help="Write what would be opened as one file."),
    as_json: bool = JSON,
) -> None:
    """Replay recorded paths in Rerun, several at once over each other; without any, list the
    recordings.

    With --constraint, --query and --planner what fits is opened; with fewer of them the list is
    narrowed.
    """
    from constraint_geodesics.recording.catalogue import Filter

    wanted = Filter(constraint, scene, query, tuple(planner or ()), tuple(seed or ()), manifold)
    chooses = recordings or wanted.one_problem or _is_asked()
    if save is not None and (as_json or not chooses):
        line = "--save: name the recordings, or a query with --constraint, --query and --planner"
        raise SystemExit(complain(ValueError(line), WRONG_USAGE))
    files = _files(recordings or [], wanted, as_json)
    if not files:
        return
    require("record")
    from constraint_geodesics.recording.viewer import open_recordings, save_recordings

    if save is not None:
        save_recordings(files, save, apart=apart)
        print(f"{save}: open it with geodesics replay {save}")
        return
    raise SystemExit(open_recordings(files, web=web, apart=apart, web_port=web_port))


def _files(words: Sequence[str], wanted: "Filter", as_json: bool) -> list[Path]:
    """What is opened; nothing where the list is printed."""
    from constraint_geodesics.recording.catalogue import Filter, as_records

    if words and (as_json or wanted != Filter()):
        choosing = "--constraint, --query, ... choose from the list"
        what = "--json prints the list of recordings" if as_json else choosing
        raise SystemExit(complain(ValueError(f"{what}: give no file"), WRONG_USAGE))
    if as_json:
        print(json.dumps({"recordings": as_records(_listed(wanted))}))
        return []
    return _named(words) if words else _chosen(_listed(wanted), wanted)


def _listed(wanted: "Filter") -> "list[Listed]":
    """The recordings of this checkout that are as asked for."""
    from constraint_geodesics.recording.catalogue import catalogue, narrowed, read_entry

    entries = catalogue(Path(), read_entry)
    if not entries:
        none = "data/recordings: no recordings yet"
        raise FileNotFoundError(f"{none}; run `make plan` for one, or `make repro` for all")
    return narrowed(entries, wanted)


def _named(words: Sequence[str]) -> list[Path]:
    """The files that some words name, by themselves or by their numbers in the list."""
    from constraint_geodesics.recording.catalogue import CatalogueError, Filter, by_words

    files = {word: Path(word) for word in words if Path(word).is_file()}
    numbers = [word for word in words if word not in files]
    if missing := next((word for word in numbers if not word.isdigit()), None):
        none = f"{missing}: no such recording"
        raise CatalogueError(f"{none}; `geodesics replay` lists those there are")
    if numbers:
        found = by_words(_listed(Filter()), numbers)
        files |= {word: Path(entry.file) for word, entry in zip(numbers, found, strict=True)}
    return [files[word] for word in words]


def _chosen(listed: "list[Listed]", wanted: "Filter") -> list[Path]:
    """What was asked for of the list, or what a person at the terminal chooses; piped, nothing."""
    from constraint_geodesics.recording.catalogue import as_table, by_words, one_of_each

    if wanted.one_problem:
        chosen = one_of_each(listed, wanted)
        names = ", ".join(f"{entry.number} ({entry.planner})" for entry in chosen)
        more = f" of the {len(listed)} that fit" if len(listed) > len(chosen) else ""
        print(f"opening recordings {names}{more}", file=sys.stderr)
        return [Path(entry.file) for entry in chosen]
    print(as_table(listed))
    if not _is_asked():
        print(f"\nOpen one with: geodesics replay {listed[0].number}")
        return []
    try:
        answer = input("\nWhich to open? Numbers, for example 1 7; Enter for none: ")
    except EOFError:
        return []
    return [Path(entry.file) for entry in by_words(listed, answer.replace(",", " ").split())]


def _is_asked() -> bool:
    """Whether a person at a terminal can choose from the list."""
    return sys.stdin.isatty() and sys.stdout.isatty()


@app.command("ui")
def ui(
    port: int = typer.Option(5000, help="Port on 127.0.0.1.", min=1, max=65535),
    browser: bool | None = typer.Option(
        None, "--open/--no-open", help="Open it in a browser; by default where there is a desktop."
    ),
    as_json: bool = JSON,
) -> None:
    """Compare this checkout's runs in MLflow's dashboard, on this machine only; it runs until it is
    stopped.
    """
    require("pipeline")
    from constraint_geodesics.tracking.dashboard import serve_and_open
    from constraint_geodesics.tracking.store import require_free, runs_page, ui_command

    root = Path().resolve()
    command = ui_command(root, port)
    require_free(port)
    page = runs_page(root, port)
    print(json.dumps({"address": page}) if as_json else f"{page}  (stop with Ctrl-C)", flush=True)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # the server's log is no answer
    if browser is None:
        from constraint_geodesics.recording.viewer import display

        browser = display() and not as_json
    if browser:
        raise SystemExit(serve_and_open(command, page))
    os.execvp(command[0], command)


@app.command("serve")
def serve(
    address: str = typer.Argument(
        "models:/constraint_geodesics@champion", help="The planner in MLflow's registry."
    ),
    port: int = typer.Option(5002, help="Port that it listens on.", min=1, max=65535),
    host: str = typer.Option(
        "127.0.0.1", help="Address to listen on; 0.0.0.0 lets everybody ask, without a password."
    ),
    workers: int = typer.Option(1, help="Processes, each with its own planner.", min=1, max=1024),
    waiting: int = typer.Option(16, help="Requests that a process lets in at once.", min=1),
    as_json: bool = JSON,
) -> None:
    """Answer planning requests over HTTP, by default on this machine alone, until it is stopped.

    Requests are those of MLflow's model server. Where too many wait, the answer is 503.
    """
    require("pipeline")
    from constraint_geodesics.tracking.serving import Served, serve

    where = f"http://{host}:{port}"
    text = json.dumps({"address": where}) if as_json else f"{where}/invocations  (stop with Ctrl-C)"
    served = Served(host, port, workers, waiting)
    serve(address, Path().resolve(), served, lambda: print(text, flush=True))


def _records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The rows of a table for JSON: what is not a finite number there is null."""
    records: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", double_precision=15))
    return records


if __name__ == "__main__":
    main()
