"""Stage: episodes in simulation, an arm that moves among obstacles that it sees when they are near,
with `replan` and beside BiRRT from scratch; goes on where an earlier run of it stopped.
"""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_digest, data_digest
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine, run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.progress import progress
from constraint_geodesics.recording.episode_recording import EpisodeRecord, Stretch, record_episode
from constraint_geodesics.report.episodes_page import episodes_markdown
from constraint_geodesics.studies import episode_runs as runs
from constraint_geodesics.studies import episodes as study
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "study_episodes"
SEED, EPISODES = 0, 40
CONSTRAINTS = ("level_cup", "free", "slide")


def main(params: Params, layout: Layout) -> None:
    """Write data/episode_rows/ as episodes end, then reports/episodes.csv.gz, .json and .md, and a
    recording of each.
    """
    code = f"{code_digest('studies.episode_runs')} {data_digest(layout.planner)} {machine()} {SEED}"
    folder = layout.root / "data" / "episode_rows"
    tasks = [
        runs.Task(layout.planner, constraint, number, SEED, code, folder)
        for constraint in CONSTRAINTS
        for number in range(EPISODES)
    ]
    settings: dict[str, Any] = {"seed": SEED, "episodes": EPISODES}
    settings |= {"latency_s": study.LATENCY_S, "sensing_m": list(study.SENSING_M)}
    work = Work(STAGE, "episodes", settings, [layout.planner])
    reports = layout.root / "reports"
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        rows = parallel_map(runs.kept, tasks, params.compute, description="episodes")
        table, answers = runs.tables(rows)
        found = runs.figures(table, answers)
        both = [table.assign(table="run"), answers.assign(table="answer")]
        about = run_header(layout.root)
        write_table(pd.concat(both), reports / "episodes.csv.gz", about)
        run.report({"machine": about, "figures": found}, reports / "episodes.json")
        write_text(reports / "episodes.md", episodes_markdown(found, about))
        with progress("recordings", len(tasks)) as advance:
            for task, row in zip(tasks, rows, strict=True):
                _record(task, layout, row)
                advance()


def _record(task: runs.Task, layout: Layout, row: Mapping[str, Any]) -> None:
    planner, constraint = runs.opened(task.planner), task.constraint
    with study.carrying(planner, constraint):
        ends = runs.ends(planner, constraint, task.seed)
        episode = study.drawn(planner, constraint, task.number, task.seed, ends)
    for controller, own in row["motions"].items():
        name = f"episode{task.number}-{controller.split()[0].lower()}.rrd"
        file = layout.recordings(STAGE, constraint) / name
        record_episode(file, _record_of(controller, constraint, episode, own), meshes=False)


def _record_of(
    controller: str, constraint: str, episode: study.Episode, own: Mapping[str, Any]
) -> EpisodeRecord:
    stretches = [
        Stretch(leg["begins_s"], np.array(leg["times"]), np.array(leg["joints"]))
        for leg in own["legs"]
    ]
    text = f"**{controller}**, constraint `{constraint}`: {own['outcome']}"
    about = controller, constraint, episode.number, episode.first.scene, episode.obstacles
    kept = episode.first.constraint
    return EpisodeRecord(*about, own["seen"], stretches, own["over_s"], text, kept)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
