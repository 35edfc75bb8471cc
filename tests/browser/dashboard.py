"""Ways through MLflow's dashboard that its tests and the documentation's pictures share."""

import json
import re
import urllib.request
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

EXPERIMENT = "constraint_geodesics"
FLAT = {"orderByKey": "tags.`child`", "orderByAsc": "true"}
"""Sorted by anything but their time, children stand in the table by themselves, not hidden below
their parents.
"""
SIDE_PANEL_CLOSED = (
    "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true');"
    "localStorage.setItem('mlflow.assistant.panelOpen_v1', 'false');"
)
"""A chat panel covers a quarter of the window on the first visit, until it is closed."""


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
