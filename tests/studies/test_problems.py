"""Problems in scenes of their own: what is drawn there is seeded and keeps what it says, planners
are judged by the certifier and by PyBullet, and figures are of what they say.
"""

from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.benchmark.problem_fixtures import problem, shape, small_file, written

from constraint_geodesics import bundle
from constraint_geodesics.benchmark.arm_source import (
    MOST_OPEN,
    PipelineArm,
    UrdfArm,
    close_opened,
    opened,
)
from constraint_geodesics.benchmark.dense_check import watched
from constraint_geodesics.benchmark.problem_files import Problem, ProblemFileError, read_problems
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.benchmark.runner import batch_rows, rows_to_do, run_batch
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.params import BaselineParams, load_params
from constraint_geodesics.peers.baseline import BaselineError
from constraint_geodesics.problem import PlannerError, Solution
from constraint_geodesics.report.problems_page import problems_markdown, totals_markdown
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.studies.clutter import KINDS, MAKERS, cluttered, shapes_of, write_bracket
from constraint_geodesics.studies.problem_runs import (
    Asked,
    answered,
    batches,
    figures,
    limited,
    table_of,
)
from constraint_geodesics.studies.problems import (
    ENDS_RAD,
    MOVED_M,
    TILT_RAD,
    TILTED,
    level_pose,
    tilted,
)

PARAMS = load_params(Path(__file__).parents[2] / "params.yaml")
XARM = PipelineArm(bundle.PACKAGED)


@pytest.fixture(scope="module")
def problems(tmp_path_factory) -> list[Problem]:
    return read_problems(written(small_file(), tmp_path_factory.mktemp("file") / "small.json"))


def asked(folder: Path, **planners: dict) -> Asked:
    named = {name: BaselineParams.model_validate(own) for name, own in planners.items()}
    return Asked(PARAMS, named, 10.0, {TILTED: 20.0}, folder, "code")


def tilt(own: Problem, q: np.ndarray) -> float:
    """Of the tool's axis that the reference has upright [rad]."""
    reference = own.constraint.reference
    assert reference is not None
    upright = own.scene.robot.forward(q)[1] @ reference.rotation.T @ [0.0, 0.0, 1.0]
    return float(np.arccos(np.clip(upright[2], -1.0, 1.0)))


def test_drawn_queries_are_seeded_and_keep_what_they_say(problems) -> None:
    found, again = tilted(problems, 2, 3), tilted(problems, 2, 3)
    assert [own.group for own in found] == ["posts", "posts", "crate"]
    for own, same in zip(found, again, strict=True):
        np.testing.assert_array_equal(own.start, same.start)
        np.testing.assert_array_equal(own.goal, same.goal)
        assert own.constraint_name == TILTED
        assert own.constraint.tolerance[3:5] == (pytest.approx(TILT_RAD),) * 2
        robot = own.scene.robot
        with own.scene.world() as world:
            for q in (own.start, own.goal):
                assert tilt(own, q) <= ENDS_RAD + 1e-6
                assert robot.limit_distance(q) >= 0.0
                assert world.is_free(q)
        tools = [robot.forward(q)[0] for q in (own.start, own.goal)]
        assert np.linalg.norm(tools[1] - tools[0]) >= MOVED_M
    other = tilted(problems, 2, 4)
    assert not np.allclose(found[0].start, other[0].start)


def test_a_query_does_not_hang_on_the_other_ones(problems) -> None:
    alone = tilted(problems[2:], 1, 3)
    np.testing.assert_array_equal(alone[0].start, tilted(problems, 1, 3)[1].start)


def test_level_is_as_the_goals_have_the_tool(problems) -> None:
    robot = problems[0].scene.robot
    for own in problems:
        pose = level_pose([own])
        turn = robot.forward(own.goal)[1]
        np.testing.assert_allclose(np.linalg.det(pose.rotation), 1.0)
        # what is upright at the reference is what is nearest to upright at the goal
        assert int(np.abs(turn[2]).argmax()) == int(np.abs(pose.rotation[2]).argmax())
        assert turn[2] @ pose.rotation[2] > 0.0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_any_axis_of_the_tool_may_be_upright(axis, sign) -> None:
    up = sign * np.eye(3)[axis]

    @dataclass
    class Robot:
        def forward(self, q):
            return np.zeros(3), np.stack([np.roll(up, 1), np.roll(up, 2), up])

    @dataclass
    class Own:
        goal = np.zeros(7)
        scene = type("S", (), {"robot": Robot()})

    pose = level_pose([Own()])  # type: ignore[list-item]
    np.testing.assert_allclose(pose.rotation[2], up)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def rows(problems, tmp_path_factory) -> list[dict]:
    """The planner and BiRRT on two free problems and one with a held tilt."""
    planners = {"planner": {"kind": "planner"}, "BiRRT + band": {"kind": "birrt", "band": True}}
    of = asked(tmp_path_factory.mktemp("rows"), **planners)
    found = []
    for batch in batches([*problems[::2], *tilted(problems[2:], 1, 3)], of):
        assert run_batch(batch) == 2
        assert rows_to_do(batch) == 0
        found += batch_rows(batch)
    return found


def test_all_planners_answer_in_every_scene_and_are_judged_twice(rows) -> None:
    assert len(rows) == 6
    for row in rows:
        assert (row["status"], row["valid"], row["touches"]) == ("solved", True, False), row
        assert row["ends"] == ""
        # every 5 mrad, the rows themselves among them
        assert row["looked_at"] >= row["length_rad"] / 0.005
        assert 0.0 < row["core_share"] < 1.2
    found = figures(table_of(rows, lambda name: 10.0))
    assert {name: set(scenes) for name, scenes in found.items()} == {
        "free": {"posts", "crate", "all"},
        TILTED: {"crate", "all"},
    }
    for planner in ("planner", "BiRRT + band"):
        total = found["free"]["all"][planner]
        assert (total["problems"], total["solvable"], total["solved"]) == (2, 2, 2)
        assert total["ratio_median"] >= 1.0
        assert total["wrongly_certified"] == 0
    text = problems_markdown("Problems", ["two scenes"], found)
    assert "| 2 of 2 |" in " ".join(text.split())
    assert f"## Scene by scene: {TILTED}" in text


def test_who_a_constraint_is_not_for_has_no_figures_of_it(rows) -> None:
    own = [row for row in rows if (row["planner"], row["constraint"]) == ("planner", TILTED)]
    kept = [row | {"planner": "bundle", "status": "not_applicable"} for row in own]
    found = figures(table_of([*rows, *kept], lambda name: 10.0))
    assert found == figures(table_of(rows, lambda name: 10.0))


def test_a_changed_scene_limit_or_code_is_asked_again(problems, tmp_path) -> None:
    of = asked(tmp_path, planner={"kind": "planner"})
    (batch,) = batches(problems[:1], of)
    box = Box("new", (1.5, 0.0, 0.5), (0.1, 0.1, 0.1))
    moved = replace(problems[0], scene=problems[0].scene.adding(box))
    others = [
        batches([moved], of)[0],
        batches(problems[:1], replace(of, limit_s=5.0))[0],
        batches(problems[:1], replace(of, code="other"))[0],
    ]
    prints = {own.baselines[0].fingerprint for own in (batch, *others)}
    assert len(prints) == 4
    assert batches(problems[:1], of)[0].baselines == batch.baselines


TRIANGLE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 {height}\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
ARM = """<robot name="two">
  <link name="base"/>
  <link name="upper"><collision><geometry><mesh filename="part.obj"/></geometry></collision></link>
  <link name="tool"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="tool"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
</robot>"""
SIX_AXIS = Path(__file__).parents[1] / "robots" / "six_axis.urdf"
SRDF = '<robot name="two">{pairs}</robot>'
PAIR = '<disable_collisions link1="base" link2="tool" reason="Never"/>'


def test_an_arm_whose_files_change_in_place_is_asked_again(tmp_path) -> None:
    urdf, srdf, mesh = (tmp_path / name for name in ("two.urdf", "two.srdf", "part.obj"))
    urdf.write_text(ARM)
    record = {
        "joints": ["a", "b"],
        "scenes": {"all": [{"start": [0.0, 0.0], "goal": [1.0, 0.5], "shapes": []}]},
    }
    file, seen = written(record, tmp_path / "two.json"), []
    for height, pairs in ((0.1, ""), (0.2, ""), (0.1, PAIR), (0.1, "")):
        mesh.write_text(TRIANGLE.format(height=height))
        srdf.write_text(SRDF.format(pairs=pairs))
        close_opened()  # as a later run
        found = read_problems(file, UrdfArm(str(urdf), "tool", str(srdf)))
        (batch,) = batches(found, asked(tmp_path, planner={"kind": "planner"}))
        seen.append(batch.baselines[0].fingerprint)
    assert len(set(seen)) == 3
    assert seen[0] == seen[3]


def test_planners_beyond_the_last_few_are_closed_and_opened_anew(tmp_path) -> None:
    close_opened()
    files = [tmp_path / f"{k}.srdf" for k in range(MOST_OPEN + 1)]
    for file in files:
        file.write_text(SRDF.format(pairs=""))
    arms = [UrdfArm(str(SIX_AXIS), "tool", str(file)) for file in files]
    first = opened(arms[0])
    assert opened(arms[0]) is first
    for arm in arms[1:]:
        opened(arm)
    with pytest.raises(PlannerError, match="closed"):
        first.plan(np.zeros(6), np.ones(6), "free")
    assert opened(arms[0]) is not first
    close_opened()


def test_problems_with_one_key_are_refused_before_any_work(problems, tmp_path) -> None:
    of = asked(tmp_path / "rows", planner={"kind": "planner"})
    again = [*problems, problems[0]]
    with pytest.raises(ProblemFileError, match="two problems are number 0 of 'posts'"):
        answered(again, of, "problems")
    assert not of.rows.exists()


def test_no_rows_are_an_empty_table() -> None:
    table = table_of([], lambda name: 10.0)
    assert table.empty
    assert "length_rad" in table
    assert figures(table) == {}
    assert totals_markdown({}).startswith("| constraint ")


def test_what_was_trained_for_another_arm_is_refused(problems, tmp_path) -> None:
    for own in ({"kind": "latent_graph"}, {"kind": "planner", "method": "learned"}):
        with pytest.raises(BaselineError, match="'trained' is made of what the pipeline trained"):
            batches(problems[:1], asked(tmp_path, trained=own))


def test_planners_of_ompl_stop_at_the_limit() -> None:
    birrt = BaselineParams(kind="birrt", band=True)  # type: ignore[call-arg]
    own = BaselineParams(kind="birrt", budget_s=3.0)  # type: ignore[call-arg]
    assert limited(birrt, 7.0).settings == {"band": True, "budget_s": 7.0}
    assert limited(own, 7.0).settings == {"budget_s": 3.0}
    assert limited(BaselineParams(kind="planner"), 7.0).settings == {}


@dataclass(frozen=True)
class Through:
    """Answers with the straight line, whatever is there."""

    name: str = "through"

    def plan(self, problem, seed):
        return Solution("solved", np.linspace(problem.start, problem.goal, 100), 0.001, 1)


@contextmanager
def through(names, scene, constraint, manifold):
    yield {name: Through() for name in names}, {}


def test_pybullet_has_its_own_word_on_answered_paths(tmp_path) -> None:
    """A wall between the ends, and one that the start is in."""
    record = small_file()
    turn = [0.0, 0.0, float(np.sin(0.25)), float(np.cos(0.25))]  # half way between the ends
    place = [0.55 * float(np.cos(0.5)), 0.55 * float(np.sin(0.5)), 0.6]
    wall = shape("wall", "box", [0.4, 0.01, 1.2], place, turn)
    inside = shape("wall", "box", [0.1, 0.1, 0.1], [0.31, 0.0, 0.59], [0.0, 0.0, 0.0, 1.0])
    record["scenes"] = {"wall": [problem(wall)], "inside": [problem(inside)]}
    found = read_problems(written(record, tmp_path / "wall.json"))
    rows = []
    for batch in batches(found, asked(tmp_path, planner={"kind": "planner"})):
        changed = replace(batch, build=through)
        run_batch(changed)
        rows += batch_rows(changed)
    assert [row["ends"] for row in rows] == ["", "start touches"]
    assert [row["touches"] for row in rows] == [True, True]
    assert not any(row["valid"] for row in rows)
    assert batch.watch is watched


def row_of(planner: str, query: int, **own) -> dict:
    return {
        "planner": planner,
        "constraint": "free",
        "scene": "box",
        "query": query,
        "seed": 0,
        "settings": "s",
        "status": "solved",
        "valid": True,
        "touches": False,
        "ends": "",
        "time_s": 0.1,
        "scene_s": 0.02,
        "length_rad": 2.0,
        "looked_at": 400,
        "iterations": 1,
        "peak_memory_mb": 0.0,
        "core_share": 0.5,
        "reason": "",
        **own,
    }


NO_PATH = {"status": "not_found", "valid": False, "length_rad": None, "time_s": 1.0}


def test_figures_count_what_they_say() -> None:
    """One problem a line: a is longer, a fails, b is late, b is wrongly certified, none solves it,
    ends touch.
    """
    table = table_of(
        [
            *(row_of("a", 0, length_rad=3.0), row_of("b", 0)),
            *(row_of("a", 1, **NO_PATH), row_of("b", 1, time_s=0.3)),
            *(row_of("a", 2), row_of("b", 2, time_s=11.0, length_rad=1.0)),
            *(row_of("a", 3), row_of("b", 3, touches=True, length_rad=0.5)),
            *(row_of("a", 4, **NO_PATH), row_of("b", 4, valid=False)),
            *(row_of("a", 5, ends="goal touches", **NO_PATH), row_of("b", 5, ends="goal touches")),
        ],
        lambda name: 10.0,
    )
    a, b = (figures(table)["free"]["all"][name] for name in ("a", "b"))
    for own in (a, b):
        counts = [own[name] for name in ("problems", "apart", "asked", "solvable")]
        assert counts == [6, 1, 5, 4]
    assert (a["solved"], b["solved"]) == (3, 2)
    assert (a["late"], b["late"]) == (0, 1)
    assert (a["wrongly_certified"], b["wrongly_certified"]) == (0, 1)
    assert (a["refused"], b["refused"]) == (0, 1)
    # a late path is the best known all the same, one that touches something is not
    assert a["ratio_p95"] == pytest.approx(np.quantile([1.5, 2.0, 1.0], 0.95))
    assert b["ratio_median"] == 1.0
    assert (a["time_ms_median"], b["time_ms_median"]) == (100.0, pytest.approx(200.0))
    # failures as the whole limit: of b a late path and a wrongly certified one
    assert b["time_all_ms_median"] == pytest.approx(np.median([100.0, 300.0, 1e4, 1e4]))
    assert figures(table)["free"]["box"]["a"] == a
    row = totals_markdown(figures(table)).splitlines()[2]
    assert [cell.strip() for cell in row.split("|")[1:5]] == ["free", "a", "5", "3 of 4"]


def test_kept_rows_make_the_same_file_twice(tmp_path) -> None:
    table = table_of([row_of("a", 0), row_of("a", 1, **NO_PATH)], lambda name: 10.0)
    for name in ("one.csv.gz", "two.csv.gz"):
        write_table(table, tmp_path / name, {"commit": "c"})
    assert (tmp_path / "one.csv.gz").read_bytes() == (tmp_path / "two.csv.gz").read_bytes()
    again = pd.read_csv(tmp_path / "one.csv.gz", comment="#")
    assert list(again.columns) == list(table.columns)
    assert again["length_rad"].tolist()[0] == 2.0


def test_clutter_is_seeded_of_all_kinds_and_within_reach(tmp_path) -> None:
    bracket = write_bracket(tmp_path)
    for kind in KINDS:
        found = shapes_of(kind, np.random.default_rng(5), bracket)
        assert found == shapes_of(kind, np.random.default_rng(5), bracket)
        assert found != shapes_of(kind, np.random.default_rng(6), bracket)
        assert len(found) == kind.shapes
        kinds = {type(own).__name__ for own in found}
        assert kinds == ({"Box"} if kind.half_m is None else KINDS_OF_SHAPES)
        for own in found:
            corners = np.concatenate([piece.corners for piece in own.pieces()])
            assert np.linalg.norm(corners[:, :2], axis=1).min() < 0.9


KINDS_OF_SHAPES = {"Box", "Sphere", "Capsule", "Cylinder", "Mesh", "PointCloud"}


def test_every_maker_makes_a_shape_no_larger_than_is_asked(tmp_path) -> None:
    rng, bracket = np.random.default_rng(0), write_bracket(tmp_path)
    for name, make in MAKERS.items():
        own = make(name, Placement((0.5, 0.0, 0.4), (0.3, 0.2, 0.1)), 0.1, rng, bracket)
        away = max(
            np.linalg.norm(piece.corners - [0.5, 0.0, 0.4], axis=1).max() + piece.rounding
            for piece in own.pieces()
        )
        assert 0.02 < away < 0.2, name


def test_queries_among_clutter_are_free_and_keep_their_constraints(tmp_path) -> None:
    names = ("free", "slide")
    found = list(cluttered(XARM, names, 2, 4, 5, tmp_path))
    again = list(cluttered(XARM, names, 2, 4, 5, tmp_path))
    counts = pd.Series([(own.group, own.constraint_name) for own in found]).value_counts()
    assert set(counts.index) == {(kind.name, name) for kind in KINDS for name in names}
    assert (counts <= 4).all()
    assert counts["10 shapes", "free"] == 4
    keys = [(own.group, own.constraint_name, own.number) for own in found]
    assert len(set(keys)) == len(keys)
    for own, same in zip(found, again, strict=True):
        np.testing.assert_array_equal(own.start, same.start)
        manifold = ConstraintManifold(own.scene.robot, own.constraint)
        assert max(manifold.violation(q) for q in (own.start, own.goal)) <= 1e-4
    with Certifier(found[0].scene) as certifier:
        assert certifier.collisions.free(np.stack([found[0].start, found[0].goal])).all()
    table = {own.name for own in opened(XARM).scene.workcell}
    assert table <= {own.name for own in found[0].scene.workcell}


def test_queries_of_one_scene_are_asked_together(tmp_path) -> None:
    found = list(cluttered(XARM, ("free",), 1, 3, 5, tmp_path))
    made = batches(found, asked(tmp_path, planner={"kind": "planner"}))
    assert [len(batch.queries) for batch in made] == [3, 3, 3]
    assert run_batch(made[0]) == 3
    assert {row["scene"] for row in batch_rows(made[0])} == {"10 shapes"}
