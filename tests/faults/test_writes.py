"""Files whose writing fails at every place where it can, and files that were damaged since: the
previous file or none, one line that names the file, and nothing half written that counts.
"""

import builtins
import errno
import io
import json
import os
import random
import re
import resource
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from constraint_geodesics.benchmark import runner
from constraint_geodesics.benchmark.planner_arena import export_arena
from constraint_geodesics.benchmark.row import (
    COLUMNS,
    KEY,
    TEXTS,
    read_rows,
    read_table,
    row_line,
    write_table,
)
from constraint_geodesics.bundle import PACKAGED, Bundle, read_bundle
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.geodesics.learned_method import read_learned
from constraint_geodesics.geodesics.policy_search import (
    Actor,
    TrainedPolicy,
    _checkpoint,
    save_policy,
    write_checkpoint,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geometry.braking import Motion
from constraint_geodesics.identification import (
    Identified,
    identify,
    load_constraint,
    save_constraint,
)
from constraint_geodesics.learning.dataset import (
    POSE_COLUMNS,
    RPY_COLUMNS,
    Queries,
    Shard,
    read_joints,
    read_queries,
    write_joints,
    write_queries,
)
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.path_diffusion import PathDiffusion
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    load_submanifold,
    save_submanifold,
)
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.pipeline.paths import read_paths, save_paths
from constraint_geodesics.pipeline.stage import SHOWN
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.recording.recording import PathRecord, read_recording, record_path
from constraint_geodesics.studies.cup import Execution
from constraint_geodesics.studies.execution import load_execution, save_execution
from constraint_geodesics.text_files import write_text, written
from constraint_geodesics.tracking.left import UNSENT
from constraint_geodesics.tracking.sending import Sender
from constraint_geodesics.trajectory import read_trajectory, write_trajectory
from tests.faults.effort import QUICK, Effort, counted_at_end
from tests.planner_fixtures import packaged_learned, packaged_planner, untrained_diffusion

ROWS = np.linspace(-1.0, 1.0, 120).reshape(20, 6)
FREE = Constraint((0,) * 6, (0,) * 6)
ROW = {"planner": "learned_geodesic", "query": 0, "seed": 1}
Write = Callable[[Path, int], None]


@dataclass(frozen=True)
class Artifact:
    """write: a file's or folder's content, of a number.  files: those that it writes.  read: back,
    as arrays by name.  sealed: whether a changed bit is always noticed.  flips: whether bits are
    changed at all.
    """

    write: Write
    files: tuple[str, ...]
    read: Callable[[Path], dict[str, Any]]
    sealed: bool = True
    flips: bool = True


TRIED: Counter[str] = Counter()
"""Faults injected, and those of tests that passed."""


@pytest.fixture(scope="module", autouse=True)
def _counted(effort: Effort, request: pytest.FixtureRequest) -> Iterator[None]:
    """At the end, if no test has failed."""
    with counted_at_end("faults", effort, request.session, _figures):
        yield


def _figures() -> dict[str, int]:
    return {**TRIED, "results_lost": TRIED["injected"] - TRIED["survived"]}


def _rows(number: int) -> np.ndarray:
    return ROWS + 0.01 * number


def _trajectory(folder: Path, number: int) -> None:
    motion = Motion(_rows(number), np.linspace(0.0, 2.0, 20), np.zeros(6))
    names = [f"joint{k}" for k in range(6)]
    write_trajectory(folder / "path.csv", motion, Constraint((0,) * 6, (0,) * 6), names)


def _table(name: str) -> Write:
    def write(folder: Path, number: int) -> None:
        texts = dict.fromkeys(TEXTS, "a")
        row = {name: float(number) for name in COLUMNS} | texts | {"planner": "p"}
        rows = pd.DataFrame([row | {"query": k} for k in range(30)])
        write_table(rows, folder / name, {"commit": "0"})

    return write


def _database(folder: Path, number: int) -> None:
    row = dict.fromkeys((*COLUMNS, "best_known_rad"), float(number)) | dict.fromkeys(TEXTS, "a")
    row |= {"planner": "p", "valid": True}
    rows = pd.DataFrame([row | {"query": k} for k in range(30)])
    export_arena(rows, folder / "rows.db", {"commit": "0"}, {"p": "its settings"})


def _runs_of(folder: Path) -> dict[str, Any]:
    with closing(sqlite3.connect(folder / "rows.db")) as database:
        return dict(pd.read_sql("SELECT solution_length, memory FROM runs", database).items())


@cache
def _identified() -> Identified:
    """What demonstrations of a tool that stays level keep to."""
    planner = packaged_planner()
    return identify(planner.nodes("level_cup")[:300], planner.robot)


def _constraint(folder: Path, number: int) -> None:
    save_constraint(_identified().held_loosely(1.0 + number), folder / "level.yaml")


def _recording(folder: Path, number: int) -> None:
    manifold = ConstraintManifold(packaged_planner().scene.robot, FREE)
    path = PathRecord("birrt", "free", 0, number, _rows(number), "", meshes=False)
    record_path(folder / "path.rrd", path, manifold, [], frames=5)


def _bundle(folder: Path, number: int) -> None:
    whole = read_bundle(PACKAGED)
    some = {name: whole.roadmaps[name] for name in list(whole.roadmaps)[number : number + 1]}
    own = {name: whole.constraints[name] for name in some}
    Bundle(whole.robot, whole.workcell, own, whole.planner, whole.judge, some).write(folder)


def _manifold(folder: Path, number: int) -> None:
    torch.manual_seed(number)
    LearnedManifold(JointVae(6, 2, [8], 4).eval()).save(folder)


def _policy(folder: Path, number: int) -> None:
    torch.manual_seed(number)
    save_policy(TrainedPolicy(Actor(4, [8], 2), []), folder, 0)


def _submanifold(folder: Path, number: int) -> None:
    edges = np.array([[0, 1], [1, 2]])
    save_submanifold(GraphSubmanifold(ROWS, _rows(number), edges, ROWS[:2, 0], edges[:, 0]), folder)


def _joints(folder: Path, number: int) -> None:
    columns: dict[str, Any] = {f"joint_{k + 1}": _rows(number)[:, k] for k in range(6)}
    named = (*POSE_COLUMNS, *RPY_COLUMNS, "limit_distance")
    columns |= {name: np.abs(ROWS[:, 0]) for name in named}
    columns |= {f"{kind}_collision": np.zeros(20, bool) for kind in ("self", "workcell")}
    write_joints([Shard(pd.DataFrame(columns), 20, 0, 0)], folder / "joints.parquet", {"seed": "0"})


def _paths(folder: Path, number: int) -> None:
    save_paths([ROW], [_rows(number)], folder)


def _learned(folder: Path, number: int) -> None:
    whole = packaged_learned()
    some = {name: whole.submanifolds[name] for name in list(whole.submanifolds)[number:][:1]}
    replace(whole, submanifolds=some).write(folder)


def _diffusion(folder: Path, number: int) -> None:
    arrays = untrained_diffusion().arrays
    PathDiffusion({**arrays, "seen_mean": arrays["seen_mean"] + number}).save(folder)


def _checkpoint_of(folder: Path, number: int) -> None:
    """As the training of policies writes it."""
    torch.manual_seed(number)
    content = {"policy": Actor(4, [8], 2).state_dict(), "steps": number}
    write_checkpoint(content, folder / "seed.pt")


def _execution(folder: Path, number: int) -> None:
    times, balls, cup = np.linspace(0.0, 1.0, 20), np.zeros((20, 3, 3)), np.zeros((20, 7))
    own = Execution(3, 2, 0.01, 0.1, 1.0, times, _rows(number), balls, cup)
    save_execution(folder / "execution.npz", own)


def _picture(folder: Path, number: int) -> None:
    figure = Figure((2, 1))
    figure.subplots().plot(_rows(number)[number:])
    save_png(figure, folder / "path.png")


def _table_of(name: str) -> Callable[[Path], dict[str, Any]]:
    return lambda folder: dict(read_table(folder / name)[0].items())


ARTIFACTS: dict[str, Artifact] = {
    "path": Artifact(
        _trajectory,
        ("path.csv",),
        lambda folder: {"joints": read_trajectory(folder / "path.csv").joints},
        sealed=False,  # a number with another digit is a number
    ),
    "rows": Artifact(_table("rows.csv"), ("rows.csv",), _table_of("rows.csv"), sealed=False),
    "packed rows": Artifact(_table("rows.csv.gz"), ("rows.csv.gz",), _table_of("rows.csv.gz")),
    "recording": Artifact(
        _recording,
        ("path.rrd",),
        lambda folder: {"joints": read_recording(folder / "path.rrd").joints},
        sealed=False,  # nothing in Rerun's files seals them
        flips=False,  # where a length is another, Rerun 0.41 ends the process that reads
    ),
    "bundle": Artifact(
        _bundle,
        ("planner.json", "roadmaps.safetensors"),
        lambda folder: {name: own.joints for name, own in read_bundle(folder).roadmaps.items()},
    ),
    "manifold": Artifact(
        _manifold,
        ("weights.safetensors", "manifold.json"),
        lambda folder: {
            name: own.numpy() for name, own in LearnedManifold.load(folder).vae.state_dict().items()
        },
    ),
    "policy": Artifact(
        _policy,
        ("policy-0.safetensors",),
        lambda folder: {
            str(k): layer[0] for k, layer in enumerate(MeanPolicy.load(folder, 0).layers)
        },
        sealed=False,
    ),
    "submanifold": Artifact(
        _submanifold,
        ("submanifold.npz", "submanifold.json"),
        lambda folder: vars(load_submanifold(folder)),
    ),
    "joints": Artifact(
        _joints,
        ("joints.parquet",),
        lambda folder: {"joints": read_joints(folder / "joints.parquet").joints},
    ),
    "paths": Artifact(
        _paths, ("paths.npz",), lambda folder: {"path": read_paths([ROW], folder)[0]}
    ),
    "queries": Artifact(
        lambda folder, number: write_queries(Queries(_rows(number), ROWS), folder / "queries.csv"),
        ("queries.csv",),
        lambda folder: vars(read_queries(folder / "queries.csv")),
        sealed=False,
    ),
    "learned method": Artifact(
        _learned,
        ("learned.json", "manifold.safetensors", "policy.safetensors", "submanifolds.safetensors"),
        lambda folder: {
            name: own.joints for name, own in read_learned(folder).submanifolds.items()
        },
    ),
    "path diffusion": Artifact(
        _diffusion,
        ("path_diffusion.json", "path_diffusion.safetensors"),
        lambda folder: dict(PathDiffusion.load(folder).arrays),
    ),
    "checkpoint": Artifact(
        _checkpoint_of,
        ("seed.pt",),
        lambda folder: {
            name: own.numpy() for name, own in _checkpoint(folder / "seed.pt")["policy"].items()
        },
        sealed=False,  # what no checksum of a zip file covers says nothing of the weights
    ),
    "execution": Artifact(
        _execution,
        ("execution.npz",),
        lambda folder: asdict(load_execution(folder / "execution.npz")),
    ),
    "constraint": Artifact(
        _constraint,
        ("level.yaml",),
        lambda folder: {"constraint": json.dumps(load_constraint(folder / "level.yaml").to_json())},
        sealed=False,
    ),
    "database": Artifact(_database, ("rows.db",), _runs_of, sealed=False),
    "picture": Artifact(
        _picture,
        ("path.png",),
        lambda folder: {"pixels": np.asarray(Image.open(folder / "path.png"))},
    ),
}

UNREAD = {"picture", "database"}
"""Which the package reads nowhere."""

ERRORS = (errno.ENOSPC, errno.EIO, errno.EMFILE, errno.ENOMEM)
CALLS = (
    *((os, name) for name in ("mkdir", "open", "fsync", "replace", "rename")),
    *((io, name) for name in ("open",)),
    *((builtins, name) for name in ("open",)),
)


@contextmanager
def failing(number: int, error: int, folder: Path) -> Iterator[list[int]]:
    """The `number`-th call about a file of the folder fails; gives how many there were."""
    made = [0]

    def counted(call: Callable[..., Any]) -> Callable[..., Any]:
        def one(*arguments: Any, **named: Any) -> Any:
            named_file = not isinstance(arguments[0], int)
            if named_file and str(folder) not in str(arguments[0]):
                return call(*arguments, **named)
            made[0] += 1
            if made[0] == number and error == errno.ENOMEM:
                raise MemoryError
            if made[0] == number:
                raise OSError(error, os.strerror(error), *arguments[: int(named_file)])
            return call(*arguments, **named)

        return one

    with pytest.MonkeyPatch.context() as patch:
        for module, name in CALLS:
            patch.setattr(module, name, counted(getattr(module, name)))
        yield made


@contextmanager
def full_at(size: int) -> Iterator[None]:
    """No file may become longer: what a full disk does in the middle of a write, whoever writes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def is_one_line(error: BaseException, folder: Path, *, named: bool = True) -> bool:
    """What a stage shows as one line, not as a traceback; and the file is named."""
    said = str(error)
    return isinstance(error, SHOWN) and "\n" not in said and (str(folder) in said or not named)


def error_of(call: Callable[[], Any]) -> Exception | None:
    try:
        call()
    except Exception as error:
        return error
    return None


@pytest.mark.parametrize("name", ARTIFACTS)
def test_a_write_that_fails_leaves_the_previous_file_whole(
    name: str, tmp_path: Path, effort: Effort
) -> None:
    own = ARTIFACTS[name]
    folder, fresh = tmp_path / "used", tmp_path / "fresh"
    own.write(folder, 0)
    own.write(tmp_path / "new", 1)
    old, new = contents(folder), contents(tmp_path / "new")
    assert set(own.files) == set(old)
    before, after, read = own.read(folder), own.read(tmp_path / "new"), list[dict[str, Any]]()
    assert before
    assert not same(before, after)
    began = TRIED["injected"]
    sizes = [len(content) for content in new.values()]
    for size in sorted({0, 1, *(int(share * max(sizes)) for share in (0.3, 0.99))}):
        for place in (folder, fresh):
            with pytest.raises((OSError, RuntimeError)) as caught, full_at(size):
                own.write(place, 1)
            assert is_one_line(caught.value, place)
            TRIED["injected"] += 1
        assert contents(folder) == old
        assert not contents(fresh)
    for first in range(1 if effort == QUICK else len(ERRORS)):  # else by turns
        ended = False
        for number in range(1, effort.faults):
            with failing(number, ERRORS[(first + number) % len(ERRORS)], folder) as made:
                failed = error_of(lambda: own.write(folder, 1))
            named = not isinstance(failed, MemoryError)  # which no file is at fault of
            assert failed is None or is_one_line(failed, folder, named=named)
            if made[0] < number:
                ended = True
                break
            TRIED["injected"] += 1
            now = error_of(lambda: read.append(own.read(folder)))
            if failed is None:  # what says nothing has written
                assert now is None
                assert same(read[-1], after)
            elif now is None:  # all of the one or all of the other
                assert same(read[-1], before) or same(read[-1], after)
            else:  # of several files some are new: it is refused
                assert len(own.files) > 1
                assert is_one_line(now, folder)
                TRIED["to_be_written_again"] += 1
            own.write(folder, 0)
        assert ended or effort == QUICK, f"{effort.faults} faults do not reach the end of the write"
    TRIED["survived"] += TRIED["injected"] - began
    assert contents(folder).keys() == old.keys()


@pytest.mark.parametrize("name", sorted(set(ARTIFACTS) - UNREAD))
def test_a_file_that_was_damaged_is_refused_or_says_what_it_said(
    name: str, tmp_path: Path, effort: Effort
) -> None:
    own, rng = ARTIFACTS[name], random.Random(name)
    own.write(tmp_path, 0)
    right, whole, judged = own.read(tmp_path), contents(tmp_path), 0
    for file, content in whole.items():
        cuts = [content[:place] for place in cut_at(len(content), rng, effort.faults)]
        flips = [flipped(content, rng) for _ in range(effort.faults * own.flips)]
        for changed in (*cuts, *flips):
            (tmp_path / file).write_bytes(changed)
            found = dict[str, Any]()
            refused = error_of(lambda found=found: found.update(own.read(tmp_path)))
            if refused is None and not own.sealed:
                continue  # it may say anything now
            judged += 1
            TRIED["injected"] += 1
            if refused is not None:
                assert is_one_line(refused, tmp_path)
            else:
                assert same(found, right), f"{file}: {len(changed)} of {len(content)} bytes"
        (tmp_path / file).write_bytes(content)
    assert judged >= len(whole), "a file that was emptied at least"
    TRIED["survived"] += judged


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9])
def test_a_row_for_which_there_is_no_room_costs_no_other(share: float, tmp_path: Path) -> None:
    """The line is cut off within a write; what is kept later begins a line of its own."""
    file = tmp_path / "rows.jsonl"
    rows = [
        dict(zip(KEY, ("p", "free", "table", k, 0), strict=True)) | {"fingerprint": "0"}
        for k in range(3)
    ]
    first, second, third = map(row_line, rows)
    runner._append(file, first)
    whole = file.stat().st_size
    with pytest.raises(OSError, match="File too large"), full_at(whole + int(share * len(second))):
        runner._append(file, second)
    if not file.read_bytes().endswith(b"\n"):  # as `run_batch` begins
        runner._append(file, "")
    runner._append(file, third)
    assert read_rows(file, {"p": "0"}) == [rows[0], rows[2]]
    TRIED.update(injected=1, survived=1)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9])
def test_a_call_to_mlflow_for_which_there_is_no_room_costs_no_other(
    share: float, tmp_path: Path
) -> None:
    sender, file = Sender("nowhere", tmp_path, "parent"), tmp_path / UNSENT
    calls = [{"call": "metrics", "run": "r", "time": k, "metrics": {"a": 1.0}} for k in range(3)]
    sender._keep(file, calls[0])
    whole = file.stat().st_size
    room = whole + int(share * len(json.dumps(calls[1])))
    with pytest.raises(OSError, match="File too large"), full_at(room):
        sender._keep(file, calls[1])
    sender._keep(file, calls[2])
    told: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sender, "tell", lambda self, call: told.append(call))
        assert sender.tell_kept() == 2
    assert told == [calls[0], calls[2]]
    TRIED.update(injected=1, survived=1)


def test_a_kept_row_that_was_damaged_is_asked_again(tmp_path: Path, effort: Effort) -> None:
    file, rng = tmp_path / "rows.jsonl", random.Random(2)
    rows = [
        dict(zip(KEY, ("p", "free", "table", k, 0), strict=True))
        | {"fingerprint": "0", "length_rad": 1.0 / (k + 1), "status": "solved"}
        for k in range(8)
    ]
    whole = "".join(row_line(row) + "\n" for row in rows).encode()
    file.write_bytes(whole)
    assert read_rows(file, {"p": "0"}) == rows
    began = TRIED["injected"]
    cuts = [whole[:place] for place in cut_at(len(whole), rng, effort.faults)]
    for changed in (*cuts, *(flipped(whole, rng) for _ in range(10 * effort.faults))):
        file.write_bytes(changed)
        TRIED["injected"] += 1
        assert all(row in rows for row in told_of(read_rows(file, {"p": "0"})))
    TRIED["survived"] += TRIED["injected"] - began


def told_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is read of rows: another column that a changed letter makes of the seal is not."""
    names = (*KEY, "fingerprint", "length_rad", "status")
    return [{name: row[name] for name in names} for row in rows]


def cut_at(length: int, rng: random.Random, number: int) -> list[int]:
    places = {0, 1, length // 2, length - 1, *(rng.randrange(length) for _ in range(number // 2))}
    return sorted(places)


def flipped(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    changed[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def same(found: dict[str, Any], right: dict[str, Any]) -> bool:
    return found.keys() == right.keys() and all(
        np.array_equal(np.asarray(found[name]), np.asarray(own)) for name, own in right.items()
    )


def test_output_that_can_not_be_written_is_one_line_and_a_code(tmp_path: Path) -> None:
    for place in ("/proc/path.csv", "/sys/kernel/path.csv", f"{tmp_path}/file/path.csv"):
        (tmp_path / "file").write_text("")
        with pytest.raises(OSError, match=re.escape(place.removesuffix("/path.csv"))):
            write_text(Path(place), "text")
    program = "from pathlib import Path; import sys\nfrom constraint_geodesics.text_files import"
    program += " write_text; write_text(Path('/dev/stdout'), 'to a pipe')"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert said.stdout == "to a pipe", said.stderr


def test_a_process_that_is_killed_within_a_write_leaves_what_there_was(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    write_text(file, "whole")
    program = f"""
import os
from pathlib import Path
from constraint_geodesics.text_files import written
with written(Path({str(file)!r})) as part:
    part.write_text("hal")
    os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    assert file.read_text() == "whole"
    link = tmp_path / "link.csv"
    link.symlink_to(file)
    with written(link) as part:
        part.write_text("again")
    assert link.is_symlink()
    assert file.read_text() == "again"
    assert file.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
