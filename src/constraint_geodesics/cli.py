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

from constraint_geodesics.params import Params, ParamsError, load_params
from constraint_geodesics.paths import Layout

if TYPE_CHECKING:
    import pandas as pd

WRONG_USAGE = 2
NO_PATH = 3

app = typer.Typer(
    help="Shortest robot paths that keep a task constraint.", no_args_is_help=True, add_completion=True,
    pretty_exceptions_enable=False, context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip


def main() -> None:
    """Entry point of the command: an error of the user's is one line, not a traceback."""
    try:
        app()
    except (ValueError, OSError, RuntimeError) as error:
        raise SystemExit(_complain(error)) from None


def run_stage(stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Run one stage in this checkout: check params.yaml first, and report a bad input in one line.

    arguments: the names after (params, layout), as dvc.yaml passes them; each must be one that params.yaml has.
    """
    began = time.perf_counter()
    try:
        params = load_params()
        _check_names(params, stage, arguments)
        stage(params, Layout(), *arguments)
        note_stage_time(Layout().stage_times, Path(sys.argv[0]).stem, arguments, time.perf_counter() - began)
    except (ValueError, OSError, RuntimeError) as error:
        if os.environ.get("GEODESICS_TRACEBACK"):
            raise
        raise SystemExit(_complain(error)) from None


def note_stage_time(file: Path, stage: str, names: Sequence[str], seconds: float) -> None:
    """Keep how long the last finished run of each stage took, workers and all: what training costs is read from it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    own = " ".join([stage, *names])
    kept = dict(line.split(",") for line in file.read_text().splitlines()[1:]) if file.is_file() else {}
    kept[own] = f"{seconds:.1f}"
    file.write_text("\n".join(["stage,seconds", *(f"{name},{kept[name]}" for name in sorted(kept))]) + "\n")


def _check_names(params: Params, stage: Callable[..., None], arguments: Sequence[str]) -> None:
    """Each argument must be a name of the kind that the stage's own parameter is called after."""
    kinds = list(inspect.signature(stage).parameters)[2:]
    if len(kinds) != len(arguments):
        raise ParamsError(f"this stage takes {len(kinds)} names ({', '.join(kinds)}), not {len(arguments)}")
    names: dict[str, list[str]] = {
        "constraint": list(params.constraints),
        "manifold": list(params.manifolds),
        "analytic": list(params.geodesics.analytic),
    }
    for kind, name in zip(kinds, arguments, strict=True):
        if name not in names[kind]:
            raise ParamsError(f"params.yaml: there is no {kind} {name!r}: must be one of {names[kind]}")


def _complain(error: Exception, code: int | None = None) -> int:
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
    if code is not None:
        return code
    return WRONG_USAGE if isinstance(error, ParamsError) else 1


@app.command("params")
def check_params(
    file: Annotated[Path, typer.Argument(help="The file to check.")] = Path("params.yaml"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as one JSON object.")] = False,
) -> None:
    """Check a params.yaml: one line naming the first bad entry, or "ok".  Exit code 0: good; 2: bad."""
    try:
        load_params(file)
    except ParamsError as error:
        if not as_json:
            raise
        print(json.dumps({"file": str(file), "valid": False, "error": str(error)}))
        raise SystemExit(WRONG_USAGE) from None
    print(json.dumps({"file": str(file), "valid": True, "error": None}) if as_json else f"{file}: ok")


@app.command("doctor")
def look_for_trouble(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as one JSON object.")] = False,
) -> None:
    """Look for what is wrong with this checkout and its environment, and say the mend.  Exit code 1: a problem."""
    from constraint_geodesics.doctor import report

    findings = report.examine(Path())
    print(report.as_json(findings) if as_json else report.as_text(findings, report.terminal_colours()))
    raise SystemExit(report.exit_code(findings))


@app.command("constraints")
def list_constraints(
    planner: Annotated[str | None, typer.Option(help="Where the planner comes from, as for `plan`.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """List the constraints that `plan` knows by name."""
    from constraint_geodesics.bundle import open_bundle

    constraints = open_bundle(planner)[0].constraints
    if as_json:
        print(json.dumps({name: constraint.model_dump(mode="json") for name, constraint in constraints.items()}))
        return
    for name, constraint in constraints.items():
        print(f"{name:20s} {' '.join(map(str, constraint.axes))}  {constraint.description}")


@app.command("plan", context_settings={"allow_extra_args": False})
def plan(
    start: Annotated[str, typer.Option(help='Start configuration: the joints in rad, as in "0.1 -0.5 …".')],
    goal: Annotated[str, typer.Option(help="Goal configuration [rad].")],
    constraint: Annotated[str, typer.Option(help="A name that `geodesics constraints` lists.")],
    out: Annotated[Path | None, typer.Option(help="Write the path here, as CSV.")] = None,
    record: Annotated[Path | None, typer.Option(help="Write a Rerun recording here.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the path here, as PNG.")] = None,
    planner: Annotated[
        str | None,
        typer.Option(help="A planner's folder or MLflow address; by default the pipeline's outputs or the package's."),
    ] = None,
    budget: Annotated[
        float | None, typer.Option(help="Look for shorter paths until so many seconds have passed; by default do not.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as one JSON object.")] = False,
) -> None:
    """Plan one path.  Exit code 0: solved; 2: wrong usage; 3: there is no path, and the line says why."""
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import Planner, PlannerError

    try:
        first, last = _joints(start, "--start"), _joints(goal, "--goal")
        with Planner.load(planner) as loaded:
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
    file: Annotated[Path, typer.Argument(help="A path as CSV: a header, then one row of joints [rad] a line.")],
    constraint: Annotated[
        str | None, typer.Option(help="A name that `geodesics constraints` lists; by default what the file says.")
    ] = None,
    planner: Annotated[str | None, typer.Option(help="Where robot and workcell come from, as for `plan`.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the certificate as one JSON object.")] = False,
) -> None:
    """Certify anybody's path.  Exit code 0: it keeps every promise; 2: wrong usage; 3: it breaks the one named."""
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import PlannerError, check_path

    try:
        certificate = check_path(file, constraint, planner)
    except (BundleError, PlannerError) as error:
        raise SystemExit(_complain(error, WRONG_USAGE)) from None
    broken = certificate.violation
    untimed = " (no times: velocity and acceleration not looked at)" if math.isnan(certificate.duration_s) else ""
    meant = constraint or f"the constraint that {file.name} names"
    if as_json:
        print(json.dumps(certificate.summary()))
    elif broken is None:
        print(
            f"valid: {certificate.length_rad:.3f} rad, at most {certificate.violation_bound:.1e} (rad, m) off {meant} "
            f"anywhere, {certificate.collision_checks} configurations free of collision{untimed}"
        )
    else:
        print(f"{broken.kind}: {broken.message}")
    raise SystemExit(0 if broken is None else NO_PATH)


def _joints(text: str, option: str) -> list[float]:
    from constraint_geodesics.planner import PlannerError

    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise PlannerError(f"{option} {text!r}: must be numbers [rad], with spaces or commas between them") from None


@app.command("bench")
def bench(
    queries: Annotated[int, typer.Option(help="Queries of each constraint and scene.", min=1)] = 1,
    seeds: Annotated[int, typer.Option(help="Seeds of each planner that chance plays a part in.", min=1)] = 1,
    constraint: Annotated[list[str] | None, typer.Option(help="One of params.yaml's; by default all.")] = None,
    planner: Annotated[
        list[str] | None, typer.Option(help="One of params.yaml's bench.planners; by default all.")
    ] = None,
    longest: Annotated[float, typer.Option(help="Leave out planners that are given more seconds a query.")] = 2.0,
    out: Annotated[Path, typer.Option(help="Folder of rows, table and summary.")] = Path(".geodesics/bench"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object.")] = False,
) -> None:
    """Hold planners against each other on a few of the benchmark's queries; what is done is not done again."""
    from constraint_geodesics.benchmark_blocks import answered, blocks_of, fewer
    from constraint_geodesics.evaluation.benchmark import write_table
    from constraint_geodesics.evaluation.benchmark_report import overview_markdown
    from constraint_geodesics.evaluation.benchmark_statistics import all_constraints, benchmark_summary
    from constraint_geodesics.evaluation.machine import run_header

    params, layout = load_params(), Layout()
    some, left_out = fewer(params, queries, seeds, constraint, planner, longest)
    table = answered(blocks_of(some, layout, out / "rows", out / "recordings"), some.compute)
    write_table(table, out / "benchmark.csv", run_header(layout.root))
    order = {name: k for k, name in enumerate(some.bench.planners)}
    table = table.sort_values("planner", key=lambda names: names.map(order), kind="stable")
    summary = benchmark_summary(all_constraints(table), next(iter(some.bench.planners)))
    text = overview_markdown(
        summary, [n for n, e in some.bench.planners.items() if e.kind in ("ompl", "decoder_sampling")]
    )
    (out / "overview.md").write_text(text)
    if as_json:
        print(json.dumps({"rows": str(out / "benchmark.csv"), "overview": _records(summary), "left_out": left_out}))
        return
    print(text)
    if left_out:
        print(f"left out, as they are given more than {longest:g} s a query (--longest): {', '.join(left_out)}")
    print(f"rows: {out / 'benchmark.csv'}")


@app.command("results")
def show_results(
    as_json: Annotated[bool, typer.Option("--json", help="Print the table's rows as one JSON object.")] = False,
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
    files: Annotated[list[Path] | None, typer.Argument(help="Recordings to open; none lists them.")] = None,
    web: Annotated[bool, typer.Option(help="Open in a browser on this machine instead of a window.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as one JSON object.")] = False,
) -> None:
    """Replay recorded paths in Rerun; without a file, list the recordings."""
    if as_json and files:
        raise SystemExit(_complain(ValueError("--json prints the list of recordings: give no file"), WRONG_USAGE))
    if not files:
        found = recordings_of(Layout())
        if not found:
            raise FileNotFoundError("data/recordings: no recordings yet; run `make repro`")
        if as_json:
            print(json.dumps({"recordings": [str(file) for file in found]}))
            return
        print("\n".join(map(str, found)))
        print(f"\nOpen one with: geodesics replay {found[0]}")
        return
    for file in files:
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such recording")
    from constraint_geodesics.tracking.recording import open_recordings

    raise SystemExit(open_recordings(files, web=web))


@app.command("ui")
def ui(port: Annotated[int, typer.Option(help="Port on 127.0.0.1.", min=1, max=65535)] = 5000) -> None:
    """Open MLflow's dashboard for this checkout, on this machine only."""
    from constraint_geodesics.tracking.experiment import ui_command

    command = ui_command(Path().resolve(), port)
    print(f"http://127.0.0.1:{port}  (stop with Ctrl-C)", flush=True)
    os.execvp(command[0], command)


def _records(frame: "pd.DataFrame") -> list[dict[str, Any]]:
    """The rows of a table for JSON: what is not a finite number there is null."""
    records: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", double_precision=15))
    return records


def recordings_of(layout: Layout) -> list[Path]:
    """All recordings of this checkout, learned paths that keep a cup level first."""
    found = (layout.root / "data" / "recordings").rglob("*.rrd")
    return sorted(found, key=lambda file: ("planner-level_cup/query0-learned" not in file.as_posix(), file.as_posix()))


if __name__ == "__main__":
    main()
