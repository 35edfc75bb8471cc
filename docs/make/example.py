"""Ten demonstrations to try `geodesics identify` on: `python docs/make/example.py` writes
docs/examples/wipe.csv.

The xArm 6 wipes a bowl turned upside down, the hidden task "sphere" of the study of demonstrations,
with a person's smooth error of a few tenths of a degree in each joint.
"""

from pathlib import Path

import numpy as np

from constraint_geodesics.params import load_params
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.hidden_tasks import TASKS

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "docs" / "examples" / "wipe.csv"
COUNT, ERROR_DEG, EVERY, SEED = 10, 0.2, 3, 0


def main() -> None:
    """Write the file: a demonstration's number, and its joints [rad]."""
    scene = Scene.from_params(load_params(ROOT / "params.yaml"))
    shown = TASKS["sphere"].demonstrate(scene, COUNT, ERROR_DEG, SEED)
    rows = [(k, *row) for k, motion in enumerate(shown) for row in motion[::EVERY]]
    FILE.parent.mkdir(exist_ok=True)
    header = ",".join(("demonstration", *scene.robot.joint_names))
    np.savetxt(FILE, rows, ["%d", *["%.4f"] * scene.robot.dof], ",", header=header, comments="")


if __name__ == "__main__":
    main()
