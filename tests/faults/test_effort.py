"""What a row of the counts tells, and when there is none."""

import json
from pathlib import Path

import pytest

from tests.faults import effort as efforts
from tests.faults.effort import COUNTS, FAULTS, QUICK, SOAK, Effort, counting


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(COUNTS, str(tmp_path / "counts.json"))
    return tmp_path / "counts.json"


def measure(part: str, effort: Effort, lost: int) -> None:
    with counting(part, effort) as row:
        row["lost"] = lost


def test_a_row_says_what_was_measured_on_which_commit_and_for_how_long(file: Path) -> None:
    measure("kills", FAULTS, 0)
    measure("load", QUICK, 3)
    rows = json.loads(file.read_text())
    assert list(rows["kills"]) == ["effort", "commit", "seconds", "processor", "lost"]
    assert rows["kills"]["effort"] == "faults"
    assert rows["kills"]["seconds"] >= 0.0
    assert rows["load"]["lost"] == 3


def test_a_row_is_in_the_checkout_wherever_its_test_went(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(efforts, "ROOT", tmp_path)
    monkeypatch.setenv(COUNTS, "counts.json")
    with counting("runs", FAULTS) as row:
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        row["lost"] = 0
    assert json.loads((tmp_path / "counts.json").read_text())["runs"]["lost"] == 0


@pytest.mark.parametrize("effort", [QUICK, FAULTS, SOAK], ids=lambda own: own.name)
def test_a_row_does_not_outlive_the_test_that_fails(file: Path, effort: Effort) -> None:
    measure("kills", FAULTS, 0)
    measure("load", FAULTS, 0)
    with pytest.raises(AssertionError), counting("kills", effort) as row:
        assert "kills" not in json.loads(file.read_text()), "or a killed run would leave it"
        row["lost"] = 0
        raise AssertionError
    with counting("load", effort):
        pass  # a file of tests of which one failed
    assert json.loads(file.read_text()) == {}


def test_figures_of_more_effort_stay_and_a_skip_says_nothing(file: Path) -> None:
    measure("kills", SOAK, 0)
    before = file.read_text()
    measure("kills", FAULTS, 0)
    assert file.read_text() == before
    with pytest.raises(pytest.skip.Exception), counting("kills", SOAK):
        pytest.skip("not installed")
    assert file.read_text() == before
    measure("kills", SOAK, 1)
    assert json.loads(file.read_text())["kills"]["lost"] == 1


def test_nothing_is_counted_where_no_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(COUNTS, raising=False)
    monkeypatch.chdir(tmp_path)
    measure("kills", FAULTS, 0)
    assert list(tmp_path.iterdir()) == []
