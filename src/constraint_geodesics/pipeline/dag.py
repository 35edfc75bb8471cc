"""`make dag`: the pipeline, drawn for a terminal.

A node is a script with the number of its items.  An edge that follows from others is left out, and
so is the digest of the code, on which all stages hang.  Scripts that feed the same ones share a
line; where two lines cross, the one from above passes over the other.
"""

import shlex
from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import networkx as nx
import numpy as np
from dvc.repo import Repo
from scipy.optimize import isotonic_regression

LEFT_OUT = "digest_code"
GAP = 3
"""Columns between two names, at least."""
SWEEPS = 6
"""Down and up again, in which names move towards those that they are joined to."""
STROKES = "│UD ─LR ┌DR ┐DL └UR ┘UL ├UDR ┤UDL ┬DLR ┴ULR ┼UDLR"
"""Each with where it leads: up, down, left and right."""
CHARACTERS = {frozenset(stroke[1:]): stroke[0] for stroke in STROKES.split()}
Node = str | tuple[str, int]
"""A script, or a place where its line passes a layer."""


class Bus(NamedTuple):
    """One line between two layers: the columns that come into it from above, and that leave it."""

    above: frozenset[int]
    below: frozenset[int]


def pipeline(root: Path = Path()) -> tuple[nx.DiGraph, dict[str, int]]:
    """What needs what of dvc.yaml, an edge from each script to the next, and how many items each
    has.
    """
    with Repo(str(root)) as repo:
        graph = repo.index.graph
        stages = [s for s in graph if s.path_in_repo == "dvc.yaml" and s.name != LEFT_OUT]
        script = {own: Path(shlex.split(own.cmd)[1]).stem for own in stages}
        needed = [(first, then) for then, first in graph.edges if {first, then} <= set(stages)]
    edges = {(script[first], script[then]) for first, then in needed}
    needed_once = nx.transitive_reduction(nx.DiGraph((a, b) for a, b in edges if a != b))
    found = nx.DiGraph()  # in the order of the names, so that it is drawn in one way
    found.add_nodes_from(sorted(set(script.values())))
    found.add_edges_from(sorted(needed_once.edges))
    return found, dict(Counter(script.values()))


def drawing(graph: nx.DiGraph, items: Mapping[str, int]) -> str:
    """Scripts below what they need, as text."""
    layers, joined = _layers(graph)
    names = {node: _label(node, items) for layer in layers for node in layer}
    columns = _columns(layers, joined, names)
    lines = list[str]()
    for upper, lower in zip(layers, [*layers[1:], []], strict=True):
        lines.append(_written({columns[node]: names[node] for node in upper}))
        lines += _rows(_buses(upper, lower, joined, columns, names))
    return "\n".join(lines)


def _label(node: Node, items: Mapping[str, int]) -> str:
    if not isinstance(node, str):
        return "│"
    return f"{node} ×{items[node]}" if items.get(node, 1) > 1 else node


def _layers(graph: nx.DiGraph) -> tuple[list[list[Node]], set[tuple[Node, Node]]]:
    """The nodes of each layer from above, and which are joined to which in the next one."""
    level = {
        node: depth
        for depth, nodes in enumerate(nx.topological_generations(graph))
        for node in nodes
    }
    for node in reversed(list(nx.topological_sort(graph))):
        alone = all(graph.out_degree(before) == 1 for before in graph.predecessors(node))
        if alone and graph.out_degree(node):  # nothing else waits for what it follows
            level[node] = min(level[after] for after in graph.successors(node)) - 1
    layers: list[list[Node]] = [[] for _ in range(1 + max(level.values()))]
    joined = set[tuple[Node, Node]]()
    for node in nx.topological_sort(graph):
        layers[level[node]].append(node)
        last: Node = node
        ends = sorted(graph.successors(node), key=level.__getitem__)
        for depth in range(level[node] + 1, level[ends[-1]] + 1 if ends else 0):
            joined |= {(last, after) for after in ends if level[after] == depth}
            if depth < level[ends[-1]]:
                layers[depth].append((node, depth))
                joined.add((last, (node, depth)))
                last = (node, depth)
    return layers, joined


def _columns(
    layers: list[list[Node]], joined: set[tuple[Node, Node]], names: Mapping[Node, str]
) -> dict[Node, int]:
    """The middle of each name; the layers are sorted by it."""
    place = {node: float(k) for layer in layers for k, node in enumerate(layer)}
    both = nx.Graph()
    both.add_edges_from(sorted(joined, key=str))
    for sweep in range(2 * SWEEPS):
        for layer in layers if sweep % 2 == 0 else layers[::-1]:
            wish = {
                n: np.mean([place[o] for o in both.adj.get(n, ())] or [place[n]]) for n in layer
            }
            layer.sort(key=wish.__getitem__)
            width = np.array([len(names[node]) for node in layer], dtype=float)
            room = np.concatenate([[0.0], np.cumsum((width[1:] + width[:-1]) / 2 + GAP)])
            free = isotonic_regression([wish[node] for node in layer] - room).x
            place |= dict(zip(layer, (free + room).tolist(), strict=True))
    left = min(place[node] - len(names[node]) / 2 for node in place)
    columns = {node: round(at - left) for node, at in place.items()}
    for upper, lower in pairwise(layers):
        for node in lower:
            beside = {columns[own] for own in upper if (own, node) not in joined}
            if not isinstance(node, str) and columns[node] in beside:
                columns[node] += 1  # a line that leaves there would meet the one that passes
    return columns


def _buses(
    upper: list[Node],
    lower: list[Node],
    joined: set[tuple[Node, Node]],
    columns: Mapping[Node, int],
    names: Mapping[Node, str],
) -> list[Bus]:
    """The lines between two layers.  Each comes into a name at a column of its own, which no other
    one leaves.
    """
    grouped: dict[tuple[Node, ...], set[int]] = {}
    for node in upper:
        if below := tuple(own for own in lower if (node, own) in joined):
            grouped.setdefault(below, set()).add(columns[node])
    leaving, used = set().union(*grouped.values()), set[int]()
    buses = list[Bus]()
    for nodes, above in grouped.items():
        taken, ports = leaving - above, list[int]()
        for node in nodes:
            middle, left = columns[node], columns[node] - len(names[node]) // 2
            room = range(left, left + len(names[node]))
            best = sorted(room, key=lambda at: (at not in above, abs(at - middle)))
            ports.append(next((at for at in best if at not in taken | used), middle))
            used.add(ports[-1])
        buses.append(Bus(frozenset(above), frozenset(ports)))
    return buses


def _rows(buses: list[Bus]) -> list[str]:
    """The rows between two layers: one for each line that is not straight."""
    bent = [bus for bus in buses if len(bus.above | bus.below) > 1]
    straight = set[int]().union(*(bus.above for bus in buses if bus not in bent))
    if not bent:
        return [_written(dict.fromkeys(straight, "│"))] if straight else []
    rows = list[str]()
    for row, bus in enumerate(bent):
        passing = straight.union(*(own.below for own in bent[:row]))
        passing = passing.union(*(own.above for own in bent[row + 1 :]))
        rows.append(_written(_track(bus) | dict.fromkeys(passing, "│")))
    return rows


def _track(bus: Bus) -> dict[int, str]:
    """The characters of a line where it runs from side to side, by their columns."""
    ends = bus.above | bus.below
    first, last, found = min(ends), max(ends), dict[int, str]()
    for column in range(first, last + 1):
        leads = {
            "U": column in bus.above,
            "D": column in bus.below,
            "L": column > first,
            "R": column < last,
        }
        found[column] = CHARACTERS[frozenset(way for way in leads if leads[way])]
    return found


def _written(texts: Mapping[int, str]) -> str:
    """Texts in one line, each around its column."""
    line = ""
    for column, text in sorted(texts.items()):
        line = line.ljust(column - len(text) // 2) + text
    return line


if __name__ == "__main__":
    print(drawing(*pipeline()))
