"""Pages that open offline: figures embedded, tables whose rows link to their recordings and runs,
nothing asked of the network.
"""

import base64
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from constraint_geodesics.palette import DAY, FAMILIES, NIGHT, PAPER, by_night, planner_family
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.results import ReportError
from constraint_geodesics.text_files import write_text

DASHBOARD = "http://127.0.0.1:5000"
"""Where `make ui` shows the runs, on this machine alone."""
EXPERIMENT = 1
"""MLflow's number of the pipeline's experiment: the first in a new store, behind MLflow's own 0."""


class Recorded(NamedTuple):
    """A recorded path: its file in the checkout, and what it shows."""

    file: str
    text: str

    @property
    def command(self) -> str:
        """What replays it."""
        return f"geodesics replay {shlex.quote(self.file)}"


class Links(NamedTuple):
    """Where one row of a table leads.  runs: an address in MLflow's dashboard, or empty."""

    runs: str = ""
    recordings: Sequence[Recorded] = ()


class Row(NamedTuple):
    """One row as the page shows it.  colour: of its planner, by the page's name for it, empty where
    it is of none.
    """

    cells: Sequence[str]
    colour: str
    links: Links


@dataclass(frozen=True)
class Table:
    """A table of the report: a title, how to read it, its header, and its rows of texts.

    groups: titles over the columns after the first, each with the number of columns it spans.
    planners: the planner of each row, and links: where each leads; empty for a table that has none.
    """

    title: str
    note: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    groups: Sequence[tuple[str, int]] = ()
    planners: Sequence[str] = ()
    links: Sequence[Links] = ()

    @property
    def shown(self) -> Iterator[Row]:
        """The rows with their colours and links."""
        none = [""] * len(self.rows)
        colours = [family_colour(name) for name in self.planners] or none
        links = self.links or [Links()] * len(self.rows)
        return (Row(*row) for row in zip(self.rows, colours, links, strict=True))

    @property
    def linked(self) -> bool:
        """Whether any row leads somewhere."""
        return any(own.runs or own.recordings for own in self.links)

    @property
    def recorded(self) -> int:
        """How many of its paths are recorded."""
        return sum(len(own.recordings) for own in self.links)


def family_colour(planner: str) -> str:
    """A planner's colour as a style names it, the same by day and by night; empty for one that is
    in no family.
    """
    family = planner_family(planner)
    return f"var(--family-{family})" if family else ""


def runs_link(stage: str, item: str) -> str:
    """Address of a stage's runs in the dashboard: by their tags, as a run's own number is another
    one each time.  Without the kind of work the page would be of language models.

    item: of the stage's matrix.
    """
    query = quote(f"tags.stage = '{stage}' and tags.item = '{item}'", safe="")
    asked = f"searchFilter={query}&workflowType=machine_learning"
    return f"{DASHBOARD}/#/experiments/{EXPERIMENT}/runs?{asked}"


class Picture(NamedTuple):
    """A figure on a page.  file: the PNG, somewhere below the page's folder.  alt: what is said
    where it isn't seen.
    """

    name: str
    title: str
    caption: str
    alt: str
    file: Path


class Section(NamedTuple):
    """A part of a page: anchor, title, text, figures, and tables, some of them folded."""

    name: str
    title: str
    text: str
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    folded: Sequence[Table] = ()


def write_page(layout: Layout, name: str, **content: Any) -> Path:
    """Write reports/<name>.html from its template; returns the file.

    Raises ReportError naming the figure that is missing.
    """
    file = layout.root / "reports" / f"{name}.html"
    environment = Environment(
        loader=PackageLoader("constraint_geodesics.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["png"] = _embedded
    environment.filters["size"] = _size
    environment.filters["link"] = lambda target: target.relative_to(file.parent).as_posix()
    environment.globals.update(
        families=FAMILIES, by_night=by_night, day=DAY, night=NIGHT, paper=PAPER, channels=_channels
    )
    page = environment.get_template(f"{name}.html.j2").render(content)
    write_text(file, page)
    return file


def _channels(colour: str) -> list[str]:
    """Red, green and blue from 0 to 1, as a filter takes them."""
    return [f"{int(colour[k : k + 2], 16) / 255:.4f}" for k in (1, 3, 5)]


def _size(file: Path) -> str:
    """Width and height as attributes, so that nothing moves while the page is opened."""
    with Image.open(file) as image:
        return f"width={image.width} height={image.height}"


def _embedded(file: Path) -> str:
    try:
        return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"
    except FileNotFoundError:
        raise ReportError(f"{file}: missing; `make repro` and `make bench` make it") from None
