"""The commands `plan`, `check` and `constraints`: exit codes, one line for an error, strict JSON,
files.
"""

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics import bundle, cli, cli_planning, progress
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.recording.recording import read_recording
from constraint_geodesics.trajectory import read_trajectory
from tests.planner_fixtures import NAMES, nodes_of, packaged_bundle, packaged_planner, pairs_of

COMMAND = str(Path(sys.executable).parent / "geodesics")
TOUCHES_ITSELF = "0 2.0 -0.2 0 0.3 0.1"
ZEROS = "0 0 0 0 0 0"


def called(monkeypatch, capfd, words: Sequence[str]) -> tuple[int, str, str]:
    """The command in this process: its exit code and what it wrote."""
    monkeypatch.setattr(sys, "argv", ["geodesics", *words])
    monkeypatch.setattr(progress, "LINE_AFTER_S", 600.0)  # a machine with other work is slow
    capfd.readouterr()
    code: object = 0
    try:
        cli.main()
    except SystemExit as stop:
        code = stop.code
    out, err = capfd.readouterr()
    assert isinstance(code, int | None)
    return code or 0, out, err


@pytest.fixture
def command(monkeypatch, capfd):
    """The command in this process, the planner's folder given unless it is there."""

    def run(*words: str) -> tuple[int, str, str]:
        given = () if "--planner" in words else ("--planner", str(bundle.PACKAGED))
        return called(monkeypatch, capfd, [*words, *given])

    return run


def words_of(q: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in q)


def asked(start: str, goal: str, constraint: str = "level_cup") -> tuple[str, ...]:
    return ("plan", f"--start={start}", f"--goal={goal}", "--constraint", constraint)


def strict(text: str) -> dict:
    """JSON as other languages read it: no NaN, no Infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def error_line(err: str) -> str:
    """The one line that says what is wrong, after the one that names the planner."""
    assert "Traceback" not in err
    lines = [line for line in said_aloud(err) if not line.startswith("planner: ")]
    assert len(lines) == 1, err
    assert lines[0].startswith("error: ")
    return lines[0]


def said_aloud(err: str) -> list[str]:
    """Lines of standard error, but for those of what takes two seconds on a machine with other
    work.
    """
    return [line for line in err.splitlines() if not line.endswith(" …")]


@pytest.fixture(scope="module")
def query() -> tuple[str, str]:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    return words_of(start), words_of(goal)


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("paths") / "path.csv"
    path = packaged_planner().plan(*pairs_of("level_cup", 1, seed=1)[0], "level_cup")
    path.save(file)
    return file


def test_a_path_is_planned_and_its_files_are_written(command, query, tmp_path) -> None:
    csv, rrd, png = (tmp_path / "new" / f"path.{kind}" for kind in ("csv", "rrd", "png"))
    files = ("--out", str(csv), "--record", str(rrd), "--picture", str(png))
    code, out, err = command(*asked(*query), *files)
    assert code == 0
    own = packaged_planner().plan(*pairs_of("level_cup", 1, seed=1)[0], "level_cup")
    figures = rf"{own.length_rad:.2f} rad, motion {own.times[-1]:.2f} s, planned in \d+ ms"
    figures += r"( \(\d+ ms as the first of its process\))?"
    bound, clear = f"{own.violation_bound:.1e}", f"{1e3 * own.clearance_m:.1f}"
    proven = rf"at most {bound} \(rad, m\) off level_cup anywhere, at least {clear} mm from .*"
    assert re.fullmatch(f"solved: {figures}; proven: {proven}\n", out), out
    assert err.strip() == f"planner: {bundle.PACKAGED}"
    joints, times, constraint, *_ = read_trajectory(csv)
    assert joints.tobytes() == own.joints.tobytes()
    assert times.tobytes() == own.times.tobytes()
    assert constraint.axes == own.constraint.axes
    assert len(read_recording(rrd).joints) > 1
    assert png.read_bytes().startswith(b"\x89PNG")
    code, out, err = command("check", str(csv))
    assert (code, err) == (0, "")
    assert out.startswith("valid: ")


def test_where_nothing_is_held_only_the_distance_is_told(command, query) -> None:
    code, out, _ = command(*asked(*query, "free"))
    assert code == 0
    assert re.search(r"; proven: (at least \d+\.\d mm|free|with nothing)", out), out


@pytest.mark.parametrize(
    ("seconds", "said"), [(4e-4, "less than 1 ms"), (0.0034, "3 ms"), (12.345, "12.35 s")]
)
def test_a_time_is_said_as_people_say_it(seconds, said) -> None:
    assert cli_planning._spent(seconds) == said


def test_an_answer_is_one_json_object(command, query, tmp_path) -> None:
    code, out, _ = command(*asked(*query), "--json")
    assert code == 0
    answer = strict(out)
    assert answer["status"] == "solved"
    assert answer["constraint"] == "level_cup"
    assert 0.0 <= answer["violation_bound"] <= 1e-4
    out_of_reach = asked(query[0], TOUCHES_ITSELF, "free")
    code, out, _ = command(*out_of_reach, "--json", "--out", str(tmp_path / "path.csv"))
    assert code == 3
    answer = strict(out)
    assert answer["status"] == "in_collision"
    assert answer["length_rad"] is None
    assert not (tmp_path / "path.csv").exists()


@pytest.mark.parametrize(
    ("start", "constraint", "status"),
    [
        ("0 0 -0.5 0 0.3 0", "level_cup", "start_violates"),
        ("9 0 -0.5 0 0.3 0", "free", "out_of_limits"),
        (TOUCHES_ITSELF, "free", "in_collision"),
    ],
)
def test_no_path_is_code_three_and_a_line_that_says_why(
    command, query, start, constraint, status
) -> None:
    code, out, err = command(*asked(start, query[1], constraint))
    assert code == 3
    assert out.startswith(f"{status}: ")
    assert out.count("\n") == 1
    assert "error" not in err


def test_configurations_are_numbers_with_spaces_or_commas_negative_ones_first(
    command, query
) -> None:
    q = nodes_of("free")[0]
    start = q[np.argmax(q[:, 0] < 0.0)]
    assert start[0] < 0.0
    answers = []
    spaces, commas, both = (mark.join(words_of(start).split()) for mark in (" ", ",", ", "))
    for option in (
        ["--start", spaces],
        [f"--start={spaces}"],
        ["--start", commas],
        [f"--start={both}"],
    ):
        code, out, err = command(
            "plan", *option, "--goal", query[1], "--constraint", "free", "--json"
        )
        assert code == 0, err
        answers.append(strict(out)["length_rad"])
    assert len(set(answers)) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (asked("1 2 3", ZEROS, "free"), r"start.*\(3,\)"),
        (asked(ZEROS, f"{ZEROS} 0", "free"), r"goal.*\(7,\)"),
        (asked("0 0 0 0 0 zero", ZEROS, "free"), "--start '0 0 0 0 0 zero'"),
        (asked("", ZEROS, "free"), r"start.*\(0,\)"),
        (asked("nan 0 0 0 0 0", ZEROS, "free"), r"start\[0\] is not finite"),
        (asked(ZEROS, "0 0 0 0 0 inf", "free"), r"goal\[5\] is not finite"),
        (asked(ZEROS, ZEROS, "cup"), "'cup'.*level_cup"),
        ((*asked(ZEROS, ZEROS, "free"), "--budget", "0"), "budget_s = 0"),
        (("plan", "--start", "0.5", "-0.5", "0"), "--start takes its numbers in quotes"),
        (
            (*asked(ZEROS, ZEROS), "--out", "a", "--record", "./a"),
            "--out, --record a: one file can't hold both",
        ),
        (
            (*asked(ZEROS, ZEROS, "wipe.yaml"), "--out", "./wipe.yaml"),
            r"--constraint, --out wipe\.yaml: one file can't hold both",
        ),
        ((*asked(ZEROS, ZEROS), "--picture", "a.jpg"), r"written as PNG: a\.png"),
    ],
    ids=(
        *("three", "seven", "word", "nothing", "nan", "inf", "name", "budget"),
        *("unquoted", "one file", "over its input", "jpg"),
    ),
)
def test_wrong_usage_of_plan_is_code_two(command, words, said) -> None:
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert re.search(said, error_line(err)), err


def test_numbers_of_a_list_need_no_quotes() -> None:
    cli._require_quotes(["replay", "--web", "1", "6"])
    with pytest.raises(SystemExit) as stop:
        cli._require_quotes(["ik", "--pose", "0.4", "0.2"])
    assert stop.value.code == 2


@pytest.mark.parametrize("missing", ["--start", "--goal", "--constraint"])
def test_every_needed_option_is_asked_for(command, missing) -> None:
    given = {"--start": ZEROS, "--goal": ZEROS, "--constraint": "free"}
    del given[missing]
    code, out, err = command("plan", *(word for pair in given.items() for word in pair))
    assert (code, out) == (2, "")
    assert missing in err
    assert "Traceback" not in err


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="a file that never ends is Linux's")
@pytest.mark.parametrize(
    ("words", "most"), [(("check",), 256), ((*asked(ZEROS, ZEROS), "--scene"), 16)]
)
def test_a_file_that_never_ends_is_one_line(command, words, most) -> None:
    code, out, err = command(*words, "/dev/zero")
    assert (code, out) == (2, "")
    assert "/dev/zero: " in error_line(err)
    assert f"longer than {most} MiB" in err


def test_a_scene_whose_urdf_is_no_xml_is_one_line(command, tmp_path, monkeypatch) -> None:
    (tmp_path / "lamp.urdf").write_text("a lamp")
    (tmp_path / "scene.yaml").write_text("shapes: {lamp: {kind: urdf, urdf: lamp.urdf}}")
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*asked(ZEROS, ZEROS), "--scene", "scene.yaml")
    assert (code, out) == (2, "")
    assert "lamp.urdf: no URDF: it is no XML" in error_line(err)


def test_a_server_that_is_not_there_and_a_store_without_its_library_are_one_line(
    command, monkeypatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:1")
    for address, said in (("models:/arm/1", "127.0.0.1"), ("s3://bucket/arm", "s3://bucket/arm: ")):
        code, out, err = command(*asked(ZEROS, ZEROS), "--planner", address)
        assert (code, out) == (1, "")
        assert said in error_line(err)


def test_a_planner_that_is_none_is_one_line(command, tmp_path) -> None:
    for words in (asked(ZEROS, ZEROS, "free"), ("constraints",)):
        code, out, err = command(*words, "--planner", str(tmp_path))
        assert code in (1, 2)
        assert out == ""
        assert "planner.json" in error_line(err)


def test_a_file_that_can_not_be_written_is_one_line(command, query, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    code, _, err = command(*asked(*query, "free"), "--out", str(tmp_path / "file" / "path"))
    assert code in (1, 2)
    assert str(tmp_path / "file") in error_line(err)


def test_a_path_that_breaks_a_promise_is_code_three(command, saved, tmp_path) -> None:
    code, out, _ = command("check", str(saved), "--constraint", "tool_down")
    assert code == 3
    assert out.startswith("constraint: in row ")
    code, out, _ = command("check", str(saved), "--constraint", "tool_down", "--json")
    assert code == 3
    answer = strict(out)
    assert answer["valid"] is False
    assert answer["violation"]["kind"] == "constraint"
    lines = saved.read_text().splitlines()
    (tmp_path / "jump.csv").write_text("\n".join([*lines[:11], *lines[21:]]))
    code, out, _ = command("check", str(tmp_path / "jump.csv"))
    assert code == 3
    assert out.startswith("step: rows 6 and 7")


def test_a_certificate_is_one_json_object(command, saved) -> None:
    code, out, err = command("check", str(saved), "--json")
    assert (code, err) == (0, "")
    answer = strict(out)
    assert answer["valid"] is True
    assert answer["violation"] is None
    assert answer["violation_bound"] <= 1e-4
    assert answer["clearance_m"] > 1e-4
    assert answer["asked_pybullet"] == 0


def test_a_collision_is_named_in_json_as_well(command, tmp_path) -> None:
    """A path through the table into the arm itself, slow enough."""
    file = tmp_path / "collision.csv"
    rows = np.linspace(0.0, 1.0, 60)[:, None] * np.array([float(x) for x in TOUCHES_ITSELF.split()])
    names = ",".join(packaged_planner().scene.robot.joint_names)
    file.write_text("\n".join([names, *(",".join(map(repr, row)) for row in rows.tolist())]))
    words = ("check", str(file), "--constraint", "free")
    code, out, _ = command(*words)
    assert code == 3
    kind, message = out.split(": ", 1)
    assert kind in ("self_collision", "workcell_collision")
    assert " touches " in message
    code, out, _ = command(*words, "--json")
    assert code == 3
    assert strict(out)["violation"]["kind"] == kind


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (1, "# constraint: {}", "line 1: not a constraint"),
        (5, "0,0,0,0,zero,0,0", "line 5: not a row of numbers"),
        (9, "0,0,0", "line 9: 3 numbers under 7 names"),
    ],
)
def test_a_corrupted_file_is_code_two_and_names_the_line(
    command, saved, tmp_path, line, text, said
) -> None:
    lines = saved.read_text().splitlines()
    lines[line - 1] = text
    broken = tmp_path / "broken.csv"
    broken.write_text("\n".join(lines))
    for option in ((), ("--json",)):
        code, out, err = command("check", str(broken), *option)
        assert (code, out) == (2, "")
        assert f"{broken}, {said}" in error_line(err)


def test_wrong_usage_of_check_is_code_two(command, saved, tmp_path) -> None:
    code, out, err = command("check", str(tmp_path / "nowhere.csv"))
    assert (code, out) == (2, "")
    assert "nowhere.csv" in error_line(err)
    code, out, err = command("check", str(saved), "--constraint", "cup")
    assert (code, out) == (2, "")
    assert "'cup'" in error_line(err)
    bare = tmp_path / "bare.csv"
    bare.write_text("\n".join(saved.read_text().splitlines()[1:]))
    code, out, err = command("check", str(bare))
    assert (code, out) == (2, "")
    assert "--constraint" in error_line(err)


def test_a_path_comes_out_of_a_pipe(saved) -> None:
    """Once: nothing of it is left for a second reading."""
    program = [Path(sys.executable).parent / "geodesics", "check", "/dev/stdin"]
    with subprocess.Popen(["cat", saved], stdout=subprocess.PIPE) as cat:
        done = subprocess.run(
            program, stdin=cat.stdout, capture_output=True, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("valid: ")


def test_a_constraint_of_ones_own_comes_from_a_file(command, query, tmp_path) -> None:
    start, goal = query
    file = tmp_path / "tilting.yaml"
    about = json.dumps(Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.1, 0.1, 0)).to_json())
    file.write_text(f"constraint: {about}\n")
    words = "--constraint", str(file), "--start", start, "--goal", goal
    code, out, err = command("plan", *words)
    assert code == 0, out + err


def test_a_reference_in_a_file_that_is_no_pose_is_code_two(command, saved, tmp_path) -> None:
    about = (
        '# constraint: {"axes": [0,0,0,1,1,0], "tolerance": [0,0,0,0,0,0], '
        '"reference": {"position_m": [0,0,0], '
    )
    lines = saved.read_text().splitlines()
    lines[0] = about + '"rotation": [[2,0,0],[0,1,0],[0,0,1]]}}'
    (tmp_path / "broken.csv").write_text("\n".join(lines))
    code, _, err = command("check", str(tmp_path / "broken.csv"))
    assert code == 2
    assert "line 1" in error_line(err)


def test_constraints_are_listed(command) -> None:
    code, out, err = command("constraints")
    assert (code, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()] == list(packaged_bundle().constraints)
    code, out, _ = command("constraints", "--json")
    listed = strict(out)
    assert set(NAMES) <= set(listed)
    for name, constraint in packaged_bundle().constraints.items():
        assert tuple(listed[name]["axes"]) == constraint.axes
        assert listed[name]["description"] == constraint.description


def test_the_installed_command_answers(query, tmp_path) -> None:
    """In processes of its own: a path, and wrong usage."""
    given = ("--planner", str(bundle.PACKAGED))
    runs = {0: (*asked(*query), "--json", *given), 2: ("check", "nowhere.csv", *given)}
    for code, words in runs.items():
        done = subprocess.run(
            [COMMAND, *words], capture_output=True, text=True, cwd=tmp_path, check=False
        )
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        if code == 0:
            assert strict(done.stdout)["status"] == "solved"
        if code == 2:
            assert "nowhere.csv" in error_line(done.stderr)
    assert not list(tmp_path.iterdir())


def test_a_budget_is_used(command, query) -> None:
    words = (*asked(*query), "--json")
    first, longer = (strict(command(*words, *more)[1]) for more in ((), ("--budget", "0.2")))
    assert longer["planning_time_s"] >= 0.1
    assert longer["length_rad"] <= first["length_rad"]


@pytest.mark.parametrize("method", ["planner", "learned", "learned+band"])
def test_a_method_is_chosen_by_its_name_and_named_in_the_answer(command, query, method) -> None:
    words = (*asked(*query), "--json")
    code, out, _ = command(*words, "--method", method)
    assert (code, strict(out)["method"]) == (0, method)
    code, out, err = command(*words, "--method", "paper")
    assert (code, out) == (2, "")
    assert "no method 'paper'" in error_line(err)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--constraint", "cup"), "no constraint 'cup': must be one of free, level_cup"),
        (("--planner", "RRT"), "no planner 'RRT': must be one of planner"),
        (("--planner", "RRT* 10 s"), "no planner is left"),
    ],
)
def test_what_bench_does_not_know_is_one_line(monkeypatch, capfd, tmp_path, words, said) -> None:
    words = ("bench", "--out", str(tmp_path / "bench"), *words)
    code, _, err = called(monkeypatch, capfd, words)
    assert code == 2
    assert said in error_line(err)
    assert not (tmp_path / "bench").exists()


SCENE = "shapes:\n  ball: {kind: sphere, centre_m: [0.2, 0.6, 0.9], radius_m: 0.05}\n"
CUP = "cup: {link: link6, kind: cylinder, pose: {}, length_m: 0.05, radius_m: 0.02}\n"


def test_a_scene_and_what_is_carried_come_from_files(command, query, tmp_path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "cup.yaml").write_text(CUP)
    files = ("--scene", str(tmp_path / "scene.yaml"), "--attach", str(tmp_path / "cup.yaml"))
    csv, rrd = tmp_path / "path.csv", tmp_path / "path.rrd"
    code, out, _ = command(*asked(*query), *files, "--out", str(csv), "--record", str(rrd))
    assert (code, out.startswith("solved: ")) == (0, True)
    entities = read_recording(rrd).entity_paths
    assert {"/workcell/ball", "/attached/cup"} <= set(entities)
    code, out, _ = command("check", str(csv), *files, "--json")
    assert code == 0
    assert "cup on link6" in strict(out)["rests_on"]
    code, out, err = command("check", str(csv), *files[:2], "--json")
    assert strict(out)["valid"]
    line = (
        f"note: {csv} was planned among cup, which are not in this scene: give --scene and --attach"
    )
    assert line in err.splitlines()
    (tmp_path / "scene.yaml").write_text(SCENE.replace("ball", "table"))
    code, out, err = command(*asked(*query), *files)
    assert (code, out) == (2, "")
    line = error_line(err)
    assert "'table' already" in line
    assert line.count(str(tmp_path / "scene.yaml")) == 1
    code, out, err = command(*asked(*query), "--attach", str(tmp_path / "cup.yaml"), *files[2:])
    assert (code, out) == (2, "")
    assert f"{tmp_path / 'cup.yaml'}: " in error_line(err)


def test_a_request_of_moveit_says_it_all(command, query, tmp_path) -> None:
    names = [f"joint{k}" for k in range(1, 7)]
    start, goal = ([float(x) for x in ends.split()] for ends in query)
    joints = [f"{{joint_name: {n}, position: {x}}}" for n, x in zip(names, goal, strict=True)]
    state = f"joint_state: {{name: [{', '.join(names)}], position: {start}}}"
    (tmp_path / "request.yaml").write_text(
        f"goal_constraints:\n- joint_constraints: [{', '.join(joints)}]\n"
    )
    (tmp_path / "scene.yaml").write_text(f"robot_state: {{{state}}}\n")
    request = ("--moveit-request", str(tmp_path / "request.yaml"))
    scene = ("--moveit-scene", str(tmp_path / "scene.yaml"))
    code, out, _ = command("plan", *request, *scene)
    assert (code, out.startswith("solved: ")) == (0, True)
    saved = tmp_path / "path.csv"
    assert command("plan", *request, *scene, "--out", str(saved))[0] == 0
    code, out, _ = command("check", str(saved), *scene)
    assert (code, out.startswith("valid: ")) == (0, True)
    code, out, err = command("check", str(saved), "--moveit-scene", str(tmp_path / "none.yaml"))
    assert (code, out) == (2, "")
    assert "none.yaml" in error_line(err)
    code, out, err = command("plan", *request)
    assert (code, out) == (2, "")
    assert "start_state: has no value for joint1" in error_line(err)
    code, _, err = command(*asked(*query), *request)
    assert code == 2
    assert "goes without --start" in error_line(err)
