"""What the documentation says can be done is done here: its code runs, its commands parse, its
names exist.

That its commands run is in tests/test_docs_commands.py.
"""

import ast
import inspect
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from importlib import import_module
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

import constraint_geodesics
from constraint_geodesics import cli
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.params import load_params
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.search_space import read_space
from constraint_geodesics.tracking.experiment import Work, tracked_stage
from constraint_geodesics.tracking.registry import register_planner
from tests.docs_site import MKDOCS, NO_MKDOCS, NOTEBOOK_PAGE, built
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
    for answer in ("path", "again", "longer", "round_it"):
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
    assert site["theme"]["font"] is False
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


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The pages as `make docs` makes them."""
    return built(tmp_path_factory.mktemp("site"))


@NO_MKDOCS
def test_the_site_opens_from_disk(site: Path) -> None:
    assert {page.with_suffix(".md").name for page in site.glob("*.html")} == {
        *PAGES,
        NOTEBOOK_PAGE,
        "404.md",
    }
    for page in site.glob("*.html"):
        if page.name == "404.html":  # for servers
            continue
        parsed = Loaded()
        parsed.feed(page.read_text())
        for address in parsed.addresses:
            inside = address.partition("#")[0].partition("?")[0]
            assert address.startswith("data:image/") or (site / inside).is_file(), (
                page.name,
                address,
            )
    for style in site.rglob("*.css"):
        for address in re.findall(r"""(?:url\(|@import)\s*["']?([^"')\s]+)""", style.read_text()):
            inside = style.parent / address.partition("#")[0].partition("?")[0]
            assert address.startswith(("data:", "#")) or inside.is_file(), (style.name, address)
    parsed = Loaded()
    parsed.feed((site / "method.html").read_text())
    assert "σ(z)⁻² = Σ_k w_k exp(−½ ‖z − c_k‖² / h_k²)" in parsed.text, (
        "equations are text: nothing renders them"
    )


@NO_MKDOCS
def test_the_search_has_every_page_and_lies_in_a_script(site: Path) -> None:
    """A page from disk may load a script, and nothing else."""
    index = (site / "search" / "search_index.js").read_text()
    found = json.loads(index.removeprefix("var __index = "))
    pages = {entry["location"].partition("#")[0] for entry in found["docs"]}
    assert pages == {page.replace(".md", ".html") for page in [*PAGES, NOTEBOOK_PAGE]}
    titles = {re.sub(r"<[^>]+>", "", entry["title"]).strip() for entry in found["docs"]}
    assert {"replan", "When a format changes", "constraint_geodesics.Planner"} <= titles


API = {page: text for page, text in PAGES.items() if page.startswith("api")}
DOCUMENTED = re.findall(r"^::: (constraint_geodesics\.[\w.]+)$", "\n".join(API.values()), re.M)


def test_the_api_names_all_that_the_package_exports() -> None:
    assert {f"constraint_geodesics.{name}" for name in constraint_geodesics.__all__} <= set(
        DOCUMENTED
    )
    assert len(set(DOCUMENTED)) == len(DOCUMENTED)
    assert all(f"`{name}`" in API["api.md"] for name in constraint_geodesics.__all__)


def test_the_api_names_all_that_the_pages_import() -> None:
    text = "\n".join(API.values())
    for page in having("python"):
        for block in blocks(page, "python"):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and node.module:
                    module = import_module(node.module)
                    for name in (own.name for own in node.names):
                        if module.__name__.partition(".")[0] == PACKAGE.name:
                            home = getattr(getattr(module, name), "__module__", node.module)
                            paths = {f"{where}.{name}" for where in (node.module, home)}
                            named = paths & set(DOCUMENTED) or f"`{name}`" in text
                            assert named, f"{page}: {node.module}.{name} stands on no page api*.md"


def documented(path: str) -> Iterator[tuple[str, str]]:
    """An object and its public members that have a docstring of their own, by their paths."""
    module, _, name = path.rpartition(".")
    found = getattr(import_module(module), name)
    if not isinstance(found, type) and not inspect.isfunction(found):
        return
    yield path, inspect.getdoc(found) or ""
    if isinstance(found, type) and not re.search(
        rf"^::: {re.escape(path)}\n(?:    .*\n)*      members: false", "\n".join(API.values()), re.M
    ):
        for member, own in vars(found).items():
            own = getattr(own, "__func__", own)  # of a class's method
            is_own = inspect.isfunction(own) or isinstance(own, property)
            if is_own and own.__doc__ and not member.startswith("_"):
                yield f"{path}.{member}", inspect.getdoc(own) or ""


@NO_MKDOCS
@pytest.mark.parametrize("path", DOCUMENTED)
def test_a_docstring_stands_on_its_page_word_for_word(path: str, site: Path) -> None:
    """It is plain text: no asterisk or bracket of it may turn into a form of Markdown."""
    (page,) = (page for page, text in API.items() if re.search(rf"^::: {path}$", text, re.M))
    html = (site / page.replace(".md", ".html")).read_text()
    parsed = Loaded()
    parsed.feed(html)
    text = " ".join(parsed.text.split())
    assert f'id="{path}"' in html
    for name, docstring in documented(path):
        assert f'id="{name}"' in html, name
        for part in re.split(r"\n\s*\n", docstring):
            assert " ".join(part.replace("`", "").split()) in text, name


@NO_MKDOCS
def test_every_error_that_the_api_names_is_on_its_page(site: Path) -> None:
    named = set()
    for page in API:
        parsed = Loaded()
        parsed.feed((site / page.replace(".md", ".html")).read_text())
        named |= set(re.findall(r"\b[A-Z]\w+Error\b", parsed.text))
    assert len(named) > 5
    assert named <= {path.rpartition(".")[2] for path in DOCUMENTED} | {
        "KeyError",
        "TypeError",
        "ValueError",
    }


@NO_MKDOCS
@pytest.mark.parametrize(
    "bad",
    ["<script src='//host/x.js'></script>", "<style>a {background: url(//host/x.png)}</style>"],
)
def test_a_page_that_loads_something_from_the_net_fails_the_build(bad, tmp_path) -> None:
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    for name in ("mkdocs.yml", "reports", "src"):
        (tmp_path / name).symlink_to(ROOT / name)
    with (tmp_path / "docs" / "limits.md").open("a") as page:
        page.write(f"\n{bad}\n")
    command = [str(MKDOCS), "build", "--strict"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "would load //host/x" in done.stderr


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
