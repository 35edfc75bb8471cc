"""The command `demo`: lines, recording, and the viewer while it happens."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from constraint_geodesics import bundle
from constraint_geodesics.recording.recording import read_recording
from tests.recording.test_recording import wait_for
from tests.test_cli_plan import called

PACKAGED = ("--planner", str(bundle.PACKAGED))
ANSWERED = re.compile(
    r"^\d+\.\d\d s: (at rest|((box|sphere) \d seen at 0\.\d\d m(, )?)+): .+ in \d+ ms$"
)


@pytest.fixture
def demo(monkeypatch, capfd, tmp_path):
    """The command in this process, in an empty folder, without a display."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, ["demo", *words])

    return start


def test_without_a_display_it_is_recorded(demo) -> None:
    code, out, err = demo(*PACKAGED)
    assert code == 0, err
    first, *answers, end, written = out.splitlines()
    assert re.match(r"level_cup: a path of \d\.\d\d s, \d unknown obstacles? .* from 0\.3 m", first)
    assert all(map(ANSWERED.match, answers)), answers
    assert " seen at " in answers[0]
    assert re.match(r"\d+\.\d\d s: (goal reached|touched|no path)", end)
    assert "no display" in written
    assert "geodesics replay demo.rrd" in written
    summary = read_recording(Path("demo.rrd"))
    assert summary.about.constraint == "level_cup"
    assert "/attached/cup" in summary.entity_paths


def test_it_is_written_where_it_is_wanted(demo) -> None:
    words = ("--constraint", "free", "--seed", "1", "--out", "other/free.rrd", *PACKAGED)
    code, out, err = demo(*words)
    assert code == 0, err
    assert "no display" not in out
    assert read_recording(Path("other/free.rrd")).about.constraint == "free"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--constraint", "levl_cup"), "there is no constraint 'levl_cup'"),
        (("--out", "a.rrd", "--web"), "--out opens no viewer"),
        (("--planner", "nowhere"), "nowhere"),
    ],
)
def test_bad_input_is_one_line(demo, words, line) -> None:
    given = words if "--planner" in words else (*words, *PACKAGED)
    code, out, err = demo(*given)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert line in err


def test_help_says_what_it_does(demo) -> None:
    code, out, _ = demo("--help")
    assert code == 0
    for word in ("live in Rerun's viewer", "--constraint", "--seed", "--out", "--web"):
        assert word in " ".join(out.split())


@pytest.mark.timeout(300)
def test_it_is_shown_live_until_it_is_stopped(tmp_path) -> None:
    command = [sys.executable, "-m", "constraint_geodesics.cli", "demo", "--web", *PACKAGED]
    shown = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env=dict(os.environ),
    )
    try:
        assert shown.stdout is not None
        lines = []
        for line in shown.stdout:
            lines.append(line.strip())
            if re.match(r"\d+\.\d\d s: (goal reached|touched|no path)", line):
                break
        pages = [line for line in lines if line.startswith("http://127.0.0.1:")]
        assert pages, lines
        answers = [line for line in lines[:-1] if re.match(r"\d+\.\d\d s: ", line)]
        assert answers, lines
        assert all(map(ANSWERED.match, answers)), answers
        page = pages[0].split("?")[0]
        assert b"rerun" in wait_for(page).lower()
        assert shown.poll() is None  # the viewer stays
        shown.terminate()
        assert shown.wait(20) == 128 + signal.SIGTERM
        with pytest.raises(OSError, match="refused"):  # and goes with the command
            wait_for(page, seconds=0.0)
    finally:
        if shown.poll() is None:
            os.killpg(shown.pid, signal.SIGKILL)
            shown.wait()
    assert not list(tmp_path.iterdir())
