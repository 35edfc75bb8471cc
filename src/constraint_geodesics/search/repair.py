"""A path that something new is in the way of: its curve pushed clear as a band, and to either side
of what it meets.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from constraint_geodesics.search.candidates import Candidate, Task, along, refined, round_it
from constraint_geodesics.search.roadmap import nearest, resample, shortest_way

_MOST_WAYS = 100
"""Ways over the graph that are looked at; more lead hardly any further motion on, and cost time
where there is none.
"""


def pushed(task: Task, nodes: Float[np.ndarray, "n D"]) -> Candidate | None:
    """The curve through nodes, relaxed clear of what may meet; None where it is not sound."""
    return refined(task, "bend", nodes, clear=True)


def repaired(task: Task, rows: Float[np.ndarray, "T D"]) -> Iterator[Candidate | None]:
    """Sound curves near a path: pushed clear from where it is; then from either side.  None for a
    try that came to nothing, so that whoever waits can look at the clock.
    """
    nodes = resample(rows, task.settings.segments + 1)
    yield pushed(task, nodes)
    yield from round_it(task, "bend", nodes)


def over_graph(
    task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
) -> Candidate | None:
    """The way over the constraint's graph, relaxed; None where there is none, or none is found
    soon: where something cuts the goal off, the search would look at every edge.
    """
    roadmap = task.roadmap()
    if roadmap is None:
        return None
    ends = nearest(roadmap, start), nearest(roadmap, goal)
    corners = shortest_way(roadmap, start, goal, *ends, task.clear, most=_MOST_WAYS)
    return None if corners is None else next(along(task, "graph", corners, True, True), None)


def onward(
    task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
) -> Iterator[Candidate | None]:
    """Curves from where an arm rests that take little time to find: the straight line pushed clear,
    and the way over the graph; None for one that is not sound.
    """
    yield pushed(task, resample(np.stack([start, goal]), task.settings.segments + 1))
    yield over_graph(task, start, goal)
