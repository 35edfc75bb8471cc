"""A path that something new is in the way of: its curve pushed clear as a band, and to either side
of what it meets.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from constraint_geodesics.search.candidates import Candidate, Task, connection, refined
from constraint_geodesics.search.roadmap import resample, shortest_way

_SLOPE = 1e-4
"""Step [rad] of the differences that the way out is found by."""
_MOST_WAYS = 60
"""Ways over the graph that are looked at."""
_WIDTH = 0.2
"""Of the bump by which a curve is moved aside, as a share of its length."""
_MOST = 0.8
"""How far a curve is moved aside at most [rad]."""
_SPARE_M = 0.03
"""Distance [m] that a curve moved aside has to spare at first."""


def pushed(task: Task, nodes: Float[np.ndarray, "n D"]) -> Candidate | None:
    """The curve through nodes, relaxed clear of what may meet; None where it is not sound."""
    return refined(task, "bend", nodes, clear=True)


def repaired(task: Task, rows: Float[np.ndarray, "T D"]) -> Iterator[Candidate]:
    """Sound curves near a path: pushed clear from where it is; then from either side."""
    nodes = resample(rows, task.settings.segments + 1)
    found = pushed(task, nodes)
    if found is not None:
        yield found
    for moved in _aside(task, rows, nodes):
        found = pushed(task, moved)
        if found is not None:
            yield found


def over_graph(
    task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
) -> Candidate | None:
    """The way over the constraint's graph, relaxed; None where there is none, or none is found
    soon: where something cuts the goal off, the search would look at every edge.
    """
    answer, roadmap = connection(task, start, goal), task.roadmap()
    if roadmap is None or answer.at_start is None or answer.at_goal is None:
        return None
    ends = answer.at_start, answer.at_goal
    corners = shortest_way(roadmap, start, goal, *ends, task.clear, most=_MOST_WAYS)
    if corners is None:
        return None
    for pieces in (task.settings.segments, 2 * task.settings.segments):
        found = refined(task, "graph", resample(corners, pieces + 1), clear=True)
        if found is not None:
            return found
    return None


def onward(
    task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
) -> Iterator[Candidate]:
    """Curves from where an arm rests that take little time to find: the straight line pushed clear,
    and the way over the graph.
    """
    line = pushed(task, resample(np.stack([start, goal]), task.settings.segments + 1))
    if line is not None:
        yield line
    way = over_graph(task, start, goal)
    if way is not None:
        yield way


def _aside(
    task: Task, rows: Float[np.ndarray, "T D"], nodes: Float[np.ndarray, "n D"]
) -> Iterator[Float[np.ndarray, "n D"]]:
    """The nodes moved aside where the path is deepest in something, both ways along the slope of
    its distance.
    """
    robot, model = task.manifold.robot, task.clearance
    if not len(rows):
        return
    apart = model.clearance(robot, rows)
    deepest = rows[int(apart.argmin())]
    around = deepest + _SLOPE * np.eye(len(deepest))
    slope = (model.clearance(robot, around) - apart.min()) / _SLOPE
    jacobian = task.manifold.jacobian(deepest)[task.manifold.rows.exact]
    if len(jacobian):
        slope -= np.linalg.pinv(jacobian) @ (jacobian @ slope)
    steep = float(np.linalg.norm(slope))
    if steep < 1e-6:
        return
    share = np.linspace(0.0, 1.0, len(nodes))
    middle = share[int(np.linalg.norm(nodes - deepest, axis=1).argmin())]
    bump = np.exp(-(((share - middle) / _WIDTH) ** 2)) * np.sin(np.pi * share) ** 0.5
    size = min((_SPARE_M - float(apart.min())) / steep, _MOST)
    for sign in (1.0, -2.0):
        yield np.ascontiguousarray(nodes + sign * size * bump[:, None] * slope / steep)
