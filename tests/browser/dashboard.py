"""Ways through MLflow's dashboard that its tests and the documentation's pictures share."""

import json
import re
import sys
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.tracking.comparison import REPORT, cells_of, of_seeds
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage
from constraint_geodesics.tracking.views import View, page_of
from tests.browser.chromium import ROOT, free_port, served
from tests.end_to_end import smoke

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

EXPERIMENT, LEARNED = "constraint_geodesics", "learned_geodesic"
FLAT = {"orderByKey": "tags.`child`", "orderByAsc": "true"}
"""Sorted by anything but their time, children stand in the table by themselves, not hidden below
their parents.
"""
SIDE_PANEL_CLOSED = (
    "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true');"
    "localStorage.setItem('mlflow.assistant.panelOpen_v1', 'false');"
)
"""A chat panel covers a quarter of the window on the first visit, until it is closed."""


@contextmanager
def dashboard_of(folder: Path) -> Iterator[str]:
    """What `geodesics ui` prints there: the address of a page, which answers."""
    command = [sys.executable, "-m", "constraint_geodesics.cli", "ui", "--no-open"]
    command += ["--port", str(free_port())]
    with served(command, folder, smoke.environment(ROOT)) as page:
        yield page


def base_of(page: str) -> str:
    """The dashboard that a page is of."""
    return page.partition("/#")[0]


def log_committed_rows(params: Params, folder: Path) -> None:
    """Runs of the learned search and of the report's table, in the store of a folder, from the rows
    that are committed.
    """
    name, reports = params.tracking.experiment, ROOT / "reports"
    for constraint in params.constraints:
        file = reports / "train_geodesics" / f"planner-{constraint}"
        rows: Any = pd.read_csv(file.with_suffix(".csv")).to_dict("records")
        about = subject_of(params, constraint=constraint, manifold="planner")
        work = Work("train_geodesics", file.name, {}, [], about)
        with tracked_stage(work, name, folder) as run:
            seeds = sorted({row["seed"] for row in rows if row["planner"] == LEARNED})
            for seed in seeds:
                with run.child(f"seed {seed}", {"seed": seed, "planner": LEARNED}):
                    pass
            run.compared(of_seeds(rows, LEARNED, seeds))
            run.mirror(json.loads(file.with_suffix(".json").read_text()))
    table = pd.read_csv(reports / "table.csv").query("manifold == 'planner'")
    cells: Any = table.to_dict("records")
    with tracked_stage(Work("report", "report"), name, folder) as run:
        run.cells(cells_of(cells, ("constraint", "planner"), REPORT))


def asked(dashboard: str, call: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """An answer of the server's interface for programs."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(
        f"{dashboard}/api/2.0/mlflow/{call}", data, {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return dict(json.load(answer))


def experiment_id(dashboard: str) -> str:
    """The project's experiment."""
    found = asked(dashboard, f"experiments/get-by-name?experiment_name={EXPERIMENT}")
    return str(found["experiment"]["experiment_id"])


def runs_found(dashboard: str, search: str) -> list[dict[str, Any]]:
    """The runs that a search finds, newest first."""
    body = {"experiment_ids": [experiment_id(dashboard)], "filter": search, "max_results": 1000}
    return list(asked(dashboard, "runs/search", body).get("runs", []))


def runs_address(dashboard: str, search: str, **more: str) -> str:
    """The page of the runs that a search finds; more: the page's other settings, as it puts them
    into its address.
    """
    query = "&".join(
        f"{name}={quote(value)}" for name, value in {"searchFilter": search, **more}.items()
    )
    return f"{dashboard}/#/experiments/{experiment_id(dashboard)}/runs?{query}"


def view_address(dashboard: str, view: View, mode: str = "TABLE") -> str:
    """The page of a view, as a table or as charts."""
    return f"{page_of(dashboard, experiment_id(dashboard), view)}&compareRunsMode={mode}"


def row(page: "Page", name: str) -> "Locator":
    """The table's row of the first run whose name begins so."""
    link = page.get_by_role("link", name=re.compile(f"^{re.escape(name)}"))
    return page.locator("[role=row]").filter(has=link).first


def line_colours(page: "Page") -> set[str]:
    """Colours of the lines in all charts, without the black edges of what is no line.

    A line that stays in a single place is no curve.
    """
    drawn = page.locator("path.js-line").evaluate_all(
        "paths => paths.map(path => [path.getAttribute('d') || '', path.style.stroke])"
    )
    curves = {
        colour for outline, colour in drawn if len(set(re.findall(r"[-\d.]+,[-\d.]+", outline))) > 1
    }
    return curves - {"rgb(0, 0, 0)"}
