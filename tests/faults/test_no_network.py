"""Nothing is asked outside this machine, and servers listen on it alone."""

import ast
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from constraint_geodesics.tracking.store import ui_command
from tests.faults.effort import Effort, counting

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [*(ROOT / "src").rglob("*.py"), *(ROOT / "stages").rglob("*.py")]
LOADERS = (
    *("joblib.load", "pandas.read_pickle", "yaml.load"),
    *("yaml.full_load", "yaml.unsafe_load", "eval", "exec", "os.system", "os.popen"),
    *("ElementTree.parse", "ElementTree.fromstring", "ElementTree.iterparse"),
)
"""Calls that run, or grow without end on, what a file says."""
PICKLERS = ("pickle", "_pickle", "cloudpickle", "dill", "shelve", "marshal")
"""Modules that nothing is called of: all that they read may run code."""
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
        "import lightning, stable_baselines3, rerun, dask.distributed\n"
        "from constraint_geodesics.tracking.store import mlflow_module\n"
        "mlflow_module().MlflowClient('sqlite:///mlflow.db').create_experiment('own')",
    ],
}
TELLING = [
    *(sys.executable, "-c"),
    "import time, mlflow\n"
    "mlflow.MlflowClient('sqlite:///mlflow.db').create_experiment('own')\n"
    "time.sleep(3)",
]
"""MLflow tells its makers of its use where this project does not keep it from that."""
SILENT = (
    *("PYTEST_CURRENT_TEST", "CI", "GITHUB_ACTIONS", "GITLAB_CI", "JENKINS_URL"),
    *("DVC_TEST", "DVC_NO_ANALYTICS", "DO_NOT_TRACK", "MLFLOW_DISABLE_TELEMETRY"),
)
"""Of the environment: where they are, those tools tell nothing of themselves."""


LONG = ("learning",)
QUICK = [name for name in COMMANDS if name not in LONG]


def calls(text: str) -> list[ast.Call]:
    return [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Call)]


def imported(text: str) -> dict[str, str]:
    """What the names stand for that are imported anywhere in a source."""
    found = {}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            found |= {own.asname or own.name: f"{node.module}.{own.name}" for own in node.names}
        elif isinstance(node, ast.Import):
            found |= {own.asname or own.name: own.name for own in node.names}
    return found


def run_by(text: str) -> list[str]:
    """Modules and calls of a source that run what a file says, under whatever name."""
    names = imported(text)
    found = [own for own in names.values() if own.partition(".")[0] in PICKLERS]
    for call in calls(text):
        first, dot, rest = ast.unparse(call.func).partition(".")
        name = names.get(first, first) + dot + rest
        if name in LOADERS or name.endswith(tuple(f".{own}" for own in LOADERS if "." in own)):
            found.append(name)
    return found


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "from pickle import Unpickler as U",
        "import cloudpickle as c",
        "def f():\n    from dill import load",
        "import joblib\njoblib.load('file')",
        "from joblib import load as get\nget('file')",
        "import pandas as pd\npd.read_pickle('file')",
        "from xml.etree import ElementTree\nElementTree.parse('file')",
        "import xml.etree.ElementTree as ET\nET.fromstring('')",
        "eval('1')",
    ],
)
def test_what_runs_a_file_is_seen(text: str) -> None:
    assert run_by(text)


def test_no_source_calls_what_runs_a_file() -> None:
    found = {str(file): run_by(file.read_text()) for file in SOURCES}
    assert not {file: own for file, own in found.items() if own}
    made = [ast.unparse(call) for file in SOURCES for call in calls(file.read_text())]
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


@pytest.mark.long
def test_mlflow_is_seen_where_it_is_not_told_to_be_silent(tmp_path: Path) -> None:
    """Or that it asks nothing would be the tests' doing, not the project's."""
    assert _guarded(TELLING, tmp_path)[1]


@pytest.mark.long
def test_dvc_tells_nobody_of_its_use(tmp_path: Path, effort: Effort) -> None:
    """It does where it has none of the project's settings, by a process that our guard does not
    see.
    """
    with counting("nothing_asked_dvc", effort) as row, ExitStack() as opened:
        makers = {}
        for name, settings in (("with", (ROOT / ".dvc" / "config").read_text()), ("without", "")):
            makers[name] = opened.enter_context(socket.socket())
            makers[name].bind(("127.0.0.1", 0))
            makers[name].listen()
            folder = tmp_path / name
            (folder / ".dvc").mkdir(parents=True)
            (folder / ".dvc" / "config").write_text(settings)
            (folder / "dvc.yaml").write_text("stages: {own: {cmd: echo}}")
            there = f"http://127.0.0.1:{makers[name].getsockname()[1]}"
            subprocess.run(
                ["bash", "-ec", "git init -q && dvc repro -q"],
                cwd=folder,
                env={**_environment(tmp_path), "DVC_ANALYTICS_ENDPOINT": there},
                check=True,
                timeout=120,
            )
        makers["without"].settimeout(60.0)
        told, _ = makers["without"].accept()
        with told, pytest.raises(TimeoutError):
            makers["with"].settimeout(5.0)
            makers["with"].accept()
        row |= {"commands": 1, "asked": 0}


def _environment(tmp_path: Path) -> dict[str, str]:
    """As a user's: tools that are silent in tests are not."""
    found = {name: value for name, value in os.environ.items() if name not in SILENT}
    path = os.pathsep.join([str(Path(sys.executable).parent), found["PATH"]])
    return found | {"HOME": str(tmp_path), "PATH": path}


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
    environment = {**_environment(tmp_path), "PYTHONPATH": path, "ASKED": str(asked)}
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
