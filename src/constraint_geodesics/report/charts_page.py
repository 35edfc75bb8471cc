"""What a learned manifold adds to the search: the table of reports/charts.md and what it says, from
reports/compare_charts.json.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import fixed, markdown_table, origin, share
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.studies.charts import CHART, HOLE, JOINTS, TASK, WORKCELL
from constraint_geodesics.studies.proposals import DESCENT, POLICY

Figures = Mapping[str, Mapping[str, float | None]]
"""Mean, least and largest over seeds, by figure."""
LEARNED_FROM = (WORKCELL, TASK)
METRICS = {
    "with_variance": "geodesic, with the variance term",
    "without_variance": "geodesic, without it",
    "straight_latent_line": "straight latent line",
}


def chart_figures(layout: Layout) -> dict[str, Any]:
    """What the study reported."""
    found: dict[str, Any] = read_metrics(layout.root / "reports" / "compare_charts.json")
    return found


def charts_markdown(params: Params, layout: Layout) -> str:
    """Table and sentences, as Markdown."""
    found, own = chart_figures(layout), params.compare_charts
    charts = found["charts"]
    given = (
        f"A policy for `{own.constraint}` is trained in each chart with {own.steps:,} environment "
        f"steps, and asked for one certified curve on {found['queries']} queries, of which "
        f"{found['solvable']} are solved in any chart; *descent* is random curves and the "
        f"problem's own descent in the time that the policy took. Means over {len(own.seeds)} "
        f"seeds, the least and largest in brackets. Charts are VAEs of N latent dimensions, "
        f"{own.epochs} epochs, learned from all free configurations of the workcell or from those "
        f"of the task alone; the straight line, random curves and the descent are the chart's. "
        f"Length is over the shortest answer of all, of what was solved; charts were searched side "
        f"by side, so their times are no comparison. {origin(found['machine'])}."
    )
    hole = own.hole
    held = (
        f"Data with a hole: charts are learned from the free configurations that keep away from "
        f"what stands in `compare_charts.hole` of params.yaml, and nothing else tells of. Up to "
        f"{hole.pairs} pairs of these configurations whose straight latent line meets it, or the "
        f"workcell, are joined by geodesics; a chart without such a pair is in no share."
    )
    said = " ".join(_sentences(charts))
    return (
        f"# What a learned manifold adds to the search\n\n{said}\n\n{given}\n\n"
        f"{markdown_table(_rows(charts))}\n\n{held}\n\n{markdown_table(_hole_rows(charts))}\n"
    )


def cases(charts: Mapping[str, Any]) -> Iterator[tuple[str, int, Mapping[str, Figures]]]:
    """What was searched in: data, dimension, and figures by method."""
    for data in (JOINTS, *LEARNED_FROM):
        for dim in sorted(map(int, charts[data])):
            yield data, dim, charts[data][str(dim)]


def _sentences(charts: Mapping[str, Any]) -> list[str]:
    found = {(data, dim): own[POLICY] for data, dim, own in cases(charts)}
    ((joint_dim, joint),) = [(dim, own) for (data, dim), own in found.items() if data == JOINTS]
    learned = {key: own for key, own in found.items() if key[0] != JOINTS}
    best = max(learned, key=lambda key: (_mean(learned[key], "solved"), -_p95(learned[key])))
    low = [own for (_, dim), own in learned.items() if dim < joint_dim]
    sentences = [
        f"In joint space itself the policy solves {share(_mean(joint, 'solved'), 1)} with a p95 of "
        f"{fixed(_p95(joint), 3)}; in the best learned chart, of {best[1]} dimensions and "
        f"{best[0]} data, {share(_mean(learned[best], 'solved'), 1)} and "
        f"{fixed(_p95(learned[best]), 3)}."
    ]
    if low:
        least, most = (pick(_mean(own, "solved") for own in low) for pick in (min, max))
        sentences.append(
            f"With fewer dimensions than joints it solves {share(least, 1)} to {share(most, 1)}."
        )
    holes = [
        f"{dim} dimensions {_span(own['with_variance'], 'collision_free')} of the geodesics with "
        f"the variance term are free, {_span(own['without_variance'], 'collision_free')} without"
        for dim, own in sorted(charts[HOLE].items())
    ]
    sentences.append(f"Where the data has a hole, in {'; in '.join(holes)}.")
    return sentences


def _rows(charts: Mapping[str, Any]) -> list[Sequence[str]]:
    header = ["learned from", "N", "reproduction, mean [rad]", "training [s]"]
    header += ["policy: solved", "length, median", "p95", "[ms]", "descent: solved", "p95"]
    rows: list[Sequence[str]] = [header]
    for data, dim, own in cases(charts):
        chart, policy, descent = own[CHART], own[POLICY], own[DESCENT]
        spent = _mean(chart, "learned_s") + _mean(chart, "trained_s")
        told = "–" if data == JOINTS else fixed(_mean(chart, "reproduction_rad"), 4)
        rows.append(
            [
                *("nothing: joint space" if data == JOINTS else f"{data} data", str(dim)),
                *(told, fixed(spent, 0), _span(policy, "solved")),
                *(fixed(_mean(policy, "ratio_median"), 4), fixed(_p95(policy), 3)),
                *(fixed(_mean(policy, "ms"), 1), _span(descent, "solved"), fixed(_p95(descent), 3)),
            ]
        )
    return rows


def _hole_rows(charts: Mapping[str, Any]) -> list[Sequence[str]]:
    rows: list[Sequence[str]] = [["N", "", "free of collision", "decoded length [rad]", "pairs"]]
    for dim, own in sorted(charts[HOLE].items()):
        for metric, label in METRICS.items():
            length = fixed(_mean(own[metric], "length_rad"))
            pairs = "{mean:.0f} ({least:.0f} to {largest:.0f})".format(**own[metric]["pairs"])
            rows.append([dim, label, _span(own[metric], "collision_free"), length, pairs])
    return rows


def _span(own: Figures, figure: str) -> str:
    values = own[figure]
    if values["mean"] is None:
        return "–"
    least, largest = values["least"], values["largest"]
    assert least is not None
    assert largest is not None
    return f"{share(values['mean'], 1)} ({100 * least:.0f} to {100 * largest:.0f})"


def _mean(own: Figures, figure: str) -> float:
    value = own[figure]["mean"]
    return float("nan") if value is None else value


def _p95(own: Figures) -> float:
    return _mean(own, "ratio_p95")
