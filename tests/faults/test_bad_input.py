"""Hundreds of bad inputs: each is refused in one line of a typed error that names the culprit; none
is a traceback, hangs, or is taken for something else.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from constraint_geodesics import cli, text_files
from constraint_geodesics.params import params_of, read_yaml
from tests.faults import bad_calls, bad_files, bad_params
from tests.faults.bad_input import Bad, Tally
from tests.faults.effort import Effort, counted_at_end
from tests.planner_fixtures import packaged_planner

ROOT = Path(__file__).resolve().parents[2]
SOME = 8
"""Each so many of the bad entries of params.yaml is tried where there is little time."""
TOP = tuple(read_yaml(ROOT / "params.yaml"))
ENDS = ("--start", "0 0 0 0 0 0", "--goal", "0 0 0 0 0 0")
MODEL = "plan {ends} --constraint free --planner models:/arm/1"
SHELL: list[tuple[str, int, str]] = [
    ("plan", 2, "--start is missing"),
    ("plan --start x --goal 0 --constraint free", 2, "--start 'x'"),
    ("plan --start 0 --constraint free", 2, "goal is missing"),
    ("plan --start 0,0,0,0,0,0 --goal 0 --constraint nope", 2, "no constraint 'nope'"),
    ("plan --start nan,0,0,0,0,0 --goal 0,0,0,0,0,0 --constraint free", 2, "start[0]"),
    ("plan --start 1e300,0,0,0,0,0 --goal 0,0,0,0,0,0 --constraint free", 2, "start[0] = 1e+300"),
    ("plan --start 0,0,0,0,0,0 --goal-pose 1,2,3 --constraint free", 2, "--goal-pose '1,2,3'"),
    ("plan --start 0,0,0,0,0,0 --goal-pose 0,0,0,0,0,nan --constraint free", 2, "--goal-pose"),
    ("plan --start 0 --goal 0 --goal-free yaw --constraint free", 2, "--goal-pose"),
    ("plan {ends} --constraint no.yaml", 2, "no.yaml"),
    ("plan {ends} --constraint free --planner nowhere", 2, "nowhere"),
    ("plan {ends} --constraint free --scene no.yaml", 2, "no.yaml"),
    ("plan {ends} --constraint free --attach /dev/zero", 2, "/dev/zero"),
    ("plan {ends} --constraint free --moveit-scene /dev/null", 2, "/dev/null"),
    ("plan --moveit-request no.yaml", 2, "no.yaml"),
    ("plan {ends} --constraint free --velocity-scale nan", 2, "velocity_scale = nan"),
    ("plan {ends} --constraint free --acceleration-scale 2", 2, "acceleration_scale = 2"),
    ("plan {ends} --constraint free --budget -1", 2, "budget_s = -1"),
    ("plan {ends} --constraint free --budget soon", 2, "--budget"),
    ("plan {ends} --constraint free --method magic", 2, "'magic'"),
    ("plan {ends} --constraint free --urdf no.urdf", 2, "no.urdf"),
    ("plan {ends} --constraint free --urdf no.urdf --tool-link hand", 2, "no.urdf"),
    ("plan {ends} --constraint free --urdf params.yaml --tool-link hand", 2, "params.yaml"),
    ("plan {ends} --constraint free --tool-link hand", 2, "--urdf"),
    ("plan {ends} --constraint free --hold elbow=x", 2, "--urdf"),
    ("plan {ends} --constraint free --speed 5", 2, "--speed"),
    ("check no.csv", 2, "no.csv"),
    ("check /dev/zero", 2, "/dev/zero"),
    ("check params.yaml", 2, "params.yaml"),
    ("check pipe.csv", 2, "pipe.csv"),
    ("ik --pose 1,2", 2, "--pose '1,2'"),
    ("ik --pose inf,0,0,0,0,0", 2, "--pose"),
    ("ik --pose 1e300,0,0,0,0,0", 2, "1e+300"),
    ("robot no.urdf", 2, "no.urdf"),
    ("robot params.yaml", 2, "params.yaml"),
    ("robot kuka_iiwa/model.urdf --tool-link hand", 2, "'hand'"),
    ("robot kuka_iiwa/model.urdf --tool-link lbr_iiwa_link_7 --hold a", 2, "--hold 'a'"),
    ("robot kuka_iiwa/model.urdf --tool-link lbr_iiwa_link_7 --srdf /dev/zero", 2, "/dev/zero"),
    ("identify no.csv", 2, "no.csv"),
    ("identify params.yaml", 2, "params.yaml"),
    ("identify params.yaml --loosely nan", 2, "--loosely nan"),
    ("identify params.yaml --where-shown", 2, "--out"),
    ("identify params.yaml --out a.yaml --record ./a.yaml", 2, "one file can't hold"),
    ("params no.yaml", 2, "no.yaml"),
    ("params /dev/zero", 2, "/dev/zero"),
    ("params broken.yaml", 2, "broken.yaml"),
    ("constraints --planner nowhere", 2, "nowhere"),
    ("replay nowhere.rrd", 2, "nowhere.rrd"),
    ("warmup --jobs 0", 2, "--jobs"),
    ("bench --planner magic", 2, "'magic'"),
    ("bench --constraint magic", 2, "'magic'"),
    ("bench --queries 0", 2, "--queries"),
    ("bench --problems no.json", 2, "no.json"),
    ("bench --problems params.yaml --time-limit nan", 2, "--time-limit nan"),
    ("magic", 2, "magic"),
    ("plan {ends} --constraint free --planner s3://bucket/x", 1, "s3://bucket/x: "),
    (f"MLFLOW_TRACKING_URI=http://user:secret@127.0.0.1:9 {MODEL}", 1, "127.0.0.1:9"),
    (f"MLFLOW_TRACKING_URI=sqlite:////proc/nowhere/runs.db {MODEL}", 1, "/proc/nowhere/runs.db"),
    (f"MLFLOW_TRACKING_URI=sqlite:///params.yaml {MODEL}", 1, "params.yaml"),
    (f"MLFLOW_TRACKING_URI=nonsense://runs {MODEL}", 1, "nonsense://runs"),
]
"""Words, with variables of the environment before them, the exit code, and what the line says."""


@pytest.fixture(scope="module")
def tally(effort: Effort, request: pytest.FixtureRequest) -> Iterator[Tally]:
    """Of all cases of this file, counted at its end if no test has failed."""
    found, kinds = Tally(), ("cases", "tracebacks", "accepted", "hung", "unnamed")
    with counted_at_end("bad_input", effort, request.session, lambda: found.row(*kinds)):
        yield found


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipe that nothing comes from is not waited for."""
    monkeypatch.setattr(text_files, "PATIENCE_S", 0.05)


def all_refused(tally: Tally, cases: Iterator[Bad]) -> int:
    """How many were asked; what is not refused as it must be fails the test."""
    before = tally.cases
    wrong = len(tally.wrong)
    for case in cases:
        tally.judge(case)
    assert not tally.wrong[wrong:], "\n".join(tally.wrong[wrong:][:20])
    return tally.cases - before


def test_good_parameters_are_good() -> None:
    """What the next test makes bad."""
    assert params_of(read_yaml(ROOT / "params.yaml"), Path("params.yaml")).labels.seed == 1


@pytest.mark.parametrize("top", TOP)
def test_every_entry_of_the_parameters(top: str, tally: Tally, effort: Effort) -> None:
    cases = list(bad_params.cases(top))
    some = cases[:: SOME if effort.name == "quick" else 1]
    assert all_refused(tally, iter(some)) > 1


def test_what_only_the_files_behind_the_parameters_show(
    tally: Tally, effort: Effort, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some of them where there is little time: tests/test_params.py has them as well."""
    monkeypatch.chdir(tmp_path)
    cases = list(bad_params.gate_cases())
    assert len(cases) >= 18
    all_refused(tally, iter(cases[:: 3 if effort.name == "quick" else 1]))


@pytest.mark.parametrize("of", [bad_calls.cases, bad_files.cases], ids=("calls", "files"))
def test_calls_and_files(
    of: Callable, tally: Tally, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planner's scene is as it was after each."""
    monkeypatch.chdir(tmp_path)
    planner = packaged_planner()
    before = planner.scene.now
    arguments = (planner, tmp_path) if of is bad_files.cases else (planner,)
    asked = all_refused(tally, of(*arguments))
    assert asked > 300
    assert planner.scene.now is before


@pytest.mark.parametrize(("words", "code", "said"), SHELL, ids=[words for words, *_ in SHELL])
def test_the_shell(
    words: str,
    code: int,
    said: str,
    tally: Tally,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One line, and the exit code of its kind."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_bytes((ROOT / "params.yaml").read_bytes())
    (tmp_path / "broken.yaml").write_text("robot: [")
    os.mkfifo(tmp_path / "pipe.csv")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")  # or keys would be asked for
    named = re.match(r"(?:(\w+)=(\S+) )?(.*)", words)
    assert named is not None
    name, value, words = named.groups()
    if name:
        monkeypatch.setenv(name, value)
    given = [part for word in words.split() for part in (ENDS if word == "{ends}" else (word,))]
    monkeypatch.setattr(sys, "argv", ["geodesics", *given])
    tally.cases += 1
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main()
    except Exception:
        tally.tracebacks += 1
        raise
    told = capfd.readouterr()
    line = told.err.strip().splitlines()[-1]
    assert ended.value.code == code, told.err
    assert said in line
    assert "Traceback" not in told.err
    assert "secret" not in told.err
    assert not told.out


def test_a_pipe_that_is_written_to_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However late, and in parts; a file is read to its end, and no further than it may be."""
    monkeypatch.setattr(text_files, "PATIENCE_S", 30.0)
    os.mkfifo(tmp_path / "pipe")
    content = b"0123456789" * 100_000
    command = "sleep 0.2; head -c 500000 whole; sleep 0.2; tail -c 500000 whole"
    (tmp_path / "whole").write_bytes(content)
    with subprocess.Popen(f"({command}) > pipe", shell=True, cwd=tmp_path):
        assert text_files.read_content(tmp_path / "pipe") == content
    assert text_files.read_content(tmp_path / "whole", most=len(content)) == content
    with pytest.raises(OSError, match="longer than"):
        text_files.read_content(tmp_path / "whole", most=len(content) - 1)
