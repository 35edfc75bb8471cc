"""Stage: the planner's files, from the run's manifold, graphs and policies; a copy travels with the
package, and MLflow's registry has them as a model.
"""

import shutil
import sys
from pathlib import Path

from safetensors.numpy import load_file

import constraint_geodesics
from constraint_geodesics.bundle import Bundle
from constraint_geodesics.cli import run_stage
from constraint_geodesics.learning.dataset import read_queries
from constraint_geodesics.learning.files import WEIGHTS
from constraint_geodesics.learning.submanifold import GraphSubmanifold, load_submanifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.search.roadmap import Roadmap
from constraint_geodesics.tracking.experiment import subject_of, tracked_stage
from constraint_geodesics.tracking.registry import register_planner

STAGE = "build_planner"
CODE = Path(constraint_geodesics.__file__).parent / "tracking" / "served_model.py"


def main(params: Params, layout: Layout) -> None:
    """Write data/planner/ and src/constraint_geodesics/pretrained/, and register the planner."""
    manifold, shown = params.geodesics.searched[0], params.studies.constraint
    sources = [layout.manifold(manifold), layout.policies(manifold), layout.queries(shown)]
    about = subject_of(params, manifold=manifold)
    with tracked_stage(
        STAGE,
        "planner",
        params.planner,
        sources,
        experiment=params.tracking.experiment,
        root=layout.root,
        subject=about,
    ) as run:
        graphs = {
            name: load_submanifold(layout.submanifold(manifold, name))
            for name in params.constraints
        }
        roadmaps = {
            n: Roadmap.from_submanifold(g)
            for n, g in graphs.items()
            if isinstance(g, GraphSubmanifold)
        }
        seeds = {
            seed: load_file(layout.policies(manifold) / f"policy-{seed}.safetensors")
            for seed in params.geodesics.seeds
        }
        bundle = Bundle(
            params.robot,
            params.workcell,
            params.constraints,
            params.planner,
            params.policy_settings(),
            params.judge,
            load_file(layout.manifold(manifold) / WEIGHTS),
            {
                f"{seed}/{name}": values
                for seed, policy in seeds.items()
                for name, values in policy.items()
            },
            roadmaps,
        )
        bundle.write(layout.planner)
        shutil.copytree(layout.planner, layout.pretrained, dirs_exist_ok=True)
        queries = read_queries(layout.queries(shown))
        example = {
            "start": queries.starts[0].tolist(),
            "goal": queries.goals[0].tolist(),
            "constraint": shown,
        }
        register_planner(run, layout.planner, CODE, example)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
