"""What MLflow's dashboard shows at once: views of the runs, kept as tags of their experiment.

The menu "Views" above the runs lists them; an address names one.  A view is a search, an order,
columns, and charts; MLflow's own way to keep one is a tag with what the page shows as JSON.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

COMPARED = ("success", "median_ratio", "median_ms")
"""What runs of different stages are compared by: share of queries solved, length over the shortest
that is known, planning time."""
TAG = "mlflow.sharedViewState."
"""Before a view's key, in the name of its tag."""
NOTE, MADE = "mlflow.note.content", "geodesics.views"
"""The tags of the description, and of a digest of the views: they are written again when it
differs, and what somebody changed in the dashboard stays until then."""
FIRST_MS = 1_700_000_000_000
"""When the last view in the menu was made, as the menu understands it: the youngest is on top."""
NAME_PX, CREATED_PX, TEXT_PX, FIGURE_PX, LETTER_PX = 285, 100, 150, 96, 8
"""Widths of columns.  The first holds the longest name of a run; all of COMPARED is seen in a
window of 1400.  A figure's column is as wide as its own name."""


@dataclass(frozen=True)
class View:
    """Which runs, in which order, with which columns; charts: kind and metric of each.

    tags, metrics: the columns' names.  order: the tag or metric that the runs are sorted by, lowest
    first unless told: in the order of time MLflow would hide children below their parents.
    """

    key: str
    name: str
    tells: str
    search: str
    order: str
    tags: Sequence[str] = ()
    metrics: Sequence[str] = ()
    charts: Sequence[tuple[str, str]] = ()
    highest_first: bool = False

    @property
    def columns(self) -> list[str]:
        """As the page names them."""
        named = [f"tags.`{name}`" for name in self.tags]
        return named + [f"metrics.`{name}`" for name in self.metrics]

    @property
    def tag(self) -> str:
        """Of the experiment."""
        return TAG + self.key

    def state(self) -> dict[str, Any]:
        """What the page is to show."""
        widths = {"attributes.`Run Name`": NAME_PX, "runDateAndNestInfo": CREATED_PX}
        widths |= {f"tags.`{name}`": TEXT_PX for name in self.tags}
        widths |= {
            f"metrics.`{name}`": max(FIGURE_PX, LETTER_PX * (len(name) + 2))
            for name in self.metrics
        }
        shown = {
            "searchFilter": self.search,
            "orderByKey": self.order,
            "orderByAsc": not self.highest_first,
            "selectedColumns": self.columns,
            "columnOrder": [*widths, "duration"],
            "columnWidths": {**widths, "duration": FIGURE_PX},
        }
        return shown | (_charts(self.charts) if self.charts else {})


VIEWS = (
    View(
        "results",
        "Results",
        "every answered set of queries: constraint, planner, seed, success, length, time",
        "metrics.`success` >= 0 and tags.child LIKE '%'",
        "metrics.`success`",
        ("constraint", "scene", "planner", "seed"),
        COMPARED,
        highest_first=True,
    ),
    View(
        "constraints",
        "Constraints",
        "which constraint is hard for the learned search, with and without a policy",
        "tags.stage = 'train_geodesics' and tags.child IS NULL",
        "tags.`constraint`",
        ("constraint", "manifold"),
        ("success", "success_at_random_mean", *COMPARED[1:], "queries_connected"),
        [("BAR", "success"), ("BAR", "success_at_random_mean"), ("BAR", "median_ms")],
    ),
    View(
        "seeds",
        "Seeds",
        "how much chance decides: learning curves and figures of every seed",
        "tags.child LIKE 'seed %'",
        "tags.`item`",
        ("stage", "item", "seed"),
        (*COMPARED, "final/final_saving", "final/mean_ratio"),
        [("LINE", "saving"), ("LINE", "return"), ("BAR", "success"), ("BAR", "median_ratio")],
    ),
    View(
        "rewards",
        "Rewards",
        "settings of the reward, one beside the other: means over their seeds",
        "tags.reward LIKE '%' and tags.child IS NULL",
        "tags.`item`",
        ("stage", "item", "reward", "dvc_experiment"),
        (*COMPARED, "final_saving_mean"),
        [("LINE", "seeds/saving_mean"), ("BAR", "final_saving_mean"), ("BAR", "success")],
    ),
    View(
        "demonstrations",
        "Demonstrations",
        "constraints from demonstrations: how far paths leave the hidden formula, and what solves",
        "tags.task LIKE '%'",
        "tags.`task`",
        ("task", "method", "demonstrations", "noise_deg"),
        ("solved", "deg", "mm", "ratio_median", "ms_median"),
        [("BAR", "solved"), ("BAR", "deg"), ("BAR", "mm")],
    ),
    View(
        "planners",
        "Planners",
        "planners on the same queries, of the pipeline, of the benchmark and of its studies",
        "tags.planner LIKE '%'",
        "tags.`planner`",
        ("stage", "planner", "constraint", "scene"),
        COMPARED,
        [("BAR", name) for name in COMPARED],
    ),
)
"""In the order of the menu; `geodesics ui` opens the first whose search finds a run."""


def experiment_tags() -> dict[str, str]:
    """The experiment's description and views; last the tag that says that they are all there."""
    tags = {NOTE: _note()}
    for place, view in enumerate(reversed(VIEWS)):
        made = FIRST_MS + place
        about = {"name": view.name, "createdAt": made, "updatedAt": made}
        tags[view.tag] = json.dumps({**about, "state": json.dumps(view.state())})
    return tags | {MADE: hashlib.sha256(json.dumps(tags).encode()).hexdigest()[:16]}


def outdated(tags: Mapping[str, str]) -> dict[str, str]:
    """What an experiment with these tags is to get."""
    wanted = experiment_tags()
    return {} if tags.get(MADE) == wanted[MADE] else wanted


def page_of(address: str, experiment_id: str, view: View | None = VIEWS[0]) -> str:
    """The address of a view, or of all runs, below the dashboard's.  Without the kind of work the
    page would be of language models.
    """
    shown = f"viewStateShareKey={view.key}&" if view else ""
    return f"{address}/#/experiments/{experiment_id}/runs?{shown}workflowType=machine_learning"


def _note() -> str:
    lines = [f"- **{view.name}**: {view.tells}" for view in VIEWS]
    return "\n".join(
        [
            "Click **Views** at the top right (it has the name of the view that is open) for a view"
            " of each question:",
            "",
            *lines,
            "",
            "The chart icon beside the search draws what the table has; tick two runs and press"
            " **Compare** for these alone. What the names mean: `docs/mlflow.md`.",
        ]
    )


def _charts(charts: Sequence[tuple[str, str]]) -> dict[str, Any]:
    section = {"uuid": "chosen", "name": "Charts", "display": True}
    return {
        "compareRunCharts": [_chart(place, *chart) for place, chart in enumerate(charts)],
        "compareRunSections": [
            {**section, "isReordered": False, "deleted": False, "isGenerated": False}
        ],
        "isAccordionReordered": True,
        "runsHiddenMode": "FIRST_20_RUNS",
    }


def _chart(place: int, kind: str, metric: str) -> dict[str, Any]:
    chart = {
        "uuid": f"chart{place}",
        "type": kind,
        "metricKey": metric,
        "displayName": metric,
        "metricSectionId": "chosen",
        "runsCountToCompare": 20,
        "deleted": False,
        "isGenerated": False,
    }
    line = {
        "lineSmoothness": 0,
        "xAxisScaleType": "linear",
        "scaleType": "linear",
        "range": {},
        "xAxisKey": "step",
        "selectedXAxisMetricKey": "",
        "yAxisKey": "metric",
        "yAxisExpressions": [],
        "ignoreOutliers": False,
        "useGlobalXaxisKey": True,
        "useGlobalLineSmoothing": True,
        "selectedMetricKeys": [metric],
    }
    return chart | (line if kind == "LINE" else {})
