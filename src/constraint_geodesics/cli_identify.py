"""The command of `geodesics` that finds a constraint in demonstrations."""

import json
import math
import sys
from pathlib import Path
from typing import Annotated

import typer

from constraint_geodesics.cli_planning import (
    NO_PATH,
    Arm,
    AsJson,
    Hold,
    Source,
    Srdf,
    ToolLink,
    Urdf,
    loading,
    require_apart,
)
from constraint_geodesics.pipeline.stage import WRONG_USAGE, complain
from constraint_geodesics.progress import waiting


def identify_constraint(
    demonstrations: Annotated[
        Path,
        typer.Argument(
            help="CSV with a joint a column in rad, and before them the demonstration's number if "
            "there are several, or with the joints' names above; or parquet as LeRobot writes it."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Write the constraint here, as YAML for `plan --constraint`."),
    ] = None,
    loosely: Annotated[
        float,
        typer.Option(
            help="Widen each relation by so many times its error on left-out demonstrations; 0 "
            "holds it exactly."
        ),
    ] = 0.0,
    where_shown: Annotated[
        bool,
        typer.Option(
            "--where-shown", help="Also keep the tip in the region where demonstrations were."
        ),
    ] = False,
    rounded: Annotated[
        bool,
        typer.Option(
            "--rounded",
            help="Take axes and round numbers in place of the fitted ones, where the "
            "demonstrations are as near to them.",
        ),
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(help="Write a Rerun recording of demonstrations and identified set here."),
    ] = None,
    planner: Source = None,
    urdf: Urdf = None,
    tool_link: ToolLink = None,
    tool_pose: Annotated[str | None, typer.Option(help="As for `plan`.")] = None,
    hold: Hold = None,
    srdf: Srdf = None,
    as_json: AsJson = False,
) -> None:
    """Say what demonstrations keep to, and write it as a constraint.  Exit code 0: identified; 2:
    wrong usage; 3: nothing is identified, and the line says why.
    """
    import numpy as np

    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.constraints.constraint import ConstraintError
    from constraint_geodesics.extras import require
    from constraint_geodesics.identification.demonstrations import (
        DemonstrationError,
        demonstrations_from,
    )
    from constraint_geodesics.identification.files import SUFFIXES, save_constraint
    from constraint_geodesics.identification.identify import identify
    from constraint_geodesics.planner import PlannerError
    from constraint_geodesics.robot.kinematics import RobotError

    if record is not None:
        require("record")
    try:
        read = [("the demonstrations", demonstrations), ("--urdf", urdf), ("--srdf", srdf)]
        require_apart({"--out": out, "--record": record}, read)
        if out is not None and out.suffix not in SUFFIXES:
            raise PlannerError(f"--out {out}: the name must end in {' or '.join(SUFFIXES)}")
        if where_shown and out is None:
            raise PlannerError("--where-shown is of the file that --out names: give it, too")
        if not 0.0 <= loosely < math.inf:
            raise PlannerError(f"--loosely {loosely}: must be 0 or more, and finite")
        with loading():
            loaded = Arm(planner, urdf, tool_link, tool_pose, hold, srdf).open()
        with loaded, waiting(f"looking what {demonstrations} keeps to"):
            robot, workcell = loaded.robot, loaded.scene.workcell
            shown, motions = demonstrations_from(demonstrations, robot)
            found = identify(shown if motions else np.concatenate(shown), robot)
        if rounded and found.rounded is None:
            print("note: no rounder numbers fit: --rounded changes nothing", file=sys.stderr)
        found = (rounded and found.rounded) or found
        if loosely > 0.0:
            found = found.held_loosely(loosely)
        # before a file fails to be written: what was found must not go with it
        print(json.dumps(found.summary()) if as_json else found.explanation, flush=True)
        if out is not None and found.constraint is not None:
            save_constraint(found, out, where_shown)
            print(f"written: {out}", file=sys.stderr)
        if record is not None:
            from constraint_geodesics.recording.demonstrations import record_demonstrations

            record_demonstrations(record, shown, found, robot, workcell)
            print(f"written: {record}", file=sys.stderr)
    except (BundleError, ConstraintError, DemonstrationError, PlannerError, RobotError) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    raise SystemExit(0 if found.constraint is not None else NO_PATH)
