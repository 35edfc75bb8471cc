"""How stages and commands end: with one line where the machine has too little, and with the time
that they took kept.
"""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics import cli
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import note_stage_time, run_stage

ROOT = Path(__file__).resolve().parents[2]
LITTLE = "error: this machine's memory is not enough"


def without_memory(*_: object) -> None:
    raise MemoryError


def too_large(params: Params, layout: Layout) -> None:
    np.empty(2**55)


@pytest.mark.parametrize("stage", [without_memory, too_large])
def test_a_stage_without_memory_ends_in_one_line(stage, tmp_path, monkeypatch, capfd) -> None:
    shutil.copy(ROOT / "params.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["stages/some.py"])
    with pytest.raises(SystemExit) as ended:
        run_stage(stage, [])
    assert ended.value.code == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(LITTLE)
    assert line == LITTLE or "Unable to allocate" in line
    assert not Layout().stage_times.exists()


def test_a_command_without_memory_ends_in_one_line(monkeypatch, capfd) -> None:
    monkeypatch.setattr(cli, "app", without_memory)
    monkeypatch.setattr(sys, "argv", ["geodesics", "plan"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    assert capfd.readouterr().err == f"{LITTLE}\n"


CONFLICT = """stage,seconds
label,3.0
<<<<<<< HEAD
train a,1.0
=======
train a,2.0
>>>>>>> theirs
train b,5.0
"""


@pytest.mark.parametrize(
    ("content", "kept"),
    [
        (CONFLICT.encode(), ["label,3.0", "train a,2.0", "train b,5.0"]),
        (b"stage,seconds\nlabel,3.0\ntrain a,1", ["label,3.0", "train a,1"]),
        (b"stage,seconds\nlabel,3.0\ntrain a", ["label,3.0"]),
        (b"stage,seconds\nlabel,nan\ntrain a,soon\n,1.0\na,1.0,2.0\n", []),
        (b"\xff\x00\xfe", []),
        (b"", []),
    ],
    ids=["conflict", "cut short", "cut in a name", "no times", "no text", "empty"],
)
def test_damaged_times_of_stages_fail_no_stage(content, kept, tmp_path) -> None:
    file = tmp_path / "stage_times.csv"
    file.write_bytes(content)
    note_stage_time(file, "train", ["c"], 2.04)
    assert file.read_text().splitlines() == ["stage,seconds", *kept, "train c,2.0"]
