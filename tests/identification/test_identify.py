"""Demonstrations of hidden tasks: what is identified keeps to the hidden formula."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from tests.identification.hidden import HIDDEN, UPRIGHT, demonstrations, drawn, manifold_of

from constraint_geodesics import bundle
from constraint_geodesics.constraints.constraint import ConstraintError, ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.identification import (
    DemonstrationError,
    identify,
    load_constraint,
    save_constraint,
)
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.identify import with_tolerance
from constraint_geodesics.planner import Planner
from constraint_geodesics.text_files import MOST_BYTES


def missed(task, found, robot) -> dict[str, float]:
    """The 95th percentile of the hidden residuals, by unit, on all of the identified set near the
    task: also where the hidden formula is not kept.
    """
    near = drawn(task, robot, 300, seed=8)
    moved = near + np.random.default_rng(2).normal(scale=0.15, size=near.shape)
    own = retract(ConstraintManifold(robot, found.constraint), moved)
    assert own.converged.mean() > 0.9
    hidden = manifold_of(task, robot)
    off = np.quantile(np.abs(hidden.residual(own.joints[own.converged])), 0.95, axis=0)
    worst = dict.fromkeys(hidden.constraint.units, 0.0)
    for unit, value in zip(hidden.constraint.units, off, strict=True):
        worst[unit] = max(worst[unit], float(value))
    return worst


@pytest.mark.parametrize("task", [*UPRIGHT, "orientation"])
def test_what_is_upside_down_is_no_demonstration_of_it(task, xarm) -> None:
    """A level axis has the same formula the other way up, an orientation turned by half."""
    found = identify(demonstrations(task, xarm, 10), xarm)
    anywhere = xarm.sample(4000, np.random.default_rng(1))
    own = retract(ConstraintManifold(xarm, found.constraint), anywhere)
    turned = xarm.forward(own.joints[own.converged])[1]
    assert len(turned) > 100
    if task == "orientation":
        assert (np.trace(turned, axis1=1, axis2=2) > 1.0).all()
    else:
        assert (turned[:, 2, 1] > 0.0).all()
        assert "direction (0, 0, 1)" in found.explanation


def test_an_upright_cup_s_constraint_is_far_from_the_tool_turned_by_half(xarm) -> None:
    found = identify(demonstrations("cup", xarm, 10), xarm)
    down = drawn("cup", xarm, 20)
    down[:, 5] += np.where(down[:, 5] > 0.0, -np.pi, np.pi)
    assert ConstraintManifold(xarm, found.constraint).violation(down).min() > 0.5


@pytest.mark.parametrize("task", HIDDEN)
def test_clean_demonstrations_give_the_formula_itself(task, xarm) -> None:
    found = identify(demonstrations(task, xarm, 10), xarm)
    assert found.codim == len(HIDDEN[task]), found.explanation
    assert max(missed(task, found, xarm).values()) < 1e-6
    assert found.missing == ""
    assert max(found.left_out) < 1e-6


@pytest.mark.parametrize("task", HIDDEN)
def test_a_persons_error_is_averaged_out(task, xarm) -> None:
    found = identify(demonstrations(task, xarm, 20, error_deg=0.3), xarm)
    assert found.codim == len(HIDDEN[task]), found.explanation
    off = missed(task, found, xarm)
    assert off.get("rad", 0.0) < np.radians(0.35)
    assert off.get("m", 0.0) < 2e-3
    assert found.noise_rad == pytest.approx(np.radians(0.3), rel=0.25)


@pytest.mark.parametrize("task", HIDDEN)
def test_noise_of_independent_rows(task, xarm) -> None:
    rows = drawn(task, xarm, 2000)
    noise = np.random.default_rng(1).normal(size=rows.shape)
    found = identify(rows + np.radians(0.5) * noise, xarm)
    assert found.codim == len(HIDDEN[task]), found.explanation
    off = missed(task, found, xarm)
    assert off.get("rad", 0.0) < np.radians(0.15)
    assert off.get("m", 0.0) < 0.8e-3
    assert found.noise_rad == pytest.approx(np.radians(0.5), rel=0.1)


def test_words_tell_the_numbers(xarm) -> None:
    text = identify(demonstrations("towards a centre", xarm, 10), xarm).explanation
    assert "a sphere, r = 250.0 mm about (420.0, 0.0, -50.0) mm" in text
    assert "z axis points at its centre" in text
    text = identify(demonstrations("door", xarm, 10), xarm).explanation
    assert "y axis keeps the direction (0, 0, 1)" in text
    assert "circle, r = 350.0 mm about the line through (550.0, 350.0, 0.0) mm" in text


def test_free_motion_identifies_nothing(xarm, kuka) -> None:
    for robot in (xarm, kuka):
        found = identify(robot.sample(2000, np.random.default_rng(0)), robot)
        assert found.constraint is None
        assert "free" in found.explanation
        assert found.codim == 0


def test_motions_that_hardly_differ_keep_to_nothing(xarm, kuka) -> None:
    """Free motions from one place to another: what is the same in all is no relation."""
    rng, t = np.random.default_rng(1), np.linspace(0.0, 1.0, 60)[:, None]
    for robot in (xarm, kuka):
        first, last = 0.4 * robot.sample(2, rng)
        for scatter in (0.01, 0.03, 0.06):
            for count in (3, 10):
                noise = rng.normal(size=(2, count, 1, robot.dof))
                shown = first + t * (last - first) + scatter * (noise[0] + np.sin(3 * t) * noise[1])
                found = identify(shown, robot)
                assert found.constraint is None, found.explanation
                assert "show more demonstrations" in found.missing or "free" in found.missing


def test_singular_configurations_are_no_error(kuka) -> None:
    """Demonstrations that begin stretched out, where the Jacobian is singular."""
    rng, t = np.random.default_rng(0), np.linspace(0.0, 1.0, 60)[:, None]
    shown = [t * 0.7 * kuka.sample(1, rng)[0] for _ in range(8)]
    assert isinstance(identify(shown, kuka).explanation, str)


def test_too_few_demonstrations_ask_for_more(xarm) -> None:
    shown = demonstrations("cup", xarm, 1)
    for one in (identify(shown, xarm), identify(shown[0], xarm)):
        assert one.constraint is None
        assert "there are no others: show more demonstrations" in one.missing
    for task in HIDDEN:
        for count in (2, 3):
            found = identify(demonstrations(task, xarm, count), xarm)
            assert found.codim <= len(HIDDEN[task]), found.explanation
            if found.codim < len(HIDDEN[task]):
                assert "show more demonstrations" in found.missing


def test_wrong_rows_are_left_out(xarm) -> None:
    rows = drawn("cup", xarm, 1000)
    wrong = np.random.default_rng(4).choice(1000, 50, replace=False)
    rows[wrong] = xarm.sample(50, np.random.default_rng(5))
    found = identify(rows, xarm)
    assert found.codim == 2
    assert 45 <= found.dropped <= 60
    assert missed("cup", found, xarm)["rad"] < np.radians(0.02)


def broken() -> dict:
    return {
        "one row": (lambda q: q[:1], "at least 12"),
        "nan": (lambda q: np.where(np.arange(len(q))[:, None] == 7, np.nan, q), "row 7"),
        "joints": (lambda q: q[:, :5], r"must be \(T, 6\)"),
        "degrees": (np.degrees, "degrees"),
        "another robot": (lambda q: q + 3.0, "another robot"),
        "still": (lambda q: np.repeat(q[:1], 50, axis=0), "moving"),
        "nothing": (lambda _: None, "must be rows"),
        "ragged": (lambda q: [q[:20], q[0].tolist()], "demonstration 1: shape"),
        "empty": (lambda q: [q, q[:0]], "demonstration 1: shape"),
    }


@pytest.mark.parametrize("name", broken())
def test_what_nothing_can_be_learned_from_is_one_line(name, xarm) -> None:
    change, words = broken()[name]
    with pytest.raises(DemonstrationError, match=words) as caught:
        identify(change(drawn("cup", xarm, 50)), xarm)
    assert "\n" not in str(caught.value)


def test_one_motion_is_one_however_it_is_written(xarm, tmp_path) -> None:
    """Twice, as demonstrations of a row each, or with its frames' numbers in front."""
    motion = demonstrations("cup", xarm, 10)[0]
    numbered = np.column_stack([np.arange(len(motion)), motion])
    np.savetxt(tmp_path / "frames.csv", numbered, delimiter=",")
    for given in ([motion, motion.copy()], [row[None] for row in motion], tmp_path / "frames.csv"):
        found = identify(given, xarm)
        assert found.constraint is None
        assert found.demonstrations == 1
        assert "there are no others" in found.missing


def test_rows_that_are_shown_twice_count_once(xarm) -> None:
    rows = drawn("cup", xarm, 300, seed=3)
    once, twice = identify(rows, xarm), identify(np.concatenate([rows, rows]), xarm)
    assert twice.rows == once.rows == 300
    assert twice.relations == once.relations


def test_glitches_make_no_variation(xarm) -> None:
    """Free motions that hardly differ, with a row anywhere in each; and one joint that is written
    within half a turn, so that it jumps where it passes that.
    """
    rng, t = np.random.default_rng(6), np.linspace(0.0, 1.0, 60)[:, None]
    first, last = 0.4 * xarm.sample(2, rng)
    noise = rng.normal(size=(2, 10, 1, xarm.dof))
    shown = first + t * (last - first) + 0.01 * (noise[0] + np.sin(3 * t) * noise[1])
    jumping = shown.copy()
    jumping[..., 0] -= 2 * np.pi * (shown[..., 0] > np.median(shown[..., 0]))
    wide = replace(xarm, lower=xarm.lower - 2 * np.pi, upper=xarm.upper + 2 * np.pi)
    glitched = shown.copy()
    glitched[np.arange(10), rng.integers(60, size=10)] = xarm.sample(10, rng)
    for own in (shown, jumping, glitched):
        assert identify(own, wide).constraint is None


def test_what_is_no_table_of_joints_is_refused_by_its_names(xarm, tmp_path) -> None:
    names = ["time_s", *xarm.joint_names[:5]]
    table = np.column_stack([np.linspace(0, 1, 60), demonstrations("cup", xarm, 1)[0][:60, :5]])
    (tmp_path / "own.csv").write_text(
        "\n".join([",".join(names), *(",".join(map(str, row)) for row in table)])
    )
    for given in (tmp_path / "own.csv", pd.DataFrame(table, columns=names)):
        with pytest.raises(DemonstrationError, match="named otherwise than the joints"):
            identify(given, xarm)
    motion = demonstrations("cup", xarm, 1)[0]
    with pytest.raises(DemonstrationError, match="all but 1 of"):
        identify([motion, motion[:1]], xarm)
    mixed = pd.DataFrame(motion[:, ::-1], columns=xarm.joint_names[::-1])
    assert identify(mixed, xarm).rows == len(motion)


def test_files_are_read_as_arrays_are(xarm, tmp_path) -> None:
    import pandas as pd

    shown = demonstrations("cup", xarm, 4)
    numbers = np.repeat(np.arange(4.0), 60)[:, None]
    rows = np.concatenate(shown)
    np.savetxt(tmp_path / "demos.csv", np.hstack([numbers, rows]), delimiter=",")
    pd.DataFrame(
        {"episode_index": numbers[:, 0].astype(int), "observation.state": list(rows)}
    ).to_parquet(tmp_path / "demos.parquet")
    expected = identify(shown, xarm)
    for name in ("demos.csv", "demos.parquet"):
        found = identify(tmp_path / name, xarm)
        assert found.demonstrations == 4
        assert found.explanation == expected.explanation
    with pytest.raises(DemonstrationError, match="no such file"):
        identify(tmp_path / "none.csv", xarm)
    names = ",".join(xarm.joint_names)
    timed = np.hstack([np.arange(60.0)[:, None], shown[0]])
    np.savetxt(tmp_path / "timed.csv", timed, delimiter=",", header=f"time_s,{names}", comments="")
    assert identify(tmp_path / "timed.csv", xarm).constraint is None, "one motion"
    timed[:, 0] *= 0.1
    np.savetxt(tmp_path / "unnamed.csv", timed, delimiter=",")
    with pytest.raises(DemonstrationError, match="must be the demonstration's number"):
        identify(tmp_path / "unnamed.csv", xarm)
    (tmp_path / "empty.csv").write_text(f"{names}\n")
    with pytest.raises(DemonstrationError, match="no rows of numbers"):
        identify(tmp_path / "empty.csv", xarm)
    (tmp_path / "text.csv").write_text("a,b\nc,d\n")
    with pytest.raises(DemonstrationError, match="not a table of numbers"):
        identify(tmp_path / "text.csv", xarm)


def test_images_of_a_file_are_not_read(xarm, tmp_path) -> None:
    rows = np.concatenate(demonstrations("cup", xarm, 2))
    image = np.random.default_rng(0).bytes(MOST_BYTES // len(rows) + 1)
    table = pd.DataFrame({"observation.state": list(rows), "observation.image": image})
    file = tmp_path / "seen.parquet"
    table.to_parquet(file, compression=None, use_dictionary=False)
    assert file.stat().st_size > MOST_BYTES
    (found,), _ = demonstrations_from(file, xarm)
    np.testing.assert_array_equal(found, rows)


def test_columns_are_never_taken_for_others(xarm, tmp_path) -> None:
    """By their order where names are half of them right, or beside one that is no text."""
    shown, names = np.concatenate(demonstrations("cup", xarm, 4)), list(xarm.joint_names)
    table = pd.DataFrame(shown, columns=names)
    numbers = pd.Series(np.repeat(np.arange(4), len(shown) // 4))
    told, motions = demonstrations_from(pd.concat([numbers, table], axis=1), xarm)
    assert not motions or len(told) == 1
    np.testing.assert_array_equal(np.unique(np.concatenate(told), axis=0), np.unique(shown, axis=0))
    swapped = [names[1], names[0], "joint_3", *names[3:]]
    file = tmp_path / "swapped.csv"
    table.set_axis(swapped, axis=1).to_csv(file, index=False)
    with pytest.raises(DemonstrationError, match=f"swapped.csv: among its columns.*{names[2]}"):
        demonstrations_from(file, xarm)
    file.write_text(",".join(["0.1"] * 5 + [""]) + "\n" + table.to_csv(index=False, header=False))
    with pytest.raises(
        DemonstrationError, match="csv: its first row has '' among numbers: must be"
    ):
        demonstrations_from(file, xarm)


def test_a_tip_on_a_sphere_whose_axis_lies_in_it_is_found(kuka) -> None:
    """What is found later is looked at on other rows, too."""
    centre, radius = np.array([0.4, 0.0, 0.5]), 0.25

    def off(q: np.ndarray) -> np.ndarray:
        places, turns = kuka.forward(q)
        away = places - centre
        return np.stack(
            [(away**2).sum(-1) - radius**2, np.einsum("ni,ni->n", away, turns[..., 2])], axis=-1
        )

    q, step = kuka.sample(1500, np.random.default_rng(2)), 1e-6
    for _ in range(30):
        slopes = [(off(q + step * e) - off(q - step * e)) / (2 * step) for e in np.eye(kuka.dof)]
        q = q - np.einsum("nij,nj->ni", np.linalg.pinv(np.stack(slopes, axis=-1)), off(q))
    good = (np.abs(off(q)).max(axis=1) < 1e-12) & (kuka.limit_distance(q) > 0.0)
    found = identify(q[good][:250], kuka)
    assert found.constraint is not None
    assert len(found.constraint.relations) == 2


def free_ends(planner: Planner, shown: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Those of the first demonstration that begins and ends where the planner's arm touches
    nothing; a demonstration knows of no table.
    """
    with planner.scene.world() as world:
        return next((own[0], own[-1]) for own in shown if world.free(own[[0, -1]]).all())


def test_a_saved_constraint_is_planned_with_and_certified(xarm, kuka, tmp_path) -> None:
    found = identify(demonstrations("cup", xarm, 10), xarm)
    found.save(tmp_path / "cup.yaml")
    loaded = load_constraint(tmp_path / "cup.yaml")
    assert loaded.key == found.constraint.key
    with Planner.load(bundle.PACKAGED) as planner:
        start, goal = free_ends(planner, demonstrations("cup", xarm, 20)[10:])
        path = planner.plan(start, goal, loaded)
        assert path.status == "solved", path.explanation
        hidden = manifold_of("cup", xarm)
        assert np.abs(hidden.residual(path.joints)).max() < 2e-4
        assert "left out" in path.explanation
        bare = PolynomialConstraint(found.constraint.relations)
        assert "left out" not in planner.plan(start, goal, bare).explanation
        assert "left out" in planner.plan(start, goal, loaded).explanation
    loose = with_tolerance(found.constraint, 3.0)
    tolerances = [own.tolerance for own in loose.relations]
    assert tolerances[:2] == pytest.approx([3 * x for x in found.left_out[:2]])
    again = found.held_loosely(3.0).held_loosely(3.0)
    assert again.constraint.key == found.held_loosely(3.0).constraint.key
    (tmp_path / "other.yaml").write_text("format: 1\nconstraint: {kind: polynomial}\n")
    with pytest.raises(ConstraintError, match="other.yaml: polynomial: 'relations' is missing"):
        load_constraint(tmp_path / "other.yaml")
    with pytest.raises(ConstraintError, match="found for xarm6 with the tool link6, not"):
        load_constraint(tmp_path / "cup.yaml", kuka)
    longer = xarm.chain.tool.copy()
    longer[2, 3] += 0.1
    other = replace(xarm, chain=xarm.chain._replace(tool=longer))
    with pytest.raises(ConstraintError, match=r"found for a tool link6 at \(.*, not at \(.*0\.1"):
        load_constraint(tmp_path / "cup.yaml", other)
    assert load_constraint(tmp_path / "cup.yaml", xarm).key == loaded.key
    nothing = identify(xarm.sample(500, np.random.default_rng(0)), xarm)
    with pytest.raises(ConstraintError, match="no constraint to save"):
        save_constraint(nothing, tmp_path / "free.yaml")


def test_from_a_csv_to_a_path_by_the_shell(xarm, tmp_path, capsys) -> None:
    from typer.testing import CliRunner

    from constraint_geodesics.cli import app
    from constraint_geodesics.recording.recording import read_recording

    shown = demonstrations("cup", xarm, 10)
    numbers = np.repeat(np.arange(10.0), 60)[:, None]
    csv, yaml = tmp_path / "demos.csv", tmp_path / "wipe.yaml"
    np.savetxt(csv, np.hstack([numbers, np.concatenate(shown)]), delimiter=",")
    run = CliRunner()
    rrd = tmp_path / "demos.rrd"
    ask = ["identify", str(csv), "--out", str(yaml), "--where-shown", "--record", str(rrd)]
    answer = run.invoke(app, [*ask, "--json"])
    assert answer.exit_code == 0, answer.output
    about = json.loads(answer.stdout)
    assert about["identified"]
    assert about["codim"] == 2
    assert "region where it was shown" in about["where_shown"]
    assert "region where it was shown" in load_constraint(yaml, xarm).label
    entities = read_recording(rrd).entity_paths
    assert {"/demonstrations", "/identified", "/tool/trace"} <= set(entities)
    assert run.invoke(app, ["identify", str(csv), "--where-shown"]).exit_code == 2
    (tmp_path / "taken.yaml").mkdir()
    answer = run.invoke(
        app, ["identify", str(csv), "--out", str(tmp_path / "taken.yaml"), "--json"]
    )
    assert answer.exit_code != 0
    assert json.loads(answer.stdout)["codim"] == 2, "what was found is told all the same"
    with Planner.load(bundle.PACKAGED) as planner:
        ends = [" ".join(f"{x:.9f}" for x in q) for q in free_ends(planner, shown)]
    ask = ["plan", "--constraint", str(yaml), "--start", ends[0], "--goal", ends[1], "--json"]
    ask += ["--planner", str(bundle.PACKAGED)]
    path = run.invoke(app, ask)
    assert path.exit_code == 0, path.output
    assert json.loads(path.stdout)["status"] == "solved"
    drawn_beside = ["--record", str(tmp_path / "path.rrd"), "--demonstrations", str(csv)]
    answer = run.invoke(app, [*ask, *drawn_beside])
    assert answer.exit_code == 0, answer.output
    entities = read_recording(tmp_path / "path.rrd").entity_paths
    assert {"/demonstrations", "/identified", "/tool/trace"} <= set(entities)
    assert run.invoke(app, [*ask, *drawn_beside[2:]]).exit_code == 2, "drawn in no recording"
    rounded = run.invoke(app, ["identify", str(csv), "--rounded"])
    assert rounded.exit_code == 0
    assert "no rounder numbers fit" in rounded.stderr
    wrong = run.invoke(app, ["identify", str(csv), "--out", str(tmp_path / "cup.txt")])
    assert wrong.exit_code == 2
    np.savetxt(csv, xarm.sample(300, np.random.default_rng(0)), delimiter=",")
    assert run.invoke(app, ["identify", str(csv)]).exit_code == 3
    missing = run.invoke(app, ["identify", str(tmp_path / "none.csv")])
    assert missing.exit_code == 2
    assert run.invoke(app, [*ask[:2], str(tmp_path / "none.yaml"), *ask[3:]]).exit_code == 2
