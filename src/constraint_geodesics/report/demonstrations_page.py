"""Constraints from demonstrations whose formula is hidden: the tables of reports/demonstrations.md
and what they say, from reports/demonstrations.json.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import Cells, fixed, markdown_table, origin, share, short
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.studies.demonstrations import (
    AS_NETWORKS,
    COMPARED,
    DESCENT,
    FLAT,
    FORMULA,
    IDENTIFIED,
    LEARNED,
    LEVEL_SET,
    NEAREST,
    PEERS,
    POLICY,
    RESIDUAL,
    ROUNDED,
    TANGENTS,
    WITHIN,
)

Figures = Mapping[str, Any]


def demonstrations_markdown(params: Params, layout: Layout) -> str:
    """Tables and sentences, as Markdown."""
    reports, own = layout.root / "reports", params.demonstrations
    found = read_metrics(reports / "demonstrations.json")
    learned = reports / "learned_demonstrations.json"
    networks = read_metrics(learned) if learned.is_file() else {"cells": {}, "machine": {}}
    known = networks["cells"]
    for task, case, methods in _cells(known):
        if case in found["cells"].get(task, {}):  # else of other tasks than the study's now
            found["cells"][task][case] |= methods
    given = (
        f"Each task's formula is hidden from `identify`, which is given demonstrations of it: "
        f"motions with a person's smooth error, or independent rows with noise of each joint, all "
        f"free of collision by PyBullet. {own.pairs} pairs of configurations that keep to the "
        f"formula, and that the formula's planner joins by a path in the region that is shown, or "
        f"through the hole of that task, are asked for in each of "
        f"{len(own.seeds)} draws; peers, whose paths meet the workcell or not, are asked for "
        f"{own.peer_pairs} of them. Of a tolerance, straight joint lines between the ends "
        f"leave it. The worst violation of the formula along each path is taken: "
        f"medians over the paths, 95th percentiles behind them. Length is over the path of the "
        f"formula's planner. Times include the projection of the ends and the certificate, not the "
        f"graph of a new constraint, which is drawn once. {origin(found['machine'])}."
    )
    peers = (
        f"*{TANGENTS}* are planes or quadrics through the nearest rows; they are told the rank, "
        f"and take the number of neighbours and the degree that are best on demonstrations left "
        f"out. *{NEAREST}* is the shortest way over a graph of the rows, in which each is joined "
        f"to rows of other demonstrations, too."
    )
    trained = (
        f"*{LEVEL_SET}* learns a function that is zero at the rows and the distance from them "
        f"beside them (ECoMaNN), in {own.learned.level_set_steps} steps, *{RESIDUAL}* the way back "
        f"to the rows from beside them, in {own.learned.residual_steps}; both are told the rank, "
        f"and see joints or tool poses, whichever is better on demonstrations left out; paths are "
        f"bands on their zeros. *{DESCENT}* is the paper's way without a formula: a VAE of the "
        f"rows with as many latent dimensions as the hidden set has ({own.learned.epochs} epochs "
        f"of {own.learned.batches} batches), and cubic geodesics of its metric by descent; "
        f"*{POLICY}* the same by a policy of {own.learned.policy_steps} PPO steps; ends are the "
        f"query's own. All are trained on the same demonstrations, the networks of the first "
        f"{_most(known, LEVEL_SET, 'queries') // own.peer_pairs} draws, the VAEs and policies of "
        f"{_most(known, POLICY, 'queries') // own.peer_pairs}."
    )
    parts = [
        "# Constraints from demonstrations",
        " ".join(_sentences(found)),
        given,
        markdown_table(_identified_rows(found["cells"])),
        peers,
        markdown_table(_peer_rows(found["cells"], PEERS)),
    ]
    if known:
        shown = (LEVEL_SET, RESIDUAL, DESCENT, POLICY)
        parts.append(f"{trained} {origin(networks['machine'])}.")
        parts.append(markdown_table(_peer_rows(found["cells"], shown)))
        parts.append(markdown_table(_training_rows(found["cells"])))
    parts += [_of_holes(found["cells"]), markdown_table(_hole_rows(found["cells"]))]
    return "\n\n".join(parts) + "\n"


def _of_holes(cells: Figures) -> str:
    said = (
        "Where the examples have a hole, the formula and what is identified say nothing of it; the "
        "variance in a learned metric was meant to keep paths out of it."
    )
    for *_, methods in _cells({"hole": cells.get("hole", {})}):
        if {DESCENT, FLAT} <= set(methods):
            deep = [fixed(methods[name]["depth_mm"], 1) for name in (DESCENT, FLAT)]
            said += f" With it they go {deep[0]} mm deep, without it {deep[1]} mm."
    return said


def _cells(cells: Figures) -> Iterator[tuple[str, str, Figures]]:
    for task, cases in cells.items():
        for case, methods in cases.items():
            yield task, case, methods


def _most(cells: Figures, method: str, figure: str) -> int:
    """The largest of a method's figure over all cells."""
    return max((int(own[method][figure]) for *_, own in _cells(cells) if method in own), default=0)


def _sentences(found: Figures) -> Iterator[str]:
    ranks, free = found["ranks"], found["free_motion"]
    yield (
        f"Of {ranks['cells']} draws the number of relations is right in "
        f"{share(ranks['right'], 1)}, right or said to be too small in "
        f"{share(ranks['right_or_refused'], 1)}; too many are found in {ranks['too_many']}."
    )
    nothing = sum(row["codim"] + row["bounds"] == 0 for row in free)
    robots = len({row["robot"] for row in free})
    yield f"In free motion of {robots} arms nothing is found in {nothing} of {len(free)} draws."
    behind, compared = list[str](), 0
    for task, case, methods in _cells(found["cells"]):
        peers = {name: methods.get(name, {}) for name in (*PEERS, *LEARNED)}
        peers = {name: peer for name, peer in peers.items() if peer.get("solved")}
        for unit in ("deg", "mm"):
            off = {name: peer[unit] for name, peer in peers.items() if unit in peer}
            if not off:
                continue
            first = min(off, key=off.__getitem__)
            same = AS_NETWORKS if first in (LEVEL_SET, RESIDUAL) else COMPARED
            if same not in methods and COMPARED in methods:
                continue  # nobody asked for it: rows of another day
            best, mine = off[first], methods.get(same, {}).get(unit)
            if max(best, mine or 0.0) > 1e-6:
                compared += 1
                if mine is None or mine > best:
                    own = "none" if mine is None else fixed(mine, 2)
                    behind.append(
                        f"{task}, {case}: {own} against {fixed(best, 2)} {unit} ({first})"
                    )
    yield (
        f"On the queries that baselines are asked, the identified constraint's median violation is "
        f"at most that of the best baseline, whatever share of them that joins, in "
        f"{compared - len(behind)} of {compared} comparisons"
        + (f"; not in {'; '.join(behind)}." if behind else ".")
    )


def _identified_rows(cells: Figures) -> Cells:
    rows: Cells = [
        (
            *("task", "shown", "violation [°]", "p95", "worst draw"),
            *("violation [mm]", "p95", "worst draw", "rounded [° / mm]"),
            *(
                "length",
                "pairs joined",
                "identify [s]",
                "plan [ms]",
                "p95",
                "formula's [ms]",
                "p95",
            ),
        )
    ]
    for task, case, methods in _cells(cells):
        own, formula = methods.get(IDENTIFIED), methods[FORMULA]
        if own is None or not own["solved"]:
            rows.append((task, case, "nothing identified", *[""] * 11, *_times(formula)))
            continue
        found = [_off(own, f"{unit}{kind}") for unit in ("deg", "mm") for kind in KINDS]
        found.append(_both(methods.get(ROUNDED)))
        ratio, joined = fixed(own["ratio_median"], 4), share(own["solved"], 1)
        seconds = short(own["identify_s"])
        rows.append((task, case, *found, ratio, joined, seconds, *_times(own), *_times(formula)))
    return rows


KINDS = ("", "_p95", "_worst_seed")


def _off(own: Figures, name: str) -> str:
    value = own.get(name)
    return "–" if value is None else "0" if value < 5e-6 else f"{value:.2g}"


def _times(own: Figures) -> tuple[str, str]:
    return short(own["ms_median"]), short(own["ms_p95"])


def _both(own: Figures | None) -> str:
    return "" if own is None else f"{_off(own, 'deg')} / {_off(own, 'mm')}"


def _peer_rows(cells: Figures, peers: tuple[str, ...]) -> Cells:
    names = (COMPARED, *peers)
    header = [
        own
        for name in names
        for own in (f"{IDENTIFIED if name == COMPARED else name} [° / mm]", "length", "joined")
    ]
    rows: Cells = [("task", "shown", *header)]
    for task, case, methods in _cells(cells):
        row = [task, case]
        for name in names:
            own = methods.get(name)
            if own is None:
                row += ["–", "–", "–"]
                continue
            row += [_both(own), fixed(own["ratio_median"], 3), share(own["solved"])]
        rows.append(tuple(row))
    return rows


def _training_rows(cells: Figures) -> Cells:
    """Seconds, over all tasks and cases."""
    rows: Cells = [("trained on demonstrations", "training [s]", "a path [ms]")]
    for name in LEARNED:
        own = [methods[name] for _, _, methods in _cells(cells) if name in methods]
        if own:
            known = ([cell[key] for cell in own if cell.get(key) is not None] for key in TIMES)
            means = (sum(values) / len(values) if values else None for values in known)
            rows.append((name, *map(short, means)))
    return rows


TIMES = "trained_s", "ms_median"


def _hole_rows(cells: Figures) -> Cells:
    rows: Cells = [
        ("into a hole of 40 mm", "depth [mm]", "p95", "violation [° / mm]", "joined", "ms")
    ]
    for _, _, methods in _cells({"hole": cells.get("hole", {})}):
        for name in (FORMULA, IDENTIFIED, WITHIN, *PEERS, DESCENT, FLAT, POLICY):
            own = methods.get(name)
            if own is None or own.get("depth_mm") is None:
                continue
            depth = fixed(own["depth_mm"], 1), fixed(own["depth_mm_p95"], 1)
            joined, ms = share(own["solved"]), short(own["ms_median"])
            rows.append((name, *depth, _both(own), joined, ms))
    return rows
