"""Which recordings there are, and what they show: the rows of the stages' tables that name one, and
the files that no table names.  The tables are small and read without pandas, which takes longer to
import than they take to read.
"""

import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from constraint_geodesics.pipeline.layout import RECORDINGS, Layout, in_checkout

FOLDERS = (RECORDINGS, "first_path")
"""Where recordings lie, relative to the checkout."""
HEADINGS = (
    "#",
    "constraint",
    "scene",
    "manifold",
    "planner",
    "query",
    "seed",
    "length [rad]",
    "valid",
    "file",
)


class CatalogueError(ValueError):
    """No recording is as asked for; the message says what there is instead."""


@dataclass(frozen=True)
class Entry:
    """One recording; what is not known of it is "" or None."""

    number: int
    """Its place in the whole list, from 1."""
    constraint: str
    scene: str
    """What stands round the robot, in the benchmark of all planners; its queries are others than
    those without.
    """
    planner: str
    """Or what was executed."""
    query: int | None
    seed: int | None
    length_rad: float | None
    valid: bool | None
    file: str
    """Relative to the checkout."""
    manifold: str = ""
    """The learned one that the path was searched on, if it was."""

    @property
    def problem(self) -> tuple[str, str, int]:
        """Paths with the same one go from the same start to the same goal among the same bodies."""
        return self.constraint, self.scene, -1 if self.query is None else self.query


@dataclass(frozen=True)
class Wanted:
    """What is asked for; an empty one asks for nothing."""

    constraint: str | None = None
    scene: str | None = None
    query: int | None = None
    planners: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    manifold: str | None = None

    @property
    def one_problem(self) -> bool:
        """Whether it says whose paths of which query, so that they can be opened at once."""
        return self.constraint is not None and self.query is not None and bool(self.planners)


Read = Callable[[Path], Entry]


def catalogue(root: Path, read: Read) -> list[Entry]:
    """All recordings of a checkout: as the tables name them, then what no table names, numbered
    from 1.

    read: what a file says of itself (`read_entry`), asked of those that no table names.
    """
    named = [entry for entry in _rows(Layout(root)) if (root / entry.file).is_file()]
    known = {entry.file for entry in named}
    found = sorted(file for folder in FOLDERS for file in (root / folder).rglob("*.rrd"))
    others = [file for file in found if file.relative_to(root).as_posix() not in known]
    entries = named + [
        replace(read(file), file=file.relative_to(root).as_posix()) for file in others
    ]
    return [replace(entry, number=k) for k, entry in enumerate(entries, 1)]


def read_entry(file: Path) -> Entry:
    """What a recording says of itself; a file that is no recording of one path says so instead of a
    planner.
    """
    import numpy as np

    from constraint_geodesics.recording.recording import RecordingError, read_recording

    try:
        summary = read_recording(file)
    except RecordingError:
        return Entry(0, "", "", "(not one path)", None, None, None, None, file.as_posix())
    about, steps = summary.about, np.diff(summary.joints, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    return Entry(
        0,
        about.constraint,
        about.scene,
        about.planner,
        about.query,
        about.seed,
        length,
        None,
        file.as_posix(),
    )


def _rows(layout: Layout) -> Iterator[Entry]:
    """Learned paths that keep a cup level first, then by stage."""
    reports = layout.root / "reports"
    learned = sorted((reports / "train_geodesics").glob("*.csv"), key=_first_to_see)
    for file in (
        *learned,
        *sorted((reports / "benchmark_planners").glob("*.csv")),
        layout.benchmark_table,
        *sorted((reports / "execute_paths").glob("*.csv")),
    ):
        rows = [_entry(row, file.stem) for row in _named(file)]
        yield from sorted(
            rows, key=lambda entry: (*entry.problem, not entry.planner.startswith("learned"))
        )


def _first_to_see(table: Path) -> tuple[bool, bool, str]:
    """Before the paper's latent plane, whose paths do not keep the constraint, comes the manifold
    that people use.
    """
    return table.name != "planner-level_cup.csv", not table.name.startswith("planner-"), table.name


def _named(file: Path) -> Iterator[Mapping[str, str]]:
    """The rows of a table that name a recording; lines that begin with # are comments."""
    if not file.is_file():
        return
    with file.open(newline="") as content:
        lines: Iterable[str] = (line for line in content if not line.startswith("#"))
        yield from (row for row in csv.DictReader(lines) if row.get("recording"))


def _entry(row: Mapping[str, str], table: str) -> Entry:
    seed, length, valid = row.get("seed"), float(row.get("length_rad") or "nan"), row.get("valid")
    return Entry(
        0,
        row.get("constraint") or table,
        row.get("scene", ""),
        row.get("planner") or row.get("kind", ""),
        int(row["query"]),
        int(seed) if seed else None,
        length if math.isfinite(length) else None,
        valid == "True" if valid else None,
        in_checkout(row["recording"]),
        row.get("manifold", ""),
    )


def narrowed(entries: Sequence[Entry], wanted: Wanted) -> list[Entry]:
    """Those that are as asked for.  Raises CatalogueError if none is, with what there is."""
    left = list(entries)
    for what, values, own in (
        (
            "constraint",
            () if wanted.constraint is None else (plain(wanted.constraint),),
            lambda e: plain(e.constraint),
        ),
        ("scene", () if wanted.scene is None else (plain(wanted.scene),), lambda e: plain(e.scene)),
        (
            "manifold",
            () if wanted.manifold is None else (plain(wanted.manifold),),
            lambda e: plain(e.manifold),
        ),
        ("query", () if wanted.query is None else (str(wanted.query),), lambda e: str(e.query)),
        ("planner", tuple(plain(name) for name in wanted.planners), lambda e: plain(e.planner)),
        ("seed", tuple(str(seed) for seed in wanted.seeds), lambda e: str(e.seed)),
    ):
        if not values:
            continue
        there = sorted({own(entry) for entry in left} - {"", "None"})
        if missing := sorted(set(values) - set(there)):
            instead = ", ".join(there) or "none"
            raise CatalogueError(
                f"no recording of {what} {missing[0]} is as asked for: there is {instead}"
            )
        left = [entry for entry in left if own(entry) in values]
    return left


def one_of_each(entries: Sequence[Entry], wanted: Wanted) -> list[Entry]:
    """What is opened at once: the first recording of each planner that is asked for, or each of the
    seeds asked for.

    They are taken from the one problem that most of the planners have a path of, the first such in
    the list; a path that the judge accepts comes before one that it does not.
    Raises CatalogueError if a planner has none there.
    """
    order = [plain(name) for name in wanted.planners]
    problems: dict[tuple[str, str, int], list[Entry]] = {}
    for entry in entries:
        problems.setdefault(entry.problem, []).append(entry)
    most = max(problems.values(), key=lambda own: len({plain(entry.planner) for entry in own}))
    if missing := sorted(set(order) - {plain(entry.planner) for entry in most}):
        where = f" in scene {most[0].scene}" if most[0].scene else ""
        raise CatalogueError(
            f"{missing[0]} has no path of the query that the others have{where}: queries are "
            f"others in each scene; "
            f"choose with --scene, or open files"
        )
    firsts: dict[tuple[str, int | None], Entry] = {}
    for entry in sorted(most, key=lambda entry: entry.valid is False):
        firsts.setdefault((plain(entry.planner), entry.seed if wanted.seeds else None), entry)
    return sorted(firsts.values(), key=lambda entry: order.index(plain(entry.planner)))


def by_words(entries: Sequence[Entry], words: Sequence[str]) -> list[Entry]:
    """The recordings of some numbers, as the list has them.  Raises CatalogueError for what is no
    number of it.
    """
    numbered = {str(entry.number): entry for entry in entries}
    for word in words:
        if word not in numbered:
            raise CatalogueError(f"{word}: no number of the list, which `geodesics replay` prints")
    return [numbered[word] for word in words]


def plain(name: str) -> str:
    """A name as a file's name has it: "BiRRT + band" is birrt_band, and RRT* is rrt_star."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower().replace("rrt*", "rrt_star")).strip("_")


def as_table(entries: Sequence[Entry]) -> str:
    """The list as text, one recording a line, its file last."""
    rows = [HEADINGS, *(_cells(entry) for entry in entries)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEADINGS) - 1)]
    return "\n".join(
        "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[-1]])
        for row in rows
    )


def _cells(entry: Entry) -> tuple[str, ...]:
    length = "" if entry.length_rad is None else f"{entry.length_rad:.3f}"
    valid = {None: "", True: "yes", False: "no"}[entry.valid]
    numbers = ("" if value is None else str(value) for value in (entry.query, entry.seed))
    about = (str(entry.number), entry.constraint, entry.scene, entry.manifold, entry.planner)
    return (*about, *numbers, length, valid, entry.file)


def as_records(entries: Sequence[Entry]) -> list[dict[str, object]]:
    """The list for JSON."""
    return [asdict(entry) for entry in entries]
