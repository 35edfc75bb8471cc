"""The command `geodesics`, and how a stage starts."""

import inspect
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from constraint_geodesics import completion
from constraint_geodesics.params import Params, ParamsError, load_params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.progress import waiting
from constraint_geodesics.pipeline.threads import ONE_THREAD, one_thread

if TYPE_CHECKING:
    import pandas as pd

    from constraint_geodesics.recording.catalogue import Entry, Wanted

WRONG_USAGE = 2
NO_PATH = 3

app = typer.Typer(
    help="Shortest robot paths that keep a task constraint.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Entry point of the command: an error of the user's is one line, not a traceback."""
    os.environ.update(
        ONE_THREAD
    )  # before anything heavy is loaded: answers are the same whoever calls
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        raise SystemExit(_complain(error)) from None


def run_stage(stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Run one stage in this checkout: check params.yaml first, and report a bad input in one line.

    What runs in this process computes on one thread, libraries that are loaded already too, so that
    results are those of `make`; more cores are used by `parallel_map`.
    arguments: the names after (params, layout), as dvc.yaml passes them; each must be one that
    params.yaml has.
    """
    began = time.perf_counter()
    try:
        params = load_params()
        _check_names(params, stage, arguments)
        with one_thread(), waiting(" ".join([Path(sys.argv[0]).stem, *arguments])):
            stage(params, Layout(), *arguments)
        note_stage_time(
            Layout().stage_times, Path(sys.argv[0]).stem, arguments, time.perf_counter() - began
        )
    except (ValueError, OSError, RuntimeError) as error:
        if os.environ.get("GEODESICS_TRACEBACK"):
            raise
        raise SystemExit(_complain(error)) from None


def note_stage_time(file: Path, stage: str, names: Sequence[str], seconds: float) -> None:
    """Keep how long the last finished run of each stage took, workers and all: what training costs
    is read from it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    own = " ".join([stage, *names])
    kept = (
        dict(line.split(",") for line in file.read_text().splitlines()[1:])
        if file.is_file()
        else {}
    )
    kept[own] = f"{seconds:.1f}"
    file.write_text(
        "\n".join(["stage,seconds", *(f"{name},{kept[name]}" for name in sorted(kept))]) + "\n"
    )


def _check_names(params: Params, stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Each argument must be a name of the kind that the stage's own parameter is called after."""
    kinds = list(inspect.signature(stage).parameters)[2:]
    if len(kinds) != len(arguments):
        raise ParamsError(
            f"this stage takes {len(kinds)} names ({', '.join(kinds)}), not {len(arguments)}"
        )
    names: dict[str, list[str]] = {
        "constraint": list(params.constraints),
        "manifold": list(params.manifolds),
        "analytic": list(params.geodesics.analytic),
    }
    for kind, name in zip(kinds, arguments, strict=True):
        if name not in names[kind]:
            raise ParamsError(
                f"params.yaml: there is no {kind} {name!r}: must be one of {names[kind]}"
            )


def _complain(error: Exception, code: int | None = None) -> int:
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
    if code is not None:
        return code
    return WRONG_USAGE if isinstance(error, ParamsError) else 1


@app.command("params")
def check_params(
    file: Annotated[Path, typer.Argument(help="The file to check.")] = Path("params.yaml"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the verdict as one JSON object.")
    ] = False,
) -> None:
    """Check a params.yaml: one line naming the first bad entry, or "ok".  Exit code 0: good; 2:
    bad.
    """
    try:
        load_params(file)
    except ParamsError as error:
        if not as_json:
            raise
        print(json.dumps({"file": str(file), "valid": False, "error": str(error)}))
        raise SystemExit(WRONG_USAGE) from None
    print(
        json.dumps({"file": str(file), "valid": True, "error": None}) if as_json else f"{file}: ok"
    )


@app.command("doctor")
def look_for_trouble(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the findings as one JSON object.")
    ] = False,
) -> None:
    """Look for what is wrong with this checkout and its environment, and say the mend.  Exit code
    1: a problem.
    """
    from constraint_geodesics.doctor import report

    findings = report.examine(Path())
    print(
        report.as_json(findings) if as_json else report.as_text(findings, report.terminal_colours())
    )
    raise SystemExit(report.exit_code(findings))


@app.command("constraints")
def list_constraints(
    planner: Annotated[
        str | None, typer.Option(help="Where the planner comes from, as for `plan`.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """List the constraints that `plan` knows by name."""
    from constraint_geodesics.bundle import open_bundle

    constraints = open_bundle(planner)[0].constraints
    if as_json:
        print(
            json.dumps(
                {
                    name: constraint.model_dump(mode="json")
                    for name, constraint in constraints.items()
                }
            )
        )
        return
    for name, constraint in constraints.items():
        print(f"{name:20s} {' '.join(map(str, constraint.axes))}  {constraint.description}")


@app.command("plan", context_settings={"allow_extra_args": False})
def plan(
    start: Annotated[
        str, typer.Option(help='Start configuration: the joints in rad, as in "0.1 -0.5 …".')
    ],
    goal: Annotated[str, typer.Option(help="Goal configuration [rad].")],
    constraint: Annotated[
        str,
        typer.Option(
            help="A name that `geodesics constraints` lists.",
            shell_complete=completion.planned_constraints,
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Write the path here, as CSV.")] = None,
    record: Annotated[Path | None, typer.Option(help="Write a Rerun recording here.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the path here, as PNG.")] = None,
    planner: Annotated[
        str | None,
        typer.Option(
            help="A planner's folder or MLflow address; else the pipeline's or the package's."
        ),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            help="Look for shorter paths until so many seconds have passed; by default do not."
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the answer as one JSON object.")
    ] = False,
) -> None:
    """Plan one path.  Exit code 0: solved; 2: wrong usage; 3: there is no path, and the line says
    why.
    """
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import Planner, PlannerError

    try:
        first, last = _joints(start, "--start"), _joints(goal, "--goal")
        with waiting(what_takes_time()), Planner.load(planner) as loaded:
            path = loaded.plan(first, last, constraint, budget_s=budget)
            source = loaded.source
    except (BundleError, PlannerError) as error:
        raise SystemExit(_complain(error, WRONG_USAGE)) from None
    print(f"planner: {source}", file=sys.stderr)
    if path.status == "solved":
        if out is not None:
            path.save(out)
        if record is not None:
            path.record(record)
        if picture is not None:
            path.draw(picture)
    print(json.dumps(path.summary()) if as_json else f"{path.status}: {path.explanation}")
    raise SystemExit(0 if path.status == "solved" else NO_PATH)


@app.command("check")
def check(
    file: Annotated[
        Path, typer.Argument(help="A path as CSV: a header, then one row of joints [rad] a line.")
    ],
    constraint: Annotated[
        str | None,
        typer.Option(
            help="A name that `geodesics constraints` lists; by default what the file says.",
            shell_complete=completion.planned_constraints,
        ),
    ] = None,
    planner: Annotated[
        str | None, typer.Option(help="Where robot and workcell come from, as for `plan`.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the certificate as one JSON object.")
    ] = False,
) -> None:
    """Certify anybody's path, between whatever ends it has.  Exit code 0: valid; 2: wrong usage; 3:
    what it breaks.
    """
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import PlannerError, check_path

    try:
        with waiting(what_takes_time()):
            certificate = check_path(file, constraint, planner)
    except (BundleError, PlannerError) as error:
        raise SystemExit(_complain(error, WRONG_USAGE)) from None
    broken = certificate.violation
    untimed = (
        " (no times: velocity and acceleration not looked at)"
        if math.isnan(certificate.duration_s)
        else ""
    )
    meant = constraint or f"the constraint that {file.name} names"
    if as_json:
        print(json.dumps(certificate.summary()))
    elif broken is None:
        print(
            f"valid: {certificate.length_rad:.3f} rad, at most "
            f"{certificate.violation_bound:.1e} (rad, m) off {meant} "
            f"anywhere, {certificate.collision_checks} configurations free of collision{untimed}"
        )
    else:
        print(f"{broken.kind}: {broken.message}")
    raise SystemExit(0 if broken is None else NO_PATH)


KERNELS = (
    "robot/kernels",
    "robot/clearance",
    "constraints/kernels",
    "certification/kernels",
    "geometry/timing",
    "geodesics/band_kernels",
)
"""Modules that numba compiles before the first path; their code is kept beside them, until they
change.
"""


def what_takes_time(package: Path = Path(__file__).parent) -> str:
    """What a planner's user waits for: the compiler where a kernel has no compiled code yet."""
    for name in KERNELS:
        source = package / f"{name}.py"
        kept = (source.parent / "__pycache__").glob(f"{source.stem}.*.nbi")
        if not any(cache.stat().st_mtime >= source.stat().st_mtime for cache in kept):
            return "compiling the numerical kernels, once for this environment: a minute or two"
    return "loading the planner"


def _joints(text: str, option: str) -> list[float]:
    from constraint_geodesics.planner import PlannerError

    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise PlannerError(
            f"{option} {text!r}: must be numbers [rad], with spaces or commas between them"
        ) from None


@app.command("bench")
def bench(
    queries: Annotated[int, typer.Option(help="Queries of each constraint and scene.", min=1)] = 1,
    seeds: Annotated[
        int, typer.Option(help="Seeds of each planner that chance plays a part in.", min=1)
    ] = 1,
    constraint: Annotated[
        list[str] | None,
        typer.Option(
            help="One of params.yaml's; by default all.",
            shell_complete=completion.listed_constraints,
        ),
    ] = None,
    planner: Annotated[
        list[str] | None,
        typer.Option(
            help="One of params.yaml's benchmark.planners; by default all.",
            shell_complete=completion.benchmarked_planners,
        ),
    ] = None,
    longest: Annotated[
        float, typer.Option(help="Leave out planners that are given more seconds a query.")
    ] = 2.0,
    out: Annotated[Path, typer.Option(help="Folder of rows, table and summary.")] = Path(
        ".geodesics/bench"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the summary as one JSON object.")
    ] = False,
) -> None:
    """Hold planners against each other on a few of the benchmark's queries; what is done is not
    done again.
    """
    from constraint_geodesics.benchmark.entries import Wish, answered, committed_run, fewer
    from constraint_geodesics.benchmark.row import write_table
    from constraint_geodesics.benchmark.statistics import all_constraints, benchmark_summary
    from constraint_geodesics.peers.registry import all_settings
    from constraint_geodesics.pipeline.machine import run_header
    from constraint_geodesics.report.benchmark_tables import asks_in_python, overview_markdown

    params, layout = load_params(), Layout()
    some, left_out = fewer(params, Wish(queries, seeds, constraint, planner, longest))
    table = answered(committed_run(some, layout, out / "rows", out / "recordings"))
    write_table(table, out / "benchmark.csv", run_header(layout.root))
    order = {name: k for k, name in enumerate(some.benchmark.planners)}
    table = table.sort_values("planner", key=lambda names: names.map(order), kind="stable")
    summary = benchmark_summary(all_constraints(table), next(iter(some.benchmark.planners)))
    text = overview_markdown(summary, asks_in_python(all_settings(some)))
    (out / "overview.md").write_text(text)
    if as_json:
        print(
            json.dumps(
                {
                    "rows": str(out / "benchmark.csv"),
                    "overview": _records(summary),
                    "left_out": left_out,
                }
            )
        )
        return
    print(text)
    if left_out:
        print(
            f"left out, as they are given more than {longest:g} s a query (--longest): "
            f"{', '.join(left_out)}"
        )
    print(f"rows: {out / 'benchmark.csv'}")


@app.command("results")
def show_results(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the table's rows as one JSON object.")
    ] = False,
) -> None:
    """Print the committed result table and how to look further."""
    table = Layout().root / "reports" / ("table.csv" if as_json else "table.md")
    if not table.is_file():
        raise FileNotFoundError(f"{table}: no results yet; run `make repro`")
    if as_json:
        import pandas as pd

        print(json.dumps({"rows": _records(pd.read_csv(table, float_precision="round_trip"))}))
        return
    recordings = recordings_of(Layout())
    print(table.read_text().rstrip())
    print("\nOpen the runs in MLflow:    make ui")
    if recordings:
        print(f"Replay a path in Rerun:     make replay FILE={recordings[0]}")
    print("Read the report offline:    reports/index.html")


@app.command("replay")
def replay(
    recordings: Annotated[
        list[str] | None,
        typer.Argument(
            help="Files to open, or their numbers in the list; none lists them.",
            shell_complete=completion.recordings,
        ),
    ] = None,
    constraint: Annotated[
        str | None,
        typer.Option(help="Only of this constraint.", shell_complete=completion.listed_constraints),
    ] = None,
    query: Annotated[int | None, typer.Option(help="Only of this query.", min=0)] = None,
    planner: Annotated[
        list[str] | None, typer.Option(help="Only of this planner; may be given several times.")
    ] = None,
    scene: Annotated[str | None, typer.Option(help="Only in this scene of the benchmark.")] = None,
    manifold: Annotated[
        str | None, typer.Option(help="Only of paths searched on this learned manifold.")
    ] = None,
    seed: Annotated[
        list[int] | None, typer.Option(help="Only of this seed; may be given several times.")
    ] = None,
    beside: Annotated[
        bool,
        typer.Option(
            "--side-by-side", help="A view for each recording, instead of one over the other."
        ),
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Open in a browser on this machine instead of a window.")
    ] = False,
    web_port: Annotated[
        int, typer.Option(help="Port of the page on 127.0.0.1.", min=1, max=65535)
    ] = 9090,
    save: Annotated[
        Path | None, typer.Option(help="Write what would be opened as one file, to hand on.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the list as one JSON object.")
    ] = False,
) -> None:
    """Replay recorded paths in Rerun, several at once over each other; without any, list the
    recordings.

    With --constraint, --query and --planner what fits is opened; with fewer of them the list is
    narrowed.
    """
    from constraint_geodesics.recording.catalogue import Wanted, as_records

    wanted = Wanted(constraint, scene, query, tuple(planner or ()), tuple(seed or ()), manifold)
    if recordings and (as_json or wanted != Wanted()):
        words = (
            "--json prints the list of recordings"
            if as_json
            else "--constraint, --query, ... choose from the list"
        )
        raise SystemExit(_complain(ValueError(f"{words}: give no file"), WRONG_USAGE))
    if as_json:
        print(json.dumps({"recordings": as_records(_listed(wanted))}))
        return
    files = _named(recordings) if recordings else _chosen(_listed(wanted), wanted)
    if not files:
        return
    from constraint_geodesics.recording.viewer import open_recordings, save_recordings

    if save is not None:
        save_recordings(files, save, beside=beside)
        print(f"{save}: open it with geodesics replay {save}")
        return
    raise SystemExit(open_recordings(files, web=web, beside=beside, web_port=web_port))


def _listed(wanted: "Wanted") -> "list[Entry]":
    """The recordings of this checkout that are as asked for."""
    from constraint_geodesics.recording.catalogue import catalogue, narrowed, read_entry

    entries = catalogue(Path(), read_entry)
    if not entries:
        raise FileNotFoundError(
            "data/recordings: no recordings yet; run `make plan` for one, or `make repro` for all"
        )
    return narrowed(entries, wanted)


def _named(words: Sequence[str]) -> list[Path]:
    """The files that some words name, by themselves or by their numbers in the list."""
    from constraint_geodesics.recording.catalogue import Wanted, by_words

    for word in words:
        if not word.isdigit() and not Path(word).is_file():
            raise FileNotFoundError(
                f"{word}: no such recording; `geodesics replay` lists those there are"
            )
    numbers = [word for word in words if not Path(word).is_file()]
    files = {
        entry.number: Path(entry.file)
        for entry in (by_words(_listed(Wanted()), numbers) if numbers else [])
    }
    return [Path(word) if Path(word).is_file() else files[int(word)] for word in words]


def _chosen(listed: "list[Entry]", wanted: "Wanted") -> list[Path]:
    """What is opened of the list: what was asked for, or what a person at the terminal chooses;
    piped, nothing.
    """
    from constraint_geodesics.recording.catalogue import as_table, by_words, one_of_each

    if wanted.one_problem:
        chosen = one_of_each(listed, wanted)
        names = ", ".join(f"{entry.number} ({entry.planner})" for entry in chosen)
        print(f"opening {names} of the {len(listed)} that fit", file=sys.stderr)
        return [Path(entry.file) for entry in chosen]
    print(as_table(listed))
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        print(f"\nOpen one with: geodesics replay {listed[0].number}")
        return []
    try:
        answer = input("\nWhich to open? Numbers, for example 1 7; Enter for none: ")
    except EOFError:
        return []
    return [Path(entry.file) for entry in by_words(listed, answer.replace(",", " ").split())]


@app.command("ui")
def ui(
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1.", min=1, max=65535)] = 5000,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the address as one JSON object.")
    ] = False,
) -> None:
    """Open MLflow's dashboard for this checkout, on this machine only; it runs until it is
    stopped.
    """
    from constraint_geodesics.tracking.experiment import ui_command

    command, address = ui_command(Path().resolve(), port), f"http://127.0.0.1:{port}"
    print(
        json.dumps({"address": address}) if as_json else f"{address}  (stop with Ctrl-C)",
        flush=True,
    )
    os.execvp(command[0], command)


def _records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The rows of a table for JSON: what is not a finite number there is null."""
    records: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", double_precision=15))
    return records


def recordings_of(layout: Layout) -> list[Path]:
    """All recordings of this checkout, learned paths that keep a cup level first."""
    from constraint_geodesics.recording.catalogue import catalogue, read_entry

    return [layout.root / entry.file for entry in catalogue(layout.root, read_entry)]


if __name__ == "__main__":
    main()
