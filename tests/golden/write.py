"""Golden files of a release, written by what writes people's files, and what they hold:
`python -m tests.golden.write`.

tests/test_golden.py reads them with every later release.  A release that is out keeps its folder as
it is; that of pyproject.toml, while it is not, is removed by hand and written again.
"""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from constraint_geodesics import bundle
from constraint_geodesics.bundle import Bundle, read_bundle
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.geodesics.learned_method import FOLDER, read_learned
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geometry.graph import components
from constraint_geodesics.identification import identify
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.planner import Planner
from constraint_geodesics.recording.recording import PathRecord, record_path
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud, Points
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.roadmap import Roadmap
from constraint_geodesics.trajectory import Trajectory
from tests.identification.hidden import demonstrations

ROOT, HERE = Path(__file__).resolve().parents[2], Path(__file__).resolve().parent
FACTS = "facts.json"
START = [1.329923, -0.584036, -3.766650, -2.008429, 0.728803, -2.581396]
GOAL = [1.071549, -0.217480, -1.682647, -2.906655, -0.337949, 1.348704]
NODES, UNITS, CENTRES, FRAMES = 40, 4, 8, 4
"""Of a roadmap, a network's layer, its centres and a recording: files stay small."""
SEEN = 120
"""Numbers that a policy sees."""
SCENE = """format: 1
shapes:
  crate: {kind: box, centre_m: [0.5, 0.3, 0.1], size_m: [0.15, 0.15, 0.2], rpy_rad: [0, 0, 0.4]}
  ball: {kind: sphere, centre_m: [0.3, 0.5, 1.0], radius_m: 0.05, exempt_links: [link1]}
  pipe: {kind: capsule, from_m: [0.6, -0.3, 0.9], to_m: [0.6, 0.3, 0.9], radius_m: 0.05}
  bottle: {kind: cylinder, pose: {position_m: [-0.5, -0.5, 0.15]}, length_m: 0.3, radius_m: 0.04}
  part: {kind: mesh, file: part.obj, scale: 0.1,
    pose: {position_m: [0.6, -0.2, 0.1], rpy_rad: [0, 0, 0.5]}}
  seen: {kind: point_cloud, radius_m: 0.02, points_m: [[0.4, 0.1, 0.5], [0.42, 0.1, 0.5]]}
attached:
  cup: {link: link6, touching: [link5], kind: sphere, centre_m: [0, 0, 0.1], radius_m: 0.05}
allowed:
- [crate, bottle]
"""
"""As people write it."""
ATTACHED = """format: 1
cup: {link: link6, touching: [], kind: cylinder, length_m: 0.1, radius_m: 0.037,
  pose: {position_m: [0, 0, 0.075], rpy_rad: [-1.5708, 0, 0]}}
"""
MESH = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


def scene_shapes(folder: Path) -> tuple[Shape, ...]:
    """What SCENE says, made of the classes."""
    places = {
        "bottle": Placement((-0.5, -0.5, 0.15)),
        "part": Placement((0.6, -0.2, 0.1), (0.0, 0.0, 0.5)),
    }
    points = Points([[0.4, 0.1, 0.5], [0.42, 0.1, 0.5]])
    return (
        Box("crate", (0.5, 0.3, 0.1), (0.15, 0.15, 0.2), rpy_rad=(0.0, 0.0, 0.4)),
        Sphere("ball", (0.3, 0.5, 1.0), 0.05, exempt_links=("link1",)),
        Capsule("pipe", (0.6, -0.3, 0.9), (0.6, 0.3, 0.9), 0.05),
        Cylinder("bottle", places["bottle"], 0.3, 0.04),
        Mesh("part", folder / "part.obj", places["part"], scale=0.1),
        PointCloud("seen", points, 0.02),
    )


def shape_facts(shape: Shape) -> dict[str, Any]:
    """The kind of a shape, and the box of its pieces [m]."""
    ends = [
        (p.corners.min(axis=0) - p.rounding, p.corners.max(axis=0) + p.rounding)
        for p in shape.pieces()
    ]
    low, high = np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)
    return {
        "kind": type(shape).__name__,
        "exempt_links": list(shape.exempt_links),
        "low_m": low.tolist(),
        "high_m": high.tolist(),
    }


def scene_files(folder: Path) -> dict[str, Any]:
    """Scene, attached shape, mesh."""
    (folder / "part.obj").write_text(MESH)
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "attached.yaml").write_text(ATTACHED)
    pose = Pose.from_rpy([0.0, 0.0, 0.075], [-1.5708, 0.0, 0.0])
    held = Sphere("cup", (0.0, 0.0, 0.1), 0.05)
    return {
        "shapes": {shape.name: shape_facts(shape) for shape in scene_shapes(folder)},
        "attached": {"cup": {"link": "link6", "touching": ["link5"]} | shape_facts(held)},
        "allowed": [["crate", "bottle"]],
        "attached alone": {
            "cup": {"link": "link6", "touching": []}
            | shape_facts(Cylinder("cup", pose, 0.1, 0.037))
        },
    }


def trajectory_facts(trajectory: Trajectory) -> dict[str, Any]:
    """Waypoints [rad], times [s], the velocity at the first [rad/s] and the constraint."""
    start = trajectory.start_velocity
    return {
        "waypoints": len(trajectory.joints),
        "first_rad": trajectory.joints[0].tolist(),
        "last_rad": trajectory.joints[-1].tolist(),
        "mean_rad": trajectory.joints.mean(axis=0).tolist(),
        "duration_s": float(trajectory.times[-1]),
        "start_velocity": None if start is None else start.tolist(),
    } | constraint_facts(trajectory.constraint, trajectory.scene.robot, trajectory.joints[::20])


def constraint_facts(
    constraint: Constraint, robot: SerialRobot, q: Float[np.ndarray, "n D"]
) -> dict[str, Any]:
    """Residuals at configurations [rad], in each row's unit."""
    residual = ConstraintManifold(robot, constraint).residual(q)
    units = list(constraint.units)
    return {"q_rad": q.tolist(), "residual": residual.tolist(), "units": units}


def trajectory_files(folder: Path, planner: Planner) -> tuple[dict[str, Any], Trajectory]:
    """A path, and one that begins in motion."""
    path = planner.plan(START, GOAL, "level_cup")
    stop = path.stop(0.3 * path.times[-1])
    assert path.status == "solved"
    path.save(folder / "path.csv")
    stop.save(folder / "moving.csv")
    return {"path.csv": trajectory_facts(path), "moving.csv": trajectory_facts(stop)}, path


def recording_file(folder: Path, path: Trajectory) -> dict[str, Any]:
    """A recording without meshes, of a few frames."""
    robot = path.scene.robot
    record = PathRecord("planner", "level_cup", 3, 1, path.joints, path.explanation, meshes=False)
    manifold = ConstraintManifold(robot, path.constraint)
    record_path(folder / "path.rrd", record, manifold, path.scene.workcell, frames=FRAMES)
    tool = robot.forward(path.joints[[0, -1]])[0]
    return {
        "frames": FRAMES,
        "first_rad": path.joints[0].tolist(),
        "last_rad": path.joints[-1].tolist(),
        "tool_ends_m": tool.tolist(),
        "planner": "planner",
        "constraint": "level_cup",
        "query": 3,
        "seed": 1,
    }


def identification_files(folder: Path, robot: SerialRobot) -> dict[str, Any]:
    """Demonstrations, and the constraint that they keep to."""
    shown = [rows[::3] for rows in demonstrations("cup", robot, 10)]
    lines = [",".join(("demonstration", *robot.joint_names))]
    for number, rows in enumerate(shown):
        lines += [",".join([str(number), *(f"{q:.5f}" for q in row)]) for row in rows]
    (folder / "demonstrations.csv").write_text("# format: 1\n" + "\n".join(lines) + "\n")
    found = identify(folder / "demonstrations.csv", robot)
    assert found.constraint is not None, found.explanation
    found.save(folder / "constraint.yaml")
    q = np.concatenate([shown[0][:2], robot.sample(2, np.random.default_rng(0))])
    return {
        "demonstrations.csv": {
            "rows": [len(rows) for rows in shown],
            "first_rad": np.round(shown[0][0], 5).tolist(),
            "last_rad": np.round(shown[-1][-1], 5).tolist(),
        },
        "constraint.yaml": constraint_facts(found.constraint, robot, q),
    }


def first_nodes(roadmap: Roadmap) -> Roadmap:
    """The first NODES nodes and the edges between them."""
    joints, kept = roadmap.joints[:NODES], (roadmap.edges < NODES).all(axis=1)
    edges = roadmap.edges[kept]
    return Roadmap(joints, edges, roadmap.lengths[kept], components(len(joints), edges))


def graph_facts(graphs: dict[str, Roadmap]) -> dict[str, Any]:
    """Of each graph its nodes [rad] and edges."""
    return {
        name: {
            "nodes": len(graph.joints),
            "edges": graph.edges.tolist(),
            "first_rad": graph.joints[0].astype(np.float32).tolist(),
            "length_rad": float(graph.lengths.sum()),
        }
        for name, graph in graphs.items()
    }


def planner_files(folder: Path) -> dict[str, Any]:
    """The planner that comes with the package, with the beginning of a roadmap."""
    packaged = read_bundle(bundle.PACKAGED)
    small = {"level_cup": first_nodes(packaged.roadmaps["level_cup"])}
    replace(packaged, roadmaps=small).write(folder)
    return planner_facts(packaged) | {"roadmaps": graph_facts(small)}


def planner_facts(packaged: Bundle) -> dict[str, Any]:
    """Robot, constraints, scene, settings."""
    held = {name: list(c.axes) for name, c in packaged.constraints.items() if c.kind == "pose"}
    return {
        "urdf": packaged.robot.urdf,
        "tool_link": packaged.robot.tool_link,
        "limits_rad": {name: list(ends) for name, ends in packaged.robot.limits_rad.items()},
        "shapes": {name: shape_facts(own) for name, own in packaged.workcell.shapes.items()},
        "axes": held,
        "clearance_m": packaged.planner.clearance_m,
        "acceleration_rad_s2": packaged.planner.acceleration_rad_s2,
        "violation_tolerance": packaged.judge.violation_tolerance,
    }


def learned_files(folder: Path) -> dict[str, Any]:
    """The learned method's, with small networks that learned nothing in place of the large ones."""
    files = read_learned(bundle.PACKAGED / FOLDER)
    manifold, policy = untrained_networks(len(files.manifold["centre"]))
    small = {"level_cup": first_nodes(files.submanifolds["level_cup"])}
    replace(files, manifold=manifold, policy=policy, submanifolds=small).write(folder)
    return {"chart": files.chart, "degree": files.settings.degree} | network_facts(
        manifold, policy, small
    )


def untrained_networks(dof: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Arrays of a manifold's and of a policy's."""
    torch.manual_seed(0)
    state = JointVae(dof, dof, [UNITS, UNITS], CENTRES).state_dict()
    rng, policy = np.random.default_rng(0), {"log_std": np.zeros(2 * dof, np.float32)}
    sizes = {"body.0": (UNITS, SEEN), "body.2": (UNITS, UNITS), "mean": (2 * dof, UNITS)}
    for layer, (out, given) in sizes.items():
        policy[f"{layer}.weight"] = rng.normal(size=(out, given)).astype(np.float32)
        policy[f"{layer}.bias"] = rng.normal(size=out).astype(np.float32)
    return {name: value.numpy() for name, value in state.items()}, policy


def network_facts(manifold: Any, policy: Any, graphs: dict[str, Roadmap]) -> dict[str, Any]:
    """What the networks answer to 0.1 everywhere, and the graphs."""
    chart, actor = FrozenManifold(manifold), MeanPolicy.from_arrays(policy)
    asked = np.full((1, actor.layers[0][0].shape[1]), 0.1)
    return {
        "decoded_rad": chart.decode(np.full(chart.dim, 0.1)).tolist(),
        "action": actor.act(asked)[0].tolist(),
        "submanifolds": graph_facts(graphs),
    }


def write(folder: Path) -> None:
    """All files into a folder that is made."""
    folder.mkdir()
    with Planner.load(bundle.PACKAGED) as planner:
        robot = planner.robot
        trajectories, path = trajectory_files(folder, planner)
        facts = {
            "trajectories": trajectories,
            "recording": recording_file(folder, path),
            "scene": scene_files(folder),
            "identification": identification_files(folder, robot),
            "planner": planner_files(folder / "planner"),
            "learned": learned_files(folder / "planner" / FOLDER),
        }
    (folder / FACTS).write_text(json.dumps(facts, indent=1) + "\n")


def main() -> None:
    """Write the folder of the release in pyproject.toml."""
    release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    folder = HERE / release
    if folder.exists():
        raise SystemExit(f"error: {folder} exists: remove it if {release} is not out yet")
    write(folder)
    size = sum(file.stat().st_size for file in folder.rglob("*"))
    print(f"{folder.relative_to(ROOT)}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
