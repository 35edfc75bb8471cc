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
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from constraint_geodesics.palette import BLUE, VERMILION, planner_colour
from constraint_geodesics.tracking.views import VIEWS, View
from tests.browser import hero
from tests.browser.chromium import ROOT, chromium, served, until, visit
from tests.browser.dashboard import (
    SIDE_PANEL_CLOSED,
    asked,
    base_of,
    dashboard_of,
    line_colours,
    row,
    runs_found,
    view_address,
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
POLICIES = "tags.stage = 'train_policies'"
VIEW = {view.key: view for view in VIEWS}

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


@contextlib.contextmanager
def shown_view(
    browser: "Browser", dashboard: str, view: View, *, search: str = "", mode: str = "TABLE"
) -> "Iterator[Page]":
    """The page of a view, narrowed by a search of one's own."""
    with visit(browser, viewport={"width": WIDTH, "height": 700}) as (page, _):
        page.add_init_script(SIDE_PANEL_CLOSED)
        page.goto(view_address(dashboard, view, mode))
        page.get_by_role("button", name="Toggle sidebar").click()
        page.add_style_tag(content="[data-assistant-ui] { display: none !important; }")
        if search:
            box = page.get_by_test_id("search-box")
            until(lambda: box.input_value() == view.search, "the view's own search")
            box.fill(search)
            page.keyboard.press("Enter")
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


def results(browser: "Browser", dashboard: str) -> bytes:
    with shown_view(browser, dashboard, VIEW["results"]) as page:
        row(page, "planner-").wait_for()
        return settled(page)


def two_seeds(browser: "Browser", dashboard: str) -> bytes:
    found = runs_found(dashboard, f"{POLICIES} and tags.child LIKE 'seed %'")
    two = [of_child(found, f"seed {seed}") for seed in (0, 1)]
    paint(dashboard, *two)
    ids = ", ".join(repr(run["info"]["run_id"]) for run in two)
    search = f"attributes.run_id IN ({ids})"
    with shown_view(browser, dashboard, VIEW["seeds"], search=search, mode="CHART") as page:
        until(lambda: len(line_colours(page)) == 2, "the learning curves of two seeds")
        return settled(page)


def constraints(browser: "Browser", dashboard: str) -> bytes:
    with shown_view(browser, dashboard, VIEW["constraints"]) as page:
        row(page, "train_geodesics planner-").wait_for()
        return settled(page)


def two_rewards(browser: "Browser", dashboard: str) -> bytes:
    search = f"{POLICIES} and tags.child IS NULL"
    by_reward = {tags_of(run)["reward"]: run for run in runs_found(dashboard, search)}
    if len(by_reward) < 2:
        raise MissingRunError(
            "no run of train_policies with another reward: "
            "dvc exp run -n printed-cup -S policies.reward.form=printed train_policies"
        )
    paint(dashboard, *list(by_reward.values())[:2])
    with shown_view(browser, dashboard, VIEW["rewards"], search=search, mode="CHART") as page:
        until(lambda: len(line_colours(page)) == 2, "the learning curves of two rewards")
        return settled(page)


def of_child(found: Sequence[Run], child: str) -> Run:
    for run in found:
        if tags_of(run).get("child") == child:
            return run
    raise MissingRunError(f"no run of train_policies, {child}: make repro")


def tags_of(run: Run) -> dict[str, str]:
    return {entry["key"]: entry["value"] for entry in run["data"].get("tags", [])}


def paint(dashboard: str, first: Run, second: Run) -> None:
    """Two colours that can be told apart: MLflow's own are drawn by chance."""
    for run, colour in ((first, BLUE), (second, VERMILION)):
        body = {"run_id": run["info"]["run_id"], "key": "mlflow.runColor", "value": colour}
        asked(dashboard, "runs/set-tag", body)


def keep_newest(dashboard: str) -> None:
    """Remove from the copy what an older run of the same settings left."""
    told = ("stage", "item", "child", "reward", "dvc_experiment")
    seen = set()
    for run in runs_found(dashboard, ""):
        key = tuple(tags_of(run).get(name) for name in told)
        if key in seen:
            asked(dashboard, "runs/delete", {"run_id": run["info"]["run_id"]})
        seen.add(key)


@contextlib.contextmanager
def copied_dashboard() -> Iterator[str]:
    """What `geodesics ui` opens on a copy of this checkout's runs, the newest of each setting."""
    if not (ROOT / "mlflow.db").is_file():
        raise MissingRunError("mlflow.db: this checkout has no runs yet: make repro")
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy2(ROOT / "mlflow.db", folder)
        with dashboard_of(Path(folder)) as page:
            keep_newest(base_of(page))
            yield page


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
    "mlflow_results": Shot(
        "MLflow's table of runs as geodesics ui opens it: constraint, planner, seed, success, "
        "median ratio and median time of each",
        results,
    ),
    "mlflow_two_rewards": Shot(
        "MLflow's charts of two runs of train_policies with different rewards: the mean saving of "
        "their seeds over the steps, and what it ends with as bars",
        two_rewards,
    ),
    "mlflow_two_seeds": Shot(
        "MLflow's charts of seeds 0 and 1 of train_policies: saving and return over the steps, a "
        "line each",
        two_seeds,
    ),
    "mlflow_constraints": Shot(
        "MLflow's table of train_geodesics, a row a constraint, with success, median ratio, median "
        "time and the success without a policy",
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
    code, taken = 0, {}
    with chromium() as browser, contextlib.ExitStack() as open_until_end:
        dashboard = ""
        for name, shot in chosen.items():
            began = time.monotonic()
            try:
                if name.startswith("mlflow"):
                    dashboard = dashboard or base_of(
                        open_until_end.enter_context(copied_dashboard())
                    )
                (IMAGES / f"{name}.png").write_bytes(compressed(shot.take(browser, dashboard)))
                taken[name] = shot.alt  # only now: the words are of the new picture
                print(f"docs/images/{name}.png  {time.monotonic() - began:.0f} s", flush=True)
            except (
                MissingRunError,
                AssertionError,
            ) as error:  # the latter: a page did not show what it should
                print(f"{name}: {error}", file=sys.stderr)
                code = 1
    for page in DOCS.glob("*.md"):
        text = page.read_text()
        if (new := with_pictures(text, taken)) != text:
            page.write_text(new)
    return code


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
