"""Stage: the files of the paper's system as a method of the planner, from the run's manifold, the
first of its policies and the sub-manifolds.
"""

import sys

from safetensors.numpy import load_file

from constraint_geodesics.geodesics.learned_method import LearnedFiles
from constraint_geodesics.learning.inference import WEIGHTS
from constraint_geodesics.learning.submanifold import GraphSubmanifold, load_submanifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.search.roadmap import Roadmap


def main(params: Params, layout: Layout) -> None:
    """Write data/learned/."""
    manifold = params.geodesics.searched[0]
    graphs = {n: load_submanifold(layout.submanifold(manifold, n)) for n in params.constraints}
    submanifolds = {
        name: Roadmap(g.joints, g.edges, g.lengths, g.labels)
        for name, g in graphs.items()
        if isinstance(g, GraphSubmanifold)
    }
    name, settings = params.policies.chart, params.policy_settings()
    weights = load_file(layout.manifold(manifold) / WEIGHTS)
    policy = load_file(layout.policies(name) / f"policy-{settings.seeds[0]}.safetensors")
    files = LearnedFiles(params.robot, name, settings, weights, policy, submanifolds)
    files.write(layout.learned)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
