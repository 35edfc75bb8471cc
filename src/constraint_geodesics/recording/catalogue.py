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

from constraint_geodesics.errors import WrongUsageError
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.recording.folders import FOLDERS

HEADINGS = (
    *("#", "constraint", "scene", "manifold", "planner", "query", "seed"),
    *("length [rad]", "valid", "file"),
)


SEARCHING = ("train_geodesics", "benchmark_planners", "execute_paths")
"""Stages whose tables name recordings, besides the benchmark."""


class CatalogueError(WrongUsageError):
    """No recording is as asked for; the message says what there is instead."""


@dataclass(frozen=True)
class Listed:
    """One recording; what is not known of it is "" or None."""

    number: int
    """Its place in the whole list, from 1."""
    constraint: str
    scene: str
    """What stands round the robot in the benchmark; its queries differ from those without."""
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
class Filter:
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

    @property
    def values(self) -> dict[str, tuple[str, ...]]:
        """Of what a recording must have one, by its field."""
        names = {key: getattr(self, key) for key in ("constraint", "scene", "manifold")}
        return {
            **{key: () if name is None else (plain(name),) for key, name in names.items()},
            "query": () if self.query is None else (str(self.query),),
            "planner": tuple(plain(name) for name in self.planners),
            "seed": tuple(str(seed) for seed in self.seeds),
        }


Read = Callable[[Path], Listed]


def catalogue(root: Path, read: Read) -> list[Listed]:
    """All recordings of a checkout: as the tables name them, then what no table names, numbered
    from 1.

    read: what a file says of itself (`read_entry`), asked of those that no table names.
    """
    named = [entry for entry in _rows(Layout(root)) if (root / entry.file).is_file()]
    known = {entry.file for entry in named}
    found = sorted(file for folder in FOLDERS for file in (root / folder).rglob("*.rrd"))
    others = [file for file in found if file.relative_to(root).as_posix() not in known]
    own = [replace(read(file), file=file.relative_to(root).as_posix()) for file in others]
    return [replace(entry, number=k) for k, entry in enumerate(named + own, 1)]


def unread(file: Path, why: str = "(not read)") -> Listed:
    """A recording of which nothing is known."""
    return Listed(0, "", "", why, None, None, None, None, file.as_posix())


def read_entry(file: Path) -> Listed:
    """What a recording says of itself; one that is not of one path says so as its planner, and so
    does one that can't be read for want of Rerun.
    """
    import numpy as np

    try:
        from constraint_geodesics.recording.recording import RecordingError, read_recording
    except ImportError:
        return unread(file)
    try:
        summary = read_recording(file)
    except RecordingError:
        return unread(file, "(not one path)")
    about, steps = summary.about, np.diff(summary.joints, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    own = (about.constraint, about.scene, about.planner, about.query, about.seed)
    return Listed(0, *own, length, None, file.as_posix())


def _rows(layout: Layout) -> Iterator[Listed]:
    """Learned paths that keep a cup level first, then by stage.  All stages but the benchmark share
    the pipeline's queries, which stand in one scene.
    """
    stages = (layout.root / "reports" / stage for stage in SEARCHING)
    learned, sampled, executed = (sorted(folder.glob("*.csv")) for folder in stages)
    learned.sort(key=_first_to_see)
    for file in (*learned, *sampled, layout.benchmark_table, *executed):
        rows = [_listed(row, file.stem) for row in _named(file)]
        if file != layout.benchmark_table:
            rows = [replace(row, scene="") for row in rows]
        yield from sorted(
            rows, key=lambda row: (*row.problem, not row.planner.startswith("learned"))
        )


def _first_to_see(table: Path) -> tuple[bool, bool, str]:
    """The manifold that people use comes before the paper's plane, which keeps no constraint."""
    return table.name != "planner-level_cup.csv", not table.name.startswith("planner-"), table.name


def _named(file: Path) -> Iterator[Mapping[str, str]]:
    """The rows of a table that name a recording; lines that begin with # are comments."""
    if not file.is_file():
        return
    with file.open(newline="") as content:
        lines: Iterable[str] = (line for line in content if not line.startswith("#"))
        yield from (row for row in csv.DictReader(lines) if row.get("recording"))


def _listed(row: Mapping[str, str], table: str) -> Listed:
    seed, length, valid = row.get("seed"), float(row.get("length_rad") or "nan"), row.get("valid")
    return Listed(
        number=0,
        constraint=row.get("constraint") or table,
        scene=row.get("scene", ""),
        planner=row.get("planner") or row.get("kind", ""),
        query=int(row["query"]),
        seed=int(seed) if seed else None,
        length_rad=length if math.isfinite(length) else None,
        valid=valid == "True" if valid else None,
        file=in_checkout(row["recording"]),
        manifold=row.get("manifold", ""),
    )


def narrowed(entries: Sequence[Listed], wanted: Filter) -> list[Listed]:
    """Those that are as asked for.  Raises CatalogueError if none is, with what there is."""
    left = list(entries)
    for what, values in wanted.values.items():
        own = [_text(getattr(entry, what)) for entry in left]
        if missing := sorted(set(values) - set(own)):
            instead = ", ".join(sorted(set(own) - {""})) or "none"
            none = f"no recording of {what} {missing[0]} is as asked for"
            raise CatalogueError(f"{none}: there is {instead}")
        if values:
            left = [entry for entry, value in zip(left, own, strict=True) if value in values]
    return left


def _text(value: str | int | None) -> str:
    return plain(value) if isinstance(value, str) else "" if value is None else str(value)


def one_of_each(entries: Sequence[Listed], wanted: Filter) -> list[Listed]:
    """What is opened at once: the first recording of each planner that is asked for, or each of the
    seeds asked for.

    They are taken from the one problem that most of the planners have a path of, the first such in
    the list; a path that the judge accepts comes before one that it does not.
    Raises CatalogueError if a planner has none there.
    """
    order = [plain(name) for name in wanted.planners]
    problems: dict[tuple[str, str, int], list[Listed]] = {}
    for entry in entries:
        problems.setdefault(entry.problem, []).append(entry)
    most = max(problems.values(), key=lambda own: len({plain(entry.planner) for entry in own}))
    if missing := sorted(set(order) - {plain(entry.planner) for entry in most}):
        where = f" in scene {most[0].scene}" if most[0].scene else ""
        raise CatalogueError(
            f"{missing[0]} has no path of the query that the others have{where}: queries are "
            f"others in each scene; choose with --scene, or open files"
        )
    firsts: dict[tuple[str, int | None], Listed] = {}
    for entry in sorted(most, key=lambda entry: entry.valid is False):
        firsts.setdefault((plain(entry.planner), entry.seed if wanted.seeds else None), entry)
    return sorted(firsts.values(), key=lambda entry: order.index(plain(entry.planner)))


def by_words(entries: Sequence[Listed], words: Sequence[str]) -> list[Listed]:
    """The recordings of some numbers.  Raises CatalogueError for what is no number of the list."""
    numbered = {str(entry.number): entry for entry in entries}
    for word in words:
        if word not in numbered:
            raise CatalogueError(f"{word}: no number of the list, which `geodesics replay` prints")
    return [numbered[word] for word in words]


def plain(name: str) -> str:
    """A name as a file's name has it: "BiRRT + band" is birrt_band, and RRT* is rrt_star."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower().replace("rrt*", "rrt_star")).strip("_")


def as_table(entries: Sequence[Listed]) -> str:
    """The list as text, one recording a line, its file last."""
    rows = [HEADINGS, *(_cells(entry) for entry in entries)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths[-1] = 0
    padded = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(row) for row in padded)


def _cells(entry: Listed) -> tuple[str, ...]:
    length = "" if entry.length_rad is None else f"{entry.length_rad:.3f}"
    valid = {None: "", True: "yes", False: "no"}[entry.valid]
    numbers = ("" if value is None else str(value) for value in (entry.query, entry.seed))
    about = (str(entry.number), entry.constraint, entry.scene, entry.manifold, entry.planner)
    return (*about, *numbers, length, valid, entry.file)


def as_records(entries: Sequence[Listed]) -> list[dict[str, object]]:
    """The list for JSON."""
    return [asdict(entry) for entry in entries]
