"""What params.yaml names, looked at before hours of work: the robot's and the workcell's files, and
what the stages ask of each other's parameters.

`load_params` checks what can be seen in params.yaml alone; this opens the files behind it.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.learning.learned_manifold import JOINT_SPACE
from constraint_geodesics.params import Params, ParamsError
from constraint_geodesics.peers import registry
from constraint_geodesics.peers.baseline import BaselineError
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.scene import Scene, robot_from
from constraint_geodesics.studies.hidden_tasks import TASKS
from constraint_geodesics.tracking.store import tracking_uri

TABLE_I = ("prm", "rrt_star", "birrt")
"""Kinds of baselines that the result table has rows of."""
THIS_MACHINE = ("127.0.0.1", "::1", "localhost")


def check_params(params: Params) -> None:
    """Raises ParamsError, one line with the entry, its value and what is allowed, for the first on
    which a stage would fail.
    """
    _check_robot(params)
    _check_constraints(params)
    for problem in _problems(params):
        raise ParamsError(problem)


def _check_robot(params: Params) -> None:
    """URDF, tool link, joints, limits and collision shapes; then the bodies of the workcell, and
    those that are carried, and the links they name.
    """
    robot, carried = params.robot, params.carried
    try:
        read_pieces(robot_from(robot).urdf)
    except (ValueError, OSError) as error:
        raise ParamsError(f"robot: {error}") from None
    for entry, constraint in (("workcell", ""), ("carried", next(iter(carried.constraints), ""))):
        try:
            scene = Scene.from_params(params, constraint)
            for shape in (*scene.workcell, *(one.shape for one in scene.attached)):
                shape.pieces()
            with scene.world():
                pass
        except (ValueError, OSError, RuntimeError) as error:
            raise ParamsError(f"{entry}: {error}") from None


def _check_constraints(params: Params) -> None:
    """That the reference is where the tool can be near, and that the arm can be at two
    configurations of each, within its limits and clear of all.
    """
    robot = robot_from(params.robot)
    somewhere = robot.forward(robot.sample(2000, np.random.default_rng(0)))[0]
    reach = 1.2 * float(np.linalg.norm(somewhere, axis=1).max())
    for name, described in params.all_constraints.items():
        reference = getattr(described, "reference", None)
        if reference is not None and np.linalg.norm(reference.position_m) > reach:
            raise ParamsError(
                f"constraints: {name}: reference.position_m={list(reference.position_m)}: the tool "
                f"gets about {reach:.2g} m away from the base"
            )
        scene = Scene.from_params(params, name)
        try:
            draw_queries(scene, constraint_manifold(scene.robot, described), name, 1, 0)
        except (ValueError, OSError, RuntimeError, ImportError) as error:
            raise ParamsError(f"constraints: {name}: {' '.join(str(error).split())}") from None


def _problems(params: Params) -> Iterator[str]:
    joints, execution, compute = robot_from(params.robot).dof, params.execution, params.compute
    if compute.backend == "dask" and tracking_uri(Path()).startswith("sqlite:"):
        address = str(compute.dask_address)
        if urlsplit(address).hostname not in THIS_MACHINE:
            yield (
                f"compute.dask_address={address!r}: workers on other machines tell MLflow of their "
                f"seeds, and must not write to one file of SQLite: set MLFLOW_TRACKING_URI to the "
                f"address of an MLflow server"
            )
    for name, manifold in params.manifolds.items():
        if manifold.latent_dim > joints:
            yield (
                f"manifolds.{name}.latent_dim={manifold.latent_dim}: must be at most {joints}, the "
                f"robot's joints"
            )
    for name in params.demonstrations.tasks:
        if name not in TASKS:
            yield f"demonstrations.tasks={name!r}: must be one of {', '.join(TASKS)}"
    for name in params.geodesics.searched:
        if not params.manifolds[name].retract:
            yield (
                f"geodesics.searched={name!r}: manifolds.{name}.retract must be true, policies for "
                f"all constraints are trained on retracted curves"
            )
    for block in ("geodesics", "policies"):
        settings = getattr(params, block)
        rows = settings.environments * settings.ppo.rollout_steps
        if settings.ppo.batch_size > rows:
            yield (
                f"{block}.ppo.batch_size={settings.ppo.batch_size}: must be at most {rows}, "
                f"{block}.environments times rollout_steps"
            )
    chart = params.policies.chart
    if chart != JOINT_SPACE and chart not in params.manifolds:
        known = ", ".join([JOINT_SPACE, *sorted(params.manifolds)])
        yield f"policies.chart={chart!r}: must be one of {known}"
    if not execution.least_tilt_rad < math.pi:
        yield f"execution.least_tilt_rad={execution.least_tilt_rad}: must be below π"
    carried = params.studies.constraint
    if not params.constraints[carried].keeps_upright:
        yield (
            f"studies.constraint={carried!r}: must hold roll and pitch, or the cup that the stage "
            f"execute_paths carries need not stay upright"
        )
    yield from _planner_problems(params)


def _planner_problems(params: Params) -> Iterator[str]:
    bench = params.benchmark
    for name, planner in bench.planners.items():
        try:
            registry.settings_of(name, planner)
        except BaselineError as error:
            yield str(error)
    for name, planner in params.problems.planners.items():
        try:
            registry.settings_of(name, planner)
        except BaselineError as error:
            yield str(error).replace("benchmark.", "problems.", 1)
    for name in bench.compared.planners:
        if name in bench.planners and bench.planners[name].kind not in TABLE_I:
            yield (
                f"benchmark.compared.planners={name!r}: its kind must be one of "
                f"{', '.join(TABLE_I)}"
            )
    for entry, planners in (("benchmark", bench.planners), ("problems", params.problems.planners)):
        for name, planner in planners.items():
            manifold = planner.settings.get("manifold")
            if manifold is not None and manifold not in params.manifolds:
                known = ", ".join(params.manifolds)
                yield f"{entry}.planners.{name}.manifold={manifold!r}: must be one of {known}"
    for entry in ("recorded", "drawn"):
        for name in getattr(bench, entry):
            if name not in bench.planners:
                yield f"benchmark.{entry}={name!r}: must be one of benchmark.planners"
