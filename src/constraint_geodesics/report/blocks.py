"""A table of the report as texts, and where each of its rows can be looked at: its recordings and
its runs.
"""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from constraint_geodesics.palette import planner_colour, planner_family

DASHBOARD = "http://127.0.0.1:5000"
"""Where `make ui` shows the runs, on this machine alone."""
EXPERIMENT = 1
"""MLflow's number of the pipeline's experiment: the first in a new store, behind MLflow's own 0."""


@dataclass(frozen=True)
class Recorded:
    """A recorded path: its file in the checkout, and what it shows."""

    file: str
    text: str

    @property
    def command(self) -> str:
        """What replays it."""
        return f"geodesics replay {shlex.quote(self.file)}"


@dataclass(frozen=True)
class Look:
    """Where one row of a table can be looked at.  runs: an address in MLflow's dashboard, or
    empty.
    """

    runs: str = ""
    recordings: Sequence[Recorded] = ()


@dataclass(frozen=True)
class Row:
    """One row as the page shows it.  colour: of its planner, empty where it is of none."""

    cells: Sequence[str]
    colour: str
    look: Look


@dataclass(frozen=True)
class Block:
    """A table of the report: a title, how to read it, its header, and its rows of texts.

    groups: titles over the columns after the first, each with the number of columns it spans.
    planners: the planner of each row, and looks: where each can be looked at; empty for a table
    that has none.
    """

    title: str
    note: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    groups: Sequence[tuple[str, int]] = ()
    planners: Sequence[str] = ()
    looks: Sequence[Look] = ()

    @property
    def shown(self) -> Iterator[Row]:
        """The rows with their colours and looks."""
        colours = [_swatch(name) for name in self.planners] or [""] * len(self.rows)
        looks = self.looks or [Look()] * len(self.rows)
        return (Row(*row) for row in zip(self.rows, colours, looks, strict=True))

    @property
    def looked_at(self) -> bool:
        """Whether any row has somewhere to be looked at."""
        return any(look.runs or look.recordings for look in self.looks)

    @property
    def recorded(self) -> int:
        """How many of its paths are recorded."""
        return sum(len(look.recordings) for look in self.looks)


def _swatch(planner: str) -> str:
    return "" if planner_family(planner) is None else planner_colour(planner)


def runs_link(stage: str, item: str) -> str:
    """Address of a stage's runs in the dashboard: by their tags, as a run's own number is another
    one each time.

    item: of the stage's matrix; a % in it stands for anything.
    """
    compared = "LIKE" if "%" in item else "="
    wanted = f"tags.stage = '{stage}' and tags.item {compared} '{item}'"
    return f"{DASHBOARD}/#/experiments/{EXPERIMENT}/runs?searchFilter={quote(wanted, safe='')}"
