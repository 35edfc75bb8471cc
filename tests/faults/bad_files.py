"""Files that are none, or say what can't be: of paths, constraints, scenes, attached shapes,
MoveIt's, problems, demonstrations, robots, meshes and data sets.
"""

import copy
import gzip
import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.problem_files import read_problems
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.files import load_constraint
from constraint_geodesics.learning.dataset import (
    POSE_COLUMNS,
    RPY_COLUMNS,
    Shard,
    read_joints,
    read_queries,
    write_joints,
)
from constraint_geodesics.moveit import add_moveit_scene, read_moveit_request
from constraint_geodesics.params import load_params
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.planning_scene import PlanningScene
from constraint_geodesics.scene.scene_file import read_attached, read_scene
from tests.benchmark.problem_fixtures import JOINTS, small_file
from tests.faults.bad_input import Bad, written

Reader = Callable[[Path], object]
ROBOTS = Path(__file__).resolve().parents[1] / "robots"
NO_TEXT = b"\xff\xfe\x00\x01\x80"
LAUGHS = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10)
)
"""A few lines of YAML with 10¹⁰ values."""
NO_YAML = {
    "broken": "shapes: [1",
    "tab": "\tshapes: 1",
    "twice": "shapes: {}\nshapes: {}\n",
    "documents": "a: 1\n---\nb: 2\n",
    "laughs": LAUGHS,
    "itself": "a: &a [*a]\n",
    "key": "? [1, 2]\n: 3\n",
    "number": "5\n",
    "list": "- 1\n- 2\n",
    "tag": "a: !!python/object/apply:os.system ['true']\n",
    "deep": "[" * 1_000,
}
CSV = "# constraint: {{}}\ntime_s,{names}\n{rows}\n"


def cases(planner: Planner, folder: Path) -> Iterator[Bad]:
    """For a planner whose scene they leave as it is; files are written into a folder."""
    robot, scene = planner.robot, planner.scene
    readers: dict[str, tuple[str, Reader]] = {
        "params": ("yaml", load_params),
        "constraint": ("yaml", lambda file: load_constraint(file, robot)),
        "scene": ("yaml", lambda file: read_scene(file).into(scene)),
        "attached": ("yaml", lambda file: read_attached(file).into(scene)),
        "moveit_scene": ("yaml", lambda file: add_moveit_scene(file, scene)),
        "moveit_request": ("yaml", lambda file: read_moveit_request(file, planner)),
        "path": ("csv", planner.check),
        "shown": ("csv", lambda file: demonstrations_from(file, robot)),
        "problems": ("json", read_problems),
        "arm": ("urdf", lambda file: Planner.from_urdf(file, "tool")),
        "mesh_obj": ("obj", lambda file: scene.add(Mesh("n", file))),
        "mesh_stl": ("stl", lambda file: scene.add(Mesh("n", file))),
        "mesh_dae": ("dae", lambda file: scene.add(Mesh("n", file))),
        "joints": ("parquet", read_joints),
        "queries": ("csv", read_queries),
    }
    for kind, (suffix, read) in readers.items():
        yield from _no_files(kind, suffix, read, folder)
        if suffix == "yaml":
            for name, text in NO_YAML.items():
                yield _case(f"{kind} {name}", read, folder, f"{name}.yaml", text)
    read = {kind: own for kind, (_, own) in readers.items()}
    yield from _paths(planner, read["path"], folder)
    yield from _scenes(read["scene"], read["attached"], folder)
    yield from _moveit(planner, read["moveit_scene"], read["moveit_request"], folder)
    yield from _problems(planner, read["problems"], folder)
    yield from _tables(planner, read, folder)
    yield from _robots(read["arm"], folder)
    yield from _constraints(planner, read["constraint"], folder)
    yield from _bundles(folder)


def _case(
    name: str, read: Reader, folder: Path, file: str, content: str | bytes, *said: str
) -> Bad:
    place = folder / "given"  # where no word stands that a line must hold for its own sake
    return Bad(name, lambda: read(written(place, file, content)), (file, *said))


def _no_files(kind: str, suffix: str, read: Reader, folder: Path) -> Iterator[Bad]:
    """Nothing, a folder, an endless one, one that nobody writes to, and such as are no text."""
    yield Bad(f"{kind} missing", lambda: read(folder / f"none.{suffix}"), (f"none.{suffix}",))
    inner = folder / f"inner.{suffix}"
    inner.mkdir(exist_ok=True)
    yield Bad(f"{kind} folder", lambda: read(inner), (f"inner.{suffix}",))
    for name, target in (("endless", "/dev/zero"), ("null", "/dev/null")):
        link = folder / f"{name}.{suffix}"
        if not link.is_symlink():
            link.symlink_to(target)
        yield Bad(f"{kind} {name}", lambda link=link: read(link), (link.name,))
    pipe = folder / f"pipe.{suffix}"
    if not pipe.exists():
        os.mkfifo(pipe)
    yield Bad(f"{kind} pipe", lambda: read(pipe), (pipe.name,))
    yield _case(f"{kind} empty", read, folder, f"empty.{suffix}", b"")
    yield _case(f"{kind} no text", read, folder, f"binary.{suffix}", NO_TEXT)
    yield _case(f"{kind} nul", read, folder, f"nul.{suffix}", b"\0" * 100)
    yield _case(f"{kind} words", read, folder, f"words.{suffix}", "good morning\n")


def _paths(planner: Planner, read: Reader, folder: Path) -> Iterator[Bad]:
    names = ",".join(planner.robot.joint_names)
    row = ",".join(["0.0"] * 6)
    held = json.dumps(planner.constraints["level_cup"].to_json())
    own = f"# constraint: {held}\n"
    timed = f"time_s,{names}\n0.0,{row}\n1.0,{row}\n"
    for name, text, said in (
        ("no constraint", f"{names}\n{row}\n{row}\n", "names no constraint"),
        ("second constraint", f"{own}{own}{timed}", "line 2: a second constraint"),
        ("second velocity", f"{own}# start_velocity: [0]\n# start_velocity: [0]\n", "line 3"),
        ("constraint of no JSON", f"# constraint: level\n{timed}", "line 1"),
        ("constraint of null", f"# constraint: null\n{timed}", "line 1"),
        ("constraint of numbers", f"# constraint: [1, 2]\n{timed}", "line 1"),
        ("constraint of NaN", own.replace("0.0", "NaN", 1) + timed, "line 1"),
        ("constraint without a kind", f'# constraint: {{"kind": "os"}}\n{timed}', "line 1"),
        ("velocity of words", f"{own}# start_velocity: fast\n{timed}", "line 2"),
        ("velocity of two", f"{own}# start_velocity: [0, 0]\n{timed}", "line 2"),
        ("velocity of NaN", f"{own}# start_velocity: [NaN, 0, 0, 0, 0, 0]\n{timed}", "line 2"),
        ("velocity of 1e400", f"{own}# start_velocity: [1e400, 0, 0, 0, 0, 0]\n{timed}", "line 2"),
        ("no header", f"{own}{row}\n{row}\n", "header"),
        ("header alone", f"{own}{names}\n", "row"),
        ("other joints", f"{own}a,b,c,d,e,f\n{row}\n", "columns"),
        ("five joints", f"{own}{names.rsplit(',', 1)[0]}\n{row[:-4]}\n", "columns"),
        ("word", f"{own}{names}\n{row}\n0,0,0,0,0,x\n", "line 4"),
        ("gap", f"{own}{names}\n{row}\n0,0,,0,0,0\n", "line 4"),
        ("five numbers", f"{own}{names}\n{row}\n0,0,0,0,0\n", "line 4"),
        ("seven numbers", f"{own}{names}\n{row}\n0,0,0,0,0,0,0\n", "line 4"),
    ):
        yield _case(f"path {name}", read, folder, "path.csv", text, said)


def _scenes(scene: Reader, attached: Reader, folder: Path) -> Iterator[Bad]:
    box: dict[str, Any] = {"kind": "box", "centre_m": [2, 2, 2], "size_m": [0.1, 0.1, 0.1]}

    def shape(**more: Any) -> dict[str, Any]:
        return {"shapes": {"crate": {**box, **more}}}

    nan, huge = math.nan, 1e300
    without = {key: value for key, value in box.items() if key != "size_m"}
    for name, raw, said in (
        ("unknown entry", {"shape": {}}, "shape"),
        ("shapes in a list", {"shapes": [box]}, "shapes"),
        ("shape of a number", {"shapes": {"crate": 5}}, "crate"),
        ("no kind", {"shapes": {"crate": {"centre_m": [0, 0, 0]}}}, "crate.kind"),
        ("unknown kind", shape(kind="cone"), "crate"),
        ("no size", {"shapes": {"crate": without}}, "crate"),
        ("size 0", shape(size_m=[0, 1, 1]), "size_m"),
        ("size below 0", shape(size_m=[-1, 1, 1]), "size_m"),
        ("size of NaN", shape(size_m=[nan, 1, 1]), "size_m"),
        ("size of 1e300", shape(size_m=[huge, 1, 1]), "size_m"),
        ("size of two", shape(size_m=[1, 1]), "size_m"),
        ("size of words", shape(size_m=["a", 1, 1]), "size_m"),
        ("centre of NaN", shape(centre_m=[0, 0, nan]), "centre_m"),
        ("centre of 1e300", shape(centre_m=[0, 0, huge]), "centre_m"),
        ("centre of words", shape(centre_m="here"), "centre_m"),
        ("unknown field", shape(mass=1), "mass"),
        ("name", {"shapes": {"Crate 1": box}}, "Crate 1"),
        ("name of a link", {"shapes": {"link6": box}}, "link6"),
        ("name that is taken", {"shapes": {"table": box}}, "table"),
        ("unknown link", shape(exempt_links=["hand"]), "hand"),
        ("links of numbers", shape(exempt_links=[5]), "exempt_links"),
        ("allowed of one", {"allowed": [["table"]]}, "allowed"),
        ("allowed unknown", {"allowed": [["table", "nothing"]]}, "nothing"),
        ("mesh missing", {"shapes": {"m": {"kind": "mesh", "file": "no.obj"}}}, "no.obj"),
        ("mesh of a device", {"shapes": {"m": {"kind": "mesh", "file": "/dev/zero"}}}, "/dev/zero"),
        ("URDF missing", {"shapes": {"m": {"kind": "urdf", "urdf": "no.urdf"}}}, "no.urdf"),
        ("points of NaN", {"shapes": {"m": _cloud([[nan, 0, 0]])}}, "points"),
        ("points of none", {"shapes": {"m": _cloud([])}}, "points"),
        ("radius 0", {"shapes": {"m": {**_cloud([[0, 0, 0]]), "radius_m": 0}}}, "radius_m"),
    ):
        text = json.dumps(raw)
        yield Bad(f"scene {name}", lambda t=text: scene(written(folder, "own.yaml", t)), (said,))
    held = {**box, "link": "link6"}
    for name, raw, said in (
        ("no link", {"cup": box}, "cup.link"),
        ("unknown link", {"cup": {**held, "link": "hand"}}, "hand"),
        ("link of a number", {"cup": {**held, "link": 5}}, "link"),
        ("touching unknown", {"cup": {**held, "touching": ["hand"]}}, "hand"),
        ("touching a word", {"cup": {**held, "touching": "link5"}}, "touching"),
        ("cup of a number", {"cup": 5}, "cup"),
    ):
        text = json.dumps(raw)
        yield Bad(
            f"attached {name}", lambda t=text: attached(written(folder, "own.yaml", t)), (said,)
        )


def _cloud(points: list[Any]) -> dict[str, Any]:
    return {"kind": "point_cloud", "points_m": points, "radius_m": 0.01}


def _spoiled(
    kind: str,
    raw: Any,
    read: Reader,
    folder: Path,
    scene: PlanningScene,
    changes: tuple[tuple[Any, ...], ...],
) -> Iterator[Bad]:
    """A good file with one entry made bad, by its path; the last name of it is told, or what stands
    behind the bad value.  The file itself is read, and the scene left as it was.
    """
    suffix, before = "json" if kind == "problems" else "yaml", scene.now
    read(written(folder / "given", f"good.{suffix}", json.dumps(raw)))
    scene.become(before)
    for number, (path, bad, *said) in enumerate(changes):
        changed = copy.deepcopy(raw)
        inner = changed
        for part in path[:-1]:
            inner = inner[part]
        inner[path[-1]] = bad
        name = ".".join(map(str, path))
        told = said or [part for part in path if isinstance(part, str)][-1:]
        file, text = f"file{number}.{suffix}", json.dumps(changed)
        yield _case(f"{kind} {name}={bad!r}"[:60], read, folder, file, text, *told)


def _moveit(planner: Planner, scene: Reader, request: Reader, folder: Path) -> Iterator[Bad]:
    pose = {"position": {"x": 2.0, "y": 2.0, "z": 2.0}}
    pose["orientation"] = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    own = {"id": "crate", "primitives": [{"type": 1, "dimensions": [0.1, 0.1, 0.1]}]}
    own |= {"primitive_poses": [pose], "header": {"frame_id": "world"}}
    state = {"joint_state": {"name": ["joint1"], "position": [0.0]}}
    raw = {"world": {"collision_objects": [own]}, "robot_state": state}
    place = ("world", "collision_objects", 0)
    turn = (*place, "primitive_poses", 0, "orientation")
    changes: tuple[tuple[Any, ...], ...] = (
        (("world",), 5),
        (("world", "collision_objects"), {}),
        (place, 5, "world.collision_objects[0]"),
        ((*place, "id"), "link6", "'link6' is a link"),
        ((*place, "operation"), "remove"),
        ((*place, "primitives"), []),
        ((*place, "primitives", 0, "type"), 4, "is a cone"),
        ((*place, "primitives", 0, "type"), "tree", "is a tree"),
        ((*place, "primitives", 0, "dimensions"), [0.1]),
        ((*place, "primitives", 0, "dimensions"), [0.1, 0.1, math.nan]),
        ((*place, "primitives", 0, "dimensions"), [0.1, 0.1, -1]),
        ((*place, "primitives", 0, "dimensions"), [0.1, 0.1, 1e300], "size_m"),
        ((*place, "primitives", 0, "dimensions"), "large", "world.collision_objects[0]"),
        ((*place, "primitive_poses"), []),
        ((*place, "primitive_poses", 0, "position"), {"x": 0.0}, "'y' is missing"),
        ((*place, "primitive_poses", 0, "position", "x"), math.inf, "{'x': 'Infinity'"),
        ((*place, "primitive_poses", 0, "position", "x"), 1e300, "position_m = (1e+300"),
        ((*turn, "w"), 0.0, "no orientation"),
        ((*turn, "w"), "up", "'up'"),
        ((*place, "header", "frame_id"), "moon", "frame 'moon'"),
        ((*place, "header", "frame_id"), "link6", "frame 'link6': moves"),
        ((*place, "planes"), [{"coef": [0, 0, 1, 0]}], "has a plane"),
        (("robot_state", "joint_state", "position"), []),
        (("robot_state", "joint_state", "position"), [math.nan], "joint1 is nan"),
        (("robot_state", "joint_state", "position"), ["far"], "'far'"),
        (("link_padding",), [{"link_name": "link1", "padding": 0.1}]),
        (("allowed_collision_matrix",), {"entry_names": ["a"], "entry_values": []}),
        (("allowed_collision_matrix",), 5),
    )
    yield from _spoiled("moveit_scene", raw, scene, folder, planner.scene, changes)
    names = list(planner.robot.joint_names)
    start = {"joint_state": {"name": names, "position": [0.0] * 6}}
    goal = [{"joint_name": name, "position": 0.1} for name in names]
    asked = {"start_state": start, "goal_constraints": [{"joint_constraints": goal}]}
    tilt = {"link_name": "link6", "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    tilt |= {f"absolute_{axis}_axis_tolerance": 0.1 for axis in "xyz"}
    held = {"orientation_constraints": [tilt]}
    yield from _spoiled(
        "moveit_request",
        asked,
        request,
        folder,
        planner.scene,
        (
            (("start_state",), 5),
            (("start_state", "joint_state", "name"), names[:5]),
            (("start_state", "joint_state", "position"), [math.nan] * 6, "joint1 is nan"),
            (("start_state", "joint_state", "velocity"), [1.0] * 6),
            (("goal_constraints",), []),
            (("goal_constraints",), 5),
            (("goal_constraints",), [{}]),
            (
                ("goal_constraints", 0, "joint_constraints", 0, "joint_name"),
                "elbow",
                "elbow is no joint",
            ),
            (("goal_constraints", 0, "joint_constraints", 0, "position"), "far", "'far'"),
            (
                ("goal_constraints", 0, "joint_constraints", 0, "position"),
                math.nan,
                "joint1 is nan",
            ),
            (
                ("goal_constraints", 0, "joint_constraints", 0, "position"),
                1e300,
                "joint1 is 1e+300",
            ),
            (("goal_constraints", 0, "position_constraints"), [{}]),
            (("path_constraints",), 5),
            (("path_constraints",), {"joint_constraints": [{}]}),
            (("path_constraints",), {"orientation_constraints": [tilt, tilt]}),
            (("path_constraints",), {"orientation_constraints": [{**tilt, "link_name": "link5"}]}),
            (
                ("path_constraints",),
                {"orientation_constraints": [{"link_name": "link6"}]},
                "'orientation' is missing",
            ),
            (
                ("path_constraints",),
                {"orientation_constraints": [{**tilt, "absolute_x_axis_tolerance": math.nan}]},
            ),
            (
                ("path_constraints",),
                {"orientation_constraints": [{**tilt, "absolute_x_axis_tolerance": -1}]},
            ),
            (("trajectory_constraints",), {"constraints": [held]}),
            (("max_velocity_scaling_factor",), "fast", "'fast'"),
            (("max_velocity_scaling_factor",), math.nan),
            (("max_velocity_scaling_factor",), 2.0),
            (("max_acceleration_scaling_factor",), -1),
            (("max_cartesian_speed",), 1.0),
        ),
    )


def _problems(planner: Planner, read: Reader, folder: Path) -> Iterator[Bad]:
    group = next(iter(small_file()["scenes"]))
    first = ("scenes", group, 0)
    yield from _spoiled(
        "problems",
        small_file(),
        read,
        folder,
        planner.scene,
        (
            (("robot",), "pr2"),
            (("robot",), 5),
            (("joints",), JOINTS[:6]),
            (("joints",), "all"),
            (("scenes",), {}),
            (("scenes",), []),
            (("scenes", group), []),
            (first, 5, f"scenes.{group}.0=5"),
            ((*first, "start"), [0.0]),
            ((*first, "start"), [math.nan] * 7),
            ((*first, "goal"), ["far"] * 7),
            ((*first, "goal"), [1e300] * 7),
            ((*first, "held"), {"thumb": 0.1}, "'thumb' can't be held"),
            ((*first, "shapes"), {}),
            ((*first, "speed"), 1),
        ),
    )
    damaged = gzip.compress(b"{}" * 100)[:-9]
    bomb = gzip.compress(b" " * (300 * 2**20), 1)
    yield _case("problems damaged", read, folder, "damaged.json.gz", damaged)
    yield _case("problems bomb", read, folder, "bomb.json.gz", bomb)
    yield _case("problems deep", read, folder, "deep.json", "[" * 100_000)


def _tables(planner: Planner, read: dict[str, Reader], folder: Path) -> Iterator[Bad]:
    rng = np.random.default_rng(0)
    rows = planner.robot.sample(20, rng)
    names = ",".join(planner.robot.joint_names)

    def text(values: np.ndarray, header: str = "") -> str:
        return header + "\n".join(",".join(map(repr, row)) for row in values.tolist()) + "\n"

    gap = rows.copy()
    gap[3, 2] = np.nan
    good = written(folder, "good shown.csv", text(rows))
    assert len(demonstrations_from(good, planner.robot)[0][0]) == len(rows)
    for name, content, said in (
        ("few rows", text(rows[:3]), "3 rows in all"),
        ("NaN", text(gap), "row 3: not a finite number"),
        ("five joints", text(rows[:, :5]), "(20, 5)"),
        ("eight columns", text(np.hstack([rows, rows[:, :2]])), "(20, 8)"),
        ("degrees", text(np.degrees(rows)), "look like degrees"),
        ("one configuration", text(np.tile(rows[:1], (20, 1))), "the same configuration"),
        ("1e300", text(rows * 1e300), "another robot's"),
    ):
        yield Bad(
            f"shown {name}", lambda c=content: read["shown"](written(folder, "own.csv", c)), (said,)
        )
    numbered = text(np.hstack([rows[:, :1], rows]))
    for name, content, said in (
        ("word", text(rows) + "a,b,c,d,e,f\n", "'a'"),
        ("ragged", text(rows) + "1,2\n", "not a table of numbers"),
        ("header alone", names + "\n", "no rows of numbers"),
        ("no numbers of demonstrations", numbered, "must be the demonstration's number"),
        ("long cell", "x" * 200_000 + "\n" + text(rows), "field larger"),
    ):
        yield _case(f"shown {name}", read["shown"], folder, "own.csv", content, said)
    table = pd.DataFrame({"observation.state": list(rows), "episode_index": 0})
    assert len(demonstrations_from(_parquet(folder, table), planner.robot)[0][0]) == len(rows)
    for name, states, said in (
        ("no column", None, "'observation.state'"),
        ("five joints", [[0.0] * 5] * 20, "(20, 5)"),
        ("words", ["here"] * 20, "column 'observation.state' holds texts"),
        ("ragged", [[0.0] * (5 + k % 2) for k in range(20)], "own.parquet"),
    ):
        frame = table.drop(columns="observation.state")
        frame = frame if states is None else frame.assign(**{"observation.state": states})
        yield Bad(
            f"shown parquet {name}", lambda f=frame: read["shown"](_parquet(folder, f)), (said,)
        )
    joints = _data_set(rows)
    own = folder / "whole.parquet"
    write_joints([Shard(joints, len(rows), 0, 0)], own, {})
    assert len(read_joints(own).joints) == len(rows)
    without = [name for name in joints if name.startswith("tool_")]
    for name, frame, said in (
        ("no columns", pd.DataFrame({"a": [1.0]}), "column 'a'"),
        ("no rows", joints[:0], "has no rows"),
        ("no places of the tool", joints.drop(columns=without), "column 'tool_x'"),
        ("NaN", joints.assign(joint_1=np.nan), "'joint_1' contains null"),
        ("words", joints.assign(joint_1="far"), "column 'joint_1' holds texts"),
        ("another column", joints.assign(joint=0.0), "column 'joint'"),
        ("NaN for a place", joints.assign(tool_z=np.nan), "tool_z"),
        ("numbers for flags", joints.assign(self_collision=0.5), "self_collision"),
        ("beyond the limits", joints.assign(limit_distance=-1.0), "limit_distance"),
        ("off the constraint", joints.assign(residual=1e-3), "residual"),
    ):
        yield Bad(
            f"joints {name}",
            lambda f=frame: read["joints"](_parquet(folder, f)),
            ("own.parquet", said),
        )
    ends = pd.DataFrame({f"{e}_{k}": rows[:, k] for e in ("start", "goal") for k in range(6)})
    good = written(folder, "good.csv", ends.rename_axis("query").to_csv())
    assert len(read_queries(good).starts) == len(rows)
    for name, frame, said in (
        ("no goals", ends.filter(like="start"), "goals (20, 0)"),
        ("NaN", ends.assign(goal_2=np.nan), "query 0: must be finite"),
        ("words", ends.assign(goal_2="far"), "'far'"),
        ("no rows", ends[:0], "starts (0, 6)"),
        ("no index", None, "Index query invalid"),
    ):
        content = "a,b\n1,2\n" if frame is None else frame.rename_axis("query").to_csv()
        yield _case(f"queries {name}", read["queries"], folder, "own.csv", content, said)


def _data_set(rows: np.ndarray) -> pd.DataFrame:
    """As the pipeline draws one, of which `write_joints` makes a file."""
    columns: dict[str, Any] = {f"joint_{k + 1}": rows[:, k] for k in range(6)}
    columns |= dict.fromkeys((*POSE_COLUMNS, *RPY_COLUMNS, "limit_distance"), 0.1)
    return pd.DataFrame(columns | dict.fromkeys(("self_collision", "workcell_collision"), False))


def _parquet(folder: Path, frame: pd.DataFrame) -> Path:
    file = folder / "own.parquet"
    frame.to_parquet(file, index=False)
    return file


def _robots(read: Reader, folder: Path) -> Iterator[Bad]:
    good = (ROBOTS / "six_axis.urdf").read_text().replace("wrist.obj", f"{ROBOTS}/wrist.obj")
    joint = good[good.index("<joint") :].split('"')[1]
    for name, old, new, said in (
        ("cut off", good[len(good) // 2 :], "", "no XML"),
        ("no links", good[good.index("<link") :], "</robot>", "<link>"),
        ("other root", "<robot", "<machine", "no XML"),
        ("xacro", '<robot name="six_axis">', '<robot name="${arm}">', "xacro"),
        ("no tool", 'name="tool"', 'name="hand"', "'tool'"),
        ("axis of 0", 'xyz="0 0 1"', 'xyz="0 0 0"', "axis"),
        ("axis of NaN", 'xyz="0 0 1"', 'xyz="0 nan 1"', "nan"),
        ("no velocity", 'velocity="', 'velocity="-', "velocity"),
        ("limits of words", 'lower="', 'lower="x', "lower"),
        ("limits of NaN", 'upper="', 'upper="nan" was="', "upper"),
        ("joint twice", "</robot>", f'<joint name="{joint}" type="fixed"/></robot>', joint),
        ("mesh missing", "<geometry>", '<geometry><mesh filename="no.obj"/>', "no.obj"),
        (
            "entity",
            '<?xml version="1.0"?>',
            '<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "b">]>&a;',
            "no XML",
        ),
    ):
        assert old in good, name
        content = good.replace(old, new) if name != "axis of 0" else good.replace(old, new, 1)
        yield _case(f"arm {name}", read, folder, "arm.urdf", content, said)


def _constraints(planner: Planner, read: Reader, folder: Path) -> Iterator[Bad]:
    robot = {"name": planner.robot.name, "tool_link": planner.robot.tool_link}
    level = planner.constraints["level_cup"].to_json()
    raw = {"format": 1, "robot": robot, "constraint": level}
    yield from _spoiled(
        "constraint",
        raw,
        read,
        folder,
        planner.scene,
        (
            (("format",), 99),
            (("format",), None),
            (("robot",), 5, "not a constraint"),
            (("robot", "name"), "pr2", "found for pr2"),
            (("robot", "tool_link"), "hand", "found for xarm6 with the tool hand"),
            (("constraint",), None, "None: no constraint"),
            (("constraint",), "level", "'level': no constraint"),
            (("constraint", "kind"), "os"),
            (("constraint", "axes"), [1, 2]),
            (("constraint", "axes"), [2] * 6),
            (("constraint", "axes"), "level"),
            (("constraint", "tolerance"), [math.nan] * 6),
            (("constraint", "tolerance"), [-1] * 6),
            (("constraint", "tolerance"), None, "tolerance = None"),
            (("constraint", "reference"), 5, "reference = 5"),
            (("constraint", "reference"), {"position_m": [0, 0, 0]}, "'rotation' is missing"),
            (("constraint", "reference", "position_m"), [0, 0, math.inf], "position = "),
            (("constraint", "reference", "rotation"), [[0] * 3] * 3),
        ),
    )


def _bundles(folder: Path) -> Iterator[Bad]:
    for name, content in (
        ("no JSON", "{"),
        ("other format", '{"format": 99, "sha256": {}}'),
        ("no checksum", '{"format": 2, "sha256": {}}'),
        ("list", "[]"),
        ("no text", NO_TEXT),
    ):
        place = folder / f"bundle {name}"
        ask = lambda p=place, c=content: read_bundle(written(p, "planner.json", c).parent)  # noqa: E731
        yield Bad(f"bundle {name}", ask, ("planner.json",))
