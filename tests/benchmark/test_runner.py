"""Rows of the benchmark: every query answered and judged, nothing computed twice, nothing lost."""

import json
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, pairs_of

from constraint_geodesics.benchmark.queries import draw_cases
from constraint_geodesics.benchmark.runner import (
    COLUMNS,
    Block,
    Case,
    Entry,
    block_rows,
    fingerprint,
    read_cases,
    rows_to_do,
    run_block,
    table_of,
    write_cases,
)
from constraint_geodesics.params import load_params
from constraint_geodesics.peers.elastic_band import StraightBand
from constraint_geodesics.problem import Solution
from constraint_geodesics.scene.sphere import Sphere

JUDGE = load_params(Path(__file__).parents[2] / "params.yaml").judge
ENTRIES = (Entry("band", (0,), "a"), Entry("liar", (0, 1), "b"), Entry("broken", (0,), "c"))


@dataclass(frozen=True)
class Liar:
    """Calls the bare joint line solved, which leaves the constraint."""

    name: str = "liar"

    def plan(self, problem, seed):
        line = np.linspace(problem.start, problem.goal, 50 + seed)
        return Solution("solved", line, 0.001, 1)


@dataclass(frozen=True)
class Broken:
    name: str = "broken"

    def plan(self, problem, seed):
        raise FloatingPointError("a library\ngave up")


@contextmanager
def build(names, scene, constraint, manifold):
    made = {"band": StraightBand(), "liar": Liar(), "broken": Broken()}
    yield {name: made[name] for name in names}, dict.fromkeys(names, 0.25)


@pytest.fixture
def block(tmp_path) -> Block:
    planner = packaged_planner()
    pairs = pairs_of("level_cup", 3, seed=1)
    cases = tuple(
        Case("level_cup", "table", k, start, goal) for k, (start, goal) in enumerate(pairs)
    )
    ball = Sphere("keep_out", (5.0, 5.0, 5.0), 0.1)
    cases = (*cases[:2], replace(cases[2], scene="keep_out", obstacle=ball))
    return Block(
        planner.scene,
        manifold_of(planner, "level_cup"),
        {},
        cases,
        ENTRIES,
        build,
        JUDGE,
        tmp_path / "new" / "rows.jsonl",
    )


def rows_of(block: Block) -> list[dict]:
    return block_rows(block)


def test_every_query_seed_and_planner_has_its_row_and_the_certifiers_word(block) -> None:
    assert rows_to_do(block) == 12
    assert run_block(block) == 12
    table = table_of(rows_of(block))
    assert list(table.columns) == list(COLUMNS)
    assert table.groupby("planner").size().to_dict() == {"band": 3, "broken": 3, "liar": 6}
    band, liar, broken = (table[table["planner"] == name] for name in ("band", "liar", "broken"))
    assert band["valid"].all()
    assert (liar["status"] == "solved").all()
    assert not liar["valid"].any()
    assert (broken["status"] == "not_found").all()
    assert broken["length_rad"].isna().all()
    np.testing.assert_array_equal(band["best_known_rad"], band["length_rad"])
    assert (table["peak_memory_mb"] >= 0.0).all()
    assert (table["scene_s"] >= 0.25).all()
    assert "FloatingPointError: a library gave up" in {row["reason"] for row in rows_of(block)}


def test_what_is_done_is_not_done_again(block) -> None:
    run_block(block)
    before = block.file.read_bytes()
    assert rows_to_do(block) == 0
    assert run_block(block) == 0
    assert block.file.read_bytes() == before


def test_a_killed_run_goes_on_where_it_stopped(block) -> None:
    run_block(block)
    lines = block.file.read_text().splitlines(keepends=True)
    whole = rows_of(block)
    block.file.write_text(
        "".join(lines[:15]) + lines[15][:40]
    )  # a line before each row says that it is begun
    assert rows_to_do(block) == 5
    assert run_block(block) == 5
    again = rows_of(block)
    for old, new in zip(sorted(whole, key=key), sorted(again, key=key), strict=True):
        assert key(old) == key(new)
        assert (old["valid"], old["length_rad"]) == (new["valid"], new["length_rad"]) or old[
            "planner"
        ] == "broken"


def test_a_row_that_killed_its_process_twice_is_a_failure(block) -> None:
    """A kill while it ran is no reason, a second one in the same row is."""
    run_block(block)
    first = block.file.read_text().splitlines()[0]
    assert "started" in first
    for kills, reason in ((1, ""), (2, "the process died in it twice")):
        block.file.write_text(f"{first}\n" * kills)
        run_block(block)
        band = next(row for row in rows_of(block) if row["planner"] == "band" and row["query"] == 0)
        assert band["valid"] == (kills == 1)
        assert band["reason"] == reason


def test_rows_that_are_not_asked_for_any_more_do_not_count(block) -> None:
    run_block(block)
    fewer = replace(
        block, cases=block.cases[:2], entries=(replace(ENTRIES[0], queries=1), ENTRIES[1])
    )
    assert rows_to_do(fewer) == 0
    kept = [(row["planner"], row["query"], row["seed"]) for row in rows_of(fewer)]
    assert sorted(kept) == [
        ("band", 0, 0),
        ("liar", 0, 0),
        ("liar", 0, 1),
        ("liar", 1, 0),
        ("liar", 1, 1),
    ]


def test_paths_are_handed_to_the_recorder_with_their_verdict(block) -> None:
    seen = []

    def record(case, planner, seed, joints, measures, scene, manifold):
        seen.append((planner, case.query, seed, measures.valid, len(joints)))
        return f"{planner}.rrd"

    run_block(replace(block, record=record))
    assert {planner for planner, *_ in seen} == {"band", "liar"}
    assert all(valid == (planner == "band") for planner, _, _, valid, _ in seen)
    named = {row["planner"]: row["recording"] for row in rows_of(block)}
    assert named == {"band": "band.rrd", "liar": "liar.rrd", "broken": ""}


def key(row):
    return [str(row[name]) for name in ("planner", "query", "seed")]


def test_a_changed_planner_is_asked_again_alone(block) -> None:
    run_block(block)
    changed = replace(block, entries=(replace(ENTRIES[0], fingerprint="new"), *ENTRIES[1:]))
    assert rows_to_do(changed) == 3
    run_block(changed)
    assert {row["planner"]: row["fingerprint"] for row in rows_of(changed)}["band"] == "new"
    assert rows_to_do(changed) == 0


def test_rows_are_json_that_every_reader_takes(block) -> None:
    run_block(block)
    for line in block.file.read_text().splitlines():
        json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_queries_are_kept_to_the_bit(block, tmp_path) -> None:
    write_cases(block.cases, tmp_path / "queries.csv")
    again = read_cases(tmp_path / "queries.csv")
    for old, new in zip(block.cases, again, strict=True):
        assert (old.constraint, old.scene, old.query, old.obstacle) == (
            new.constraint,
            new.scene,
            new.query,
            new.obstacle,
        )
        assert old.start.tobytes() == new.start.tobytes()
        assert old.goal.tobytes() == new.goal.tobytes()


def test_a_fingerprint_depends_on_everything_it_is_given() -> None:
    assert fingerprint("a", {"b": 1}, b"c") == fingerprint("a", {"b": 1}, b"c")
    others = [
        fingerprint("a", {"b": 2}, b"c"),
        fingerprint("a", {"b": 1}, b"d"),
        fingerprint("b", {"b": 1}, b"c"),
    ]
    assert len({fingerprint("a", {"b": 1}, b"c"), *others}) == 4


def test_spheres_stand_on_the_way_and_not_on_the_ends() -> None:
    planner = packaged_planner()
    manifold = manifold_of(planner, "level_cup")

    def plan(start, goal):
        return planner.plan(start, goal, "level_cup").joints

    cases = draw_cases(planner.scene, manifold, "level_cup", 3, 0.12, plan, 5)
    assert [case.scene for case in cases] == ["table"] * 3 + ["keep_out"] * 3
    assert [case.query for case in cases] == list(range(6))
    for case in cases[3:]:
        with case.in_scene(planner.scene).world() as world:
            assert world.is_free(case.start)
            assert world.is_free(case.goal)
            assert world.first_collision(plan(case.start, case.goal)) is not None
