"""params.yaml with one entry made bad, for every entry: it is missing, unknown, of a wrong type,
out of range or not finite.
"""

import copy
import math
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from constraint_geodesics.gate import _planner_problems, check_params
from constraint_geodesics.params import ParamsError, params_of, read_yaml
from tests.faults.bad_input import Bad, written

ROOT = Path(__file__).resolve().parents[2]
MAY_BE_MISSING = (
    "robot.limits_rad*",
    "workcell.shapes*",
    "compute.dask_address",
    "carried*",
    "constraints.tool_down",
    "*.descent_scale",
    "policies.reward.feasible_weight",
    "policies.reward.set_weight",
    "planner.*",
    "judge.*",
    "unseen.*",
    "compare_charts.hole.around.shapes*",
    "benchmark.planners.*",
    "problems.planners.*",
)
"""Entries with a default, and those that a user may name or not."""
MAY_BE_NEGATIVE = ("*position_m.*", "*centre_m.*", "*rpy_rad.*", "robot.limits_rad.*")
MAY_BE_NULL = ("*.reference", "compute.dask_address", "planner.clearance_share", "*.shapes")
MAY_BE_NULL_TOO = ("*.planners.*.queries", "*.planners.*.seeds", "*.planners.*_s")
MAY_BE_LARGE = ("*.inclusion_weight",)
"""Infinite, too."""
NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300, -1, 10**12)


def cases(top: str) -> Iterator[Bad]:
    """Of one of the file's blocks."""
    raw = read_yaml(ROOT / "params.yaml")
    for path, value in list(_entries(raw[top], (top,))):
        name = ".".join(map(str, path))
        key = next(str(part) for part in reversed(path) if isinstance(part, str))
        if isinstance(path[-1], str) and not _is(name, MAY_BE_MISSING):
            yield Bad(f"{name} missing", lambda path=path: _without(raw, path), (key,))
        for bad in _instead_of(value, name):
            said = "speed" if isinstance(bad, dict) and "speed" in bad else key
            ask = lambda path=path, bad=bad: _with(raw, path, bad)  # noqa: E731
            yield Bad(f"{name}={str(bad)[:40]!r}", ask, (said,))


def _instead_of(value: Any, name: str) -> list[Any]:
    if isinstance(value, dict):
        return [{**value, "speed": 1}, 5, [1], "x", True]
    if isinstance(value, list):
        return [5, "x", {"a": 1}, [math.nan] * max(1, len(value)), ["x", None]]
    if isinstance(value, bool):
        return ["yes", 5, None]
    if isinstance(value, int | float):
        null = _is(name, (*MAY_BE_NULL, *MAY_BE_NULL_TOO))
        found: list[Any] = [str(value), True, [value], {}] + [None] * (not null)
        large = math.nan, -math.inf, -1e300, -1
        numbers = large if _is(name, MAY_BE_LARGE) else NUMBERS
        return found + [x for x in numbers if x != -1 or not _is(name, MAY_BE_NEGATIVE)]
    if value is None:
        return [5, "x" * 3, [1], {"a": 1}]
    return [5, [value], {}, True]


def _entries(value: Any, path: tuple[str | int, ...]) -> Iterator[tuple[tuple, Any]]:
    yield path, value
    if isinstance(value, dict):
        for key, own in value.items():
            yield from _entries(own, (*path, key))
    elif isinstance(value, list):
        for place, own in enumerate(value):
            yield from _entries(own, (*path, place))


def _is(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)


def _checked(raw: Any, path: tuple) -> None:
    params = params_of(raw, Path("params.yaml"))
    if path[0] in ("benchmark", "problems"):
        for problem in _planner_problems(params):
            raise ParamsError(problem)


def _outer(raw: Any, path: tuple) -> Any:
    for part in path[:-1]:
        raw = raw[part]
    return raw


def _without(raw: Any, path: tuple) -> None:
    raw = copy.copy(raw) if len(path) == 1 else {**raw, path[0]: copy.deepcopy(raw[path[0]])}
    del _outer(raw, path)[path[-1]]
    _checked(raw, path)


def _with(raw: Any, path: tuple, bad: Any) -> None:
    raw = copy.copy(raw) if len(path) == 1 else {**raw, path[0]: copy.deepcopy(raw[path[0]])}
    _outer(raw, path)[path[-1]] = bad
    _checked(raw, path)


def gate_cases() -> Iterator[Bad]:
    """Faults that only the files behind the parameters show, or other parameters.  Writes one of
    these files to the current folder.
    """

    def bad(name: str, said: tuple[str, ...], *path: Any, to: Any) -> Bad:
        def ask() -> None:
            raw = copy.deepcopy(read_yaml(ROOT / "params.yaml"))
            _outer(raw, path)[path[-1]] = to
            check_params(params_of(raw, Path("params.yaml")))

        return Bad(name, ask, said)

    robot, shapes = ("robot",), ("workcell", "shapes")
    table = (*shapes, "table")
    planners = ("benchmark", "planners")
    yield bad("tool link", ("robot: ", "'hand'"), *robot, "tool_link", to="hand")
    yield bad("URDF", ("robot: ", "no/arm.urdf"), *robot, "urdf", to="no/arm.urdf")
    yield bad("no XML", ("robot: ", "no XML"), *robot, "urdf", to=str(ROOT / "params.yaml"))
    yield bad("joint", ("robot: ", "elbow"), *robot, "limits_rad", to={"elbow": [-1, 1]})
    yield bad("held joint", ("robot: ", "joint9"), *robot, "hold", to={"joint9": 0.0})
    yield bad("SRDF", ("robot: ", "no.srdf"), *robot, "may_touch", to="no.srdf")
    swapped, wider = {"joint1": [1.0, -1.0]}, {"joint1": [-9.0, 3.5]}
    yield bad("limits swapped", ("robot: ", "joint1"), *robot, "limits_rad", to=swapped)
    yield bad("limits wider", ("robot: ", "joint1"), *robot, "limits_rad", to=wider)
    yield bad("exempt link", ("workcell: ", "'arm'"), *table, "exempt_links", to=["arm"])
    door = {"kind": "urdf", "urdf": "no/door.urdf"}
    yield bad("workcell", ("workcell: ", "no/door.urdf"), *shapes, "door", to=door)
    yield bad("carried", ("carried: ", "no/door.urdf"), "carried", "shapes", "door", to=door)
    broken = written(Path(), "broken.urdf", '<robot name="door"><link name="leaf">')
    leaf = {"kind": "urdf", "urdf": str(broken)}
    yield bad(
        "workcell, broken XML", ("workcell: ", str(broken), "no XML"), *shapes, "leaf", to=leaf
    )
    raised = [0, 0, 0.3]
    yield bad("all touches", ("constraints: ", "free"), *table, "centre_m", to=raised)
    far = [9.0, 0.0, 0.2]
    slide = ("constraints", "slide", "reference", "position_m")
    yield bad("far away", ("constraints: slide", "9.0"), *slide, to=far)
    own = {"kind": "functions", "description": "own", "factory": "nowhere:f"}
    yield bad("factory", ("constraints: own", "nowhere:f"), "constraints", "own", to=own)
    yield bad("kind", ("BiRRT", "omple"), *planners, "BiRRT", to={"kind": "omple"})
    nothing = {"kind": "planner", "without": ["wings"]}
    yield bad("part", ("planner", "without"), *planners, "planner", to=nothing)
    grid = {"kind": "latent_grid", "manifold": "paprika"}
    yield bad("manifold", ("paprika", "latent grid"), *planners, "latent grid", to=grid)
    steps = {"kind": "birrt", "range_rad": math.nan}
    yield bad("setting", ("BiRRT", "range_rad"), "problems", "planners", "BiRRT", to=steps)
    yield bad("task", ("demonstrations.tasks", "tea"), "demonstrations", "tasks", to=["tea"])
    yield bad("chart", ("policies.chart", "paprika"), "policies", "chart", to="paprika")
    yield bad("batch", ("policies.ppo.batch_size",), "policies", "ppo", "batch_size", to=5000)
    yield bad("drawn", ("benchmark.drawn",), "benchmark", "drawn", to=["BiRTT"])
    yield bad("carrying", ("studies.constraint",), "studies", "constraint", to="free")
    paper = ("manifolds", "paper", "latent_dim")
    yield bad("dimensions", ("manifolds.paper.latent_dim=7",), *paper, to=7)
