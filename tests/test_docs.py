"""What the documentation says can be done is done here: its code runs, its commands parse, its
names exist.

That its commands run is in tests/test_docs_commands.py.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib
import pytest
import typer
import yaml
from dvc.cli import parse_args
from dvc.dependency.param import ParamsDependency
from dvc.repo import Repo
from dvc.utils.hydra import apply_overrides
from mlflow.utils.search_utils import SearchUtils

from constraint_geodesics import cli
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.params import load_params
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.search_space import read_space
from constraint_geodesics.tracking.experiment import Work, tracked_stage
from constraint_geodesics.tracking.registry import register_planner
from tests.readme import EXPERIMENTS as TIMES_PAGE
from tests.readme import with_stage_times

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "constraint_geodesics"
PAGES = {page.name: page.read_text() for page in sorted((ROOT / "docs").glob("*.md"))}
PARAMS = yaml.safe_load((ROOT / "params.yaml").read_text())
every_page = pytest.mark.parametrize("page", PAGES)


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGES[page], re.S | re.M)


def prose(page: str) -> str:
    return re.sub(r"^```.*?^```", "", PAGES[page], flags=re.S | re.M)


def inline(page: str) -> list[str]:
    """Code between backticks in the text, over line ends too."""
    return [
        " ".join(code.split())
        for _, code in re.findall(r"(?<!`)(`+)(?!`)(.+?)(?<!`)\1(?!`)", prose(page), re.S)
    ]


def commands(page: str) -> list[list[str]]:
    """The words of every line of the shell's blocks; variables before a command are left out."""
    return [words for block in blocks(page, "bash") for words in words_of(block)]


def words_of(block: str) -> list[list[str]]:
    """The words of every command of a block; a quoted text may go on over line ends."""
    found, text = [], ""
    for line in block.replace("\\\n", " ").splitlines():
        text += line
        try:
            words = shlex.split(text, comments=True)
        except ValueError:  # its quotation is not closed yet
            text += "\n"
            continue
        text = ""
        if words:
            found.append(
                words[next(k for k, word in enumerate(words) if not re.match(r"[A-Z_]+=", word)) :]
            )
    assert not text, text
    return found


def having(language: str) -> list[str]:
    return [page for page in PAGES if blocks(page, language)]


# Code


def run(page: str, monkeypatch, folder: Path) -> dict[str, Any]:
    """All Python of one page, one block after another; where it reads params.yaml, in the
    checkout.
    """
    code = blocks(page, "python")
    monkeypatch.chdir(ROOT if any("params.yaml" in block for block in code) else folder)
    names: dict[str, Any] = {"__name__": "example"}
    for block in code:
        exec(compile(block, page, "exec"), names)
    return names


def test_the_first_path_is_what_its_page_says(monkeypatch, tmp_path) -> None:
    names = run("first_path.md", monkeypatch, tmp_path)
    for answer in ("path", "mended", "longer", "round_it"):
        assert names[answer].status == "solved", answer
    assert names["certificate"].valid
    assert names["longer"].length_rad <= names["path"].length_rad
    assert sum(path.status == "solved" for path in names["paths"]) > 15
    for file in ("path.csv", "path.png", "path.rrd"):
        assert (tmp_path / file).is_file(), file


def test_any_arm_goes_to_any_goal_as_its_page_says(monkeypatch, tmp_path) -> None:
    names = run("any_arm.md", monkeypatch, tmp_path)
    assert names["trajectory"].status == names["path"].status == "solved"
    assert names["level"].distance_rad > 0.01
    assert names["path"].length_rad <= names["trajectory"].length_rad
    assert len(names["message"]["points"]) == len(names["path"].times)


def test_scenes_change_as_their_page_says(monkeypatch, tmp_path) -> None:
    for file, text in zip(("scene.yaml", "cup.yaml"), blocks("scenes.md", "yaml"), strict=True):
        (tmp_path / file).write_text(text)
    names = run("scenes.md", monkeypatch, tmp_path)
    assert names["path"].status == "solved"
    assert [shape.name for shape in names["planner"].scene.workcell] == ["table", "pipe", "cup"]
    assert not names["planner"].scene.attached
    assert names["seen"].status in ("solved", "not_found")


def test_the_extensions_work(monkeypatch, tmp_path) -> None:
    names = run("extend.md", monkeypatch, tmp_path)
    assert names["inside"].mean() > 0.2
    assert names["arm"].dof == 7
    assert names["geodesic"].status == "converged"
    assert names["geodesic"].length == pytest.approx(names["exact"], rel=1e-3)
    assert names["answer"].status == "solved"
    assert names["verdict"].valid


@pytest.mark.parametrize(
    "page",
    [page for page in having("python") if page not in ("first_path.md", "extend.md", "any_arm.md")],
)
def test_the_other_code_runs(page, monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    if "models:/" in PAGES[page]:  # what a run of the pipeline leaves in the registry
        with tracked_stage(Work("build_planner", "planner"), "built", tmp_path) as stage:
            example = {"start": [0.0] * 6, "goal": [0.1] * 6, "constraint": "free"}
            register_planner(stage, PACKAGED, PACKAGE / "tracking" / "served_model.py", example)
    run(page, monkeypatch, tmp_path)


def test_every_table_of_times_is_the_report_s() -> None:
    """`make readme` writes it."""
    text = TIMES_PAGE.read_text()
    assert with_stage_times(text) == text
    assert "| `train_manifold` | 2 |" in text


# The notebook

NOTEBOOK = ROOT / "docs" / "first_path.ipynb"


def cells(kind: str) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == kind]


def printed(cell: dict[str, Any]) -> str:
    return "".join(
        "".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream"
    )


def test_the_notebook_s_cells_run_and_print_what_is_stored(monkeypatch, tmp_path, capsys) -> None:
    """`make notebook` runs it in Jupyter and stores the outputs; here the same cells run without
    it.
    """
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names: dict[str, Any] = {"__name__": "notebook"}
    for cell in cells("code"):
        exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
        assert rounded(capsys.readouterr().out) == rounded(printed(cell))
    assert names["path"].status == "solved"
    assert names["certificate"].valid
    for file in ("path.png", "path.rrd"):
        assert (tmp_path / file).is_file()


def rounded(text: str) -> str:
    """Without the last digits of its numbers, which another processor may round otherwise."""
    return re.sub(r"\d+(?:\.\d+)?(?:e-?\d+)?", lambda number: f"{float(number.group()):.1e}", text)


def test_the_notebook_holds_its_pictures_and_is_small() -> None:
    pictures = [
        output
        for cell in cells("code")
        for output in cell["outputs"]
        if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 2
    assert NOTEBOOK.stat().st_size < 200_000
    assert [cell["execution_count"] for cell in cells("code")] == list(
        range(1, len(cells("code")) + 1)
    )
    told = "".join("".join(cell["source"]) for cell in cells("markdown"))
    assert set(re.findall(r"\]\(([^)#]+)", told)) <= set(PAGES)


def entries(page: str) -> list[str]:
    """Blocks that belong into params.yaml."""
    found = [] if page == "scenes.md" else blocks(page, "yaml")  # those are scenes of their own
    return [block for block in found if not block.startswith("search:")]


def test_every_search_space_is_valid(tmp_path) -> None:
    spaces = [block for page in PAGES for block in blocks(page, "yaml") if "search:" in block]
    assert len(spaces) == 1
    for block in spaces:
        (tmp_path / "space.yaml").write_text(block)
        found = read_space(tmp_path / "space.yaml").changes()
        assert len(found) == 6, "as many as the page says"
        for changes in found:
            load_params(ROOT / "params.yaml", changes)


@pytest.mark.parametrize("page", having("yaml"))
def test_every_entry_of_params_is_valid(page, tmp_path) -> None:
    for block in entries(page):
        file = tmp_path / "params.yaml"
        file.write_text(yaml.safe_dump(merged(PARAMS, yaml.safe_load(block))))
        params = load_params(file)
        with Scene.from_params(params).world():
            pass


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """The old entries with the new ones; another robot replaces the old one whole."""
    both = dict(old)
    for key, value in new.items():
        nested = isinstance(value, dict) and isinstance(old.get(key), dict) and key != "robot"
        both[key] = merged(old[key], value) if nested else value
    return both


# Commands


@pytest.mark.parametrize("page", having("bash"))
def test_every_command_of_ours_parses(page) -> None:
    known = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    for program, *words in commands(page):
        if program == "geodesics":
            known[words[0]].make_context(words[0], words[1:])


@every_page
def test_every_option_that_the_text_names_exists(page) -> None:
    program = typer.main.get_command(cli.app)
    for code in inline(page):
        if not code.startswith("geodesics "):
            continue
        words = shlex.split(code)[1:]
        named = program if words[0].startswith("-") else program.commands[words[0]]  # type: ignore[attr-defined]
        options = {option for parameter in named.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options | {"--help"}, code


@pytest.mark.parametrize("page", having("bash"))
def test_every_target_of_make_exists(page) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    named = {words[1] for words in commands(page) if words[0] == "make"}
    named |= {code.split()[1] for code in inline(page) if code.startswith("make ")}
    assert named <= targets


# Experiments


def pipeline(
    folder: Path, overrides: tuple[str, ...]
) -> dict[str, tuple[str, dict[str, Any], set[str]]]:
    """Each stage's command, values of its parameters and the stages it depends on, as DVC reads
    dvc.yaml.
    """
    folder.mkdir()
    for name in ("dvc.yaml", "params.yaml"):
        shutil.copy(ROOT / name, folder)
    if overrides:
        apply_overrides(folder / "params.yaml", list(overrides))
    load_params(folder / "params.yaml")
    repo = Repo.init(str(folder), no_scm=True)
    values = yaml.safe_load((folder / "params.yaml").read_text())
    needs: dict[str, set[str]] = {stage.name: set() for stage in repo.index.stages}
    for stage, needed in repo.index.graph.edges:
        needs[stage.name].add(needed.name)
    return {
        stage.name: (
            stage.cmd,
            {
                key: looked_up(values, key)
                for dependency in stage.deps
                if isinstance(dependency, ParamsDependency)
                for key in dependency.params
            },
            needs[stage.name],
        )
        for stage in repo.index.stages
    }


@pytest.fixture(scope="module")
def committed(tmp_path_factory) -> dict[str, tuple[str, dict[str, Any], set[str]]]:
    """The pipeline without any change."""
    return pipeline(tmp_path_factory.mktemp("pipeline") / "before", ())


def looked_up(values: Any, key: str) -> Any:
    for part in key.split("."):
        values = values[part]
    return values


def as_dvc_reads(words: list[str]) -> Any:
    """Its options and targets; DVC's parser looks at the options of this process too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dvc"])
        return parse_args(words)


def experiments() -> list[tuple[list[str], list[str], str]]:
    """Of every experiment its overrides, its targets, and the text up to the next block."""
    found = []
    for page in having("bash"):
        for block, after in re.findall(
            r"^```bash\n(.*?)^```\n(.*?)(?=^```|\Z)", PAGES[page], re.S | re.M
        ):
            for words in words_of(block):
                if words[:3] == ["dvc", "exp", "run"]:
                    told = as_dvc_reads(words[1:])
                    found.append((told.set_param, told.targets, after))
    return found


EXPERIMENTS = experiments()


@pytest.mark.parametrize(
    ("overrides", "targets", "after"),
    EXPERIMENTS,
    ids=[overrides[0].split("=")[0] for overrides, _, _ in EXPERIMENTS],
)
def test_an_experiment_changes_what_exists_and_runs_what_its_page_says(
    overrides, targets, after, committed, tmp_path
) -> None:
    for override in overrides:
        key = override.split("=")[0]
        if not key.startswith("+"):
            looked_up(PARAMS, key)
    before, now = committed, pipeline(tmp_path / "now", tuple(overrides))
    assert set(targets) <= set(now)

    @cache
    def touched(name: str) -> bool:
        return (
            name not in before
            or now[name][:2] != before[name][:2]
            or any(map(touched, now[name][2]))
        )

    def needed(name: str) -> set[str]:
        return {name}.union(*map(needed, now[name][2]))

    runs = {name for target in targets for name in needed(target) if touched(name)}
    assert runs, "the change must touch a target"
    if "**What runs**" in after:
        told = after.split("**What runs**")[1].split(".")[0]
        assert set(re.findall(r"`([^`]+)`", told)) == runs


def test_every_experiment_of_its_page_says_what_runs() -> None:
    named = [after for _, _, after in EXPERIMENTS if "**What runs**" in after]
    assert len(named) == 6


@pytest.mark.parametrize("page", having("bash"))
def test_every_command_of_dvc_parses_and_its_targets_exist(page, committed) -> None:
    known = set(committed) | {"label_joints"}
    for program, *words in commands(page):
        if program != "dvc":
            continue
        told = as_dvc_reads(words)
        if words[0] == "repro":
            assert {target.split(":")[-1] for target in told.targets} <= known
        for file in [word for word in words if word.startswith("reports/") and "serve" not in word]:
            assert (ROOT / file).is_file(), file


# Names


@every_page
def test_every_link_leads_somewhere(page) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", prose(page)):
        file, _, heading = target.partition("#")
        assert not file or file in PAGES or (ROOT / "docs" / file).is_file(), target
        if heading:
            titles = re.findall(r"^#+ (.*)$", prose(file or page), re.M)
            slugs = {
                re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower())
                for title in titles
            }
            assert heading in slugs, target


@every_page
def test_every_file_that_the_text_names_exists(page) -> None:
    for code in inline(page):
        if re.fullmatch(r"[\w/]+\.py", code) and not code.endswith("projected_line.py"):
            assert any((folder / code).is_file() for folder in (ROOT, PACKAGE)), code
        elif re.fullmatch(r"reports/[\w./*-]+", code) and "serve" not in code:
            assert list(ROOT.glob(code.rstrip("/"))), code


@every_page
def test_every_parameter_that_the_text_names_exists(page) -> None:
    for code in inline(page):
        key = code.split(":")[0]
        if (
            re.fullmatch(r"[a-z_]+(\.\w+)+", key)
            and key.split(".")[0] in PARAMS
            and not key.endswith((".py", ".json"))
            and not key.startswith("planner.scene")  # of a Planner
        ):
            looked_up(PARAMS, key)


@every_page
def test_every_filter_is_one_that_mlflow_understands(page) -> None:
    filters = blocks(page, "sql") + re.findall(
        r"`+ ?((?:tags|attributes|metrics)\.[^|]+?) ?`+ \|$", prose(page), re.M
    )
    assert filters or page not in ("mlflow.md", "experiments.md")
    for text in filters:
        assert SearchUtils.parse_search_filter(text.strip()), text


# The site


MKDOCS = ROOT / ".geodesics" / "docs-venv" / "bin" / "mkdocs"
NOTEBOOK_PAGE = "first_path_notebook.md"


def test_the_site_has_every_page_and_loads_nothing_from_the_net() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    site = yaml.safe_load(text)

    def pages(entry: Any) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        return [
            page
            for each in (entry.values() if isinstance(entry, dict) else entry)
            for page in pages(each)
        ]

    assert sorted(pages(site["nav"])) == sorted([*PAGES, NOTEBOOK_PAGE])
    assert site["theme"]["highlightjs"] is False
    assert site["plugins"] == []
    assert "//" not in text
    for page, content in PAGES.items():
        assert "<script" not in content, page
        assert set(re.findall(r"https?://([^/\s`:]+)", content)) <= {"127.0.0.1"}, page


class Loaded(HTMLParser):
    """What a browser opens for a page by itself: every address but those of links."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = ("src", "href", "srcset", "data", "poster") if tag != "a" else ()
        self.addresses += [value for name, value in attrs if name in names and value]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.skipif(not MKDOCS.is_file(), reason="no mkdocs: `make docs` installs it")
def test_the_site_builds_strictly_and_opens_from_disk(tmp_path) -> None:
    command = [str(MKDOCS), "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    assert {page.with_suffix(".md").name for page in tmp_path.glob("*.html")} == {
        *PAGES,
        NOTEBOOK_PAGE,
        "404.md",
    }
    for page in tmp_path.glob("*.html"):
        if page.name == "404.html":  # for servers
            continue
        parsed = Loaded()
        parsed.feed(page.read_text())
        for address in parsed.addresses:
            inside = address.partition("#")[0].partition("?")[0]
            assert address.startswith("data:image/") or (tmp_path / inside).is_file(), (
                page.name,
                address,
            )
    for style in tmp_path.rglob("*.css"):
        for address in re.findall(r"""(?:url\(|@import)\s*["']?([^"')\s]+)""", style.read_text()):
            inside = style.parent / address.partition("#")[0].partition("?")[0]
            assert address.startswith(("data:", "#")) or inside.is_file(), (style.name, address)
    parsed = Loaded()
    parsed.feed((tmp_path / "method.html").read_text())
    assert "σ(z)⁻² = Σ_k w_k exp(−½ ‖z − c_k‖² / h_k²)" in parsed.text, (
        "equations are text: nothing renders them"
    )


@pytest.mark.skipif(not MKDOCS.is_file(), reason="no mkdocs: `make docs` installs it")
@pytest.mark.parametrize(
    "bad",
    ["<script src='//host/x.js'></script>", "<style>a {background: url(//host/x.png)}</style>"],
)
def test_a_page_that_loads_something_from_the_net_fails_the_build(bad, tmp_path) -> None:
    for folder in ("docs", "reports"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    with (tmp_path / "docs" / "limits.md").open("a") as page:
        page.write(f"\n{bad}\n")
    built = subprocess.run(
        [str(MKDOCS), "build", "--strict"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode != 0
    assert "would load //host/x" in built.stderr


def pins(file: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==(\S+)", (ROOT / file).read_text(), re.M)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_the_documentation_s_packages_are_pinned_and_agree_with_the_project_s() -> None:
    """The notebook's kernel has both."""
    ours, theirs = pins("docs/requirements.lock"), pins("requirements.lock")
    assert {"mkdocs", "ipykernel", "nbclient", "vl-convert-python"} <= set(ours)
    assert not {"mkdocs", "ipykernel"} & set(theirs)
    assert {name: ours[name] for name in set(ours) & set(theirs)} == {
        name: theirs[name] for name in set(ours) & set(theirs)
    }


def test_the_plots_that_dvc_names_are_of_files_that_stages_write() -> None:
    plots = yaml.safe_load((ROOT / "dvc.yaml").read_text())["plots"]
    template = json.loads((ROOT / ".dvc" / "plots" / "seeds.json").read_text())
    assert template["facet"]["field"] == "panel"
    for plot in plots:
        ((title, settings),) = plot.items()
        assert settings["template"] == "seeds", title
        for file, column in settings["y"].items():
            header = (ROOT / file).read_text().splitlines()[0].split(",")
            assert {settings["x"], column} <= set(header), file


def test_the_citation_is_of_this_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert cited["cff-version"] == "1.2.0"
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
    assert {"message", "title", "authors"} <= set(cited)
    assert all({"type", "title", "authors"} <= set(reference) for reference in cited["references"])
