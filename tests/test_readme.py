"""README's figures and numbers are those of the committed run."""

import re

import pytest
import yaml
from ruamel.yaml import YAML

from tests.readme import BLOCKS, PAGES, POLICIES, QUOTED, README, RESULTS, ROOT

TEXT = README.read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_table_and_quoted_number_is_the_reports(page) -> None:
    """`make readme` writes them."""
    assert PAGES[page](page.read_text()) == page.read_text()


def test_the_results_quote_numbers_with_their_source() -> None:
    for page in (RESULTS, POLICIES):
        assert len(QUOTED.findall(page.read_text())) >= 8
        blocks = re.findall(r"<!-- /(\w+) -->", page.read_text())
        assert blocks
        assert set(blocks) <= {*BLOCKS, "origins"}


def test_every_block_is_on_a_page() -> None:
    pages = RESULTS.read_text() + POLICIES.read_text()
    assert all(pages.count(f"<!-- {name} -->") == 1 for name in BLOCKS)


def test_the_examples_run_one_after_the_other(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "example"}
    for example in re.findall(r"```python\n(.*?)```", TEXT, re.S):
        exec(compile(example, "README.md", "exec"), names)
    assert names["trajectory"].status == "solved"
    assert (tmp_path / "path.csv").is_file()
    assert (tmp_path / "path.rrd").is_file()


def test_every_figure_and_linked_file_is_in_the_repository() -> None:
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", TEXT):
        assert (ROOT / target).is_file(), target


def test_the_committed_run_is_of_these_parameters() -> None:
    """Every parameter that a stage was run with is the one in params.yaml."""
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    # DVC writes YAML 1.2, in which 2e-05 is a number
    stages = YAML(typ="safe").load((ROOT / "dvc.lock").read_text())["stages"]
    compared = 0
    for name, stage in stages.items():
        for key, locked in stage.get("params", {}).get("params.yaml", {}).items():
            value = params
            for part in key.split("."):
                value = value[part]
            assert value == locked, (name, key)
            compared += 1
    assert compared > 100
