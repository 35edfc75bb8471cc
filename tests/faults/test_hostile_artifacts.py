"""Files that somebody made to do harm, in every place where one is loaded: each is refused in one
line, or read harmlessly.  Nothing in them is run, nothing is written or asked for, and neither time
nor memory grows with what they promise.
"""

import gzip
import hashlib
import json
import os
import pickle
import resource
import shutil
import struct
import sys
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from constraint_geodesics import bundle
from constraint_geodesics.benchmark.problem_files import read_problems
from constraint_geodesics.bundle import CARD, ROADMAPS, card_digest, open_bundle
from constraint_geodesics.constraints.constraint import constraint_from
from constraint_geodesics.geodesics import learned_method
from constraint_geodesics.geodesics.learned_method import MANIFOLD, POLICY, read_learned
from constraint_geodesics.geodesics.policy_search import _checkpoint
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.files import load_constraint
from constraint_geodesics.learning.gan import Generator
from constraint_geodesics.learning.inference import WEIGHTS, FrozenManifold
from constraint_geodesics.learning.latent_manifold import LatentManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import ARRAYS, load_submanifold
from constraint_geodesics.moveit import add_moveit_scene
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.paths import read_paths
from constraint_geodesics.pipeline.stage import complain
from constraint_geodesics.recording.recording import read_recording
from constraint_geodesics.report.chooser import Chooser
from constraint_geodesics.report.page import Section, Table, write_page
from constraint_geodesics.robot.description import read_description
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene.allowed_collisions import allowed_by_srdf
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.scene.scene_file import read_scene
from constraint_geodesics.scene.triangles import read_triangles
from constraint_geodesics.studies.execution import load_execution
from constraint_geodesics.trajectory import read_trajectory
from tests.faults.effort import Effort, count

ROOT = Path(__file__).resolve().parents[2]
ROOM = 3 * 2**30
"""Bytes that one file may make the process take: about what the largest file that is read needs."""
LONGEST_S = 20.0
"""For one file, on a busy machine."""
CANARY = "canary"
"""A file that is there if something was run."""


class Bomb:
    """What a pickle may hold: a call."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.canary}",)


_WATCHED = (
    *("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen"),
    *("pickle.find_class", "socket.connect", "socket.getaddrinfo"),
)


class Watch:
    """What the process does while a hostile file is opened."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.seen: list[str] = []
        sys.addaudithook(self._look)

    def _look(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None:
            return
        if event in _WATCHED:
            self.seen.append(f"{event} {arguments}")
        elif event == "open" and isinstance(arguments[0], str):
            writes = isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            file = Path(arguments[0]).absolute()
            if writes and not file.is_relative_to(self.folder) and str(file) != os.devnull:
                self.seen.append(f"{event} {arguments}")

    @contextmanager
    def over(self, folder: Path) -> Iterator[list[str]]:
        """In memory of ROOM."""
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        before = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, before[1]))
        self.folder, self.seen = folder, []
        try:
            yield self.seen
        finally:
            self.folder = None
            resource.setrlimit(resource.RLIMIT_AS, before)


WATCH = Watch()

Open = Callable[[Path], Any]
"""Makes a hostile file in a folder and opens it."""
CASES: dict[str, Open] = {}


def case(name: str) -> Callable[[Open], Open]:
    """Keep a function as one hostile file."""

    def kept(made: Open) -> Open:
        assert name not in CASES
        CASES[name] = made
        return made

    return kept


# planners' folders, their checksums right


def planner(folder: Path) -> Path:
    return Path(shutil.copytree(bundle.PACKAGED, folder / "planner"))


def sealed(folder: Path, card: str, entries: Mapping[str, Any], files: Mapping[str, bytes]) -> Path:
    """A folder with other entries and files, and the checksums of these."""
    whole = {**json.loads((folder / card).read_text()), **entries}
    for name, content in files.items():
        (folder / name).write_bytes(content)
        whole["sha256"][name] = hashlib.sha256(content).hexdigest()
    whole["sha256"][card] = card_digest(whole)
    (folder / card).write_text(json.dumps(whole))
    return folder


def with_card(change: Callable[[dict[str, Any]], None]) -> Open:
    def made(folder: Path) -> Any:
        place = planner(folder)
        card = json.loads((place / CARD).read_text())
        change(card)
        return open_bundle(sealed(place, CARD, card, {}))

    return made


def with_roadmaps(content: Callable[[Path], bytes]) -> Open:
    def made(folder: Path) -> Any:
        return open_bundle(sealed(planner(folder), CARD, {}, {ROADMAPS: content(folder)}))

    return made


def with_graph(**changed: np.ndarray | None) -> Open:
    """The graph of `free`, some of its arrays others or missing."""
    whole = {
        "joints": np.zeros((4, 6), np.float32),
        "edges": np.array([[0, 1], [1, 2]], np.uint16),
        "lengths": np.ones(2, np.float32),
        **changed,
    }
    arrays = {f"free/{name}": own for name, own in whole.items() if own is not None}
    return with_roadmaps(lambda _: save(arrays))


def header(**entries: Any) -> bytes:
    text = json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text + bytes(64)


def tensor(shape: list[int], begin: int, end: int, dtype: str = "F32") -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


HEADERS = {
    "header longer than the file": struct.pack("<Q", 2**20) + b"{}",
    "header of 2^63 bytes": struct.pack("<Q", 2**63) + b"{}",
    "negative offsets": header(a=tensor([4], -16, 0)),
    "offsets beyond the end": header(a=tensor([4], 0, 2**40)),
    "tensors over each other": header(a=tensor([8], 0, 32), b=tensor([8], 16, 48)),
    "a shape of 2^62": header(a=tensor([2**31, 2**31], 0, 64)),
    "an unknown type": header(a=tensor([16], 0, 64, "PICKLE")),
    "a header of 10^5 lists": struct.pack("<Q", 200_000) + b"[" * 10**5 + b"]" * 10**5,
}
for _name, _content in HEADERS.items():
    case(f"safetensors: {_name}")(with_roadmaps(lambda _, content=_content: content))
GRAPHS: dict[str, dict[str, np.ndarray | None]] = {
    "NaN joints": {"joints": np.full((4, 6), np.nan, np.float32)},
    "endless lengths": {"lengths": np.array([1.0, np.inf], np.float32)},
    "negative lengths": {"lengths": np.array([1.0, -1.0], np.float32)},
    "edges out of range": {"edges": np.array([[0, 1], [1, 60_000]], np.uint16)},
    "negative edges": {"edges": np.array([[0, 1], [1, -3]], np.int64)},
    "edges that are no numbers of nodes": {"edges": np.array([[0, 1], [1, 0.5]], np.float32)},
    "edges of three ends": {"edges": np.zeros((2, 3), np.uint16)},
    "joints of one row": {"joints": np.zeros(6, np.float32)},
    "fewer lengths than edges": {"lengths": np.ones(1, np.float32)},
    "no lengths": {"lengths": None},
}
for _name, _arrays in GRAPHS.items():
    case(f"graph: {_name}")(with_graph(**_arrays))


@case("pickle for roadmaps")
def _(folder: Path) -> Any:
    return with_roadmaps(lambda own: pickle.dumps(Bomb(own / CANARY)))(folder)


def constraints_of(card: dict[str, Any], name: str, described: Any) -> None:
    card["constraints"][name] = described


CARDS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a constraint named ../../x": lambda c: constraints_of(c, "../../x", c["constraints"]["free"]),
    "a constraint named <script>": lambda c: constraints_of(
        c, "<script>alert(1)</script>", c["constraints"]["free"]
    ),
    "a URDF ../../x": lambda c: c["robot"].update(urdf="../../x.urdf"),
    "a URDF /etc/passwd": lambda c: c["robot"].update(urdf="/etc/passwd"),
    "a URDF with NUL in its name": lambda c: c["robot"].update(urdf="a\0b"),
    "an SRDF outside": lambda c: c["robot"].update(may_touch="../../../etc/hostname"),
    "a body's URDF outside": lambda c: c["workcell"]["shapes"].update(
        thing={"kind": "urdf", "name": "thing", "urdf": "../../../x.urdf"}
    ),
    "a mesh outside": lambda c: c["workcell"]["shapes"].update(
        thing={"kind": "mesh", "name": "thing", "file": "/etc/passwd"}
    ),
    "NaN in settings": lambda c: c["planner"].update(clearance_m=float("nan")),
}
for _name, _change in CARDS.items():
    case(f"card: {_name}")(with_card(_change))


@case("card: a module to import")
def _(folder: Path) -> Any:
    (folder / "evil_module.py").write_text(f"open({str(folder / CANARY)!r}, 'w')\n")
    described = {"kind": "functions", "factory": "evil_module:make", "arguments": {}}
    sys.path.insert(0, str(folder))
    try:
        return with_card(lambda card: constraints_of(card, "own", described))(folder)
    finally:
        sys.path.remove(str(folder))


@case("card: a function of a module that is there")
def _(folder: Path) -> Any:
    described = {"kind": "functions", "factory": "os:system", "arguments": {}}
    made, _ = with_card(lambda card: constraints_of(card, "own", described))(folder)
    return constraint_from(made.constraints["own"], robot_from(made.robot))


@case("card: 10^5 lists deep")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).write_text("[" * 10**5 + "]" * 10**5)
    return open_bundle(place)


@case("card: a pipe that nobody writes to")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).unlink()
    os.mkfifo(place / CARD)
    return open_bundle(place)


@case("card: a link to /dev/zero")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).unlink()
    (place / CARD).symlink_to("/dev/zero")
    return open_bundle(place)


@case("card: a link to a secret")
def _(folder: Path) -> Any:
    place = planner(folder)
    (folder / "secret").write_text("hunter2")
    (place / CARD).unlink()
    (place / CARD).symlink_to(folder / "secret")
    return open_bundle(place)


@case("roadmaps: a link to /dev/zero")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / ROADMAPS).unlink()
    (place / ROADMAPS).symlink_to("/dev/zero")
    return open_bundle(place)


# what was learned


def with_learned(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Open:
    def made(folder: Path) -> Any:
        place = planner(folder) / learned_method.FOLDER
        arrays = dict(
            read_learned(place).manifold if name == MANIFOLD else read_learned(place).policy
        )
        change(arrays)
        return read_learned(sealed(place, learned_method.CARD, {}, {name: save(arrays)}))

    return made


def nan_in(name: str) -> Callable[[dict[str, np.ndarray]], Any]:
    return lambda arrays: arrays.update({name: np.full_like(arrays[name], np.nan)})


def swollen(arrays: dict[str, np.ndarray]) -> None:
    """Two layers of which the biases alone are there: their weights would be of 14 GB."""
    for layer in (0, 2):
        arrays[f"encoder.nonlinear.{layer}.bias"] = np.zeros(60_000, np.float32)


case("policy: NaN weights")(with_learned(POLICY, nan_in("mean.weight")))
case("policy: a layer that does not fit")(
    with_learned(POLICY, lambda own: own.update({"body.0.bias": np.zeros(3, np.float32)}))
)
case("policy: a layer is missing")(with_learned(POLICY, lambda own: own.pop("mean.bias")))
case("manifold: NaN weights")(with_learned(MANIFOLD, nan_in("decoder.linear.weight")))
case("manifold: layers of 14 GB")(with_learned(MANIFOLD, swollen))


def pickled(folder: Path) -> bytes:
    """As `torch.save` wraps a pickle."""
    content = BytesIO()
    torch.save({"policy": Bomb(folder / CANARY)}, content)
    return content.getvalue()


def weights_folder(folder: Path, content: bytes, **card: Any) -> Path:
    (folder / WEIGHTS).write_bytes(content)
    about = {"sha256": hashlib.sha256(content).hexdigest(), **card}
    (folder / "manifold.json").write_text(json.dumps(about))
    return folder


case("manifold: a pickle of torch")(
    lambda folder: LearnedManifold.load(weights_folder(folder, pickled(folder)))
)
case("frozen manifold: a pickle of torch")(
    lambda folder: FrozenManifold.load(weights_folder(folder, pickled(folder)))
)
case("generator: sizes without end")(
    lambda folder: LatentManifold.load(
        weights_folder(
            folder,
            save({"a": np.zeros(1)}),
            kind="Generator",
            sizes={"dof": 6, "latent_dim": 2, "hidden": [200_000, 200_000]},
        ),
        Generator,
    )
)


@case("policy: a pickle")
def _(folder: Path) -> Any:
    (folder / "policy-0.safetensors").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
    return MeanPolicy.load(folder, 0)


@case("checkpoint: a pickle of torch")
def _(folder: Path) -> Any:
    (folder / "seed.ckpt").write_bytes(pickled(folder))
    return _checkpoint(folder / "seed.ckpt")


@case("checkpoint: a bare pickle")
def _(folder: Path) -> Any:
    (folder / "seed.ckpt").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
    return _checkpoint(folder / "seed.ckpt")


# npz


def npz(file: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as whole:
        for name, content in members.items():
            whole.writestr(f"{name}.npy", content)
    return file


def npy(shape: tuple[int, ...], descr: str = "<f8", data: bytes = b"") -> bytes:
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + data


def submanifold(folder: Path, **members: bytes) -> Any:
    (folder / "submanifold.json").write_text('{"form": "graph"}')
    npz(folder / ARRAYS, **members)
    return load_submanifold(folder)


case("npz: pickled objects")(
    lambda folder: submanifold(
        folder, joints=npy((1,), "|O", pickle.dumps([Bomb(folder / CANARY)]))
    )
)
case("npz: a shape of 2^60")(lambda folder: submanifold(folder, joints=npy((2**60,))))
case("npz: a shape of 32 GB")(lambda folder: submanifold(folder, joints=npy((2**32,))))
case("npz: a zip bomb")(
    lambda folder: submanifold(folder, **{n: bytes(2**27) for n in ("a", "b", "c")})
)
case("npz: a pickle in its place")(
    lambda folder: (
        (folder / "run.npz").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
        and load_execution(folder / "run.npz")
    )
)
case("npz: names that leave the folder")(
    lambda folder: (
        npz(folder / "paths.npz", **{"../../x": npy((1,), data=bytes(8))})
        and read_paths([], folder)
    )
)


# problems, scenes and parameters


def text(name: str, content: str, read: Open) -> Open:
    def made(folder: Path) -> Any:
        (folder / name).write_text(content)
        return read(folder / name)

    return made


def packed(file: Path) -> Path:
    file.write_bytes(40 * gzip.compress(bytes(2**24), compresslevel=1))
    return file


ANCHORS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)
)
CALL = '!!python/object/apply:os.system ["touch canary"]'
PARAMS = (ROOT / "params.yaml").read_text()
ASKED = (
    '{"urdf": "%s", "tool_link": "x", "joints": ["a"],'
    ' "scenes": {"s": [{"start": [0], "goal": [0]}]}}'
)

case("problems: 10^5 lists deep")(
    text("p.json", '{"scenes": ' + "[" * 10**5 + "]" * 10**5 + "}", read_problems)
)
case("problems: a gzip bomb")(lambda folder: read_problems(packed(folder / "p.json.gz")))
case("problems: a URDF outside")(text("p.json", ASKED % "../../../etc/passwd", read_problems))
case("problems: a number of 10^6 digits")(
    text("p.json", '{"scenes": ' + "9" * 10**6 + "}", read_problems)
)
case("scene: anchors without end")(text("scene.yaml", f"shapes:\n  {{}}\n{ANCHORS}", read_scene))
case("scene: anchors in a shape")(
    text(
        "scene.yaml",
        ANCHORS + "shapes: {box: {kind: box, centre_m: *a29, size_m: *a29}}\n",
        read_scene,
    )
)
case("scene: a call")(text("scene.yaml", f"shapes: {CALL}\n", read_scene))
case("scene: 10^5 lists deep")(
    text("scene.yaml", "shapes: " + "[" * 10**5 + "]" * 10**5, read_scene)
)
case("moveit: a call")(
    text("scene.yaml", f"world: {CALL}\n", lambda file: add_moveit_scene(file, None))  # type: ignore[arg-type]
)
case("constraint: a call")(text("constraint.yaml", CALL, load_constraint))
case("params: a call")(text("params.yaml", f"{PARAMS}\nx: {CALL}\n", load_params))
case("params: anchors")(text("params.yaml", f"{ANCHORS}\n{PARAMS}", load_params))
for _name, _stage in (("a command", "free; touch canary"), ("a substitution", "$(touch canary)")):
    case(f"params: {_name} for a constraint's name")(
        text(
            "params.yaml",
            PARAMS.replace(
                "\n  free:\n", f'\n  "{_stage}": {{axes: [0, 0, 0, 0, 0, 0]}}\n  free:\n', 1
            ),
            load_params,
        )
    )


# XML and meshes

LAUGHS = "<!DOCTYPE robot [<!ENTITY a0 'ha'>" + "".join(
    f"<!ENTITY a{k} '{f'&a{k - 1};' * 10}'>" for k in range(1, 12)
)
OUTSIDE = "<!DOCTYPE robot [<!ENTITY a11 SYSTEM 'file:///etc/passwd'>"
ASKS = "<!DOCTYPE robot SYSTEM 'http://192.0.2.1/robot.dtd' ["
ROBOT = "<robot name='r'><link name='&a11;'/></robot>"
DEEP = "<robot name='r'>" + "<link name='x'>" * 10**5 + "</link>" * 10**5 + "</robot>"
ARM = (ROOT / "tests" / "robots" / "six_axis.urdf").read_text()
SIX_AXIS = ROOT / "tests" / "robots" / "six_axis.urdf"


def as_robot(file: Path) -> Any:
    return load_robot(file, "x")


for _name, _content in {
    "entities that grow": LAUGHS + "]>" + ROBOT,
    "an entity that is a file": OUTSIDE + "]>" + ROBOT,
    "a document type at an address": ASKS + "]>" + ROBOT.replace("&a11;", "x"),
    "10^5 elements deep": DEEP,
    "an encoding of its own": "<?xml version='1.0' encoding='bomb'?><robot/>",
}.items():
    case(f"urdf: {_name}")(text("arm.urdf", _content, read_description))
    case(f"urdf, read for the chain: {_name}")(text("arm.urdf", _content, as_robot))
    case(f"srdf: {_name}")(
        text("arm.srdf", _content, lambda file: allowed_by_srdf(file, read_description(SIX_AXIS)))
    )
    case(f"collada: {_name}")(text("mesh.dae", _content, as_obj))


def meshed(name: str) -> Open:
    content = (
        f'<robot name="r"><link name="x"><collision><geometry><mesh filename="{name}"/>'
        "</geometry></collision></link></robot>"
    )
    return text("arm.urdf", content, lambda file: read_pieces(file) and read_description(file))


for _name in ("../" * 12 + "etc/passwd", "/etc/passwd", "file:///etc/passwd", "/dev/zero"):
    case(f"urdf: the mesh {_name}")(meshed(_name))
for _name in ("http://192.0.2.1/x.stl", "package://../../../etc/passwd", "\\\\192.0.2.1\\x.stl"):
    case(f"urdf: the mesh {_name}")(meshed(_name))
case("obj: numbers of corners without end")(
    text(
        "mesh.obj", "v 0 0 0\nf 1 99999999999999999999 -5\n", lambda file: read_triangles(file, "")
    )
)


@case("stl: 2^32 triangles that are not there")
def _(folder: Path) -> Any:
    (folder / "mesh.stl").write_bytes(bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50))
    return read_triangles(folder / "mesh.stl", "")


# paths, demonstrations and recordings

case("csv: a device without end")(lambda folder: read_trajectory(Path("/dev/zero")))
case("csv: a line of 4 MB")(text("path.csv", "a,b\n" + "1," * 2 * 10**6, read_trajectory))
case("csv: a constraint 10^5 lists deep")(
    text("path.csv", f"# constraint: {'[' * 10**5}\na,b\n1,2\n2,3\n", read_trajectory)
)


@case("parquet: a pickle")
def _(folder: Path) -> Any:
    (folder / "shown.parquet").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
    return demonstrations_from(folder / "shown.parquet", load_robot(SIX_AXIS, "tool0"))


for _name, _bytes in {
    "nothing but its mark": b"RRF2\0\0\0\0" + bytes(64),
    "a pickle": pickle.dumps([1]),
    "lengths without end": b"RRF2" + b"\xff" * 200,
}.items():

    @case(f"recording: {_name}")
    def _(folder: Path, content: bytes = _bytes) -> Any:
        (folder / "path.rrd").write_bytes(content)
        return read_recording(folder / "path.rrd")


HARMLESS = {"npz: names that leave the folder": "they name no files"}
"""What is read, and why that harms nothing."""


@pytest.fixture(scope="module")
def tally(effort: Effort) -> Iterator[dict[str, int]]:
    """What all of them did, counted."""
    found = {"artifacts": 0, "executions": 0, "escapes": 0, "too_long": 0}
    yield found
    count("hostile_artifacts", effort, **found)


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_refused_in_one_line_or_harms_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: dict[str, int]
) -> None:
    monkeypatch.chdir(tmp_path)
    began, refusal = time.process_time(), None
    with WATCH.over(tmp_path.parent) as seen:
        try:
            CASES[name](tmp_path)
        except (ValueError, OSError) as error:
            refusal = error
    took = time.process_time() - began
    executed = list(tmp_path.rglob(CANARY))
    tally["artifacts"] += 1
    tally["executions"] += bool(executed)
    tally["escapes"] += bool(seen)
    tally["too_long"] += took > LONGEST_S
    assert not executed, "something in it was run"
    assert seen == [], "it reached out of its folder"
    assert took < LONGEST_S
    if refusal is None:
        assert name in HARMLESS
        return
    assert type(refusal).__module__.startswith("constraint_geodesics"), repr(refusal)
    line = str(refusal)
    assert len(line.splitlines()) == 1, line
    assert "hunter2" not in line
    assert "root:" not in line


def test_there_are_enough_of_them() -> None:
    assert len(CASES) >= 30


HOSTILE_NAME = "\x1b[2J\x1b]0;owned\x07<script>alert(1)</script>\r\nerror: none"


def test_an_error_says_no_more_than_a_line_and_moves_no_cursor(
    capsys: pytest.CaptureFixture[str],
) -> None:
    complain(ValueError(f"{HOSTILE_NAME}: there is no such file"))
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.rstrip("\n").isprintable()
    assert "\\x1b[2J" in err


def test_a_page_shows_names_and_runs_none(tmp_path: Path) -> None:
    (tmp_path / "reports").mkdir()
    hostile = HOSTILE_NAME + "\"'><img src=x onerror=alert(2)>"
    table = Table(hostile, hostile, [hostile], [[hostile]], planners=[hostile])
    section = Section("one", hostile, hostile, tables=[table])
    content = {"planners": [{"name": hostile}], "cases": [{"constraint": hostile}]}
    page = write_page(
        Layout(tmp_path),
        "benchmark",
        about={hostile: hostile},
        planners=1,
        rows=1,
        winner=hostile,
        standing=hostile,
        result=hostile,
        losses={hostile: hostile},
        chooser=Chooser(
            {"other": [hostile]}, [hostile], hostile, [hostile], {hostile: hostile}, content
        ),
        sections=[section],
    ).read_text()
    assert "<script>alert" not in page
    assert "<img src=x" not in page
    assert "&lt;script&gt;alert(1)" in page
