"""`bench --problems`: a small file through the real command, and what it refuses, one line each."""

import shutil
from pathlib import Path

import pandas as pd
import pytest

from tests.benchmark.problem_fixtures import moveit_pair, problem, small_file, written
from tests.test_cli_plan import called, error_line, strict

ROOT = Path(__file__).parents[1]


@pytest.fixture
def geodesics(monkeypatch, capfd, tmp_path):
    """The command in a folder with params.yaml alone."""
    shutil.copy(ROOT / "params.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, words)

    return start


def test_a_file_of_problems_is_answered_judged_and_not_answered_again(geodesics, tmp_path) -> None:
    file = str(written(small_file(), tmp_path / "small.json.gz"))
    planners = ("--planner", "planner", "--planner", "BiRRT + band")
    words = ("bench", "--problems", file, *planners, "--every", "2", "--tilted", "1")
    code, out, err = geodesics(*words, "--time-limit", "20", "--json")
    assert code == 0, err
    assert "problems: 4/4" in err
    answer = strict(out)
    free = answer["figures"]["free"]
    assert set(free) == {"posts", "crate", "all"}
    for planner in ("planner", "BiRRT + band"):
        own = free["all"][planner]
        assert (own["problems"], own["solved"], own["wrongly_certified"]) == (2, 2, 0)
    rows = pd.read_csv(answer["rows"], comment="#")
    assert len(rows) == 8
    assert (rows["limit_s"] == 20.0).all()
    assert (rows["status"] == "solved").all()
    code, out, err = geodesics(*words, "--time-limit", "20")
    assert code == 0
    assert "problems: " not in err, "nothing was left to do"
    table = out.splitlines()
    assert table[0].startswith("| constraint ")
    assert "2 of 2" in out
    assert table[-1] == f"rows: {answer['rows']}"
    again = pd.read_csv(answer["rows"], comment="#")
    pd.testing.assert_frame_equal(rows, again)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--planner", "BiRTT"), "there is no planner 'BiRTT': must be one of"),
        (("--planner", "latent graph"), "'latent graph' is made of what the pipeline trained"),
        (("--constraint", "free"), "--problems goes without --constraint"),
        (("--queries", "5"), "--problems goes without --constraint, --queries"),
        (("--seeds", "3"), "--problems goes without --constraint, --queries"),
        (("--longest", "0.1"), "--problems goes without --constraint, --queries"),
        (("--time-limit", "0"), "--time-limit 0: must be a positive number of seconds"),
        (("--tool-link", "panda_hand"), "--tool-link, --srdf and --hold need --urdf"),
        (("--urdf", "franka_panda/panda.urdf"), "which link carries the tool?"),
        (("--urdf", "kuka_iiwa/model.urdf", "--tool-link", "lbr_iiwa_link_7"), "can't be held"),
        (("--urdf", "none.urdf", "--tool-link", "hand"), "none.urdf"),
        (
            ("--urdf", "franka_panda/panda.urdf", "--tool-link", "panda_hand", "--hold", "a=b"),
            "--hold 'a=b': must be a joint and a number",
        ),
    ],
)
def test_wrong_usage_is_one_line(geodesics, tmp_path, words, said) -> None:
    file = str(written(small_file(), tmp_path / "small.json"))
    code, out, err = geodesics("bench", "--problems", file, *words)
    assert (code, out) == (2, "")
    assert said in error_line(err)
    assert not (tmp_path / ".geodesics/bench").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"shapes?", "bad.json: neither JSON nor MoveIt's YAML"),
        (b'{"robot": "panda", "joints": ["a"], "scenes": {}}', "bad.json: scenes"),
        (b'{"robot": "r2d2", "joints": ["a"], "scenes": {"box": []}}', "robot='r2d2': known are"),
        (
            b'{"robot": "panda", "joints": ["a"], "scenes": {"box": []}}',
            "scenes.box: has no problems",
        ),
    ],
)
def test_a_bad_file_is_one_line(geodesics, tmp_path, content, said) -> None:
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    code, out, err = geodesics("bench", "--problems", str(file))
    assert (code, out) == (2, "")
    assert said in error_line(err)


def test_problems_of_folders_and_files_that_are_named_alike_are_told_apart(
    geodesics, tmp_path
) -> None:
    folder = tmp_path / "mine"
    for own in ("a/tests", "b/tests"):
        moveit_pair(folder / own, "1")
    moveit_pair(folder / "sides", "_left_1")
    moveit_pair(folder / "sides", "_right_1")
    words = ("--planner", "planner", "--time-limit", "20", "--json")
    code, out, err = geodesics("bench", "--problems", str(folder), *words)
    assert code == 0, err
    answer = strict(out)
    rows = pd.read_csv(answer["rows"], comment="#")
    keys = list(zip(rows["scene"], rows["query"], strict=True))
    assert keys == [("a/tests", 1), ("b/tests", 1), ("sides", 0), ("sides", 1)]
    assert answer["figures"]["free"]["all"]["planner"]["solved"] == 4


def test_ends_out_of_limits_are_counted_apart_and_nowhere_else(geodesics, tmp_path) -> None:
    record = small_file()
    record["scenes"] = {"far": [problem(start=[9.0] * 7)]}
    file = str(written(record, tmp_path / "far.json"))
    code, out, err = geodesics("bench", "--problems", file, "--planner", "planner")
    assert code == 0, err
    assert "1 of 1 problems have ends that touch something or are out of limits" in out
    assert "of a core" not in out
    cells = [cell.strip() for cell in out.splitlines()[2].split("|")[1:5]]
    assert cells == ["free", "planner", "0", "0 of 0"]


def test_outside_a_checkout_the_line_says_what_is_missing(geodesics, tmp_path) -> None:
    (tmp_path / "params.yaml").unlink()
    file = str(written(small_file(), tmp_path / "small.json"))
    code, out, err = geodesics("bench", "--problems", file)
    assert (code, out) == (2, "")
    line = error_line(err)
    assert f"{tmp_path / 'params.yaml'}: missing: --problems takes planners" in line
    assert "run it in a checkout" in line


def test_options_of_problems_need_problems(geodesics) -> None:
    code, out, err = geodesics("bench", "--every", "10")
    assert (code, out) == (2, "")
    assert "go with --problems alone" in error_line(err)
