"""What the benchmark runs, from params.yaml: blocks of queries with their planners, and the table
of their rows.
"""

import ast
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from constraint_geodesics.benchmark.runner import (
    Block,
    Entry,
    block_rows,
    fingerprint,
    read_cases,
    rows_to_do,
    run_block,
    table_of,
)
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import ComputeParams, Params, PeerParams
from constraint_geodesics.peers import registry
from constraint_geodesics.peers.registry import KINDS, PeerBuilder, PeerError
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.recording.benchmark_recording import PathRecorder
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.urdf import find_urdf

JUDGED_BY = "benchmark.runner"
"""The module that asks the planners and judges their answers: every row depends on what it imports.
"""
BESIDE = ("__init__.py", "params.py", "pipeline", "palette.py", "tracking", "recording", "report")
"""What no row depends on: parameters are hashed by their values."""


def blocks_of(params: Params, layout: Layout, folder: Path, recordings: Path) -> list[Block]:
    """The benchmark of `params.bench` in blocks of a few queries of one constraint and scene.

    The first block of each has all planners, the slow ones too: they are spread, so that what is
    done tells how long the rest will take.

    folder: where the rows are kept.  recordings: where some of the paths are recorded.
    Raises PeerError if the pipeline has not been run, FileNotFoundError if a stage that this needs
    has not.
    """
    if not (layout.planner / "planner.json").is_file():
        raise PeerError(
            "data/planner is missing, which the benchmark's planners are made of: run `make "
            "repro` first"
        )
    settings = params.bench
    scene, searched = Scene.from_params(params), params.geodesics.searched[0]
    charts = {searched: LearnedManifold.load(layout.manifold(searched))}
    common = [
        params.judge.model_dump(),
        params.benchmark.model_dump(),
        params.robot.model_dump(),
        params.workcell.model_dump(),
        Path(registry.__file__).read_bytes(),
        code_digest(JUDGED_BY),
        machine(),
        data_digest(layout.planner, *(layout.manifold(name) for name in params.manifolds)),
        data_digest(layout.submanifold(searched, "free").parent),
        find_urdf(params.robot.urdf).read_bytes(),
        (layout.root / "requirements.lock").read_bytes(),
    ]
    code = {kind: code_digest(*made.modules) for kind, made in KINDS.items()}
    found: list[tuple[int, Block]] = []
    for constraint, described in params.constraints.items():
        file = layout.benchmark_queries(constraint)
        cases, own_parts = read_cases(file), [*common, described.model_dump(), file.read_bytes()]
        scenes = {
            case.scene: [other for other in cases if other.scene == case.scene] for case in cases
        }
        record = PathRecorder(
            layout.root,
            recordings.resolve(),
            settings.recorded,
            {name: own[0].query for name, own in scenes.items()},
            params.recording.frames,
        )
        for name, own in scenes.items():
            for first in range(0, min(settings.queries, len(own)), settings.block):
                entries = tuple(
                    Entry(
                        planner,
                        tuple(range(peer.seeds)),
                        fingerprint(
                            planner, peer.kind, peer.settings, code.get(peer.kind), *own_parts
                        ),
                        peer.queries - first,
                        after(planner, settings.planners),
                        uses_clearance(peer),
                    )
                    for planner, peer in settings.planners.items()
                    if first < peer.queries
                )
                chosen = tuple(own[first : first + settings.block])
                if entries:
                    block = Block(
                        scene,
                        constraint_manifold(scene.robot, described),
                        charts,
                        chosen,
                        entries,
                        PeerBuilder(params, layout.root),
                        params.judge,
                        folder / f"{constraint}-{name}-{first}.jsonl",
                        record,
                    )
                    found.append((first // settings.block, block))
    return spread(found)


def spread(numbered: Sequence[tuple[int, Block]]) -> list[Block]:
    """Blocks, each with its number within its constraint and scene, so that equal numbers stand
    evenly apart.
    """
    count = 1 + max(number for number, _ in numbered)
    starts = [index for index, (number, _) in enumerate(numbered) if number == 0]
    placed = []
    for index, (number, block) in enumerate(numbered):
        turn = sum(start <= index for start in starts) - 1
        placed.append(((number + turn * count // len(starts)) % count, turn, block))
    return [block for *_, block in sorted(placed, key=lambda entry: entry[:2])]


def after(planner: str, known: Mapping[str, PeerParams]) -> str:
    """The planner whose path this one shortens by a band: the same kind with the same settings but
    for the band.
    """
    own = known[planner]
    if not own.settings.get("band") or own.settings.get("restarts_s") is not None:
        return ""
    bare = {name: value for name, value in own.settings.items() if name != "band"}
    return next(
        (name for name, peer in known.items() if peer.kind == own.kind and peer.settings == bare),
        "",
    )


def uses_clearance(peer: PeerParams) -> bool:
    """Whether a planner asks for distances to the workcell; the project's own makes its model
    itself.
    """
    return peer.kind not in ("planner", "ompl", "decoder_sampling") or bool(
        peer.settings.get("band")
    )


def ends_by_counting(peer: PeerParams) -> bool:
    """Whether a planner's search ends by counting, so that it gives the same path at any speed of
    the machine: no restarts, no anytime search; a BiRRT or PRM has a time limit that it reaches
    only where it fails.
    """
    settings = peer.settings
    if peer.kind == "planner":
        return "budget_s" not in settings
    return "restarts_s" not in settings and settings.get("algorithm", "birrt") in ("birrt", "prm")


def fewer(
    params: Params,
    queries: int,
    seeds: int,
    constraints: Sequence[str] | None,
    planners: Sequence[str] | None,
    longest_s: float,
) -> tuple[Params, list[str]]:
    """The parameters with less to do: so many queries and seeds, some constraints and planners
    (None: all), and no planner that is given more than `longest_s` for a query; and the names of
    those left out for that.

    Raises PeerError if a constraint or planner does not exist, or none is left.
    """
    for kind, wanted, known in (
        ("constraint", constraints, list(params.constraints)),
        ("planner", planners, list(params.bench.planners)),
    ):
        for name in wanted or ():
            if name not in known:
                raise PeerError(f"there is no {kind} {name!r}: must be one of {', '.join(known)}")
    named = {
        name: peer
        for name, peer in params.bench.planners.items()
        if planners is None or name in planners
    }
    slow = [
        name
        for name, peer in named.items()
        if float(peer.settings.get("budget_s", 0.0)) > longest_s
    ]
    kept = {
        name: peer.model_copy(
            update={"queries": min(queries, peer.queries), "seeds": min(seeds, peer.seeds)}
        )
        for name, peer in named.items()
        if name not in slow
    }
    if not kept:
        raise PeerError(
            f"no planner is left: all of them are given more than {longest_s:g} s a query"
        )
    bench = params.bench.model_copy(update={"planners": kept, "queries": queries, "block": 1})
    some = {
        name: c
        for name, c in params.constraints.items()
        if constraints is None or name in constraints
    }
    return params.model_copy(update={"bench": bench, "constraints": some}), slow


def answered(blocks: Sequence[Block], compute: ComputeParams) -> pd.DataFrame:
    """The table of all rows, after those that are not there yet have been made."""
    parallel_map(
        run_block,
        [block for block in blocks if rows_to_do(block)],
        compute,
        description="benchmark",
    )
    return table_of([row for block in blocks for row in block_rows(block)])


def data_digest(*folders: Path) -> str:
    """Of all files in some folders."""
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            digest.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def code_digest(*modules: str) -> str:
    """Of these modules of the package, and of all of its modules that they import, those imported
    late too.
    """
    package = Path(__file__).parents[1]
    found: set[Path] = set()
    left = [_file_of(package, module.split(".")) for module in modules]
    while left:
        file = left.pop()
        if file is None or file in found:
            continue
        found.add(file)
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                f"{package.name}"
            ):
                parts = str(node.module).split(".")[1:]
                left.append(_file_of(package, parts))
                left += [_file_of(package, [*parts, name.name]) for name in node.names]
    digest = hashlib.sha256()
    beside = [package / part for part in BESIDE]
    for file in sorted(found):
        if any(part in (file, *file.parents) for part in beside):
            continue
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def _file_of(package: Path, parts: Sequence[str]) -> Path | None:
    file = package.joinpath(*parts).with_suffix(".py") if parts else package / "__init__.py"
    return file if file.is_file() else None
