"""The documentation's pictures of MLflow and Rerun, made from this checkout's runs and recordings:
`make screenshots`.

    python -m tests.browser.screenshots [NAME ...]

A picture stands behind its marker `<!-- screenshot: NAME -->` in docs/*.md; making it again changes
nothing else.
MLflow shows a copy of the runs: of those that repeat one setting the newest alone is kept there, as
after a first `make repro`, and two that are compared have colours that can be told apart.
"""

import contextlib
import io
import json
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from PIL import Image

from constraint_geodesics.palette import BLUE, VERMILION, planner_colour
from tests.browser import hero
from tests.browser.chromium import ROOT, chromium, free_port, served, until, visit
from tests.browser.dashboard import (
    FLAT,
    SIDE_PANEL_CLOSED,
    asked,
    experiment_id,
    line_colours,
    row,
    runs_address,
    runs_found,
)
from tests.browser.pixels import having, picture, scene_of
from tests.end_to_end import smoke

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

DOCS = ROOT / "docs"
IMAGES = DOCS / "images"
MARKER = re.compile(r"<!-- screenshot: (\w+) -->")
WIDTH, LARGEST_BYTES = 1400, 150_000
LAPTOP = {"width": 1280, "height": 800}
"""The window that Rerun is shown in."""
COLOURS = (256, 128, 64, 32)
"""Of the palette: the most that stay below the size."""
CURVE_PIXELS = 60
SETTLE_S = 4.0
"""Until the arm has left the start."""
RECORDINGS = ROOT / "data" / "recordings"
SEEDS_CURVE = "seeds/saving_mean"
CUP = "tags.stage = 'train_geodesics' and tags.item = 'planner-level_cup'"

Run = Mapping[str, Any]


class MissingRunError(RuntimeError):
    """What a picture shows is not in the store or among the recordings; the message says which
    command makes it.
    """


@dataclass(frozen=True)
class Shot:
    """One picture: what it shows, in words for those who can't see it, and how it is taken as
    PNG.
    """

    alt: str
    take: "Callable[[Browser, str], bytes]"
    """Of a browser and the dashboard's address."""


# MLflow


@dataclass(frozen=True)
class View:
    """How the dashboard shows runs."""

    search: str
    columns: Sequence[str] = ()
    charts: Sequence[tuple[str, str]] = ()
    """Kind and metric of each."""
    shown: Sequence[str] | None = None
    """Ids of the runs in the charts."""
    grouped_by: str | None = None
    """A parameter: the charts have a line and a bar for each of its values."""
    sort: Mapping[str, str] = field(default_factory=lambda: FLAT)
    height: int = 640


def remembered(view: View) -> dict[str, Any]:
    """What the dashboard keeps in the browser when somebody has chosen columns and charts by
    hand.
    """
    widths = {
        "attributes.`Run Name`": 260,
        "runDateAndNestInfo": 115,
        **dict.fromkeys(view.columns, 168),
    }
    return {
        "selectedColumns": list(view.columns),
        "columnOrder": list(widths),
        "columnWidths": widths,
        "runsHiddenMode": "FIRST_10_RUNS" if view.shown is None else "CUSTOM",
        "runsVisibilityMap": {},
        "compareRunCharts": [
            _chart(k, kind, metric) for k, (kind, metric) in enumerate(view.charts)
        ]
        or None,
        "compareRunSections": [
            {
                "uuid": "chosen",
                "name": "Charts",
                "display": True,
                "isReordered": False,
                "deleted": False,
                "isGenerated": False,
            }
        ],
        "isAccordionReordered": True,
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
        "groupBy": None
        if view.grouped_by is None
        else {
            "aggregateFunction": "average",
            "groupByKeys": [{"mode": "param", "groupByData": view.grouped_by}],
        },
        "autoRefreshEnabled": False,
        "globalLineChartConfig": {
            "xAxisKey": "step",
            "lineSmoothness": 0,
            "selectedXAxisMetricKey": "",
        },
    }


def _chart(number: int, kind: str, metric: str) -> dict[str, Any]:
    chart = {
        "uuid": f"chart{number}",
        "type": kind,
        "metricKey": metric,
        "displayName": metric,
        "metricSectionId": "chosen",
        "runsCountToCompare": 10,
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


@contextlib.contextmanager
def dashboard_page(browser: "Browser", dashboard: str, view: View) -> "Iterator[Page]":
    """The page of a view."""
    number = experiment_id(dashboard)
    key = f'MLflowLocalStorage-1.1-ExperimentPage-["{number}"]-ReactComponentState'
    state = remembered(view)
    if view.shown is not None:
        found = [run["info"]["run_id"] for run in runs_found(dashboard, view.search)]
        state["runsVisibilityMap"] = {name: name in view.shown for name in found}
    with visit(browser, viewport={"width": WIDTH, "height": view.height}) as (page, _):
        page.add_init_script(SIDE_PANEL_CLOSED)
        page.add_init_script(
            f"localStorage.getItem({json.dumps(key)}) || "
            f"localStorage.setItem({json.dumps(key)}, {json.dumps(json.dumps(state))})"
        )
        mode = "CHART" if view.charts else "TABLE"
        page.goto(runs_address(dashboard, view.search, compareRunsMode=mode, **view.sort))
        page.get_by_role("button", name="Toggle sidebar").click()
        page.add_style_tag(content="[data-assistant-ui] { display: none !important; }")
        yield page


def settled(page: "Page") -> bytes:
    """The page when it has stopped changing."""
    page.mouse.move((page.viewport_size or LAPTOP)["width"] - 2, 2)
    before = b""
    for _ in range(20):
        time.sleep(0.7)
        now = page.screenshot()
        if now == before:
            break
        before = now
    return before


def two_seeds(browser: "Browser", dashboard: str) -> bytes:
    search = f"{CUP} and tags.child LIKE 'seed %'"
    first, second = (of_child(runs_found(dashboard, search), f"seed {seed}") for seed in (0, 1))
    paint(dashboard, first, second)
    charts = [("LINE", "saving"), ("BAR", "final/success"), ("BAR", "final/length_median_rad")]
    view = View(search, charts=charts, shown=[first["info"]["run_id"], second["info"]["run_id"]])
    with dashboard_page(browser, dashboard, view) as page:
        until(lambda: len(line_colours(page)) == 2, "the learning curves of two seeds")
        for run in (first, second):
            row(page, run["info"]["run_name"]).locator("input[type=checkbox]").first.click()
        return settled(page)


def constraints(browser: "Browser", dashboard: str) -> bytes:
    search = "tags.stage = 'train_geodesics' and tags.manifold = 'planner' and tags.child IS NULL"
    figures = ("success_mean", "success_at_random_mean", "queries_connected", "seeds/success_std")
    columns = ["tags.`constraint`", *(f"metrics.`{name}`" for name in figures)]
    sort = {"orderByKey": columns[1], "orderByAsc": "false"}
    with dashboard_page(browser, dashboard, View(search, columns, sort=sort, height=510)) as page:
        row(page, "train_geodesics planner-").wait_for()
        return settled(page)


def two_rewards(browser: "Browser", dashboard: str) -> bytes:
    search = f"{CUP} and tags.child IS NULL"
    has_curve = {
        form_of(run) for run in runs_found(dashboard, search) if SEEDS_CURVE in figures_of(run)
    }
    for form in ("corrected", "printed"):
        if form not in has_curve:
            raise MissingRunError(
                f"no run of train_geodesics planner-level_cup with "
                f"policies.reward.form={form} and {SEEDS_CURVE}: "
                + (
                    "dvc repro"
                    if form == own_form()
                    else f"dvc exp run -S policies.reward.form={form}"
                )
                + " "
                "--force --single-item train_geodesics@planner-level_cup"
            )
    charts = [("LINE", SEEDS_CURVE), ("BAR", "success_mean"), ("BAR", "final_saving_mean")]
    view = View(search, charts=charts, grouped_by="reward.form", height=700)
    with dashboard_page(browser, dashboard, view) as page:
        until(lambda: len(line_colours(page)) == 2, "the learning curves of two rewards")
        return settled(page)


def of_child(found: Sequence[Run], child: str) -> Run:
    for run in found:
        if tags_of(run).get("child") == child:
            return run
    raise MissingRunError(f"no run of train_geodesics planner-level_cup, {child}: make repro")


def tags_of(run: Run) -> dict[str, str]:
    return {entry["key"]: entry["value"] for entry in run["data"].get("tags", [])}


def figures_of(run: Run) -> set[str]:
    return {entry["key"] for entry in run["data"].get("metrics", [])}


def form_of(run: Run) -> str | None:
    """The reward's form."""
    params = {entry["key"]: entry["value"] for entry in run["data"].get("params", [])}
    return params.get("reward.form")


def paint(dashboard: str, first: Run, second: Run) -> None:
    """Two colours that can be told apart: MLflow's own are drawn by chance."""
    for run, colour in ((first, BLUE), (second, VERMILION)):
        body = {"run_id": run["info"]["run_id"], "key": "mlflow.runColor", "value": colour}
        asked(dashboard, "runs/set-tag", body)


def own_form() -> str:
    """The form of the reward that this checkout's params.yaml asks for."""
    return str(yaml.safe_load((ROOT / "params.yaml").read_text())["policies"]["reward"]["form"])


def keep_newest(dashboard: str, form: str | None = None) -> None:
    """Remove from the copy what repeats another run, those of the pipeline before those of an
    experiment and newer before older ones, and (form given) experiments and what has another form
    of the reward.
    """
    found = runs_found(dashboard, "tags.stage = 'train_geodesics'")
    forms = {run["info"]["run_id"]: form_of(run) for run in found}
    seen = set()
    for run in sorted(found, key=lambda run: "dvc_experiment" in tags_of(run)):
        tags, name = tags_of(run), run["info"]["run_id"]
        own = forms[name] or forms.get(
            tags.get("mlflow.parentRunId", "")
        )  # children of old runs do not say it
        key = (tags["item"], tags.get("child"), own)
        if key in seen or (form is not None and (form != own or "dvc_experiment" in tags)):
            asked(dashboard, "runs/delete", {"run_id": name})
        seen.add(key)


@contextlib.contextmanager
def copied_dashboard() -> Iterator[str]:
    """The dashboard of a copy of this checkout's runs."""
    if not (ROOT / "mlflow.db").is_file():
        raise MissingRunError("mlflow.db: this checkout has no runs yet: make repro")
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy2(ROOT / "mlflow.db", folder)
        command = [
            sys.executable,
            "-m",
            "constraint_geodesics.cli",
            "ui",
            "--port",
            str(free_port()),
        ]
        with served(command, Path(folder), smoke.environment(ROOT)) as address:
            yield address


# Rerun


def rerun(files: Sequence[str | Path], colours: Sequence[str]) -> Callable[["Browser", str], bytes]:
    """The viewer with some recordings, paused on the way; files: their paths, or words that choose
    them.
    """

    def take(browser: "Browser", dashboard: str) -> bytes:
        for file in files:
            if isinstance(file, Path) and not file.is_file():
                raise MissingRunError(f"{file.relative_to(ROOT)}: no such recording: make repro")
        command = [
            sys.executable,
            "-m",
            "constraint_geodesics.cli",
            "replay",
            "--web",
            *map(str, files),
        ]
        with (
            served(command, ROOT, smoke.environment(ROOT)) as address,
            visit(browser, viewport=LAPTOP) as (page, _),
        ):
            page.goto(f"{address}&renderer=webgl")
            until(lambda: all(drawn(page, colour) for colour in colours), "the curves are drawn")
            time.sleep(SETTLE_S)
            page.keyboard.press("Space")
            return settled(page)

    return take


def written_here(write: Callable[[Path], None], colour: str) -> Callable[["Browser", str], bytes]:
    """The viewer with a recording that needs no stage's results: it is written here."""

    def take(browser: "Browser", dashboard: str) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / "path.rrd")
            return rerun([Path(folder) / "path.rrd"], [colour])(browser, dashboard)

    return take


def cup_path(file: Path) -> None:
    """README's cup, carried past the pillar."""
    hero.planned(hero.carried_cup())[0].record(file)


def drawn(page: "Page", colour: str) -> bool:
    return int(having(scene_of(picture(page)), colour).sum()) >= CURVE_PIXELS


EXECUTED = RECORDINGS / "execute_paths" / "level_cup" / "query0-planned-path.rrd"
BOTH = re.findall(
    r"^geodesics replay (--constraint .*birrt)$", (ROOT / "docs" / "rerun.md").read_text(), re.M
)[0].split()
"""What docs/rerun.md tells to open."""

SHOTS = {
    "mlflow_two_rewards": Shot(
        "MLflow's charts of two runs of train_geodesics planner-level_cup with different "
        "rewards: the mean saving of "
        "their seeds over the steps, success_mean and final_saving_mean as bars",
        two_rewards,
    ),
    "mlflow_two_seeds": Shot(
        "MLflow's charts of seeds 0 and 1 of train_geodesics planner-level_cup: saving over "
        "the steps as two lines, "
        "final/success and final/length_median_rad as bars",
        two_seeds,
    ),
    "mlflow_constraints": Shot(
        "MLflow's table of train_geodesics on the planner's manifold, a row a constraint, "
        "with success_mean, "
        "success_at_random_mean, queries_connected and seeds/success_std",
        constraints,
    ),
    "rerun_path": Shot(
        "Rerun with a planned path of the level cup past a pillar: the arm with its cup, the level "
        "plane and the tool's way, what the constraint allows, and the joints",
        written_here(cup_path, planner_colour("planner")),
    ),
    "rerun_execution": Shot(
        "Rerun with an executed path: the arm, the cup with its spheres from near by, the "
        "cup's tilt and the joints",
        rerun([EXECUTED], [planner_colour("planner")]),
    ),
    "rerun_two_recordings": Shot(
        "Rerun with a learned geodesic and BiRRT's path of one query over each other, each in "
        "its planner's colour",
        rerun(BOTH, [planner_colour("learned_geodesic"), planner_colour("birrt")]),
    ),
}


# Pictures and pages


def compressed(png: bytes) -> bytes:
    """The picture with as many colours as the size allows.

    Raises ValueError if it does not become small enough.
    """
    whole = Image.open(io.BytesIO(png)).convert("RGB")
    for colours in COLOURS:
        file = io.BytesIO()
        whole.quantize(colours, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
            file, "PNG", optimize=True
        )
        if file.tell() <= LARGEST_BYTES:
            return file.getvalue()
    raise ValueError(
        f"more than {LARGEST_BYTES} bytes with {COLOURS[-1]} colours: take it of a smaller window"
    )


def with_pictures(text: str, alts: Mapping[str, str]) -> str:
    """A page with the line of its picture behind each marker that has one."""
    for name, alt in alts.items():
        line = f"![{alt}](images/{name}.png)"
        marker = f"<!-- screenshot: {name} -->"
        text = re.sub(
            rf"{marker}(\n+!\[[^]]*\]\(images/{name}\.png\))?", f"{marker}\n\n{line}", text
        )
    return text


def main(wanted: Sequence[str]) -> int:
    """Take the pictures of some names, or all.  Exit code 1 if one can't be taken."""
    if unknown := set(wanted) - set(SHOTS):
        print(
            f"error: there is no picture {', '.join(sorted(unknown))}: there are "
            f"{', '.join(SHOTS)}",
            file=sys.stderr,
        )
        return 2
    chosen = {name: shot for name, shot in SHOTS.items() if name in wanted or not wanted}
    IMAGES.mkdir(exist_ok=True)
    code = 0
    with chromium() as browser, contextlib.ExitStack() as open_until_end:
        dashboard = ""
        for name, shot in chosen.items():
            began = time.monotonic()
            try:
                if name.startswith("mlflow"):
                    dashboard = dashboard or open_until_end.enter_context(copied_dashboard())
                    keep_newest(dashboard, None if shot.take is two_rewards else own_form())
                (IMAGES / f"{name}.png").write_bytes(compressed(shot.take(browser, dashboard)))
                print(f"docs/images/{name}.png  {time.monotonic() - began:.0f} s", flush=True)
            except (
                MissingRunError,
                AssertionError,
            ) as error:  # the latter: a page did not show what it should
                print(f"{name}: {error}", file=sys.stderr)
                code = 1
    taken = {name: shot.alt for name, shot in SHOTS.items() if (IMAGES / f"{name}.png").is_file()}
    for page in DOCS.glob("*.md"):
        text = page.read_text()
        if (new := with_pictures(text, taken)) != text:
            page.write_text(new)
    return code


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
