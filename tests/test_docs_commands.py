"""Every command that README and the documentation print is run: here, or by the test that is named
here.
"""

import gzip
import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from constraint_geodesics import bundle
from tests.benchmark.problem_fixtures import moveit_pair
from tests.identification.hidden import demonstrations
from tests.planner_fixtures import packaged_planner
from tests.test_cli_plan import called
from tests.test_docs import ROOT, words_of

TEXTS = {"README.md": ROOT / "README.md"} | {
    page.name: page for page in sorted((ROOT / "docs").glob("*.md"))
}
HERE = "here"
"""As the page prints it, in a new folder."""
MAKE = "make -n"
"""What `make` would do is printed by make itself; what a target runs is a command of ours with a
test of its own.
"""
EXPERIMENT = "tests/end_to_end/test_experiment.py"
REGISTRY = "tests/tracking/test_registry.py"
SERVERS = "tests/faults/test_servers.py"
COVERED: dict[str, str | tuple[str, str]] = {
    "geodesics constraints": HERE,
    "geodesics warmup": HERE,
    "geodesics plan": HERE,
    "geodesics check": HERE,
    "geodesics params": HERE,
    "geodesics doctor": HERE,
    "geodesics robot": HERE,
    "geodesics ik": HERE,
    "geodesics identify": HERE,
    "geodesics package": ("tests/test_bundle.py", "cli.package()"),
    "geodesics recover": ("tests/faults/test_kills.py", '"constraint_geodesics.cli", "recover"'),
    "geodesics results": HERE,
    "geodesics results --experiments": (
        "tests/end_to_end/test_sweep.py",
        '"results", "--experiments"',
    ),
    "geodesics replay": HERE,
    "geodesics replay FILE": ("tests/recording/test_recording.py", "open_recordings([Path("),
    "geodesics demo": ("tests/test_cli_demo.py", '"demo"'),
    "geodesics bench": ("tests/test_cli_json.py", '"bench"'),
    "geodesics bench --problems": HERE,
    "geodesics serve": (REGISTRY, '"constraint_geodesics.cli", *serve.split()'),
    "geodesics ui": ("tests/tracking/test_dashboard.py", '"ui", "--open"'),
    "make": MAKE,
    "dvc checkout": (EXPERIMENT, '"dvc", "checkout"'),
    "dvc exp apply": (EXPERIMENT, '"dvc", "exp", "apply"'),
    "dvc exp diff": (EXPERIMENT, '"dvc", "exp", "diff"'),
    "dvc exp run": (EXPERIMENT, '"dvc", "exp", "run"'),
    "dvc exp show": (EXPERIMENT, '"dvc", "exp", "show"'),
    "dvc metrics show": (EXPERIMENT, '"dvc", "metrics", "show"'),
    "dvc metrics diff": (EXPERIMENT, '"dvc", "metrics", "diff"'),
    "dvc params diff": (EXPERIMENT, '"dvc", "params", "diff"'),
    "dvc plots diff": (EXPERIMENT, '"dvc", "plots", "diff"'),
    "dvc repro": ("tests/end_to_end/smoke.py", '"repro"'),
    "dvc status": (EXPERIMENT, '"dvc", "status"'),
    "git commit": (EXPERIMENT, '"git", "commit"'),
    "git restore": (EXPERIMENT, '"git", "restore"'),
    "git status": (EXPERIMENT, '"git", "status"'),
    "mlflow server": (SERVERS, '"mlflow", "server"'),
    "dvc remote": (EXPERIMENT, '"dvc", "remote"'),
    "dvc push": (EXPERIMENT, '"dvc", "push"'),
    "dvc pull": (EXPERIMENT, '"dvc", "pull"'),
    "dask": ("tests/pipeline/cluster.py", '"-m", "dask"'),
    "curl": (REGISTRY, "ask(address, body)"),
    "source": ("tests/installation/test_doctor.py", "source .venv/bin/activate"),
}
"""Where each kind of command runs: here, or in the file that is named, by what is called there."""
ELLIPSIS = {
    "1.33 …": "1.329923 -0.584036 -3.766650 -2.008429 0.728803 -2.581396",
    "1.07 …": "1.071549 -0.217480 -1.682647 -2.906655 -0.337949 1.348704",
}
"""Configurations that README shortens."""


def kind_of(words: list[str]) -> str:
    """The name of a command in COVERED."""
    if words[:2] == ["geodesics", "replay"] and words[2:]:
        return "geodesics replay FILE"
    if words[2:3] in (["--experiments"], ["--problems"]):
        return " ".join(words[:3])
    length = {
        "geodesics": 2,
        "dvc": 3 if words[1:2] in (["exp"], ["metrics"], ["params"], ["plots"]) else 2,
    }
    return " ".join(words[: length.get(words[0], 2 if words[0] in ("git", "mlflow") else 1)])


def printed(name: str) -> list[list[str]]:
    """The commands of a page's shell blocks, in order."""
    blocks = re.findall(r"^```bash\n(.*?)^```", TEXTS[name].read_text(), re.S | re.M)
    return [words for block in blocks for words in words_of(block)]


def in_text(name: str) -> list[list[str]]:
    """Whole commands between backticks in a page's text."""
    prose = re.sub(r"^```.*?^```", "", TEXTS[name].read_text(), flags=re.S | re.M)
    code = re.findall(r"`((?:geodesics|make|dvc) [^`…]+)`", prose)
    return [words for text in code for words in words_of(" ".join(text.split()))]


EVERY = {name: printed(name) for name in TEXTS}


def test_every_command_is_run_somewhere() -> None:
    kinds = {kind_of(words) for commands in EVERY.values() for words in commands}
    assert kinds <= set(COVERED), "say in COVERED where this one is run"
    for kind, where in COVERED.items():
        if isinstance(where, tuple):
            assert where[1] in (ROOT / where[0]).read_text(), kind


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a newcomer's checkout has of the files that commands read, a first path among them; a
    planner gets little time for a problem of others.
    """
    folder = tmp_path_factory.mktemp("checkout")
    params = (ROOT / "params.yaml").read_text()
    (folder / "params.yaml").write_text(
        re.sub(r"^(  (held_)?limit_s:).*", r"\1 2.0", params, flags=re.M)
    )
    shutil.copytree(ROOT / "docs" / "examples", folder / "docs" / "examples")
    (folder / "reports").mkdir()
    for name in ("table.md", "table.csv"):
        shutil.copy(ROOT / "reports" / name, folder / "reports")
    start, goal = ([float(word) for word in text.split()] for text in ELLIPSIS.values())
    path = packaged_planner().plan(start, goal, "level_cup")
    path.save(folder / "path.csv")
    path.record(folder / "first_path" / "path.rrd")
    shown = demonstrations("cup", packaged_planner().robot, 10)
    numbers = np.repeat(np.arange(10.0), 60)[:, None]
    rows = np.hstack([numbers, np.concatenate(shown)])
    np.savetxt(folder / "demos.csv", rows, delimiter=",")
    names = list(packaged_planner().robot.joint_names)
    joints = [{"joint_name": n, "position": x} for n, x in zip(names, goal, strict=True)]
    state = {"robot_state": {"joint_state": {"name": names, "position": start}}}
    (folder / "moveit_scene.yaml").write_text(yaml.safe_dump(state))
    request = {"goal_constraints": [{"joint_constraints": joints}]}
    (folder / "moveit_request.yaml").write_text(yaml.safe_dump(request))
    (example,) = re.findall(r"^```json\n(.*?)^```", TEXTS["problems.md"].read_text(), re.S | re.M)
    (folder / "panda.json.gz").write_bytes(gzip.compress(example.encode()))
    moveit_pair(folder / "folder_of_moveit", "0001")
    return folder


RUN = [
    pytest.param(words, id=f"{name} {' '.join(words)[:40]}")
    for name, commands in EVERY.items()
    for words in commands
    if COVERED.get(kind_of(words)) == HERE
]


@pytest.mark.parametrize("words", RUN)
def test_a_command_of_ours_does_what_its_page_says(words, folder, monkeypatch, capfd) -> None:
    monkeypatch.chdir(folder)
    given = [ELLIPSIS.get(word, word) for word in words[1:]]
    code, out, err = called(monkeypatch, capfd, given)
    assert "Traceback" not in err
    if words[1] == "doctor":  # a folder without an environment has what to mend
        assert code in (0, 1), err
        assert "robot" in out
        return
    assert code == 0, err
    for option in ("--out", "--record", "--picture"):
        if option in given:
            assert (folder / given[given.index(option) + 1]).stat().st_size > 500
    if words[1] == "params":
        assert out.endswith("params.yaml: ok\n")
        return
    if words[1] == "ik":
        configurations = [[float(word) for word in line.split()] for line in out.splitlines()]
        assert {len(own) for own in configurations} == {7}, "Panda's joints"
        return
    expected = {
        "warmup": "compiled",
        "constraints": "level_cup",
        "plan": "solved",
        "check": "valid",
        "robot": "carried by 7 joints",
        "identify": "on a sphere" if "docs/examples/wipe.csv" in given else "direction (0, 0, 1)",
        "results": "planner",
        "replay": "path.rrd",
        "bench": "rows: .geodesics/bench/problems.csv.gz",
    }
    assert expected[words[1]] in out


TARGETS = sorted(
    {
        tuple(words)
        for name in TEXTS
        for words in [*EVERY[name], *in_text(name)]
        if words[0] == "make"
    }
)


@pytest.mark.parametrize("words", TARGETS, ids=" ".join)
def test_make_knows_what_to_do(words) -> None:
    done = subprocess.run(
        [words[0], "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_every_target_of_make_runs_what_is_there() -> None:
    """Scripts and commands that the Makefile's targets run."""
    text = (ROOT / "Makefile").read_text()
    for script in re.findall(r"python (\S+\.py)", text):
        assert (ROOT / script).is_file(), script
    commands = set(re.findall(r"^\t(?:@)?geodesics (\w+)", text, re.M))
    assert commands <= {kind.split()[1] for kind in COVERED if kind.startswith("geodesics")}
    assert commands


# The shell


def complete(line: str, folder: Path, count: int = 3) -> list[str]:
    """What bash proposes at the end of a line; words are separated by tabs."""
    program = (
        'source "$2"; IFS=$\'\\t\' read -r -a COMP_WORDS <<< "$1"; '
        "[[ $1 == *$'\\t' ]] && COMP_WORDS+=(''); "
        "COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _geodesics_completion geodesics; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT / "src")}
    command = ["bash", "--norc", "-c", program, "bash", line, str(the_shell_s_script())]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert done.returncode == 0
    return [line for line in done.stdout.splitlines() if line]


@cache
def the_shell_s_script() -> Path:
    """What `--install-completion` would put into the shell's start-up."""
    program = (
        "import sys; sys.argv = ['geodesics']; from constraint_geodesics import cli; cli.main()"
    )
    environment = os.environ | {"_GEODESICS_COMPLETE": "source_bash"}
    command = [sys.executable, "-c", program]
    script = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout
    file = Path(tempfile.mkdtemp()) / "geodesics.bash"
    file.write_text(script)
    return file


CASES = {
    "geodesics\tpla": ["plan"],
    "geodesics\tplan\t--constraint\tlevel": ["level_cup", "level_cup_relaxed"],
    "geodesics\tcheck\tpath.csv\t--constraint\ttool": ["tool_down"],
    "geodesics\tplan\t--urdf\tarm.urdf\t--constraint\t": ["free", "level"],
    "geodesics\tbench\t--constraint\tsl": ["slide"],
    "geodesics\tbench\t--constraint\twa": ["wall"],  # unseen
    "geodesics\tbench\t--planner\tstraight": ["straight\\ +\\ band", "straight\\ latent\\ line"],
    "geodesics\tbench\t--planner\tstraight\\ l": ["straight\\ latent\\ line"],
    "geodesics\treplay\tfirst": ["first_path/path.rrd"],
    "geodesics\treplay\tother/": ["other/a\\ b.rrd"],
}


@pytest.mark.parametrize(
    ("line", "proposed"), CASES.items(), ids=[line.replace("\t", " ") for line in CASES]
)
def test_bash_completes_names(line, proposed, folder) -> None:
    (folder / "other").mkdir(exist_ok=True)
    (folder / "other" / "a b.rrd").touch()
    assert complete(line, folder) == proposed


def test_a_planner_s_own_constraints_are_proposed(folder, tmp_path) -> None:
    card = (bundle.PACKAGED / "planner.json").read_text().replace('"tool_down"', '"tool_up"')
    (tmp_path / "planner.json").write_text(card)
    line = f"geodesics\tplan\t--planner\t{tmp_path}\t--constraint\ttool"
    assert complete(line, folder) == ["tool_up"]


def test_names_are_proposed_where_files_are_missing_or_broken(tmp_path) -> None:
    assert complete("geodesics\tplan\t--constraint\ttool", tmp_path) == ["tool_down"], (
        "those of the package"
    )
    assert complete("geodesics\tbench\t--planner\t", tmp_path) == []
    typed = ("benchmark: [", "benchmark: [planners]", "benchmark: {planners: [birrt]}", "5")
    for text in typed:
        (tmp_path / "params.yaml").write_text(text)
        assert complete("geodesics\tbench\t--planner\t", tmp_path) == []
    (tmp_path / "params.yaml").write_text("benchmark: {planners: {birrt: , prm: {kind: prm}}}")
    assert complete("geodesics\tbench\t--planner\t", tmp_path) == ["birrt", "prm"]


def test_completion_loads_nothing_heavy(folder) -> None:
    program = (
        "import os, sys; os.environ.update(_GEODESICS_COMPLETE='complete_bash', COMP_CWORD='3',"
        " COMP_WORDS='geodesics\\nplan\\n--constraint\\nlevel'); sys.argv = ['geodesics']\n"
        "from constraint_geodesics import cli\n"
        "try:\n    cli.main()\n"
        "finally:\n    print(sorted({'torch', 'numpy', 'mlflow', 'pandas', 'rerun', 'dvc', "
        "'rich', 'click', 'ruamel'} & "
        "set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr
    assert "level_cup" in done.stdout


def test_completion_installs_itself(tmp_path) -> None:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"HOME": str(tmp_path), "PATH": path, "SHELL": "/bin/bash"}
    command = ["bash", "--norc", "-c", "geodesics --install-completion; echo done"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "completion installed" in done.stdout, done.stdout + done.stderr
    shown = ["bash", "--norc", "-c", "source ~/.bashrc; complete -p geodesics"]
    assert (
        "_geodesics_completion"
        in subprocess.run(shown, env=environment, capture_output=True, text=True, check=True).stdout
    )
