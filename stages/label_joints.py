"""Stage: draw the configurations of one constraint, label them with PyBullet, and draw its
queries.
"""

import json
import sys

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import (
    ShardTask,
    data_card,
    draw_queries,
    draw_shard,
    seed_of,
    shard_tasks,
    write_joints,
    write_queries,
)
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage
from constraint_geodesics.tracking.store import stable

STAGE = "label_joints"


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write data/joints/<constraint>/, its data card and, in a file of their own, since DVC and
    MLflow show every number of a card, the histograms of its columns.
    """
    scene = Scene.from_params(params, constraint)
    manifold = constraint_manifold(scene.robot, params.constraints[constraint])
    labels = params.labels
    rows = labels.free_rows if constraint == "free" else labels.constrained_rows
    settings, about = (
        {"rows": rows, "labels": labels.model_dump()},
        subject_of(params, constraint=constraint),
    )
    with tracked_stage(
        Work(STAGE, constraint, settings, [], about), params.tracking.experiment, layout.root
    ) as run:
        tasks = shard_tasks(
            ShardTask(scene, manifold, rows, seed_of(constraint, labels.seed)), labels.shard_rows
        )
        shards = parallel_map(draw_shard, tasks, params.compute, description=f"label {constraint}")
        queries = draw_queries(scene, manifold, constraint, labels.queries, labels.query_seed)
        drawn_with = {
            "constraint": constraint,
            "robot": scene.robot.name,
            "seed": str(labels.seed),
            "rows": str(rows),
        }
        write_joints(shards, layout.joints(constraint), drawn_with)
        write_queries(queries, layout.queries(constraint))
        card = data_card(shards)
        histograms = stable(card.pop("histograms"))
        write_text(layout.report(STAGE, f"{constraint}-histograms"), json.dumps(histograms) + "\n")
        run.report(card, layout.report(STAGE, constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
