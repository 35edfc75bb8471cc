"""`geodesics bench --problems`: planners side by side on a file of problems."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from constraint_geodesics.cli_planning import loading
from constraint_geodesics.pipeline.stage import WRONG_USAGE, complain
from constraint_geodesics.text_files import write_text

if TYPE_CHECKING:
    from constraint_geodesics.benchmark.arm_source import UrdfArm
    from constraint_geodesics.params import BaselineParams, Params

PARAMS = Path("params.yaml")
"""The checkout's, in the folder that the command runs in."""


class ProblemOptions(NamedTuple):
    """What is asked, as options say it.  limit_s: of every query, None: those of params.yaml."""

    file: Path
    planners: list[str] | None
    every: int
    tilted: int
    limit_s: float | None
    urdf: Path | None
    tool_link: str | None
    srdf: Path | None
    hold: list[str] | None
    out: Path
    as_json: bool


def bench_problems(options: ProblemOptions) -> None:
    """Answer what is not answered yet, write the rows and the tables, and print these.  Exit code
    2: wrong usage, or a file that can't be used.
    """
    from constraint_geodesics.benchmark.problem_files import ProblemFileError, every, read_problems
    from constraint_geodesics.benchmark.row import write_table
    from constraint_geodesics.params import load_params
    from constraint_geodesics.peers.baseline import BaselineError
    from constraint_geodesics.pipeline.code import code_digest
    from constraint_geodesics.pipeline.layout import Layout
    from constraint_geodesics.pipeline.machine import run_header
    from constraint_geodesics.report.problems_page import totals_markdown
    from constraint_geodesics.robot.kinematics import RobotError
    from constraint_geodesics.studies.problem_runs import MEASURED_BY, Asked, answered, figures
    from constraint_geodesics.studies.problems import TILTED, tilted

    if not PARAMS.is_file():
        what = "--problems takes planners, limits and seeds from it: run it in a checkout"
        error = FileNotFoundError(f"{PARAMS.absolute()}: missing: {what}")
        raise SystemExit(complain(error, WRONG_USAGE))
    params = load_params(PARAMS)
    own, limit = params.problems, options.limit_s
    held = {} if limit is not None else {TILTED: own.held_limit_s}
    try:
        planners, arm = _named(params, options.planners), _arm(options)
        with loading():
            problems = read_problems(options.file, arm)
            asked = every(problems, options.every) + tilted(problems, options.tilted, own.seed)
        rows, code = options.out / "rows", code_digest(*MEASURED_BY)
        of = Asked(params, planners, limit or own.limit_s, held, rows, code)
        table = answered(asked, of, "problems")
    except (BaselineError, ProblemFileError, RobotError) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    found, file = figures(table), options.out / "problems.csv.gz"
    write_table(table, file, run_header(Layout().root))
    text = totals_markdown(found)
    write_text(options.out / "problems.md", text + "\n")
    print(json.dumps({"rows": str(file), "figures": found}) if options.as_json else text)
    if not options.as_json:
        print(f"rows: {file}")


def _named(params: "Params", names: list[str] | None) -> "dict[str, BaselineParams]":
    from constraint_geodesics.peers.baseline import BaselineError

    own = params.problems.planners
    known = {**params.benchmark.planners, **own}
    for name in names or ():
        if name not in known:
            line = f"there is no planner {name!r}: must be one of {', '.join(known)}"
            raise BaselineError(line)
    return {name: known[name] for name in names or own}


def _arm(options: ProblemOptions) -> "UrdfArm | None":
    from constraint_geodesics.benchmark.arm_source import UrdfArm
    from constraint_geodesics.cli_planning import held
    from constraint_geodesics.robot.kinematics import RobotError

    if options.urdf is None:
        if options.tool_link or options.srdf or options.hold:
            raise RobotError("--tool-link, --srdf and --hold need --urdf")
        return None
    if options.tool_link is None:
        line = f"which link carries the tool? `geodesics robot {options.urdf}`"
        raise RobotError(line)
    srdf = None if options.srdf is None else str(options.srdf)
    values = tuple(sorted(map(held, options.hold or ())))
    return UrdfArm(str(options.urdf), options.tool_link, srdf, values)
