"""What the documentation says can be done is done here: its code runs, its commands parse, its names exist."""

import re
import shlex
import shutil
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from dvc.cli import parse_args
from dvc.dependency.param import ParamsDependency
from dvc.repo import Repo
from dvc.utils.hydra import apply_overrides
from mlflow.utils.search_utils import SearchUtils
from typer.testing import CliRunner

from constraint_geodesics import cli
from constraint_geodesics.constraints.scene import Scene
from constraint_geodesics.params import load_params
from constraint_geodesics.peers import KINDS

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
    return [" ".join(code.split()) for _, code in re.findall(r"(?<!`)(`+)(?!`)(.+?)(?<!`)\1(?!`)", prose(page), re.S)]


def commands(page: str) -> list[list[str]]:
    """The words of every line of the shell's blocks; variables before a command are left out."""
    return [words for block in blocks(page, "bash") for words in words_of(block)]


def words_of(block: str) -> list[list[str]]:
    lines = [shlex.split(line, comments=True) for line in block.replace("\\\n", " ").splitlines()]
    return [line[next(k for k, word in enumerate(line) if not re.match(r"[A-Z_]+=", word)) :] for line in lines if line]


def having(language: str) -> list[str]:
    return [page for page in PAGES if blocks(page, language)]


# Code


def run(page: str, monkeypatch, folder: Path) -> dict[str, Any]:
    """All Python of one page, one block after another; where it reads params.yaml, in the checkout."""
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
    assert names["found"].valid
    assert names["longer"].length_rad <= names["path"].length_rad
    assert sum(path.status == "solved" for path in names["paths"]) > 15
    for file in ("path.csv", "path.png", "path.rrd", "with_ball/planner.json"):
        assert (tmp_path / file).is_file(), file


def test_the_extensions_work(monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(KINDS, "projected_line", None)  # the page adds this one
    names = run("extend.md", monkeypatch, tmp_path)
    assert names["inside"].mean() > 0.2
    assert names["arm"].dof == 7
    assert names["geodesic"].status == "converged"
    assert names["geodesic"].length == pytest.approx(names["exact"], rel=1e-3)
    assert names["answer"].status == "solved"
    assert names["verdict"].valid


@pytest.mark.parametrize("page", [page for page in having("python") if page not in ("first_path.md", "extend.md")])
def test_the_other_code_runs(page, monkeypatch, tmp_path) -> None:
    run(page, monkeypatch, tmp_path)


@pytest.mark.parametrize("page", having("yaml"))
def test_every_entry_of_params_is_valid(page, tmp_path) -> None:
    for block in blocks(page, "yaml"):
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
    known = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    for code in inline(page):
        if not code.startswith("geodesics "):
            continue
        _, name, *words = shlex.split(code)
        options = {option for parameter in known[name].params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options, code


@pytest.mark.parametrize("words", [["constraints"], ["params", str(ROOT / "params.yaml")]])
def test_the_quick_commands_run(words) -> None:
    assert CliRunner().invoke(cli.app, words).exit_code == 0


@pytest.mark.parametrize("page", having("bash"))
def test_every_target_of_make_exists(page) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    named = {words[1] for words in commands(page) if words[0] == "make"}
    named |= {code.split()[1] for code in inline(page) if code.startswith("make ")}
    assert named <= targets


# Experiments


@cache
def pipeline(folder: Path, overrides: tuple[str, ...]) -> dict[str, tuple[str, dict[str, Any], set[str]]]:
    """Each stage's command, values of its parameters and the stages it depends on, as DVC reads dvc.yaml."""
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
        for block, after in re.findall(r"^```bash\n(.*?)^```\n(.*?)(?=^```|\Z)", PAGES[page], re.S | re.M):
            for words in words_of(block):
                if words[:3] == ["dvc", "exp", "run"]:
                    told = as_dvc_reads(words[1:])
                    found.append((told.set_param, told.targets, after))
    return found


EXPERIMENTS = experiments()


@pytest.mark.parametrize(
    ("overrides", "targets", "after"), EXPERIMENTS, ids=[overrides[0].split("=")[0] for overrides, _, _ in EXPERIMENTS]
)
def test_an_experiment_changes_what_exists_and_runs_what_its_page_says(overrides, targets, after, tmp_path) -> None:
    for override in overrides:
        key = override.split("=")[0]
        if not key.startswith("+"):
            looked_up(PARAMS, key)
    before, now = pipeline(tmp_path / "before", ()), pipeline(tmp_path / "now", tuple(overrides))
    assert set(targets) <= set(now)

    @cache
    def touched(name: str) -> bool:
        return name not in before or now[name][:2] != before[name][:2] or any(map(touched, now[name][2]))

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
def test_every_command_of_dvc_parses_and_its_targets_exist(page, tmp_path) -> None:
    known = set(pipeline(tmp_path / "before", ())) | {"draw_benchmark_queries", "label_joints"}
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
        assert not file or file in PAGES, target
        if heading:
            titles = re.findall(r"^#+ (.*)$", prose(file or page), re.M)
            slugs = {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}
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
        if re.fullmatch(r"[a-z_]+(\.\w+)+", key) and key.split(".")[0] in PARAMS and not key.endswith((".py", ".json")):
            looked_up(PARAMS, key)


@every_page
def test_every_filter_is_one_that_mlflow_understands(page) -> None:
    filters = blocks(page, "sql") + re.findall(r"`+ ?((?:tags|attributes|metrics)\.[^|]+?) ?`+ \|$", prose(page), re.M)
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
        return [page for each in (entry.values() if isinstance(entry, dict) else entry) for page in pages(each)]

    assert sorted(pages(site["nav"])) == sorted(PAGES)
    assert site["theme"]["highlightjs"] is False
    assert site["plugins"] == []
    assert "//" not in text
    for page, content in PAGES.items():
        assert "<script" not in content, page
        assert set(re.findall(r"https?://([^/\s`:]+)", content)) <= {"127.0.0.1"}, page


def test_the_citation_is_of_this_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert cited["cff-version"] == "1.2.0"
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
    assert {"message", "title", "authors"} <= set(cited)
    assert all({"type", "title", "authors"} <= set(reference) for reference in cited["references"])
