"""Where figures are from."""

import pytest

from constraint_geodesics.pipeline.machine import run_header


def test_without_git_a_report_has_no_commit(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run_header(tmp_path)["commit"] == ""
