"""Stage: the planner and its baselines on a file of problems, and on queries with a held tilt in
their scenes; goes on where an earlier run of it stopped.
"""

import sys
from pathlib import Path

from constraint_geodesics.benchmark.arm_source import UrdfArm
from constraint_geodesics.benchmark.problem_files import Problem, every, read_problems
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_digest, data_digest, digest
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.problems_page import report_answers
from constraint_geodesics.studies.problem_runs import MEASURED_BY, Asked
from constraint_geodesics.studies.problems import TILTED, tilted
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_problems"


def main(params: Params, layout: Layout) -> None:
    """Write data/problem_rows/ as answers come, then reports/problems.csv.gz, .json and .md."""
    own, file = params.problems, layout.root / params.problems.file
    if not file.exists():
        what = "the problems are not in this repository; docs/problems.md says where they are from"
        raise FileNotFoundError(f"{file}: missing: {what}")
    problems = read_problems(file)
    asked = every(problems, own.every) + tilted(problems, own.tilted, own.seed)
    of = Asked(
        params,
        own.planners,
        own.limit_s,
        {TILTED: own.held_limit_s},
        layout.problem_rows,
        code_digest(*MEASURED_BY),
    )
    each = "" if own.every == 1 else f", of each scene one in {own.every}"
    about = [
        f"the problems of {file.name} (SHA-256 {_digest(file)}…){each}",
        f"{own.limit_s:g} s for a query, {own.held_limit_s:g} s with a held tilt",
        *held_beyond(problems),
    ]
    title = "Problems of MotionBenchMaker"
    settings = own.model_dump(mode="json", exclude={"planners"})
    work = Work(STAGE, STAGE, settings, [file])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        report_answers(run, layout, "problems", title, about, asked, of)


def _digest(file: Path) -> str:
    return data_digest(file)[:16] if file.is_dir() else digest(file)


def held_beyond(problems: list[Problem]) -> list[str]:
    """Joints that stand where the URDF does not let them, a sentence each."""
    arms = {own.arm for own in problems if isinstance(own.arm, UrdfArm)}
    return sorted(
        {
            f"as the file has it, {name} is held at {dict(arm.held)[name]:g}: the URDF's limits "
            f"are {limits}"
            for arm in arms
            for name, limits in arm.beyond_limits.items()
        }
    )


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
