"""README's figures and numbers are those of the committed run."""

import re

import pytest
import yaml
from ruamel.yaml import YAML

from tests.readme import BLOCKS, QUOTED, ROOT, filled

README = (ROOT / "README.md").read_text()


def test_every_table_and_quoted_number_is_the_reports() -> None:
    """`make readme` writes them."""
    assert len(QUOTED.findall(README)) >= 8
    assert filled(README) == README


EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.mark.parametrize("example", EXAMPLES, ids=("plan", "constraint", "manifold"))
def test_every_example_runs(example, monkeypatch, capsys, tmp_path) -> None:
    monkeypatch.chdir(tmp_path if "Planner" in example else ROOT)
    exec(compile(example, "README.md", "exec"), {"__name__": "example"})
    printed = capsys.readouterr().out.split()
    if "Planner" in example:
        assert printed[0] == "solved"
        assert (tmp_path / "path.csv").is_file()
        assert (tmp_path / "path.rrd").is_file()
    elif "GradientSolver" in example:
        status, length, straight = printed[0], float(printed[1]), float(printed[2])
        assert status == "converged"
        assert 2.0 < length < 0.9 * straight, "round the hill, not over it"
    else:
        assert 0 <= float(printed[0]) < 1e-9


def test_every_figure_and_linked_file_is_in_the_repository() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_no_figure_of_the_run_stands_without_its_source() -> None:
    """After its first tables README quotes nothing in %, degrees or millimetres by hand."""
    told = README.split("<!-- /policies -->")[1]
    for name in BLOCKS:
        told = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", "", told, flags=re.S)
    bare = QUOTED.sub("", told)
    assert not re.findall(r"\d\s?(?:%|°|mm)", bare)


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
