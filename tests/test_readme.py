"""README's figures and numbers are those of the committed run."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def between(marker: str) -> str:
    return README.split(f"<!-- {marker} -->")[1].split(f"<!-- /{marker} -->")[0].strip()


def test_the_result_table_is_the_reports() -> None:
    assert between("results") == (ROOT / "reports" / "table.md").read_text().strip()


def test_every_figure_and_linked_file_is_in_the_repository() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_the_numbers_of_the_reports_are_quoted_as_they_are() -> None:
    """Every quoted number stands as `number` <!-- file key scale digits --> behind it and is recomputed here."""
    import json

    quoted = re.findall(r"([\d.]+)[^\d<]{0,12}<!-- from (\S+) (\S+) ([\d.e-]+) (\d) -->", README)
    assert len(quoted) >= 5
    for shown, file, key, scale, digits in quoted:
        value = json.loads((ROOT / file).read_text())
        for part in key.split("/"):
            value = value[part]
        assert shown == f"{value * float(scale):.{digits}f}", (file, key)


def test_the_committed_run_is_of_these_parameters() -> None:
    params = yaml.safe_load((ROOT / "params.yaml").read_text())
    stages = yaml.safe_load((ROOT / "dvc.lock").read_text())["stages"]
    for name in params["constraints"]:
        locked = stages[f"label_joints@{name}"]["params"]["params.yaml"]
        assert locked[f"constraints.{name}"] == params["constraints"][name]
    locked = stages["train_geodesics@planner-level_cup"]["params"]["params.yaml"]
    assert locked["geodesics"] == params["geodesics"]
    assert stages["benchmark_planners@level_cup"]["params"]["params.yaml"]["benchmark"] == params["benchmark"]
