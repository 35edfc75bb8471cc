"""Rows of the benchmark: every query answered and judged, nothing computed twice, nothing lost."""

import json
import multiprocessing
import os
import signal
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, pairs_of

from constraint_geodesics.benchmark import runner
from constraint_geodesics.benchmark.queries import (
    Query,
    QueryError,
    draw_benchmark,
    read_queries,
    write_queries,
)
from constraint_geodesics.benchmark.row import COLUMNS, table_of
from constraint_geodesics.benchmark.runner import (
    Baseline,
    QueryBatch,
    batch_rows,
    fingerprint,
    make_rows,
    rows_to_do,
    run_batch,
)
from constraint_geodesics.params import ComputeParams, load_params
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.problem import Solution
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere

PARAMS = load_params(Path(__file__).parents[2] / "params.yaml")
ASKED = tuple(
    Baseline(name=name, seeds=seeds, fingerprint=own, kind=f"{name}_kind", settings=own)
    for name, seeds, own in (("band", (0,), "a"), ("liar", (0, 1), "b"), ("broken", (0,), "c"))
)


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
def batch(tmp_path) -> QueryBatch:
    planner = packaged_planner()
    pairs = pairs_of("level_cup", 3, seed=1)
    queries = tuple(
        Query("level_cup", "table", k, start, goal) for k, (start, goal) in enumerate(pairs)
    )
    ball = Sphere("keep_out", (5.0, 5.0, 5.0), 0.1)
    queries = (*queries[:2], replace(queries[2], scene="keep_out", obstacle=ball))
    return QueryBatch(
        scene=planner.scene.now,
        manifold=manifold_of(planner, "level_cup"),
        queries=queries,
        baselines=ASKED,
        build=build,
        judge=PARAMS.judge,
        file=tmp_path / "new" / "rows.jsonl",
    )


def test_every_query_seed_and_planner_has_its_row_and_the_certifiers_word(batch) -> None:
    assert rows_to_do(batch) == 12
    assert run_batch(batch) == 12
    table = table_of(batch_rows(batch))
    assert list(table.columns) == list(COLUMNS)
    assert (table["kind"] == table["planner"] + "_kind").all()
    digests = table.groupby("planner")["settings"].unique().str[0].to_dict()
    assert digests == {"band": "a", "broken": "c", "liar": "b"}
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
    assert "FloatingPointError: a library gave up" in {row["reason"] for row in batch_rows(batch)}


def test_what_is_done_is_not_done_again(batch) -> None:
    run_batch(batch)
    before = batch.file.read_bytes()
    assert rows_to_do(batch) == 0
    assert run_batch(batch) == 0
    assert batch.file.read_bytes() == before


def test_a_killed_run_goes_on_where_it_stopped(batch) -> None:
    run_batch(batch)
    lines = batch.file.read_text().splitlines(keepends=True)
    whole = batch_rows(batch)
    # a line before each row says that it is begun
    batch.file.write_text("".join(lines[:15]) + lines[15][:40])
    assert rows_to_do(batch) == 5
    assert run_batch(batch) == 5
    again = batch_rows(batch)
    for old, new in zip(sorted(whole, key=key), sorted(again, key=key), strict=True):
        assert key(old) == key(new)
        assert (old["valid"], old["length_rad"]) == (new["valid"], new["length_rad"]) or old[
            "planner"
        ] == "broken"


def test_a_row_that_was_begun_twice_is_made_in_a_process_of_its_own(batch) -> None:
    """It need not have been the row that ended the two before."""
    own = replace(batch, queries=batch.queries[:1], baselines=ASKED[:1])
    run_batch(own)
    (whole,) = batch_rows(own)
    started = own.file.read_text().splitlines()[0]
    assert "started" in started
    own.file.write_text(f"{started}\n" * 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_timed", None)  # no answer of this process
        assert run_batch(own) == 1
    (row,) = batch_rows(own)
    assert row["valid"]
    assert row["length_rad"] == whole["length_rad"]


def test_rows_that_were_interrupted_are_made(batch, monkeypatch) -> None:
    """However often: that is the user's doing, not theirs."""

    def interrupted(planner, problem, seed):
        raise KeyboardInterrupt

    one = replace(batch, queries=batch.queries[:1], baselines=ASKED[:1])
    with monkeypatch.context() as patch:
        patch.setattr(runner, "_planned", interrupted)
        for _ in range(3):
            with pytest.raises(KeyboardInterrupt):
                make_rows([one], ComputeParams(backend="loky", workers=1), "rows")
    assert len(batch_rows(one)) == 0
    make_rows([one], ComputeParams(backend="loky", workers=1), "rows")
    assert [row["reason"] for row in batch_rows(one)] == [""]


class Dying:
    name = "band"

    def plan(self, problem, seed):
        if multiprocessing.parent_process() is None:
            raise SystemExit(1)  # in place of what would end the tests
        os.kill(os.getpid(), signal.SIGKILL)


class Leaving:
    name = "band"

    def plan(self, problem, seed):
        raise SystemExit(1)


@contextmanager
def build_dying(names, scene, constraint, manifold):
    yield {"band": Dying()}, {"band": 0.0}


@contextmanager
def build_leaving(names, scene, constraint, manifold):
    yield {"band": Leaving()}, {"band": 0.0}


@pytest.mark.parametrize("build", [build_dying, build_leaving])
def test_a_planner_that_ends_every_process_is_given_up(batch, build) -> None:
    own = replace(batch, queries=batch.queries[:1], baselines=ASKED[:1], build=build)
    for _ in range(2):
        runner._WARM.clear()  # as in a new process
        with pytest.raises(SystemExit):
            run_batch(own)
    runner._WARM.clear()
    assert run_batch(own) == 1
    assert batch_rows(own)[0]["reason"] == "its process died in it"


def test_rows_that_are_not_asked_for_any_more_do_not_count(batch) -> None:
    run_batch(batch)
    fewer = replace(
        batch, queries=batch.queries[:2], baselines=(replace(ASKED[0], queries=1), ASKED[1])
    )
    assert rows_to_do(fewer) == 0
    kept = [(row["planner"], row["query"], row["seed"]) for row in batch_rows(fewer)]
    liar = [("liar", query, seed) for query in (0, 1) for seed in (0, 1)]
    assert sorted(kept) == [("band", 0, 0), *liar]


def test_paths_are_handed_to_the_recorder_with_their_verdict(batch) -> None:
    seen = []

    def record(answer):
        key = (answer.planner, answer.query.number, answer.seed)
        seen.append((*key, answer.measures.valid, len(answer.joints)))
        return f"{answer.planner}.rrd"

    run_batch(replace(batch, record=record))
    assert {planner for planner, *_ in seen} == {"band", "liar"}
    assert all(valid == (planner == "band") for planner, _, _, valid, _ in seen)
    named = {row["planner"]: row["recording"] for row in batch_rows(batch)}
    assert named == {"band": "band.rrd", "liar": "liar.rrd", "broken": ""}


@contextmanager
def counting(query, scene):
    """Numbers the answers to one query, those without a path among them."""
    count = 0

    def look(answer):
        nonlocal count
        count += 1
        return {"answer": count, "rows": len(answer.joints), "shapes": len(scene.workcell)}

    yield look


def test_what_is_said_of_every_answer_stands_in_its_row(batch) -> None:
    run_batch(replace(batch, watch=counting))
    rows = [row for row in batch_rows(batch) if row["query"] == 2]
    assert [row["answer"] for row in rows] == [1, 2, 3, 4]
    assert {row["planner"]: row["rows"] == 0 for row in rows} == {
        "band": False,
        "liar": False,
        "broken": True,
    }
    around = len(batch.scene.workcell)
    assert {row["shapes"] for row in rows} == {around + 1}, "the query's own sphere among them"


@dataclass(frozen=True)
class Telling:
    """Says whom it may ask about configurations."""

    name: str = "telling"

    def plan(self, problem, seed):
        word = f"{type(problem.is_free.__self__).__name__}, {problem.is_sound is not None}"
        return Solution("not_found", np.empty((0, 6)), 0.0, 1, word)


@contextmanager
def telling(names, scene, constraint, manifold):
    yield {"band": Telling()}, {"band": 0.0}


def test_all_planners_ask_the_compiled_check_and_may_ask_for_a_certificate(batch) -> None:
    one = replace(batch, queries=batch.queries[:1], baselines=ASKED[:1], build=telling)
    run_batch(one)
    assert [row["reason"] for row in batch_rows(one)] == ["CollisionCheck, True"]


def key(row):
    return [str(row[name]) for name in ("planner", "query", "seed")]


def test_a_changed_planner_is_asked_again_alone(batch) -> None:
    run_batch(batch)
    changed = replace(batch, baselines=(replace(ASKED[0], fingerprint="new"), *ASKED[1:]))
    assert rows_to_do(changed) == 3
    run_batch(changed)
    assert {row["planner"]: row["fingerprint"] for row in batch_rows(changed)}["band"] == "new"
    assert rows_to_do(changed) == 0


def test_rows_are_json_that_every_reader_takes(batch) -> None:
    run_batch(batch)
    for line in batch.file.read_text().splitlines():
        json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_queries_are_kept_to_the_bit(batch, tmp_path) -> None:
    write_queries(batch.queries, tmp_path / "queries.csv")
    again = read_queries(tmp_path / "queries.csv")
    for old, new in zip(batch.queries, again, strict=True):
        for name in ("constraint", "scene", "number", "obstacle"):
            assert getattr(old, name) == getattr(new, name)
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


def test_spheres_stand_between_the_ends_and_not_on_the_ends() -> None:
    planner = packaged_planner()
    manifold = manifold_of(planner, "level_cup")

    def plan(start, goal):
        return planner.plan(start, goal, "level_cup").joints

    few = PARAMS.benchmark.model_copy(update={"queries": 3, "seed": 5})
    queries = draw_benchmark(planner.scene.now, manifold, "level_cup", few, plan)
    assert [query.scene for query in queries] == ["table"] * 3 + ["keep_out"] * 3
    assert [query.number for query in queries] == list(range(6))
    for query in queries[3:]:
        with query.in_scene(planner.scene.now).world() as world:
            assert world.is_free(query.start)
            assert world.is_free(query.goal)
            assert world.first_collision(plan(query.start, query.goal)) is not None


def test_a_constraint_without_queries_says_what_draws_them(tmp_path) -> None:
    with pytest.raises(QueryError, match="wall.csv: missing.*`make draw-queries CONSTRAINT=wall`"):
        read_queries(tmp_path / "wall.csv")


def test_the_committed_queries_are_those_of_the_parameters() -> None:
    files = sorted((Path(__file__).parents[2] / "data" / "benchmark_queries").glob("*.csv"))
    assert {file.stem for file in files} >= set(PARAMS.constraints)
    for file in files:
        queries = read_queries(file)
        assert {query.constraint for query in queries} == {file.stem}
        assert [query.number for query in queries] == list(range(2 * PARAMS.benchmark.queries))
        with Scene.from_params(PARAMS, file.stem).world() as world:  # with what is carried
            assert world.free(np.array([[q.start, q.goal] for q in queries]).reshape(-1, 6)).all()
