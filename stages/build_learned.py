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
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "build_learned"


def main(params: Params, layout: Layout) -> None:
    """Write data/learned/."""
    manifold, name = params.geodesics.searched[0], params.policies.chart
    graphs = [layout.submanifold(manifold, constraint) for constraint in params.constraints]
    inputs = [layout.manifold(manifold), layout.policies(name), *graphs]
    about = subject_of(params, manifold=manifold)
    work = Work(STAGE, "learned", {"chart": name}, inputs, about)
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        submanifolds = build(params, layout, manifold, name)
        run.mirror({"nodes": {n: len(graph.joints) for n, graph in submanifolds.items()}})


def build(params: Params, layout: Layout, manifold: str, chart: str) -> dict[str, Roadmap]:
    """Write the files; returns the graphs among them by their constraints."""
    graphs = {n: load_submanifold(layout.submanifold(manifold, n)) for n in params.constraints}
    submanifolds = {
        name: Roadmap(g.joints, g.edges, g.lengths, g.labels)
        for name, g in graphs.items()
        if isinstance(g, GraphSubmanifold)
    }
    settings = params.policy_settings()
    weights = load_file(layout.manifold(manifold) / WEIGHTS)
    policy = load_file(layout.policies(chart) / f"policy-{settings.seeds[0]}.safetensors")
    files = LearnedFiles(params.robot, chart, settings, weights, policy, submanifolds)
    files.write(layout.learned)
    return submanifolds


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
