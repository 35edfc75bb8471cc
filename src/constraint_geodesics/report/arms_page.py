"""Arms that are made from their URDFs, and tool poses as goals: tables with their targets, from
reports/arms.json.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import fixed, markdown_table, origin, share
from constraint_geodesics.report.page import Table
from constraint_geodesics.report.results import read_metrics

Figures = Mapping[str, Any]


class Column(NamedTuple):
    """A column: its header, its cell from a row's figures, and the target of all rows together, if
    it has one.
    """

    header: str
    cell: Callable[[Figures], str]
    target: str = ""


def _count(key: str) -> Callable[[Figures], str]:
    return lambda row: str(row[key])


def _per_cent(key: str) -> Callable[[Figures], str]:
    return lambda row: share(row.get(key), 1)


def _number(key: str, digits: int) -> Callable[[Figures], str]:
    return lambda row: fixed(row.get(key), digits)


QUERIES = Column("queries", _count("queries"))
SOLVED = Column("solved", _count("solved"))
NOT_CONNECTED = Column("not connected", _count("not_connected"))


def _ratios(median: str, p95: str) -> tuple[Column, Column]:
    return (
        Column("length / best known, median", _number("ratio_median", 4), median),
        Column("p95", _number("ratio_p95", 4), p95),
    )


def _times(median: str = "", p95: str = "") -> tuple[Column, Column, Column]:
    return (
        Column("time [ms], median", _number("time_ms_median", 1), median),
        Column("p95", _number("time_ms_p95", 1), p95),
        Column("p95, failures too", _number("time_all_ms_p95", 1)),
    )


class _Described(NamedTuple):
    """A table: its title, how to read it, and its columns after the row's name."""

    title: str
    note: str
    columns: Sequence[Column]


TABLES = {
    "first_path": _Described(
        "From a URDF to its first certified path",
        "in a new process, the kernels compiled, imports apart, a random start and goal; then once "
        "more in another process, with the files that the first has kept",
        (
            Column("first time [s]", _number("first_s", 2), "≤ 5 each"),
            Column("again [s]", _number("again_s", 2)),
        ),
    ),
    "configurations": _Described(
        "Between configurations",
        "each arm alone, with nothing around it; random ends on the constraint, nothing held or "
        "the tool's tilt held, at five random poses; best known: the shortest of the first path, "
        "of what the planner finds in 1 s, and of BiRRT's, with and without a band after it; BiRRT "
        "has 10 s, and asks compiled code through Python, which its times hold; the roadmap is "
        "made before; UR5 with its SRDF, the others with the pairs that sampling finds",
        (
            QUERIES,
            Column("BiRRT solves", _count("birrt_solved")),
            Column("of these the planner", _per_cent("success_of_birrt"), "≥ 98 %"),
            Column("the planner solves", _count("solved")),
            Column("by a straight line", _per_cent("straight")),
            NOT_CONNECTED,
            *_ratios("", "≤ 1.05"),
            *_times("≤ 5", "≤ 30"),
            Column("BiRRT [ms], median", _number("birrt_time_ms_median", 0)),
            Column("roadmap [s], longest", _number("prepared_s", 1)),
        ),
    ),
    "pose": _Described(
        "To tool poses",
        "the benchmark's queries without a sphere, to the pose of their goal; best known: this "
        "planner's own shortest path to any branch of its inverse kinematics as a goal by itself; "
        "given: to the query's own configuration",
        (
            QUERIES,
            SOLVED,
            NOT_CONNECTED,
            Column("of what any branch solves", _per_cent("success")),
            *_ratios("≤ 1.000", "≤ 1.001"),
            *_times("≤ 1.5", "≤ 8"),
            Column("given: solved", _count("given_solved")),
            Column("length / best known, median", _number("given_ratio_median", 3)),
            Column("p95", _number("given_ratio_p95", 3)),
        ),
    ),
    "free_yaw": _Described(
        "To tool poses with any yaw",
        "best known: this planner's own shortest path to any of 120 yaws, each a pose",
        (
            QUERIES,
            SOLVED,
            Column("of what any yaw solves", _per_cent("success")),
            *_ratios("", "≤ 1.01"),
            *_times("≤ 15", "≤ 40"),
        ),
    ),
    "redundant_pose": _Described(
        "To tool poses of arms with seven joints and more",
        "best known: this planner's own shortest path to any of 512 configurations that are spread "
        "over the pose's family and stay where they are, as a list; BiRRT goes for 10 s each to "
        "the nearest three where neither finds a path",
        (
            QUERIES,
            SOLVED,
            Column("BiRRT of the others", _count("birrt_solved")),
            Column("of what anything solves", _per_cent("success"), "≥ 98 %"),
            *_ratios("", "≤ 1.10"),
            *_times(),
        ),
    ),
    "held_angle": _Described(
        "A single angle held",
        "random ends on the constraint, held at five random poses, whose two halves no path joins "
        "for about half of the queries; BiRRT has 10 s, where the planner finds no path",
        (
            QUERIES,
            SOLVED,
            NOT_CONNECTED,
            Column("BiRRT of the others", _count("birrt_solved")),
            Column("of what either solves", _per_cent("success"), "≥ 97 %"),
            *_times(),
        ),
    ),
}


def arm_tables(layout: Layout) -> list[Table]:
    """One table a measurement, its targets in the last row."""
    found = read_metrics(layout.root / "reports" / "arms.json")
    return [_table(described, found[name]) for name, described in TABLES.items() if name in found]


def _table(described: _Described, figures: Mapping[str, Figures]) -> Table:
    rows = [[name, *(c.cell(own) for c in described.columns)] for name, own in figures.items()]
    rows.append(["target", *(column.target for column in described.columns)])
    header = ["arm, constraint", *(column.header for column in described.columns)]
    return Table(described.title, described.note, header, rows)


def arms_markdown(layout: Layout) -> str:
    """The tables as Markdown."""
    about = read_metrics(layout.root / "reports" / "arms.json").get("machine")
    told = "\n\n".join(
        f"## {own.title}\n\n{own.note[0].upper()}{own.note[1:]}.\n\n"
        f"{markdown_table([own.header, *own.rows])}"
        for own in arm_tables(layout)
    )
    said = f"{origin(about) if about else 'One thread'}, next to another process."
    return f"# Arms and goals\n\n{said}\n\n{told}\n"
