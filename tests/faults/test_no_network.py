"""Nothing is asked outside this machine, and servers listen on it alone."""

import ast
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from constraint_geodesics.tracking.store import ui_command
from tests.faults.effort import Effort, counting

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [*(ROOT / "src").rglob("*.py"), *(ROOT / "stages").rglob("*.py")]
LOADERS = (
    *("pickle.load", "pickle.loads", "joblib.load", "pd.read_pickle", "dill.load", "yaml.load"),
    *("yaml.full_load", "yaml.unsafe_load", "eval", "exec", "os.system", "os.popen"),
    *("ElementTree.parse", "ElementTree.fromstring", "ElementTree.iterparse", "shelve.open"),
)
"""Calls that run, or grow without end on, what a file says."""
GUARD = """
import os, socket, sys
_ALLOWED = ("127.", "::1", "localhost")
def _look(event, arguments):
    if event == "socket.connect" and isinstance(arguments[1], tuple):
        host = str(arguments[1][0])
    elif event == "socket.getaddrinfo":
        host = str(arguments[0])
    elif event == "socket.gethostbyname":
        host = str(arguments[0])
    else:
        return
    own = ("None", "", "0.0.0.0", "::", socket.gethostname())
    if host not in own and not host.startswith(_ALLOWED):
        with open(os.environ["ASKED"], "a") as asked:
            asked.write(f"{event} {host} {sys.argv[:3]}\\n")
        raise OSError("the network is not to be used")
sys.addaudithook(_look)
"""
"""As sitecustomize, in every Python that is started: calls to other machines are written down."""
START = "1.329923 -0.584036 -3.766650 -2.008429 0.728803 -2.581396"
GOAL = "1.071549 -0.217480 -1.682647 -2.906655 -0.337949 1.348704"
CLI = (sys.executable, "-m", "constraint_geodesics.cli")
ASKING = (sys.executable, "-c", "import socket; socket.create_connection(('192.0.2.1', 9))")
COMMANDS = {
    "plan": [*CLI, "plan", "--constraint", "level_cup", f"--start={START}", f"--goal={GOAL}"],
    "params": [*CLI, "params", str(ROOT / "params.yaml")],
    "doctor": [*CLI, "doctor"],
    "learning": [
        *(sys.executable, "-c"),
        "import lightning, stable_baselines3, rerun, dask.distributed, dvc.repo\n"
        "from constraint_geodesics.tracking.store import mlflow_module\n"
        "mlflow_module().MlflowClient('sqlite:///mlflow.db').create_experiment('own')",
    ],
}


LONG = ("learning",)
QUICK = [name for name in COMMANDS if name not in LONG]


def calls(file: Path) -> list[ast.Call]:
    return [n for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.Call)]


def test_no_source_calls_what_runs_a_file() -> None:
    found = {ast.unparse(call.func): call for file in SOURCES for call in calls(file)}
    assert not found.keys() & {*LOADERS}
    made = [ast.unparse(call) for file in SOURCES for call in calls(file)]
    assert not [call for call in made if re.search(r"\bshell=True", call)]
    read = [call for call in made if re.match(r"(torch|np|numpy)\.load\(", call)]
    assert len(read) >= 3
    for call in read:
        assert "weights_only=True" in call or "allow_pickle=False" in call, call


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(n, marks=pytest.mark.long) for n in LONG)])
def test_nothing_is_asked_outside_this_machine(name: str, tmp_path: Path, effort: Effort) -> None:
    with counting(f"nothing_asked_{name}", effort) as row:
        done, asked = _guarded(COMMANDS[name], tmp_path)
        row["commands"] = 1
        row["asked"] = len(asked)
        assert not asked, asked
        assert "Traceback" not in done.stderr, done.stderr[-2000:]
        if name != "doctor":  # which finds no checkout there
            assert done.returncode == 0, done.stderr[-2000:]


def test_what_is_asked_outside_this_machine_is_seen(tmp_path: Path) -> None:
    """Or the test before would show nothing."""
    assert "192.0.2.1" in "".join(_guarded(ASKING, tmp_path)[1])


def _guarded(
    command: Sequence[str], tmp_path: Path
) -> tuple["subprocess.CompletedProcess[str]", list[str]]:
    """A command that ran in a network without anything in it, where there can be one; and a line
    of each call to another machine.
    """
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(GUARD)
    (tmp_path / "work").mkdir()
    asked = tmp_path / "asked"
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT / "src")])
    environment = {**os.environ, "PYTHONPATH": path, "ASKED": str(asked)}
    alone = ["unshare", "-rn"] if _can_unshare() else []
    done = subprocess.run(
        [*alone, *command],
        cwd=tmp_path / "work",
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done, asked.read_text().splitlines() if asked.exists() else []


def _can_unshare() -> bool:
    """Whether a process can be given a network without anything in it."""
    found = shutil.which("unshare")
    return bool(found) and not subprocess.run([str(found), "-rn", "true"], check=False).returncode


def test_the_dashboard_listens_on_this_machine_alone_and_reports_nothing(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").touch()
    command = " ".join(ui_command(tmp_path, 5000))
    assert "--host 127.0.0.1" in command
    assert "MLFLOW_DISABLE_TELEMETRY=true" in command


def test_pages_and_settings_name_this_machine_alone() -> None:
    assert "analytics = false" in (ROOT / ".dvc" / "config").read_text()
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        assert not re.search(r"(--host|--bind)[ =]0\.0\.0\.0", page.read_text()), page


def ui(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*CLI, "ui", *options],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_dashboard_of_nothing_is_refused_and_makes_no_database(tmp_path: Path) -> None:
    done = ui(tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "dvc repro" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_taken_port_is_one_line_with_a_free_one(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").touch()
    (tmp_path / "mlflow.db").touch()
    (tmp_path / "below").mkdir()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = ui(tmp_path / "below", f"--port={port}")
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    named = re.search(r"--port (\d+)", done.stderr)
    assert named is not None
    with socket.socket() as free:
        free.bind(("127.0.0.1", int(named[1])))
