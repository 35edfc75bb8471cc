"""The whole pipeline on small parameters, in a copy of this checkout: `python
tests/end_to_end/smoke.py FOLDER`.
"""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]

SMALL: dict[str, Any] = {
    "compute": {"workers": 1},  # a worker would take longer to start than to work
    "labels": {"queries": 3, "free_rows": 4000, "constrained_rows": 1000, "shard_rows": 1000},
    "manifolds": {
        "paper": {"epochs": 3, "variance_epochs": 1, "variance_centres": 32, "batch_size": 128},
        "planner": {"epochs": 5, "variance_epochs": 1, "variance_centres": 64, "batch_size": 128},
    },
    "submanifold": {"grid": 40, "nodes": 250},
    "geodesics": {
        "seeds": [0, 1],
        "steps": 1920,
        "analytic_steps": 1920,
        "analytic_episode_steps": 10,
        "analytic": ["plane"],
        "environments": 64,
        "illustrated_constraints": ["level_cup"],
        "rollouts": 8,
        "checkpoint_steps": 1000,
        "ablated_segments": [],
        "ppo": {"batch_size": 320},
    },
    "compare_charts": {
        "dims": [2],
        "seeds": [0],
        "epochs": 1,
        "steps": 1920,
        "queries": 2,
        "hole": {"dims": [2], "pairs": 2},
    },
    "demonstrations": {
        "tasks": ["cup", "hole"],
        "seeds": [0],
        "pairs": 2,
        "peer_pairs": 1,
        "learned": {"level_set_steps": 40, "residual_steps": 40, "epochs": 2, "policy_steps": 2560},
    },
    "geometry": {"rounds": 1, "batch": 256, "checked": 32, "graph_points": 200, "pairs": 4},
    "policies": {
        "seeds": [0, 1],
        "steps": 1920,
        "environments": 64,
        "obstacles": {"count": 2},
        "ppo": {"batch_size": 192},
    },
    "planner": {"roadmap_nodes": 200},
    "path_diffusion": {"queries": 40, "width": 32, "blocks": 1, "steps": 60, "batch_size": 32},
    "studies": {"queries": 3},
    "sweep": {"seeds": [0, 1], "steps": 1920, "queries": 3},
    "execution": {"queries": 1, "spheres": 4},
    "carried": {"constraints": ["level_cup"]},
    "clutter": {"constraints": ["free", "level_cup"], "scenes": 1, "queries": 1},
    "benchmark": {"queries": 2, "compared": {"seeds": 1}},
    "recording": {"queries": 2},
}
QUICK: dict[str, Any] = {
    "many_bands": {"starts": 4},
    "gradient_geodesic": {
        "drawn": 32,
        "starts": 2,
        "descent_steps": 3,
        "polish_steps": 2,
        "rounds": 1,
    },
    "receding_horizon": {"vias": 2},
    "bayesian_optimisation": {"drawn": 64, "kept": 10, "initial": 4, "evaluations": 6},
}
"""Settings of the benchmark's planners that take long."""
CONSTRAINTS = ("free", "level_cup")
MARK = ".smoke"


def copy_checkout(folder: Path) -> None:
    """A clone of the files as they are now, uncommitted ones included, without any result."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        source = ROOT / name
        if source.is_file() and not name.startswith(("reports/", "dvc.lock")):
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    for compiled in (ROOT / "src").rglob("*.nb[ic]"):  # the kernels need not be compiled again
        target = folder / compiled.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(compiled, target)
    for command in (
        ["git", "init", "-q"],
        ["git", "add", "-A"],
        [
            "git",
            "-c",
            "user.name=smoke",
            "-c",
            "user.email=smoke@localhost",
            "commit",
            "-q",
            "-m",
            "smoke",
        ],
    ):
        subprocess.run(command, cwd=folder, check=True)


def shrink_params(folder: Path) -> None:
    """Small parameters and two constraints in the copy's params.yaml."""
    file = folder / "params.yaml"
    params = yaml.safe_load(file.read_text())
    params["constraints"] = {name: params["constraints"][name] for name in CONSTRAINTS}
    params["unseen"] = {}
    _overlay(params, SMALL)
    params["benchmark"]["planners"] = _one_of_each_kind(params["benchmark"]["planners"])
    file.write_text(yaml.safe_dump(params, sort_keys=False))


def _one_of_each_kind(planners: dict[str, Any]) -> dict[str, Any]:
    """Those that the benchmark's parameters name, and of the others the first of its kind, on one
    query each.
    """
    named = ("planner", "BiRRT", "BiRRT + band", "band from many starts", "PRM", "RRT* 1 s")
    first = {planner["kind"]: name for name, planner in reversed(planners.items())}
    kept = {name: planners[name] for name in planners if name in named or name in first.values()}
    return {
        name: {
            **planner,
            **QUICK.get(planner["kind"], {}),
            "queries": 1,
            "seeds": 2 if name == "BiRRT" else 1,
        }
        for name, planner in kept.items()
    }


def _overlay(params: dict[str, Any], changes: dict[str, Any]) -> None:
    for name, value in changes.items():
        if isinstance(value, dict):
            _overlay(params[name], value)
        else:
            params[name] = value


def environment(folder: Path) -> dict[str, str]:
    """The copy's own source before the installed one, this environment's programs first, no store
    from outside.
    """
    variables = {k: v for k, v in os.environ.items() if k != "MLFLOW_TRACKING_URI"}
    path = os.pathsep.join([str(Path(sys.executable).parent), variables.get("PATH", "")])
    return variables | {"PYTHONPATH": str(folder / "src"), "PATH": path}


def dvc(folder: Path, *arguments: str, capture: bool = True) -> subprocess.CompletedProcess[str]:
    """One dvc command in the copy."""
    command = [sys.executable, "-m", "dvc", *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment(folder), capture_output=capture, text=True, check=False
    )


def main(folder: Path) -> int:
    """Run everything once and print the result table."""
    began = time.monotonic()
    if folder.exists() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            print(
                f"error: {folder}: not empty, and not a folder that an earlier run made",
                file=sys.stderr,
            )
            return 2
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).touch()
    copy_checkout(folder)
    shrink_params(folder)
    code = dvc(folder, "repro", capture=False).returncode
    if code == 0:
        subprocess.run(
            [sys.executable, "-m", "constraint_geodesics.cli", "results"],
            cwd=folder,
            env=environment(folder),
            check=True,
        )
        print(
            f"\nThe whole pipeline on small parameters took {time.monotonic() - began:.0f} s; "
            f"see {folder}"
        )
    return code


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]).resolve()))
