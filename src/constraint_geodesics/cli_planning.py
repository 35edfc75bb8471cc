"""The commands of `geodesics` that plan: for the planner's own arm, or for that of any URDF."""

import json
import math
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from constraint_geodesics import completion
from constraint_geodesics.cli_degrees import (
    refuse_degrees,
    refuse_degrees_of_pose,
    refuse_degrees_of_table,
)
from constraint_geodesics.extras import require
from constraint_geodesics.pipeline.stage import WRONG_USAGE, complain
from constraint_geodesics.progress import LINE_AFTER_S, waiting

if TYPE_CHECKING:
    from constraint_geodesics.certification.certifier import Certificate
    from constraint_geodesics.constraints.constraint import Constraint, Pose
    from constraint_geodesics.goals.goal import Wanted
    from constraint_geodesics.planner import Planner
    from constraint_geodesics.scene.scene_file import SceneFile
    from constraint_geodesics.trajectory import Trajectory

ASKED_AGAIN_S = 1.0
"""A query that took less is asked again: its first answer has the loading of compiled code in it,
and what is made once a planner.
"""
NO_PATH = 3
POSE = '"x y z roll pitch yaw", in m and rad'

AsJson = Annotated[bool, typer.Option("--json", help="Print the answer as one JSON object.")]
Source = Annotated[
    str | None,
    typer.Option(
        "--planner",
        help="A planner's folder or MLflow address; else the pipeline's or the package's.",
    ),
]
Urdf = Annotated[
    Path | None,
    typer.Option(help="Another arm: a URDF, here or in pybullet_data; nothing is trained."),
]
ToolLink = Annotated[
    str | None, typer.Option("--tool-link", help="Of that arm: the link that carries the tool.")
]
ToolPose = Annotated[
    str | None, typer.Option(help=f"The pose of the tool's own frame in that link, as {POSE}.")
]
Hold = Annotated[
    list[str] | None,
    typer.Option(help='A joint that is not to move, as in "torso_lift_joint=0.2"; repeatable.'),
]
Srdf = Annotated[
    Path | None, typer.Option(help="Which links may touch; without it that is found by sampling.")
]
SceneFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--scene", help="YAML with shapes to add: what is there stays; repeatable. docs/scenes.md."
    ),
]
AttachFiles = Annotated[
    list[Path] | None,
    typer.Option("--attach", help="YAML with shapes that links carry; repeatable."),
]
MoveitScene = Annotated[
    Path | None, typer.Option(help="A planning scene of MoveIt to add, as YAML.")
]
Limit = Annotated[
    str | None,
    typer.Option(
        help="As for `plan`; by default what the file says.",
        shell_complete=completion.planned_constraints,
    ),
]


class Arm(NamedTuple):
    """Whom to ask, as options say it: a planner's files, or the arm of a URDF."""

    planner: str | None
    urdf: Path | None
    tool_link: str | None
    tool_pose: str | None
    hold: list[str] | None
    srdf: Path | None
    scenes: list[Path] | None = None
    attached: list[Path] | None = None

    def open(self, method: str = "planner") -> "Planner":
        """With what files add to the scene.  Raises PlannerError, BundleError or RobotError for
        options that name none, SceneError for such files.
        """
        from constraint_geodesics.scene.scene_file import read_attached, read_scene

        files = [(file, read_scene(file)) for file in self.scenes or ()]
        files += [(file, read_attached(file)) for file in self.attached or ()]
        found = self._planner(method)
        try:
            for file, said in files:
                _add(said, file, found)
        except BaseException:
            found.close()
            raise
        return found

    def _planner(self, method: str = "planner") -> "Planner":
        from constraint_geodesics.planner import Planner, PlannerError

        own = (self.tool_link, self.tool_pose, self.hold, self.srdf)
        if self.urdf is None:
            if any(own):
                raise PlannerError("--tool-link, --tool-pose, --hold and --srdf need --urdf")
            return Planner.load(self.planner, method)
        if self.planner is not None or method != "planner":
            raise PlannerError("--urdf goes without --planner and --method")
        if self.tool_link is None:
            raise PlannerError(f"which link carries the tool? `geodesics robot {self.urdf}`")
        tool = None if self.tool_pose is None else _pose(self.tool_pose, "--tool-pose")
        values = dict(map(held, self.hold or []))
        return Planner.from_urdf(self.urdf, self.tool_link, self.srdf, tool, hold=values)


def _add(said: "SceneFile", file: Path, planner: "Planner") -> None:
    """Raises SceneError with the file's name."""
    from constraint_geodesics.scene.scene import SceneError

    try:
        said.into(planner.scene)
    except SceneError as error:
        raise error if str(file) in str(error) else SceneError(f"{file}: {error}") from None


class Ends(NamedTuple):
    """What to plan, as options say it."""

    start: str | None
    constraint: str | None
    goal: str | None
    goal_pose: str | None
    goal_free: str | None
    goal_tolerance: str | None

    def asked(self) -> "tuple[list[float], Wanted, str]":
        """Start, goal and the constraint's name.  Raises PlannerError where they are not all
        given.
        """
        from constraint_geodesics.planner import PlannerError

        if self.start is None or self.constraint is None:
            missing = "--start" if self.start is None else "--constraint"
            raise PlannerError(f"{missing} is missing: plan needs --start, --goal and --constraint")
        start = _joints(self.start, "--start")
        goal = _goal(self.goal, self.goal_pose, self.goal_free, self.goal_tolerance)
        return start, goal, self.constraint


def plan(
    start: Annotated[
        str | None, typer.Option(help='Start configuration: the joints in rad, as in "0.1 -0.5 …".')
    ] = None,
    constraint: Annotated[
        str | None,
        typer.Option(
            help="A name that `geodesics constraints` lists, or a file: that of `geodesics "
            "identify`, or one of your own (docs/first_path.md); with --urdf free, or level: the "
            "tilt that the tool has at the start.",
            shell_complete=completion.planned_constraints,
        ),
    ] = None,
    goal: Annotated[str | None, typer.Option(help="Goal configuration: the joints in rad.")] = None,
    goal_pose: Annotated[
        str | None, typer.Option(help=f"Or a pose of the tool, as {POSE}, base frame.")
    ] = None,
    goal_free: Annotated[
        str | None,
        typer.Option(help='Axes of that pose which may have any value, as in "yaw" or "x y".'),
    ] = None,
    goal_tolerance: Annotated[
        str | None, typer.Option(help="Half-widths of its other axes: six numbers, in m and rad.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the path here, as CSV.")] = None,
    record: Annotated[Path | None, typer.Option(help="Write a Rerun recording here.")] = None,
    demonstrations: Annotated[
        Path | None,
        typer.Option(help="Draw what `identify` found the constraint in, in the recording."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Draw the path here, as PNG.")] = None,
    trajectory: Annotated[
        bool,
        typer.Option(
            "--trajectory", help="Print JSON with the motion, as trajectory_msgs/JointTrajectory."
        ),
    ] = False,
    planner: Source = None,
    urdf: Urdf = None,
    tool_link: ToolLink = None,
    tool_pose: ToolPose = None,
    hold: Hold = None,
    srdf: Srdf = None,
    scene: SceneFiles = None,
    attach: AttachFiles = None,
    moveit_scene: MoveitScene = None,
    moveit_request: Annotated[
        Path | None,
        typer.Option(help="A motion request of MoveIt, as YAML: start, goal and constraint."),
    ] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            help="Look for shorter paths, or for any where none is found at once, for about so "
            "many seconds; by default do not."
        ),
    ] = None,
    snap: Annotated[
        bool,
        typer.Option(
            "--snap", help="Move a start that is off by at most 0.01 rad onto the constraint."
        ),
    ] = False,
    velocity_scale: Annotated[
        float, typer.Option(help="Share of the velocity limits that is used.")
    ] = 1.0,
    acceleration_scale: Annotated[
        float,
        typer.Option(
            help="Share of the acceleration limits that is used; with --urdf those are 10 rad/s² "
            "and 1 m/s²."
        ),
    ] = 1.0,
    method: Annotated[
        str,
        typer.Option(
            help="planner: straight line, roadmap and trees, refined; nothing in it is learned.  "
            "learned: curves that a trained policy proposes, certified and not refined.  "
            "learned+band: the same, refined by the planner's elastic band.",
            shell_complete=completion.methods,
        ),
    ] = "planner",
    as_json: AsJson = False,
) -> None:
    """Plan one path.  Exit code 0: solved; 2: wrong usage; 3: there is no path, and the line says
    why.
    """
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.constraints.constraint import ConstraintError
    from constraint_geodesics.identification.demonstrations import (
        DemonstrationError,
        demonstrations_from,
    )
    from constraint_geodesics.moveit import MoveitError, add_moveit_scene, read_moveit_request
    from constraint_geodesics.planner import PlannerError, SceneError
    from constraint_geodesics.robot.kinematics import RobotError

    if record is not None:
        require("record")
    arm = Arm(planner, urdf, tool_link, tool_pose, hold, srdf, scene, attach)
    try:
        read = [
            *(("--attach", file) for file in attach or ()),
            ("--constraint", constraint),
            ("--demonstrations", demonstrations),
            ("--moveit-request", moveit_request),
            ("--moveit-scene", moveit_scene),
            *(("--scene", file) for file in scene or ()),
            ("--srdf", srdf),
            ("--urdf", urdf),
        ]
        require_apart({"--out": out, "--record": record, "--picture": picture}, read)
        if picture is not None and picture.suffix.lower() != ".png":
            line = f"--picture {picture}: a picture is written as PNG: {picture.stem}.png"
            raise PlannerError(line)
        if demonstrations is not None and record is None:
            raise PlannerError("--demonstrations is drawn in what --record names: give it, too")
        ends = Ends(start, constraint, goal, goal_pose, goal_free, goal_tolerance)
        asked = None if moveit_request is not None else ends.asked()
        if moveit_request is not None and any(ends):
            raise PlannerError("--moveit-request goes without --start, --constraint and --goal…")
        with loading():
            loaded = arm.open(method)
        with loaded:
            shown, state = None, None
            if demonstrations is not None:
                shown, _ = demonstrations_from(demonstrations, loaded.robot)
            if moveit_scene is not None:
                state = add_moveit_scene(moveit_scene, loaded.scene)
            if moveit_request is not None:
                request = read_moveit_request(moveit_request, loaded, state)
                velocity_scale *= request.velocity_scale
                acceleration_scale *= request.acceleration_scale
                first, wanted = request.start, request.goals
                kept: str | Constraint = request.constraint
            else:
                assert asked is not None
                first, wanted = asked[0], [asked[1]]
                refuse_degrees({"--start": first, "--goal": asked[1]}, loaded.robot)
                kept = _constraint(asked[2], loaded)
            says_so = budget is not None and budget > LINE_AFTER_S  # the planner itself
            ask = partial(
                loaded.plan,
                first,
                wanted,
                kept,
                budget_s=budget,
                snap=snap,
                velocity_scale=velocity_scale,
                acceleration_scale=acceleration_scale,
            )
            with waiting("" if says_so else "planning"):
                path = ask()
                in_words = path.status == "solved" and not (as_json or trajectory)
                quick = budget is None and path.planning_time_s < ASKED_AGAIN_S
                again_s = ask().planning_time_s if in_words and quick else math.inf
            source = loaded.source
    except (
        *(BundleError, ConstraintError, DemonstrationError, MoveitError, PlannerError),
        *(RobotError, SceneError),
    ) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    print(f"planner: {source}", file=sys.stderr)
    about: dict[str, Any] = path.summary()
    if path.status == "solved" and trajectory:
        about["trajectory"] = path.to_joint_trajectory()
    print(json.dumps(about) if as_json or trajectory else _told(path, again_s), flush=True)
    if path.status == "solved":  # the answer is out, should one of these fail
        with waiting("writing"):
            if out is not None:
                path.save(out)
            if record is not None:
                path.record(record, demonstrations=shown)
            if picture is not None:
                path.draw(picture)
    raise SystemExit(0 if path.status == "solved" else NO_PATH)


def require_apart(
    written: Mapping[str, Path | None], read: Sequence[tuple[str, str | Path | None]] = ()
) -> None:
    """Raises PlannerError where one file would be written over another, or over one that is read;
    both with their options.
    """
    from constraint_geodesics.planner import PlannerError

    known = dict[Path, str]()
    for option, given in read:
        if given is not None:
            known.setdefault(Path(given).resolve(), option)
    for option, file in written.items():
        if file is None:
            continue
        other = known.setdefault(file.resolve(), option)
        if other != option:
            raise PlannerError(f"{other}, {option} {file}: one file can't hold both")


def _told(path: "Trajectory", again_s: float) -> str:
    """An answer in one line: the figures of a path and what is proven of it, or why there is
    none.

    again_s: what the same query took the second time, infinite if it was asked once.
    """
    certificate = path.certificate
    if path.status != "solved" or certificate is None:
        return f"{path.status}: {path.explanation}"
    moved = path.statistics.snapped_rad
    figures = [
        f"{path.length_rad:.2f} rad",
        f"motion {path.times[-1]:.2f} s",
        _planned(path.planning_time_s, again_s),
        *([f"from a start moved by {moved:.2g} rad"] if moved else []),
    ]
    name, constraint = path.constraint_name, path.constraint
    proven = _proven(certificate, "" if constraint.is_free else name, constraint.caveat)
    others = ", ".join(f"{way.source} {way.length_rad:.2f} rad" for way in path.statistics.ways)
    line = f"solved: {', '.join(figures)}; proven: {proven}"
    return f"{line}; other ways: {others}" if others else line


def _planned(first_s: float, again_s: float) -> str:
    if again_s >= first_s:
        return f"planned in {_spent(first_s)}"
    return f"planned in {_spent(again_s)} ({_spent(first_s)} as the first of its process)"


def _spent(seconds: float) -> str:
    """A time as people say it."""
    if seconds >= 1.0:
        return f"{seconds:.2f} s"
    return f"{1e3 * seconds:.0f} ms" if seconds >= 1e-3 else "less than 1 ms"


def _proven(certificate: "Certificate", constraint: str, caveat: str) -> str:
    """What holds on the whole path, in words.  constraint: its name, blank for none."""
    if not constraint:
        return _clearance(certificate)
    bound = f"at most {certificate.violation_bound:.1e} (rad, m) off {constraint}"
    bound += f", {caveat}," if caveat else ""
    if certificate.start_velocity is None:
        return f"{bound} anywhere, {_clearance(certificate)}"
    from constraint_geodesics.answering import TURNING

    return f"{bound} {TURNING}, {_clearance(certificate)}"


def inverse_kinematics(
    pose: Annotated[str, typer.Option(help=f"Of the tool, as {POSE}, base frame.")],
    planner: Source = None,
    urdf: Urdf = None,
    tool_link: ToolLink = None,
    tool_pose: ToolPose = None,
    hold: Hold = None,
    srdf: Srdf = None,
    scene: SceneFiles = None,
    attach: AttachFiles = None,
    as_json: AsJson = False,
) -> None:
    """Print the configurations that reach a tool pose, free of collision and within the limits, one
    a line: of six joints all, of more some of each family.  Exit code 0: there are some; 2: wrong
    usage; 3: there is none.
    """
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import PlannerError, SceneError
    from constraint_geodesics.robot.kinematics import RobotError

    arm = Arm(planner, urdf, tool_link, tool_pose, hold, srdf, scene, attach)
    try:
        wanted = _pose(pose, "--pose")
        with loading():
            loaded = arm.open()
        with loaded, waiting("looking for configurations"):
            found, names = loaded.ik(wanted), loaded.robot.joint_names
    except (BundleError, PlannerError, RobotError, SceneError) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    if as_json:
        print(json.dumps({"joint_names": list(names), "configurations": found.tolist()}))
    else:
        for q in found:
            print(" ".join(f"{x:.9f}" for x in q))
    if not len(found):
        line = "no configuration was found that reaches this pose and touches nothing"
        print(line, file=sys.stderr)
    raise SystemExit(0 if len(found) else NO_PATH)


def check(
    file: Annotated[
        Path, typer.Argument(help="A path as CSV: a header, then one row of joints in rad a line.")
    ],
    constraint: Limit = None,
    planner: Annotated[
        str | None, typer.Option(help="Where robot and workcell come from, as for `plan`.")
    ] = None,
    urdf: Urdf = None,
    tool_link: ToolLink = None,
    tool_pose: ToolPose = None,
    hold: Hold = None,
    srdf: Srdf = None,
    scene: SceneFiles = None,
    attach: AttachFiles = None,
    moveit_scene: MoveitScene = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the certificate as one JSON object.")
    ] = False,
) -> None:
    """Certify anybody's path, between whatever ends it has.  Exit code 0: valid; 2: wrong usage; 3:
    what it breaks.
    """
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.constraints.constraint import ConstraintError
    from constraint_geodesics.moveit import MoveitError, add_moveit_scene
    from constraint_geodesics.planner import PlannerError, SceneError
    from constraint_geodesics.robot.kinematics import RobotError
    from constraint_geodesics.trajectory import read_trajectory

    arm = Arm(planner, urdf, tool_link, tool_pose, hold, srdf, scene, attach)
    try:
        with loading():
            loaded = arm.open()
        with loaded, waiting(f"checking {file}"):
            if moveit_scene is not None:
                add_moveit_scene(moveit_scene, loaded.scene)
            own = None if constraint is None else _constraint(constraint, loaded)
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("ignore")
                warnings.simplefilter("always", UserWarning)  # of shapes that are missing
                read = read_trajectory(file, loaded.robot.joint_names, loaded.robot)
                certificate = loaded.check_read(read, own)
            held = loaded.constraints[own] if isinstance(own, str) else own or read.constraint
            broken = certificate.violation
            if broken is not None and broken.kind == "joint_limits":
                refuse_degrees_of_table(file, read.joints, loaded.robot)
    except (
        *(BundleError, ConstraintError, MoveitError),
        *(PlannerError, RobotError, SceneError),
    ) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    untimed = (
        " (no times: velocity and acceleration not looked at)"
        if math.isnan(certificate.duration_s)
        else ""
    )
    meant = constraint or f"the constraint that {file.name} names"
    meant = "" if held is None or held.is_free else meant
    for one in told:
        print(f"note: {one.message}: give --scene and --attach", file=sys.stderr)
    if as_json:
        print(json.dumps(certificate.summary()))
    elif broken is None:
        proven = _proven(certificate, meant, "" if held is None else held.caveat)
        print(f"valid: {certificate.length_rad:.3f} rad, {proven}{untimed}")
    else:
        print(f"{broken.kind}: {broken.message}")
    raise SystemExit(0 if broken is None else NO_PATH)


def _clearance(certificate: "Certificate") -> str:
    """What was proven of collisions, in words."""
    if certificate.asked_pybullet:
        return "free of collision, by PyBullet's distances where bodies all but touch"
    if not math.isfinite(certificate.clearance_m):
        return "with nothing that can touch"
    return f"at least {1e3 * certificate.clearance_m:.1f} mm from any collision"


def show_robot(
    urdf: Annotated[Path, typer.Argument(help="A URDF, here or in pybullet_data.")],
    tool_link: Annotated[
        str | None,
        typer.Option(
            "--tool-link", help="Link that carries the tool; without it, those there are."
        ),
    ] = None,
    hold: Hold = None,
    srdf: Srdf = None,
    as_json: AsJson = False,
) -> None:
    """Say what is understood of a robot: its chain, limits, the links that may touch and why, and
    what is missing.  Exit code 0: understood; 2: wrong usage, or a URDF that can't be used.
    """
    from pydantic import ValidationError

    from constraint_geodesics.params import RobotParams, one_line
    from constraint_geodesics.robot.description import read_description
    from constraint_geodesics.robot.kinematics import RobotError
    from constraint_geodesics.scene.arm import FOUND
    from constraint_geodesics.scene.understood import understand
    from constraint_geodesics.scene.urdf import find_urdf

    try:
        file = urdf if urdf.exists() else find_urdf(urdf)
        if tool_link is None:
            if hold or srdf:
                raise RobotError("--hold and --srdf need --tool-link")
            description = read_description(file)
            ends = {link: len(description.moving(link)) for link in description.ends}
            about: dict[str, Any] = {"robot": description.name, "tool_links": ends}
            lines = [f"{link}: carried by {count} joints" for link, count in ends.items()]
            lines += ["choose one of these links, or any other: --tool-link"]
        else:
            values = dict(map(held, hold or []))
            touching = FOUND if srdf is None else str(srdf)
            params = RobotParams(
                urdf=str(file), tool_link=tool_link, hold=values, may_touch=touching
            )
            understood = understand(params)
            about, lines = understood.summary(), list(understood.lines())
    except ValidationError as error:
        raise SystemExit(complain(RobotError(one_line(error)), WRONG_USAGE)) from None
    except RobotError as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    print(json.dumps(about) if as_json else "\n".join(lines))


@contextmanager
def loading() -> Iterator[None]:
    """Say what a planner's user waits for: the compiler where it was not asked before."""
    with waiting("loading the planner"):
        yield


def _goal(joints: str | None, pose: str | None, free: str | None, tolerance: str | None) -> Any:
    """A configuration, a pose or a region, as the options say."""
    from constraint_geodesics.goals.region import GoalRegion
    from constraint_geodesics.planner import PlannerError

    if (joints is None) == (pose is None):
        raise PlannerError("the goal is missing, or there are two: --goal or --goal-pose")
    if pose is None:
        if free or tolerance:
            raise PlannerError("--goal-free and --goal-tolerance need --goal-pose")
        return _joints(joints or "", "--goal")
    wanted = _pose(pose, "--goal-pose")
    if not free and not tolerance:
        return wanted
    widths = _joints(tolerance, "--goal-tolerance") if tolerance else (0.0,) * 6
    return GoalRegion(wanted, (free or "").replace(",", " ").split(), widths)


def _constraint(name: str, planner: "Planner") -> "str | Constraint":
    """A constraint's file, or the name of one."""
    if Path(name).suffix not in (".yaml", ".yml"):
        return name
    from constraint_geodesics.identification.files import load_constraint

    return load_constraint(Path(name), planner.robot)


def _pose(text: str, option: str) -> "Pose":
    from constraint_geodesics.constraints.constraint import ConstraintError, Pose
    from constraint_geodesics.planner import PlannerError

    values = _joints(text, option)
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise PlannerError(f"{option} {text!r}: must be six finite numbers, {POSE}")
    refuse_degrees_of_pose(values, option)
    try:
        return Pose.from_rpy(values[:3], values[3:])
    except ConstraintError as error:
        raise PlannerError(f"{option} {text!r}: {error}") from None


def _joints(text: str, option: str) -> list[float]:
    from constraint_geodesics.planner import PlannerError

    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise PlannerError(
            f"{option} {text!r}: must be numbers, with spaces or commas between them"
        ) from None


def held(text: str) -> tuple[str, float]:
    """A joint and its value [rad or m], of --hold.  Raises RobotError."""
    from constraint_geodesics.robot.kinematics import RobotError

    name, _, text_of = text.partition("=")
    try:
        value = float(text_of)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RobotError(f"--hold {text!r}: must be a joint and a number, joint=value")
    return name.strip(), value
