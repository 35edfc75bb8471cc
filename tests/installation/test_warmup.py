"""All kernels are compiled in one step, after which nothing compiles any more; none of it counts as
planning.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import packaged_planner, pairs_of
from tests.test_cli_plan import called, strict

from constraint_geodesics import warmup
from constraint_geodesics.constraints.functions import FunctionsConstraint, RowBound
from constraint_geodesics.kernel_digest import PACKAGE
from constraint_geodesics.kernel_jobs import JOBS
from constraint_geodesics.robot.kernels import forward_batch

FEATURES = """
import json
from pathlib import Path
from numba.core.caching import IndexDataCacheFile

loaded, compiled = set(), []
load, save = IndexDataCacheFile._load_data, IndexDataCacheFile.save

def loads(self, name):
    loaded.add(self._data_path(name))
    return load(self, name)

def saves(self, key, data):
    compiled.append(str(self._index_path))
    save(self, key, data)

IndexDataCacheFile._load_data, IndexDataCacheFile.save = loads, saves

from dataclasses import replace
import numpy as np
from constraint_geodesics import Constraint, Planner, Pose
from constraint_geodesics.bundle import PACKAGED, read_bundle
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.functions import tip_on_sphere
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.candidates import Parts

with Planner.load(PACKAGED) as planner:
    start, goal = planner.nodes("level_cup")[[0, -1]]
    ways = ("straight", "graph", "tree")
    paths = [
        planner.plan(start, goal, "level_cup", parts=Parts(**{own: own == way for own in ways}))
        for way in ways
    ]
    path = planner.plan(start, goal, "level_cup", budget_s=0.5)
    path.at(0.5), path.at([0.0, 0.3])
    path.save("path.csv"), path.draw("path.png")
    planner.prepare("slide")
    robot = planner.scene.robot
    place, _ = robot.forward(path.at(0.5))
    held_at_start = Constraint(axes=(0, 0, 0, 1, 1, 0), tolerance=(0, 0, 0, 0.1, 0.2, 0))
    planner.plan(start, goal, held_at_start)
    board = Pose.from_rpy([0.45, 0.0, 0.35], [0.0, np.pi / 2, 0.0])
    on_board = Constraint(axes=(1, 0, 0, 0, 1, 1), reference=board)
    for constraint in (on_board, tip_on_sphere(robot, (0.4, 0.0, 0.1), 0.3)):
        planner.prepare(constraint)
        planner.plan(*planner.nodes(constraint)[[0, 1]], constraint).violation_bound
    manifold = ConstraintManifold(robot, planner.constraints["level_cup"])
    retract(manifold, start[None] + 0.01), manifold.violation(start), manifold.inclusion(start)
    rows = path.joints.copy()
    rows.flags.writeable = False
    with Certifier(planner.scene.now) as certifier:
        certifier.certify(rows, held_at_start)
    robot.forward(rows), robot.jacobian(rows), robot.skeleton(rows)
    planner.plan(start + 0.01, goal, "level_cup"), planner.plan(0.0 * start, goal, "free")
    planner.check("path.csv"), planner.project(start + 0.01, "level_cup")
    pose = Pose(*robot.forward(goal))
    anyhow = [pose, GoalRegion(pose, free=("yaw",), tolerance=(0.01, 0, 0, 0.1, 0.1, 0)), goal]
    planner.ik(pose), planner.plan(start, anyhow, "level_cup", snap=True, velocity_scale=0.5)
with Planner.from_urdf("franka_panda/panda.urdf", "panda_grasptarget") as other:
    q = 0.5 * (other.robot.lower + other.robot.upper)
    other.plan(q, Pose(*other.robot.forward(q + 0.1)), "free").to_joint_trajectory()
bundle = read_bundle(PACKAGED)
workcell = bundle.workcell.including(Sphere("ball", tuple(place), radius_m=0.08))
with Planner(replace(bundle, workcell=workcell), "this test") as planner:
    planner.plan(start, goal, "level_cup", budget_s=0.5)
found = {"solved": [own.status == "solved" for own in paths], "compiled": compiled}
print(json.dumps(found | {"loaded": sorted(loaded)}))
"""


def test_after_it_no_documented_feature_compiles_anything(tmp_path) -> None:
    """What other tests compiled does not count: it is younger than the mark."""
    warmup.ensure()
    (mark,) = Path(forward_batch.stats.cache_path).glob("all.*.nbi")
    command = [sys.executable, "-c", FEATURES]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert all(found["solved"])
    assert found["compiled"] == []
    assert len(found["loaded"]) > 20
    later = [
        file for file in found["loaded"] if os.stat(file).st_mtime_ns > os.stat(mark).st_mtime_ns
    ]
    assert later == []


def in_a_copy(source: Path, words: list[str]) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(source)}
    for name in ("NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES"):
        environment.pop(name, None)
    command = [sys.executable, "-P", *words]
    return subprocess.run(
        command, env=environment, cwd=source, capture_output=True, text=True, check=True
    )


def test_the_command_says_how_far_it_is_and_is_over_at_once_the_next_time(tmp_path) -> None:
    """In a copy of the package with its kernels, but for the mark."""
    warmup.ensure()
    ignored = shutil.ignore_patterns("all.*.nbi", "pretrained")
    shutil.copytree(PACKAGE, tmp_path / PACKAGE.name, ignore=ignored)
    command = ["-m", "constraint_geodesics.cli", "warmup"]
    first = in_a_copy(tmp_path, [*command, "--jobs", "2"])
    assert first.stdout.startswith("compiled in ")
    assert first.stdout.endswith(" s; the next plan starts at once\n")
    count, last = len(JOBS), first.stderr.splitlines()[-1]
    assert re.fullmatch(rf"compiling the kernels, .*: {count}/{count}, took .*", last)
    again = in_a_copy(tmp_path, command)
    assert (again.stdout, again.stderr) == ("all is compiled already\n", "")
    with (tmp_path / PACKAGE.name / "search" / "tree.py").open("a") as file:
        file.write("# another kernel\n")
    ask = "from constraint_geodesics import warmup; print(warmup.is_done())"
    assert in_a_copy(tmp_path, ["-c", ask]).stdout == "False\n"


def test_the_command_answers_in_json(monkeypatch, capfd) -> None:
    warmup.ensure()
    code, out, err = called(monkeypatch, capfd, ["warmup", "--json"])
    assert (code, err) == (0, "")
    assert strict(out)["compiled"] is False


def test_what_fails_is_one_line(monkeypatch) -> None:
    worker = warmup._Worker()
    try:
        with pytest.raises(warmup.WarmupError, match=r"^nothing can't be compiled: KeyError"):
            worker.run("nothing")
    finally:
        worker.close()
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    with pytest.raises(warmup.WarmupError, match="its process ended, code 1"):
        warmup._compile_all(2, lambda *_: None)


def test_windows_has_no_lock_between_processes(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with warmup._alone():
        pass


def test_every_piece_comes_after_some_that_exist() -> None:
    names = list(JOBS)
    for name, job in JOBS.items():
        assert set(job.after) <= set(names[: names.index(name)])


def test_functions_of_a_constraint_s_own_are_compiled_before_the_clock_starts(monkeypatch) -> None:
    def residual(q, out):
        out[0] = q[0] - q[0] + q[1] - q[1]

    def jacobian(q, out):
        for d in range(q.shape[0]):
            out[0, d] = 0.0

    compiling_s, compile_functions = list[float](), FunctionsConstraint.compile

    def timed(own: FunctionsConstraint) -> None:
        began = time.perf_counter()
        compile_functions(own)
        compiling_s.append(time.perf_counter() - began)

    monkeypatch.setattr(FunctionsConstraint, "compile", timed)
    nowhere = FunctionsConstraint(residual, jacobian, (RowBound("nothing", "rad", 0.0, 1.0),))
    planner, (start, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    planner.plan(start, goal, "level_cup")
    began = time.perf_counter()
    path = planner.plan(start, goal, nowhere)
    took = time.perf_counter() - began
    assert np.isfinite(path.planning_time_s)
    assert compiling_s[0] > 0.02, "it is compiled there, not looked up"
    assert path.planning_time_s + compiling_s[0] <= took
