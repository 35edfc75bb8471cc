import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from dvc.utils.hydra import apply_overrides

from constraint_geodesics.params import ParamsError, load_params

ROOT = Path(__file__).resolve().parents[1]
Change = Callable[[dict[str, Any]], Any]


def changed(tmp_path: Path, change: Change) -> Path:
    raw = copy.deepcopy(yaml.safe_load((ROOT / "params.yaml").read_text()))
    change(raw)
    file = tmp_path / "params.yaml"
    file.write_text(yaml.safe_dump(raw))
    return file


BAD: list[tuple[Change, tuple[str, ...]]] = [
    (lambda p: p.update(speed=1), ("speed=1", "no such parameter")),
    (lambda p: p["labels"].update(free_row=5), ("labels.free_row=5", "no such parameter")),
    (lambda p: p["labels"].update(free_rows="60"), ("labels.free_rows='60'", "integer")),
    (lambda p: p["labels"].update(free_rows=True), ("labels.free_rows=True", "integer")),
    (
        lambda p: p["labels"].update(free_rows=0),
        ("labels.free_rows=0", "greater than or equal to 1"),
    ),
    (
        lambda p: p["manifolds"]["paper"].update(beta=float("nan")),
        ("manifolds.paper.beta=nan", "finite"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(axes=[0, 0, 2, 1, 1, 0]),
        ("constraints.slide.axes.2=2", "0 or 1"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(tolerance=[0, 0, -1, 0, 0, 0]),
        ("constraints.slide.tolerance.2=-1",),
    ),
    (
        lambda p: p["constraints"]["slide"].update(tolerance=[1, 0, 0, 0, 0, 0]),
        ("constraints.slide", "axis is free"),
    ),
    (
        lambda p: p["constraints"]["slide"].update(reference=None),
        ("constraints.slide", "reference"),
    ),
    (
        lambda p: p["geodesics"].update(searched=["planer"]),
        ("geodesics.searched='planer'", "must be one of"),
    ),
    (
        lambda p: p["geodesics"]["reward"].update(form="best"),
        ("geodesics.reward.form='best'", "'corrected'"),
    ),
    (lambda p: p["geodesics"]["reward"].update(length_weight=0.9), ("geodesics.reward", "(0, 1]")),
    (lambda p: p["compute"].update(backend="dask"), ("compute", "dask_address")),
    (lambda p: p.pop("judge"), ("judge is missing",)),
    (lambda p: p["constraints"].pop("free"), ("constraints.free",)),
]


@pytest.mark.parametrize(("change", "parts"), BAD)
def test_a_bad_parameter_is_named_in_one_line(
    tmp_path: Path, change: Change, parts: tuple[str, ...]
) -> None:
    with pytest.raises(ParamsError) as caught:
        load_params(changed(tmp_path, change))
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_the_committed_parameters_are_good() -> None:
    assert load_params(ROOT / "params.yaml").constraints["level_cup"].axes == (0, 0, 0, 1, 1, 0)


@pytest.mark.parametrize(
    ("written", "meant"), [("2e-05", 2e-5), ("1E-6", 1e-6), ("3e2", 300.0), ("2.5e-5", 2.5e-5)]
)
def test_a_number_with_an_exponent_is_one_without_a_point_too(
    tmp_path: Path, written: str, meant: float
) -> None:
    file = tmp_path / "params.yaml"
    text = (ROOT / "params.yaml").read_text()
    assert text.count("  accuracy: 0.00001 ") == 1
    file.write_text(text.replace("  accuracy: 0.00001 ", f"  accuracy: {written} "))
    assert load_params(file).planner.accuracy == meant


def test_what_an_experiment_sets_is_read_as_dvc_wrote_it(tmp_path: Path) -> None:
    file = tmp_path / "params.yaml"
    file.write_text((ROOT / "params.yaml").read_text())
    apply_overrides(file, ["planner.accuracy=0.00001", "geodesics.ppo.learning_rate_end=1e-06"])
    assert "1e-05" in file.read_text()  # text in YAML 1.1
    params = load_params(file)
    assert (params.planner.accuracy, params.geodesics.ppo.learning_rate_end) == (1e-5, 1e-6)


@pytest.mark.parametrize("text", ["labels: [1", "labels: {}\nlabels: {}\n", "\tlabels: 1"])
def test_what_is_no_yaml_is_said_in_one_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(text)
    with pytest.raises(ParamsError, match="not YAML") as caught:
        load_params(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "stage", ["label_joints.py level_cup", "train_geodesics.py planner level_cup", "report.py"]
)
def test_a_stage_stops_before_any_work(tmp_path: Path, stage: str) -> None:
    changed(tmp_path, lambda p: p["geodesics"]["ppo"].update(gamma=1.5))
    script, *names = stage.split()
    command = [sys.executable, str(ROOT / "stages" / script), *names]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr == (
        "error: params.yaml: geodesics.ppo.gamma=1.5: input should be less than or equal to 1\n"
    )
    assert [file.name for file in tmp_path.iterdir()] == ["params.yaml"]


def test_an_unknown_constraint_is_named(tmp_path: Path) -> None:
    changed(tmp_path, lambda p: None)
    command = [sys.executable, str(ROOT / "stages" / "label_joints.py"), "level_cap"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "level_cap" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "change", ["benchmark.seeds=3", "benchmark.planners.PRM.queries=4", "studies.queries=9"]
)
def test_an_experiment_changes_one_line_of_the_benchmark(tmp_path: Path, change: str) -> None:
    """DVC writes the whole file again; what it would wrap otherwise must stand as it writes it."""
    before = (ROOT / "params.yaml").read_text()
    file = tmp_path / "params.yaml"
    file.write_text(before)
    apply_overrides(file, [change])
    old, new = (text[text.index("\nunseen:") :].splitlines() for text in (before, file.read_text()))
    assert len(old) == len(new)
    assert sum(a != b for a, b in zip(old, new, strict=True)) == 1
