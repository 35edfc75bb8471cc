"""The list of recordings against tables and files as the stages write them, and the command
`replay` on them.
"""

import csv
import os
import pty
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.test_cli_plan import COMMAND, called, strict

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import in_checkout
from constraint_geodesics.recording.catalogue import (
    CatalogueError,
    Filter,
    Listed,
    as_table,
    by_words,
    catalogue,
    narrowed,
    one_of_each,
    plain,
    read_entry,
)
from constraint_geodesics.recording.recording import PathRecord, record_path
from constraint_geodesics.scene.scene import Scene

LEARNED = "data/recordings/train_geodesics/planner-level_cup/query0-learned_geodesic-seed0.rrd"
SAMPLED = "data/recordings/benchmark_planners/level_cup/query0-birrt-seed{}.rrd"
TABLED = "data/recordings/run_benchmark/level_cup/table-query0-{}.rrd"
EXECUTED = "data/recordings/execute_paths/level_cup/query0-planned-path.rrd"


def write_table(file: Path, rows: Sequence[dict[str, Any]], *comments: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as content:
        content.writelines(f"# {line}\n" for line in comments)
        writer = csv.DictWriter(content, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def row(
    planner: str, query: int, seed: int, recording: str, valid: bool = True, **more: Any
) -> dict[str, Any]:
    return {
        "planner": planner,
        "query": query,
        "seed": seed,
        "valid": valid,
        "length_rad": 4.5,
        "recording": recording,
        "constraint": "level_cup",
        **more,
    }


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Tables of all stages and a file for each recording that they name."""
    monkeypatch.chdir(tmp_path)
    reports = Path("reports")
    write_table(
        reports / "train_geodesics/planner-level_cup.csv",
        [
            row("random_curves", 0, 0, LEARNED.replace("learned_geodesic", "random_curves")),
            row("learned_geodesic", 0, 0, LEARNED),
            row("learned_geodesic", 1, 0, ""),
        ],
    )
    write_table(
        reports / "train_geodesics/planner-level_cup-learning.csv", [{"steps": 1, "saving": 0.5}]
    )
    write_table(
        reports / "benchmark_planners/level_cup.csv",
        [row("birrt", 0, seed, SAMPLED.format(seed), valid=seed == 0) for seed in (0, 1)],
    )
    write_table(
        reports / "benchmark.csv",
        [
            row(name, 0, 0, f"/elsewhere/checkout/{TABLED.format(plain(name))}", scene="table")
            for name in ("planner", "BiRRT")
        ],
        "commit: 1",
        "date: today",
    )
    write_table(
        reports / "execute_paths/level_cup.csv",
        [{"query": 0, "kind": "planned path", "length_rad": 9.5, "recording": EXECUTED}],
    )
    for name in (
        LEARNED,
        LEARNED.replace("learned_geodesic", "random_curves"),
        SAMPLED.format(0),
        SAMPLED.format(1),
        TABLED.format("planner"),
        TABLED.format("birrt"),
        EXECUTED,
    ):
        file = Path(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"RRF2")
    return tmp_path


@pytest.fixture
def geodesics(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """The command in this process: its exit code and what it wrote."""
    return lambda *words: called(monkeypatch, capfd, words)


def unread(file: Path) -> Listed:
    raise AssertionError(f"{file} is named by a table")


def test_the_list_is_what_the_tables_name(checkout: Path) -> None:
    entries = catalogue(Path(), unread)
    assert [(e.number, e.planner, e.query, e.seed, e.scene, e.valid, e.file) for e in entries] == [
        (1, "learned_geodesic", 0, 0, "", True, LEARNED),
        (2, "random_curves", 0, 0, "", True, LEARNED.replace("learned_geodesic", "random_curves")),
        (3, "birrt", 0, 0, "", True, SAMPLED.format(0)),
        (4, "birrt", 0, 1, "", False, SAMPLED.format(1)),
        (5, "planner", 0, 0, "table", True, TABLED.format("planner")),
        (6, "BiRRT", 0, 0, "table", True, TABLED.format("birrt")),
        (7, "planned path", 0, None, "", None, EXECUTED),
    ]
    assert {entry.constraint for entry in entries} == {"level_cup"}
    assert [entry.length_rad for entry in entries] == [4.5] * 6 + [9.5]


def test_rows_without_their_file_are_left_out(checkout: Path) -> None:
    Path(LEARNED).unlink()
    assert LEARNED not in [entry.file for entry in catalogue(Path(), unread)]


def test_files_that_no_table_names_speak_for_themselves(
    checkout: Path, scene: Scene, params: Params
) -> None:
    joints = np.linspace([0.0, -0.5, -1.0, 0.0, 0.5, 0.0], [0.3, -0.5, -1.0, 0.4, 0.5, 0.0], 5)
    record = PathRecord("prm", "free", 4, 2, joints, "text", scene="keep_out", meshes=False)
    file = Path("first_path/path.rrd")
    manifold = constraint_manifold(scene.robot, params.constraints["free"])
    record_path(file, record, manifold, (), frames=5)
    Path("data/recordings/broken.rrd").write_bytes(b"RRF2")
    broken, own = catalogue(Path(), read_entry)[-2:]
    assert (own.planner, own.constraint, own.scene, own.query, own.seed) == (
        "prm",
        "free",
        "keep_out",
        4,
        2,
    )
    assert own.length_rad == pytest.approx(0.5)
    assert own.file == "first_path/path.rrd"
    assert (broken.file, broken.query, broken.length_rad) == (
        "data/recordings/broken.rrd",
        None,
        None,
    )


def test_the_list_is_narrowed_and_says_what_there_is_instead(checkout: Path) -> None:
    entries = catalogue(Path(), unread)
    assert [e.number for e in narrowed(entries, Filter(planners=("BIRRT",)))] == [3, 4, 6]
    assert [e.number for e in narrowed(entries, Filter(planners=("birrt",), seeds=(1,)))] == [4]
    assert [e.number for e in narrowed(entries, Filter(scene="table", query=0))] == [5, 6]
    for wanted, message in (
        (Filter(constraint="cup"), "constraint cup is as asked for: there is level_cup"),
        (
            Filter(planners=("birrt", "prm")),
            "planner prm .* there is birrt, learned_geodesic, planned_path, ",
        ),
        (Filter(query=3), "query 3 .* there is 0"),
    ):
        with pytest.raises(CatalogueError, match=message):
            narrowed(entries, wanted)


@pytest.mark.parametrize(
    ("planners", "seeds", "numbers"),
    [
        (("learned_geodesic", "birrt"), (), [1, 3]),
        (("birrt", "learned_geodesic"), (), [3, 1]),
        (
            ("planner", "birrt"),
            (),
            [5, 6],
        ),  # its queries are others, so that both are taken from there
        (("birrt",), (0, 1), [3, 4]),
    ],
)
def test_paths_that_are_opened_at_once_answer_one_query(checkout, planners, seeds, numbers) -> None:
    wanted = Filter("level_cup", None, 0, planners, seeds)
    chosen = one_of_each(narrowed(catalogue(Path(), unread), wanted), wanted)
    assert [entry.number for entry in chosen] == numbers


def test_numbers_are_those_of_the_list(checkout: Path) -> None:
    entries = catalogue(Path(), unread)
    assert by_words(entries, ["3", "1"]) == [entries[2], entries[0]]
    with pytest.raises(CatalogueError, match="8: no number of the list"):
        by_words(entries, ["8"])


def test_names_and_places() -> None:
    assert [plain(name) for name in ("BiRRT + band", "RRT* 1 s", "rrt_star")] == [
        "birrt_band",
        "rrt_star_1_s",
        "rrt_star",
    ]
    assert in_checkout("/a/b/data/recordings/x/y.rrd") == "data/recordings/x/y.rrd"
    assert in_checkout("elsewhere/y.rrd") == "elsewhere/y.rrd"


def test_the_command_prints_the_list_and_its_json(checkout, geodesics) -> None:
    entries = catalogue(Path(), unread)
    code, out, err = geodesics("replay")
    assert (code, err) == (0, "")
    assert out.startswith(as_table(entries) + "\n")
    code, out, err = geodesics(
        "replay", "--json", "--planner", "birrt", "--constraint", "level_cup"
    )
    assert (code, err) == (0, "")
    rows = strict(out)["recordings"]
    assert [(row["number"], row["planner"], row["valid"]) for row in rows] == [
        (3, "birrt", True),
        (4, "birrt", False),
        (6, "BiRRT", True),
    ]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["nothing.rrd"], 2, "nothing.rrd: no such recording; `geodesics replay` lists"),
        (["99"], 2, "99: no number of the list"),
        (["--planner", "magic"], 2, "no recording of planner magic"),
        (["1", "--planner", "birrt"], 2, "choose from the list: give no file"),
        (["1", "--json"], 2, "--json prints the list"),
        (["--save", "out.rrd"], 2, "--save: name the recordings, or a query with"),
        (["--json", "--save", "out.rrd"], 2, "--save: name the recordings, or a query with"),
        (["1", "--save", "out.rrd"], 1, "query0-learned_geodesic-seed0.rrd: not a recording"),
    ],
)
def test_mistakes_are_one_line(words, code, message, checkout, geodesics) -> None:
    found, out, err = geodesics("replay", *words)
    assert (found, out) == (code, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err


def test_a_fresh_clone_says_what_to_run(tmp_path, monkeypatch, geodesics) -> None:
    monkeypatch.chdir(tmp_path)
    write_table(
        Path("reports/train_geodesics/planner-level_cup.csv"),
        [row("learned_geodesic", 0, 0, LEARNED)],
    )
    code, out, err = geodesics("replay")
    assert (code, out) == (1, "")
    assert "no recordings yet" in err
    assert "make plan" in err


def test_at_a_terminal_the_command_asks(checkout: Path) -> None:
    """Enter opens nothing; a number that is none is a mistake."""
    for answer, code, said in (
        (b"\n", 0, b"Which to open?"),
        (b"77\n", 2, b"77: no number of the list"),
    ):
        terminal, own = pty.openpty()
        running = subprocess.Popen(
            [COMMAND, "replay", "--planner", "birrt"], stdin=own, stdout=own, stderr=own
        )
        os.close(own)
        os.write(terminal, answer)
        text = b""
        while True:
            try:
                text += os.read(terminal, 4096)
            except OSError:  # its end is closed
                break
        os.close(terminal)
        assert running.wait(timeout=60) == code
        assert said in text


def entry(
    number: int, planner: str, valid: bool, scene: str = "", query: int = 0, manifold: str = ""
) -> Listed:
    return Listed(number, "slide", scene, planner, query, 0, 4.5, valid, f"{number}.rrd", manifold)


def test_a_path_that_the_judge_accepts_is_opened_before_one_that_it_does_not() -> None:
    """The paper's latent plane has paths of the same names, which keep no constraint."""
    learned = [
        entry(1, "learned_geodesic", False, manifold="paper"),
        entry(2, "learned_geodesic", True),
    ]
    wanted = Filter("slide", None, 0, ("learned_geodesic", "birrt"))
    assert [e.number for e in one_of_each([*learned, entry(3, "birrt", True)], wanted)] == [2, 3]
    assert [e.number for e in narrowed(learned, Filter(manifold="paper"))] == [1]


def test_a_planner_without_a_path_of_the_query_is_named() -> None:
    entries = [
        entry(1, "learned_geodesic", True),
        entry(2, "birrt", True),
        entry(3, "planner", True, "table"),
    ]
    with pytest.raises(CatalogueError, match="planner has no path of the query"):
        one_of_each(entries, Filter("slide", None, 0, ("learned_geodesic", "birrt", "planner")))


def test_the_manifold_that_people_use_comes_before_the_papers(checkout: Path) -> None:
    for manifold in ("paper", "planner"):
        file = f"data/recordings/train_geodesics/{manifold}-slide/query0-learned_geodesic-seed0.rrd"
        rows = [row("learned_geodesic", 0, 0, file, manifold == "planner", manifold=manifold)]
        write_table(Path(f"reports/train_geodesics/{manifold}-slide.csv"), rows)
        Path(file).parent.mkdir(parents=True)
        Path(file).write_bytes(b"RRF2")
    entries = catalogue(Path(), unread)
    assert [e.manifold for e in entries if "-slide" in e.file] == ["planner", "paper"]
    assert "paper" in as_table(entries)


def test_one_command_opens_the_learned_path_over_the_sampled_one(
    checkout, geodesics, scene, params
) -> None:
    """As README has it, saved instead of shown."""
    joints = np.linspace([0.0, -0.5, -1.0, 0.0, 0.5, 0.0], [0.3, -0.5, -1.0, 0.4, 0.5, 0.0], 5)
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    for file, planner in ((LEARNED, "learned_geodesic"), (SAMPLED.format(0), "birrt")):
        record = PathRecord(planner, "level_cup", 0, 0, joints, "text", meshes=False)
        record_path(Path(file), record, manifold, scene.workcell, frames=5)
    asked = (
        "--constraint",
        "level_cup",
        "--query",
        "0",
        "--planner",
        "learned_geodesic",
        "--planner",
        "birrt",
    )
    code, out, err = geodesics("replay", *asked, "--save", "both.rrd")
    assert code == 0
    assert "opening recordings 1 (learned_geodesic), 3 (birrt)" in err
    assert Path("both.rrd").stat().st_size > 2.5e6, "two robots"
    assert out.startswith("both.rrd: ")


def test_listing_needs_neither_rerun_nor_pandas(checkout: Path) -> None:
    """They take longer to import than the list takes to read."""
    code = (
        "import sys; from constraint_geodesics import cli; sys.argv = ['geodesics', 'replay']; "
        "cli.app(standalone_mode=False); "
        "print({'rerun', 'pandas', 'torch'} & set(sys.modules))"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.splitlines()[-1] == "set()"
