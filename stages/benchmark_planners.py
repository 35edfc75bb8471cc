"""Stage: some planners of the benchmark on the pipeline's queries of one constraint (Table I)."""

import sys
from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.entries import Run, answered, with_planners
from constraint_geodesics.benchmark.queries import TABLE, Query
from constraint_geodesics.benchmark.recorder import PathKeeper
from constraint_geodesics.benchmark.statistics import comparison_figures
from constraint_geodesics.cli import run_stage
from constraint_geodesics.learning.dataset import read_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import load_submanifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.recording.replay import record_rows, save_paths
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.tracking.experiment import subject_of, tracked_stage

STAGE = "benchmark_planners"


def asked_of(file: Path, constraint: str) -> list[Query]:
    """The pipeline's queries as the benchmark asks them."""
    pairs = read_queries(file)
    ends = enumerate(zip(pairs.starts, pairs.goals, strict=True))
    return [Query(constraint, TABLE, number, start, goal) for number, (start, goal) in ends]


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write data/benchmark/<constraint>/, its recordings, rows and figures."""
    source, compared = layout.queries(constraint), params.benchmark.compared
    scene, shown = Scene.from_params(params), params.geodesics.searched[0]
    queries, scratch = asked_of(source, constraint), layout.scratch(STAGE, constraint)
    asked = {"queries": len(queries), "seeds": compared.seeds}
    entries = {
        name: params.benchmark.planners[name].model_copy(update=asked) for name in compared.planners
    }
    own, kept = with_planners(params, entries), PathKeeper(scratch / "paths")
    about = subject_of(params, constraint=constraint)
    with tracked_stage(
        STAGE,
        constraint,
        compared,
        [source],
        experiment=params.tracking.experiment,
        root=layout.root,
        subject=about,
    ) as run:
        table = answered(Run(own, layout, queries, scratch, list(params.manifolds), kept))
        rows: list[Any] = table.to_dict("records")
        paths = [kept.path(row, scene.robot.dof) for row in rows]
        # one planner of each kind stands next to the learned geodesics: its kind is its name there
        rows = [row | {"planner": row["kind"]} for row in rows]
        save_paths(rows, paths, layout.benchmark(constraint))
        rows = record_rows(
            layout.recordings(STAGE, constraint),
            rows,
            paths,
            constraint,
            LearnedManifold.load(layout.manifold(shown)),
            scene.manifold(params.constraints[constraint]),
            load_submanifold(layout.submanifold(shown, constraint)),
            scene.workcell,
            params.recording,
        )
        run.recordings(rows)
        file = layout.report(STAGE, constraint, "csv")
        file.parent.mkdir(parents=True, exist_ok=True)
        table = pd.DataFrame(rows)
        table.to_csv(file, index=False)
        run.report(comparison_figures(table), layout.report(STAGE, constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
