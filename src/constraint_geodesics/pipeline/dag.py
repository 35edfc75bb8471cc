"""`make dag`: the pipeline as a graph that fits a terminal.

A node is a stage with all its items.  An edge that follows from others is left out, and so is the
digest of the code, on which all stages hang.
"""

import networkx as nx
from dvc.commands.dag import _build
from dvc.dagascii import draw
from dvc.repo import Repo

LEFT_OUT = ("digest_code", "stages/")
"""Beginnings of the names of stages that are not drawn."""


def drawing() -> str:
    """Stages below what they need, as text."""
    with Repo() as repo:
        graph = nx.DiGraph(_build(repo, collapse_foreach_matrix=True))
    graph = nx.relabel_nodes(graph, {node: str(node) for node in graph})
    graph.remove_nodes_from([node for node in graph if node.startswith(LEFT_OUT)])
    reduced = nx.transitive_reduction(graph)
    return str(draw(sorted(reduced.nodes), sorted(reduced.edges)))


if __name__ == "__main__":
    print(drawing())
