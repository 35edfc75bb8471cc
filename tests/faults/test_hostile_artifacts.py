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
import zlib
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.numpy import save

from constraint_geodesics import bundle
from constraint_geodesics.benchmark.problem_files import read_problems
from constraint_geodesics.bundle import CARD, ROADMAPS, card_digest, open_bundle
from constraint_geodesics.constraints.constraint import constraint_from
from constraint_geodesics.constraints.spline import Spline
from constraint_geodesics.geodesics import learned_method
from constraint_geodesics.geodesics.learned_method import MANIFOLD, POLICY, read_learned
from constraint_geodesics.geodesics.policy_search import (
    Actor,
    TrainedPolicy,
    _checkpoint,
    save_policy,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.identification.demonstrations import demonstrations_from
from constraint_geodesics.identification.files import load_constraint
from constraint_geodesics.learning.gan import Generator
from constraint_geodesics.learning.inference import WEIGHTS, FrozenManifold
from constraint_geodesics.learning.latent_manifold import LatentManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import ARRAYS, load_submanifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.moveit import add_moveit_scene
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.paths import read_paths
from constraint_geodesics.pipeline.stage import complain
from constraint_geodesics.recording.recording import PathRecord, read_recording, record_path
from constraint_geodesics.report.chooser import Chooser
from constraint_geodesics.report.page import Section, Table, write_page
from constraint_geodesics.report.standing import Loss
from constraint_geodesics.robot.description import read_description
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene.allowed_collisions import allowed_by_srdf
from constraint_geodesics.scene.collada import as_obj
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.scene.scene_file import read_scene
from constraint_geodesics.scene.triangles import read_triangles
from constraint_geodesics.scene.urdf import data_path
from constraint_geodesics.studies.execution import load_execution
from constraint_geodesics.trajectory import read_trajectory
from tests.faults.effort import Effort, counted_at_end
from tests.planner_fixtures import manifold_of, packaged_planner
from tests.scene.mesh_files import Brick, write_bricks

ROOT = Path(__file__).resolve().parents[2]
ROOM = 3 * 2**30
"""Bytes that one file may make the process take: about what the largest file that is read needs."""
LONGEST_S = 20.0
"""Of work for one file, on a busy machine."""
WAITED_S = 10.0 * LONGEST_S + 5.0
"""The same by the clock, which runs on for a reader that waits."""
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
_CHANGING = {
    **dict.fromkeys(("mkdir", "remove", "rmdir", "truncate", "chmod", "utime"), slice(1)),
    "rename": slice(2),
    "symlink": slice(1, 2),
    "link": slice(1, 2),
}
"""Calls of `os` that change what some of their paths name."""


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
            if isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
                self._changed(event, arguments[:1])
        elif event.removeprefix("os.") in _CHANGING:
            self._changed(event, arguments[_CHANGING[event.removeprefix("os.")]])

    def _changed(self, event: str, paths: tuple[Any, ...]) -> None:
        assert self.folder is not None
        for path in paths:
            if isinstance(path, str | os.PathLike):
                file = Path(os.path.normpath(Path(path).absolute()))
                if not file.is_relative_to(self.folder) and str(file) != os.devnull:
                    self.seen.append(f"{event} {file}")

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

HARMLESS = {"npz: names that leave the folder": "they name no files"}
"""What is read, and why that harms nothing."""
Open = Callable[[Path], Any]
"""Makes a hostile file in a folder and opens it."""
CASES: dict[str, Open] = {}
SAID: dict[str, str] = {}
"""Words of the line that refuses each: without them it was refused for something else."""


def case(name: str, said: str = "") -> Callable[[Open], Open]:
    """Keep a function as one hostile file; said: of the line that refuses it, if it does harm."""

    def kept(made: Open) -> Open:
        assert name not in CASES
        assert bool(said) != (name in HARMLESS)
        CASES[name], SAID[name] = made, said
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


HEADERS: dict[str, tuple[bytes, str]] = {
    "header longer than the file": (struct.pack("<Q", 2**20) + b"{}", "invalid header length"),
    "header of 2^63 bytes": (struct.pack("<Q", 2**63) + b"{}", "header too large"),
    "negative offsets": (header(a=tensor([4], -16, 0)), "`-16`"),
    "offsets beyond the end": (
        header(a=tensor([4], 0, 2**40)),
        "invalid shape, data type, or offset",
    ),
    "tensors over each other": (
        header(a=tensor([8], 0, 32), b=tensor([8], 16, 48)),
        "invalid offset for tensor `b`",
    ),
    "a shape of 2^62": (header(a=tensor([2**31, 2**31], 0, 64)), "overflow"),
    "an unknown type": (header(a=tensor([16], 0, 64, "PICKLE")), "unknown variant `PICKLE`"),
    "a header of 10^5 lists": (
        struct.pack("<Q", 200_000) + b"[" * 10**5 + b"]" * 10**5,
        "invalid type: sequence",
    ),
}
for _name, (_content, _said) in HEADERS.items():
    case(f"safetensors: {_name}", _said)(with_roadmaps(lambda _, content=_content: content))
GRAPHS: dict[str, tuple[dict[str, np.ndarray | None], str]] = {
    "NaN joints": ({"joints": np.full((4, 6), np.nan, np.float32)}, "'free/joints' has nan"),
    "endless lengths": ({"lengths": np.array([1.0, np.inf], np.float32)}, "'free/lengths' has inf"),
    "negative lengths": ({"lengths": np.array([1.0, -1.0], np.float32)}, "lengths not negative"),
    "edges out of range": (
        {"edges": np.array([[0, 1], [1, 60_000]], np.uint16)},
        "edges[1] = [1, 60000]",
    ),
    "negative edges": ({"edges": np.array([[0, 1], [1, -3]], np.int64)}, "edges[1] = [1, -3]"),
    "edges that are no numbers of nodes": (
        {"edges": np.array([[0, 1], [1, 0.5]], np.float32)},
        "edges must be numbers of nodes",
    ),
    "edges of three ends": ({"edges": np.zeros((2, 3), np.uint16)}, "edges (2, 3)"),
    "joints of one row": ({"joints": np.zeros(6, np.float32)}, "joints (6,)"),
    "fewer lengths than edges": ({"lengths": np.ones(1, np.float32)}, "lengths (1,)"),
    "no lengths": ({"lengths": None}, "'free/lengths' is missing"),
}
for _name, (_arrays, _said) in GRAPHS.items():
    case(f"graph: {_name}", _said)(with_graph(**_arrays))


@case("pickle for roadmaps", "roadmaps.safetensors: not safetensors")
def _(folder: Path) -> Any:
    return with_roadmaps(lambda own: pickle.dumps(Bomb(own / CANARY)))(folder)


def constraints_of(card: dict[str, Any], name: str, described: Any) -> None:
    card["constraints"][name] = described


CARDS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a constraint named ../../x": (
        lambda c: constraints_of(c, "../../x", c["constraints"]["free"]),
        "[key]='../../x'",
    ),
    "a constraint named <script>": (
        lambda c: constraints_of(c, "<script>alert(1)</script>", c["constraints"]["free"]),
        "[key]='<script>alert(1)</script>'",
    ),
    "a URDF ../../x": (
        lambda c: c["robot"].update(urdf="../../x.urdf"),
        "robot.urdf='../../x.urdf': leaves",
    ),
    "a URDF /etc/passwd": (
        lambda c: c["robot"].update(urdf="/etc/passwd"),
        "robot.urdf='/etc/passwd': leaves",
    ),
    "a URDF with NUL in its name": (
        lambda c: c["robot"].update(urdf="a\0b"),
        r"robot.urdf='a\x00b': leaves",
    ),
    "an SRDF outside": (
        lambda c: c["robot"].update(may_touch="../../../etc/hostname"),
        "robot.may_touch='../../../etc/hostname': leaves",
    ),
    "a body's URDF outside": (
        lambda c: c["workcell"]["shapes"].update(
            thing={"kind": "urdf", "name": "thing", "urdf": "../../../x.urdf"}
        ),
        "workcell.thing.urdf='../../../x.urdf': leaves",
    ),
    "a mesh outside": (
        lambda c: c["workcell"]["shapes"].update(
            thing={"kind": "mesh", "name": "thing", "file": "/etc/passwd"}
        ),
        "workcell.thing.file='/etc/passwd': leaves",
    ),
    "NaN in settings": (lambda c: c["planner"].update(clearance_m=float("nan")), "clearance_m=nan"),
}
for _name, (_change, _said) in CARDS.items():
    case(f"card: {_name}", _said)(with_card(_change))


def functions(factory: str) -> dict[str, Any]:
    """A card's constraint that a factory makes."""
    return {"kind": "functions", "description": "own", "factory": factory, "arguments": {}}


@case("card: a module to import", "no module is imported because a file names it")
def _(folder: Path) -> Any:
    (folder / "evil_module.py").write_text(f"open({str(folder / CANARY)!r}, 'w')\n")
    described = functions("evil_module:make")
    sys.path.insert(0, str(folder))
    try:
        return with_card(lambda card: constraints_of(card, "own", described))(folder)
    finally:
        sys.path.remove(str(folder))


@case("card: a function of a module that is there", "is no constraint_factory")
def _(folder: Path) -> Any:
    described = functions("os:system")
    made, _ = with_card(lambda card: constraints_of(card, "own", described))(folder)
    return constraint_from(made.constraints["own"], robot_from(made.robot))


@case("card: 10^5 lists deep", "planner.json: not JSON: it is nested too deeply")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).write_text("[" * 10**5 + "]" * 10**5)
    return open_bundle(place)


@case("card: a pipe that nobody writes to", "planner.json: is no regular file")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).unlink()
    os.mkfifo(place / CARD)
    return open_bundle(place)


@case("card: a link to /dev/zero", "planner.json: is no regular file")
def _(folder: Path) -> Any:
    place = planner(folder)
    (place / CARD).unlink()
    (place / CARD).symlink_to("/dev/zero")
    return open_bundle(place)


@case("card: a link to a secret", "planner.json: not JSON")
def _(folder: Path) -> Any:
    place = planner(folder)
    (folder / "secret").write_text("hunter2")
    (place / CARD).unlink()
    (place / CARD).symlink_to(folder / "secret")
    return open_bundle(place)


@case("roadmaps: a link to /dev/zero", "roadmaps.safetensors: is no regular file")
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


case("policy: NaN weights", "'mean.weight' has nan")(with_learned(POLICY, nan_in("mean.weight")))
case("policy: a layer that does not fit", "layer 'body.0': (64, 120) and (3,)")(
    with_learned(POLICY, lambda own: own.update({"body.0.bias": np.zeros(3, np.float32)}))
)
case("policy: a layer is missing", "'mean.bias' is missing")(
    with_learned(POLICY, lambda own: own.pop("mean.bias"))
)
case("manifold: NaN weights", "'decoder.linear.weight' has nan")(
    with_learned(MANIFOLD, nan_in("decoder.linear.weight"))
)
case("manifold: layers of 14 GB", "are (128,): must be (60000,)")(with_learned(MANIFOLD, swollen))


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


case("manifold: a pickle of torch", "weights.safetensors: not safetensors")(
    lambda folder: LearnedManifold.load(weights_folder(folder, pickled(folder)))
)
case("frozen manifold: a pickle of torch", "weights.safetensors: not safetensors")(
    lambda folder: FrozenManifold.load(weights_folder(folder, pickled(folder)))
)
case("generator: sizes without end", "weights 'a' are (1,)")(
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


@case("policy: a pickle", "policy-0.safetensors: not safetensors")
def _(folder: Path) -> Any:
    (folder / "policy-0.safetensors").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
    return MeanPolicy.load(folder, 0)


@case("checkpoint: a pickle of torch", "damaged: Weights only load failed")
def _(folder: Path) -> Any:
    (folder / "seed.ckpt").write_bytes(pickled(folder))
    return _checkpoint(folder / "seed.ckpt")


@case("checkpoint: a bare pickle", "damaged: File is not a zip file")
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


case("npz: pickled objects", "allow_pickle=False")(
    lambda folder: submanifold(
        folder, joints=npy((1,), "|O", pickle.dumps([Bomb(folder / CANARY)]))
    )
)
case("npz: a shape of 2^60", "array is too big")(
    lambda folder: submanifold(folder, joints=npy((2**60,)))
)
case("npz: a shape of 32 GB", "Unable to allocate")(
    lambda folder: submanifold(folder, joints=npy((2**32,)))
)
case("npz: a zip bomb", "longer than 256 MiB, unpacked")(
    lambda folder: submanifold(folder, **{n: bytes(2**27) for n in ("a", "b", "c")})
)
case("npz: a pickle in its place", "File is not a zip file")(
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


CALLED = "could not determine a constructor for the tag"
MANY = "not YAML: more than 1000000 values, by aliases"
ANCHORS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 30)
)
CALL = '!!python/object/apply:os.system ["touch canary"]'
PARAMS = (ROOT / "params.yaml").read_text()
AT_ZERO = {"start": 6 * [0], "goal": 6 * [0], "shapes": []}


def asked(urdf: str) -> str:
    """A problem of an arm of six joints, as a file has it."""
    joints = ["turn", "lift", "bend", "roll", "pitch", "spin"]
    about = {"urdf": urdf, "tool_link": "tool", "joints": joints, "scenes": {"s": [AT_ZERO]}}
    return json.dumps(about)


case("problems: 10^5 lists deep", "it is nested too deeply")(
    text("p.json", '{"scenes": ' + "[" * 10**5 + "]" * 10**5 + "}", read_problems)
)
case("problems: a gzip bomb", "longer than 256 MiB, unpacked")(
    lambda folder: read_problems(packed(folder / "p.json.gz"))
)
case("problems: a URDF outside", "etc/passwd: the file is no XML")(
    text("p.json", asked("../" * 12 + "etc/passwd"), read_problems)
)
case("problems: a number of 10^6 digits", "value has 1000000 digits")(
    text("p.json", '{"scenes": ' + "9" * 10**6 + "}", read_problems)
)
case("scene: anchors without end", MANY)(
    text("scene.yaml", f"shapes:\n  {{}}\n{ANCHORS}", read_scene)
)
case("scene: anchors in a shape", MANY)(
    text(
        "scene.yaml",
        ANCHORS + "shapes: {box: {kind: box, centre_m: *a29, size_m: *a29}}\n",
        read_scene,
    )
)
case("scene: a call", CALLED)(text("scene.yaml", f"shapes: {CALL}\n", read_scene))
case("scene: 10^5 lists deep", "not YAML: maximum recursion depth exceeded")(
    text("scene.yaml", "shapes: " + "[" * 10**5 + "]" * 10**5, read_scene)
)
case("moveit: a call", CALLED)(
    text("scene.yaml", f"world: {CALL}\n", lambda file: add_moveit_scene(file, None))  # type: ignore[arg-type]
)
case("constraint: a call", CALLED)(text("constraint.yaml", CALL, load_constraint))


def spline(**changed: Any) -> dict[str, Any]:
    own = {
        "frame": np.eye(3).tolist(),
        "origin": 3 * [0.0],
        "lower": 3 * [0.0],
        "spacing": 3 * [1.0],
        "degrees": [3, 0, 0],
        "shape": [4, 1, 1],
        "coefficients": b64encode(zlib.compress(bytes(32))).decode(),
    }
    return own | changed


@case("constraint: a spline that unpacks to gigabytes", "more than 256 MiB, unpacked")
def _(folder: Path) -> Any:
    assert Spline.from_json(spline()).coefficients.size == 4
    bomb = b64encode(zlib.compress(bytes(2**29), 1)).decode()
    assert len(bomb) < 2**22
    return Spline.from_json(spline(coefficients=bomb))


@case("constraint: a module to import", "no module is imported because a file names it")
def _(folder: Path) -> Any:
    (folder / "evil_twin.py").write_text(f"open({str(folder / CANARY)!r}, 'w')\n")
    described = {"kind": "functions", "factory": "evil_twin:make", "arguments": {}, "tolerance": []}
    whole = json.dumps({"format": 1, "constraint": described})
    sys.path.insert(0, str(folder))
    try:
        read = lambda file: load_constraint(file, load_robot(SIX_AXIS, "tool"))  # noqa: E731
        return text("constraint.yaml", whole, read)(folder)
    finally:
        sys.path.remove(str(folder))


case("params: a call", CALLED)(text("params.yaml", f"{PARAMS}\nx: {CALL}\n", load_params))
case("params: anchors", MANY)(text("params.yaml", f"{ANCHORS}\n{PARAMS}", load_params))
for _name, _stage in (("a command", "free; touch canary"), ("a substitution", "$(touch canary)")):
    case(f"params: {_name} for a constraint's name", f"[key]={_stage!r}")(
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
TYPED = "it declares a document type, which is not read"
ASKS = "<!DOCTYPE robot SYSTEM 'http://192.0.2.1/robot.dtd' ["
ROBOT = "<robot name='r'><link name='&a11;'/></robot>"
DEEP = "<robot name='r'>" + "<link name='x'>" * 10**5 + "</link>" * 10**5 + "</robot>"
ARM = (ROOT / "tests" / "robots" / "six_axis.urdf").read_text()
SIX_AXIS = ROOT / "tests" / "robots" / "six_axis.urdf"


def as_robot(file: Path) -> Any:
    return load_robot(file, "x")


def as_pieces(file: Path) -> Any:
    return read_pieces(file) and read_description(file)


def as_srdf(file: Path) -> Any:
    return allowed_by_srdf(file, read_description(SIX_AXIS))


XML: dict[str, tuple[str, str]] = {
    "entities that grow": (LAUGHS + "]>" + ROBOT, TYPED),
    "an entity that is a file": (OUTSIDE + "]>" + ROBOT, TYPED),
    "a document type at an address": (ASKS + "]>" + ROBOT.replace("&a11;", "x"), TYPED),
    "10^5 elements deep": (DEEP, "its elements are nested deeper than 200"),
    "an encoding of its own": (
        "<?xml version='1.0' encoding='bomb'?><robot/>",
        "unknown encoding: bomb",
    ),
}
for _name, (_content, _said) in XML.items():
    case(f"urdf: {_name}", _said)(text("arm.urdf", _content, read_description))
    case(f"urdf, read for the chain: {_name}", _said)(text("arm.urdf", _content, as_robot))
    case(f"srdf: {_name}", _said)(text("arm.srdf", _content, as_srdf))
    case(f"collada: {_name}", _said)(text("mesh.dae", _content, as_obj))


def collada(last: str, many: int = 40) -> str:
    """Nodes that name the next one twice each, the last with an element of its own."""
    nodes = [
        f"<node id='n{k}'>" + 2 * f"<instance_node url='#n{k + 1}'/>" + "</node>"
        for k in range(many)
    ]
    corners = " ".join(["0 0 0"] * 1000)
    return (
        "<COLLADA><library_geometries><geometry id='g'><mesh>"
        f"<source id='p'><float_array>{corners}</float_array><technique_common>"
        "<accessor stride='3'/></technique_common></source>"
        "<vertices id='v'><input semantic='POSITION' source='#p'/></vertices>"
        "<triangles><input semantic='VERTEX' source='#v'/><p>0 1 2</p></triangles>"
        f"</mesh></geometry></library_geometries><library_nodes>{''.join(nodes)}"
        f"<node id='n{many}'>{last}</node></library_nodes>"
        "<library_visual_scenes><visual_scene id='s'><node><instance_node url='#n0'/></node>"
        "</visual_scene></library_visual_scenes>"
        "<scene><instance_visual_scene url='#s'/></scene></COLLADA>"
    )


UNFOLDED = "its nodes unfold to more than 100000 elements"
PLACED = "<instance_geometry url='#g'/>"
for _name, _content, _said in (
    ("2^40 empty nodes", collada(""), UNFOLDED),
    ("2^40 moves", collada("<translate>0 0 1</translate>"), UNFOLDED),
    ("2^40 geometries", collada(PLACED), "it places more than 2000000 corners and faces"),
    ("one geometry 2^14 times", collada(PLACED, 14), "it places more than 2000000 corners"),
):
    case(f"collada: {_name} of kilobytes", _said)(text("mesh.dae", _content, as_obj))
NO_MESH = "passwd is no mesh that can be read"


def meshed(name: str) -> Open:
    content = (
        f'<robot name="r"><link name="x"><collision><geometry><mesh filename="{name}"/>'
        "</geometry></collision></link></robot>"
    )
    return text("arm.urdf", content, as_pieces)


MESHES = {
    **dict.fromkeys(("../" * 12 + "etc/passwd", "/etc/passwd"), NO_MESH),
    **dict.fromkeys(("file:///etc/passwd", "package://../../../etc/passwd"), NO_MESH),
    "/dev/zero": "there is no mesh '/dev/zero'",
    "http://192.0.2.1/x.stl": "there is no mesh 'http://192.0.2.1/x.stl'",
    "\\\\192.0.2.1\\x.stl": r"there is no mesh '\\\\192.0.2.1\\x.stl'",
}
for _name, _said in MESHES.items():
    case(f"urdf: the mesh {_name}", _said)(meshed(_name))
case("obj: numbers of corners without end", "a face with a corner that is not there")(
    text(
        "mesh.obj", "v 0 0 0\nf 1 99999999999999999999 -5\n", lambda file: read_triangles(file, "")
    )
)


@case("stl: 2^32 triangles that are not there", "mesh.stl: no STL mesh: has no triangles")
def _(folder: Path) -> Any:
    (folder / "mesh.stl").write_bytes(bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50))
    return read_triangles(folder / "mesh.stl", "")


# paths, demonstrations and recordings

case("csv: a device without end", "/dev/zero: can't be read: longer than 256 MiB")(
    lambda folder: read_trajectory(Path("/dev/zero"))
)
case("csv: a line of 4 MB", "path.csv, line 2: not a row of numbers")(
    text("path.csv", "a,b\n" + "1," * 2 * 10**6, read_trajectory)
)
case("csv: a constraint 10^5 lists deep", "line 1: not a constraint: maximum recursion")(
    text("path.csv", f"# constraint: {'[' * 10**5}\na,b\n1,2\n2,3\n", read_trajectory)
)


@case("parquet: kilobytes that unpack to more than is read", "longer than 256 MiB, unpacked")
def _(folder: Path) -> Any:
    zeros = pa.table({"observation.state": pa.array(np.zeros(50_000_000))})
    pq.write_table(zeros, folder / "shown.parquet", compression="zstd", row_group_size=10**9)
    assert (folder / "shown.parquet").stat().st_size < 10**6
    return demonstrations_from(folder / "shown.parquet", load_robot(SIX_AXIS, "tool"))


@case("parquet: one long text, many times", "column 'observation.state' holds texts, not numbers")
def _(folder: Path) -> Any:
    texts = pa.table({"observation.state": pa.array(["a" * 2**20] * 10).dictionary_encode()})
    pq.write_table(texts, folder / "shown.parquet", compression="zstd")
    return demonstrations_from(folder / "shown.parquet", load_robot(SIX_AXIS, "tool"))


@case("parquet: a pickle", "shown.parquet: Parquet magic bytes not found")
def _(folder: Path) -> Any:
    (folder / "shown.parquet").write_bytes(pickle.dumps(Bomb(folder / CANARY)))
    return demonstrations_from(folder / "shown.parquet", load_robot(SIX_AXIS, "tool"))


RECORDINGS = {
    "nothing but its mark": (b"RRF2\0\0\0\0" + bytes(64), "Unknown serializer: 0"),
    "a pickle": (pickle.dumps([1]), "Not an RRD file"),
    "lengths without end": (b"RRF2" + b"\xff" * 200, "Reserved bytes not zero"),
}
for _name, (_bytes, _said) in RECORDINGS.items():

    @case(f"recording: {_name}", _said)
    def _(folder: Path, content: bytes = _bytes) -> Any:
        (folder / "path.rrd").write_bytes(content)
        return read_recording(folder / "path.rrd")


@pytest.fixture(scope="module")
def tally(effort: Effort, request: pytest.FixtureRequest) -> Iterator[dict[str, int]]:
    """What all of them did, counted if no test has failed."""
    found = {"artifacts": 0, "executions": 0, "escapes": 0, "too_long": 0}
    with counted_at_end("hostile_artifacts", effort, request.session, lambda: found):
        yield found


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_refused_in_one_line_or_harms_nothing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tally: dict[str, int]
) -> None:
    monkeypatch.chdir(tmp_path)
    began, shown_at, refusal = time.process_time(), time.monotonic(), None
    with WATCH.over(tmp_path) as seen:
        try:
            CASES[name](tmp_path)
        except (ValueError, OSError) as error:
            refusal = error
    took, waited = time.process_time() - began, time.monotonic() - shown_at
    executed = list(tmp_path.rglob(CANARY))
    tally["artifacts"] += 1
    tally["executions"] += bool(executed)
    tally["escapes"] += bool(seen)
    tally["too_long"] += took > LONGEST_S or waited > WAITED_S
    assert not executed, "something in it was run"
    assert seen == [], "it reached out of its folder"
    assert took < LONGEST_S
    assert waited < WAITED_S, "it waited for something"
    if refusal is None:
        assert name in HARMLESS
        return
    assert type(refusal).__module__.startswith("constraint_geodesics"), repr(refusal)
    line = str(refusal)
    assert name not in HARMLESS, line
    assert SAID[name] in line
    assert len(line.splitlines()) == 1, line
    assert "hunter2" not in line
    assert "root:" not in line


@pytest.mark.parametrize("escape", [Path.touch, Path.mkdir, lambda file: file.symlink_to("x")])
def test_what_reaches_out_of_its_folder_is_seen(escape: Callable[[Path], Any], tmp_path) -> None:
    folder = tmp_path / "own"
    (folder / "planner").mkdir(parents=True)
    with WATCH.over(folder) as seen:
        escape(folder / "planner" / ".." / ".." / "escaped")
    assert any(str(tmp_path / "escaped") in own for own in seen)


def test_there_are_enough_of_them() -> None:
    by_loops = {"safetensors": 8, "graph": 10, "card": 15, "params": 4, "urdf": 12}
    by_loops |= {"urdf, read for the chain": 5, "srdf": 5, "collada": 9, "recording": 3}
    assert not Counter(by_loops) - Counter(name.split(": ")[0] for name in CASES)
    assert len(CASES) >= 105


# the same files before anybody spoiled them

SOUND: dict[str, Open] = {
    "card": with_card(lambda card: None),
    "graph": with_graph(),
    "policy": with_learned(POLICY, lambda own: None),
    "manifold": with_learned(MANIFOLD, lambda own: None),
    "problems": text("p.json", asked(str(SIX_AXIS)), read_problems),
    "scene": text(
        "scene.yaml",
        "shapes: {box: {kind: box, centre_m: [2, 2, 2], size_m: [1, 1, 1]}}\n",
        read_scene,
    ),
    "params": text("params.yaml", PARAMS, load_params),
    "urdf": text("arm.urdf", ARM.replace("wrist.obj", f"{SIX_AXIS.parent}/wrist.obj"), as_pieces),
    "urdf, read for the chain": text("arm.urdf", ARM, lambda file: load_robot(file, "tool")),
    "srdf": text("arm.srdf", "<robot name='r'/>", as_srdf),
    "collada": lambda _: as_obj(data_path() / "racecar" / "meshes" / "cone.dae"),
}


def sound(name: str) -> Callable[[Open], Open]:
    """Keep a function as one file that nobody spoiled."""

    def kept(made: Open) -> Open:
        assert name not in SOUND
        SOUND[name] = made
        return made

    return kept


@sound("card with a factory")
def _(folder: Path) -> Any:
    described = functions("constraint_geodesics.constraints.functions:tip_on_sphere")
    described["arguments"] = {"centre_m": [0.4, 0.0, 0.3], "radius_m": 0.2}
    made, _ = with_card(lambda card: constraints_of(card, "own", described))(folder)
    return constraint_from(made.constraints["own"], robot_from(made.robot))


@sound("manifold's folder")
def _(folder: Path) -> Any:
    LearnedManifold(JointVae(6, 2, [8], 4).eval()).save(folder)
    return LearnedManifold.load(folder) and FrozenManifold.load(folder)


@sound("generator's folder")
def _(folder: Path) -> Any:
    LatentManifold(Generator(6, 2, [8]).eval()).save(folder)
    return LatentManifold.load(folder, Generator)


@sound("policy's file")
def _(folder: Path) -> Any:
    save_policy(TrainedPolicy(Actor(4, [8], 2), []), folder, 0)
    return MeanPolicy.load(folder, 0)


@sound("checkpoint")
def _(folder: Path) -> Any:
    torch.save({"policy": Actor(4, [8], 2).state_dict()}, folder / "seed.ckpt")
    return _checkpoint(folder / "seed.ckpt")


@sound("npz of a submanifold")
def _(folder: Path) -> Any:
    rows = npy((2, 6), data=bytes(96))
    edges, labels = npy((1, 2), "<i8", bytes(16)), npy((2,), "<i8", bytes(16))
    lengths = npy((1,), data=bytes(8))
    return submanifold(
        folder, latent=rows, joints=rows, edges=edges, lengths=lengths, labels=labels
    )


@sound("moveit")
def _(folder: Path) -> Any:
    scene = packaged_planner().scene
    before = scene.now
    try:
        return text("scene.yaml", "world: {}\n", lambda file: [add_moveit_scene(file, scene)])(
            folder
        )
    finally:
        scene.become(before)


@sound("constraint")
def _(folder: Path) -> Any:
    planner = packaged_planner()
    robot = {"name": planner.robot.name, "tool_link": planner.robot.tool_link}
    held = planner.constraints["level_cup"].to_json()
    whole = {"format": 1, "robot": robot, "constraint": held}
    return text("constraint.yaml", json.dumps(whole), load_constraint)(folder)


@sound("meshes")
def _(folder: Path) -> Any:
    brick = [Brick((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))]
    files = [write_bricks(folder / f"mesh.{suffix}", brick) for suffix in ("obj", "stl")]
    return [read_triangles(file, "") for file in files]


@sound("a mesh of a link")
def _(folder: Path) -> Any:
    write_bricks(folder / "own.obj", [Brick((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))])
    return meshed("own.obj")(folder)


@sound("csv")
def _(folder: Path) -> Any:
    held = json.dumps(packaged_planner().constraints["level_cup"].to_json())
    return text("path.csv", f"# constraint: {held}\na,b\n1,2\n2,3\n", read_trajectory)(folder)


@sound("parquet")
def _(folder: Path) -> Any:
    robot = load_robot(SIX_AXIS, "tool")
    shown = robot.sample(20, np.random.default_rng(0))
    frame = pd.DataFrame({"observation.state": list(shown), "episode_index": 0})
    frame.to_parquet(folder / "shown.parquet")
    return demonstrations_from(folder / "shown.parquet", robot)


@sound("recording")
def _(folder: Path) -> Any:
    planner = packaged_planner()
    manifold = manifold_of(planner, "free")
    rows = np.linspace(-0.1, 0.1, 60).reshape(10, 6)
    path = PathRecord("birrt", "free", 0, 0, rows, "", meshes=False)
    record_path(folder / "path.rrd", path, manifold, [], frames=5)
    return read_recording(folder / "path.rrd")


@pytest.mark.parametrize("name", SOUND)
def test_the_same_file_unspoiled_opens(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or the reader would refuse whatever it is given."""
    monkeypatch.chdir(tmp_path)
    assert SOUND[name](tmp_path) is not None


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
        losses=[Loss(hostile, [hostile], [hostile])],
        chooser=Chooser(
            {"other": [hostile]}, [hostile], hostile, [hostile], {hostile: hostile}, content
        ),
        sections=[section],
    ).read_text()
    assert "<script>alert" not in page
    assert "<img src=x" not in page
    assert "&lt;script&gt;alert(1)" in page
