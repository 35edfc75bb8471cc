"""The pipeline's drawing: what it says is what dvc.yaml says, and it fits a terminal."""

import random
import re
import string
from functools import cache
from itertools import combinations
from pathlib import Path

import networkx as nx
import pytest
import yaml

from constraint_geodesics.pipeline.dag import STROKES, drawing, pipeline

ROOT = Path(__file__).resolve().parents[2]
WAYS = {stroke[0]: stroke[1:] for stroke in STROKES.split()}
STEPS = {"U": (-1, 0), "D": (1, 0), "L": (0, -1), "R": (0, 1)}
BACK = {"U": "D", "D": "U", "L": "R", "R": "L"}
SHAPES = {
    "chain": "ab bc cd",
    "diamond": "ab ac bd cd",
    "past a layer": "ab bc ad cd ce",
    "past two layers": "ab bc cd ad ae be",
    "two beside each other": "ab cd",
    "shared": "ac ad bc bd",
    "shared in part": "ac ad bd be",
    "crossing": "ad bc be cf",
    "fan": "ab ac ad ae be ce de",
}


def graph_of(edges: str) -> nx.DiGraph:
    """Of nodes with names of several letters."""
    return nx.DiGraph([(3 * first, 3 * then) for first, then in edges.split()])


@cache
def committed() -> tuple[nx.DiGraph, dict[str, int]]:
    return pipeline(ROOT)


def read_back(text: str) -> set[tuple[str, str]]:
    """Which name leads to which, going along the lines from above: never up, and straight on where
    one passes over another.
    """
    lines = text.splitlines()
    spans = [
        (row, found.start(), found.end(), found.group(1))
        for row, line in enumerate(lines)
        for found in re.finditer(r"([a-z]\w*)(?: ×\d+)?", line)
    ]

    def followed(row: int, column: int, heading: str) -> set[str]:
        for at, first, end, name in spans:
            if at == row and first <= column < end:
                return {name}
        line = lines[row] if row < len(lines) else ""
        ways = WAYS.get(line[column : column + 1], "")
        if ways == "UD" and heading in "LR":
            onward = heading
        elif BACK[heading] in ways:
            onward = "".join(way for way in ways if way not in (BACK[heading], "U"))
        else:
            onward = ""
        found = (followed(row + STEPS[w][0], column + STEPS[w][1], w) for w in onward)
        return set().union(*found)

    def below(row: int, first: int, end: int) -> set[str]:
        return set().union(*(followed(row + 1, column, "D") for column in range(first, end)))

    return {(name, then) for row, *span, name in spans for then in below(row, *span)}


def test_it_shows_every_script_of_dvc_yaml_with_its_items() -> None:
    stages = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    graph, items = committed()
    scripts = {re.search(r"stages/(\w+)\.py", stage["cmd"])[1] for stage in stages.values()}
    assert set(graph) == set(items) == scripts - {"digest_code"}
    assert items["label_joints"] == len(params["constraints"])
    text = drawing(graph, items)
    for name, count in items.items():
        assert len(re.findall(rf"\b{name}\b", text)) == 1
        assert (f"{name} ×{count}" in text) == (count > 1)


def test_it_is_a_dozen_names_that_fit_a_terminal() -> None:
    graph, items = committed()
    lines = drawing(graph, items).splitlines()
    assert len(graph) <= 12
    assert max(map(len, lines)) <= 100
    assert len(lines) <= 24


def test_its_lines_are_what_the_stages_need() -> None:
    graph, items = committed()
    assert read_back(drawing(graph, items)) == set(graph.edges)
    assert ("label_joints", "train_manifold") in graph.edges
    assert ("build_planner", "execute_paths") in graph.edges


@pytest.mark.parametrize("edges", SHAPES.values(), ids=SHAPES)
def test_any_shape_can_be_read_back(edges: str) -> None:
    graph = graph_of(edges)
    assert read_back(drawing(graph, {"bbb": 12})) == set(graph.edges)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_needs_what_can_be_read_back(seed: int) -> None:
    chance = random.Random(seed)
    names = [letter * chance.randint(4, 15) for letter in string.ascii_lowercase[:9]]
    graph = nx.DiGraph()
    graph.add_nodes_from(names)
    graph.add_edges_from(pair for pair in combinations(names, 2) if chance.random() < 0.3)
    graph = nx.transitive_reduction(graph)
    assert read_back(drawing(graph, {})) == set(graph.edges)


def test_a_small_one_is_as_people_draw_it() -> None:
    lines = drawing(graph_of(SHAPES["diamond"]), {}).splitlines()
    assert lines == ["   aaa", "  ┌─┴───┐", " bbb   ccc", "  └─┬───┘", "   ddd"]
