"""What `dvc metrics show` and `dvc exp show` have a column for is few and is figures."""

import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
MOST = 25
"""Figures of a report that is one of the metrics."""


def metrics() -> list[Path]:
    """The committed reports that the pipelines call metrics."""
    found = set[Path]()
    for file in ("dvc.yaml", "stages/dvc.yaml", "stages/sweep/dvc.yaml"):
        for stage in yaml.safe_load((ROOT / file).read_text())["stages"].values():
            names = (name for entry in stage.get("metrics", ()) for name in entry)
            found |= {one for name in names for one in ROOT.glob(re.sub(r"\$\{.*?\}", "*", name))}
    return sorted(one for one in found if not one.stem.endswith("-histograms"))


def figures(value: object) -> int:
    """As DVC counts them, which leaves lists out."""
    if isinstance(value, dict):
        return sum(map(figures, value.values()))
    return int(isinstance(value, str | int | float))


@pytest.mark.parametrize("file", metrics(), ids=lambda file: str(file.relative_to(ROOT)))
def test_a_report_that_is_a_metric_has_few_figures(file: Path) -> None:
    assert 0 < figures(json.loads(file.read_text())) <= MOST


def test_every_stage_s_metrics_are_looked_at() -> None:
    assert len(metrics()) > 40
