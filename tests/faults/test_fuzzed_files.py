"""Good files with some bytes changed, by Hypothesis: each is read, or refused in one line of a
typed error; none is a traceback, or hangs.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from constraint_geodesics.benchmark.problem_files import read_problems
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.files import load_constraint
from constraint_geodesics.learning.dataset import Queries, read_queries, write_queries
from constraint_geodesics.moveit import add_moveit_scene, read_moveit_request
from constraint_geodesics.params import load_params
from constraint_geodesics.robot.description import read_description
from constraint_geodesics.scene.pieces import file_digest
from constraint_geodesics.scene.scene_file import read_attached, read_scene
from constraint_geodesics.scene.triangles import read_triangles
from tests.benchmark.problem_fixtures import small_file
from tests.faults.bad_input import Bad, Tally, written
from tests.faults.effort import Effort, counted_at_end
from tests.planner_fixtures import packaged_planner
from tests.scene.mesh_files import Brick, write_bricks

ROOT = Path(__file__).resolve().parents[2]
Reader = Callable[[Path], object]
TOKENS = (
    *(b"nan", b"inf", b"1e309", b"-1", b"0", b"9" * 30, b"null", b"true", b"[]", b"{}", b"''"),
    *(b"\0", b"\xff\xfe", b"\n", b"\r", b",", b":", b'"', b"<", b"/>", b"&", b"*a", b"- ", b"#"),
    *(b"../../x", b"!!python/name:os", b"<!DOCTYPE", b"e", b".", b" "),
)
BRICKS = [Brick((2.0, 2.0, 2.0), (0.1, 0.1, 0.1)), Brick((2.1, 2.1, 2.1), (0.1, 0.1, 0.1))]
COLLADA = """<?xml version="1.0"?>
<COLLADA version="1.4.1"><asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">2 2 2 2.1 2 2 2 2.1 2 2 2 2.1</float_array>
<technique_common><accessor source="#a" count="4" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>0 0 1</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
SPOILED = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 12), st.one_of(st.sampled_from(TOKENS), st.binary())),
    min_size=1,
    max_size=4,
)
"""Where in a file, how many bytes go, and what takes their place."""


def spoiled(content: bytes, changes: list[tuple[float, int, bytes]]) -> bytes:
    for place, gone, put in changes:
        at = int(place * len(content))
        content = content[:at] + put + content[at + gone :]
    return content


@pytest.fixture(scope="module")
def tally(effort: Effort, request: pytest.FixtureRequest) -> Iterator[Tally]:
    found, kinds = Tally(), ("cases", "tracebacks", "hung")
    with counted_at_end("fuzzed_files", effort, request.session, lambda: found.row(*kinds)):
        yield found


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Reader]]:
    """A good file of each kind, and what reads it; the planner's scene is left as it was."""
    folder, planner = tmp_path_factory.mktemp("good"), packaged_planner()
    robot, scene, before = planner.robot, planner.scene, planner.scene.now

    def restoring(read: Reader) -> Reader:
        def one(file: Path) -> object:
            try:
                return read(file)
            finally:
                scene.become(before)

        return one

    joints = np.linspace(0.1, 0.2, 60).reshape(10, 6)
    level = planner.constraints["level_cup"].to_json()
    rows = "\n".join(",".join(map(str, row)) for row in joints)
    path = f"# constraint: {json.dumps(level)}\n{','.join(robot.joint_names)}\n{rows}\n"
    of = {"name": robot.name, "tool_link": robot.tool_link}
    constraint = json.dumps({"format": 1, "robot": of, "constraint": level})
    shapes = {
        "crate": {"kind": "box", "centre_m": [2, 2, 2], "size_m": [0.1, 0.1, 0.1]},
        "ball": {"kind": "sphere", "centre_m": [2, 3, 2], "radius_m": 0.1},
    }
    at, turn = dict.fromkeys("xyz", 2.0), {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    pose = {"position": at, "orientation": turn}
    crate = {
        "id": "crate",
        "header": {"frame_id": "world"},
        "primitives": [{"type": 1, "dimensions": [0.1, 0.1, 0.1]}],
        "primitive_poses": [pose],
    }
    goals = [{"joint_name": name, "position": 0.1} for name in robot.joint_names]
    state = {"name": list(robot.joint_names), "position": [0.0] * robot.dof}
    asked = {
        "goal_constraints": [{"joint_constraints": goals}],
        "start_state": {"joint_state": state},
    }
    write_queries(Queries(joints, joints), folder / "queries.csv")
    shutil.copy(ROOT / "docs" / "examples" / "wipe.csv", folder)
    shutil.copy(ROOT / "docs" / "examples" / "cup.yaml", folder)
    shutil.copy(ROOT / "params.yaml", folder)
    for file in (ROOT / "tests" / "robots").iterdir():
        shutil.copy(file, folder)

    def mesh(file: Path) -> object:
        return read_triangles(file, file_digest(file))  # to divide it takes what it takes

    return {
        "path": (written(folder, "path.csv", path), planner.check),
        "constraint": (
            written(folder, "own.yaml", constraint),
            lambda file: load_constraint(file, robot),
        ),
        "scene": (
            written(folder, "scene.yaml", json.dumps({"shapes": shapes})),
            restoring(lambda file: read_scene(file).into(scene)),
        ),
        "attached": (folder / "cup.yaml", restoring(lambda file: read_attached(file).into(scene))),
        "moveit_scene": (
            written(folder, "moveit.yaml", json.dumps({"world": {"collision_objects": [crate]}})),
            restoring(lambda file: add_moveit_scene(file, scene)),
        ),
        "moveit_request": (
            written(folder, "request.yaml", json.dumps(asked)),
            restoring(lambda file: read_moveit_request(file, planner)),
        ),
        "params": (folder / "params.yaml", load_params),
        "shown": (folder / "wipe.csv", lambda file: demonstrations_from(file, robot)),
        "problems": (written(folder, "problems.json", json.dumps(small_file())), read_problems),
        "queries": (folder / "queries.csv", read_queries),
        "mesh_obj": (folder / "wrist.obj", mesh),
        "mesh_stl": (write_bricks(folder / "own.stl", BRICKS), mesh),
        "mesh_dae": (written(folder, "own.dae", COLLADA), mesh),
        "arm": (folder / "six_axis.urdf", read_description),
    }


KINDS = (
    *("path", "constraint", "scene", "attached", "moveit_scene", "moveit_request", "params"),
    *("shown", "problems", "queries", "mesh_obj", "mesh_stl", "mesh_dae", "arm"),
)


@pytest.mark.parametrize("kind", KINDS)
def test_a_spoiled_file_is_read_or_refused(
    kind: str, readers: dict[str, tuple[Path, Reader]], tally: Tally, effort: Effort, tmp_path: Path
) -> None:
    file, read = readers[kind]
    good, place = file.read_bytes(), tmp_path / f"given{file.suffix}"
    read(file)

    @settings(
        max_examples=effort.faults, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(SPOILED)
    def ask(changes: list[tuple[float, int, bytes]]) -> None:
        place.write_bytes(spoiled(good, changes))
        tally.judge(Bad(f"{kind} {changes}", lambda: read(place), (), refused=False))

    before = tally.cases, len(tally.wrong)
    ask()
    assert tally.cases - before[0] >= effort.faults // 2
    assert not tally.wrong[before[1] :], "\n".join(tally.wrong[before[1] :][:10])
