"""The report of a small run laid out in a folder: real data, manifolds and sub-manifolds, tables
written by hand.
"""

import csv
import html
import json
import re
import shutil
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pandas as pd
import pytest
import torch
from mlflow.utils.search_utils import SearchUtils
from tests.report.pages import DASHBOARD, check_page
from tests.report.study_fixtures import write_arm_report, write_study_reports

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import (
    ShardTask,
    data_card,
    draw_shard,
    read_joints,
    seed_of,
    shard_tasks,
    write_joints,
)
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    Surface,
    extract,
    save_submanifold,
    submanifold_figures,
)
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.palette import planner_colour
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.arms_page import arm_tables
from constraint_geodesics.report.cells import plus_minus, short
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.report.front import NOT_RUN, learning, opening, planner_row
from constraint_geodesics.report.page import Recorded
from constraint_geodesics.report.pipeline_figures import latent_curves
from constraint_geodesics.report.pipeline_page import write_report
from constraint_geodesics.report.pipeline_tables import ablation_tables, recorded_paths
from constraint_geodesics.report.results import (
    ReportError,
    compare_planners,
    findings,
    read_paths,
    result_table,
)
from constraint_geodesics.scene.scene import Scene

ROOT = Path(__file__).parents[2]
CONSTRAINTS, SEEDS, QUERIES = ("free", "level_cup", "slide"), (0, 1), 3
HELD_OUT = {
    "joint_error_mean_deg": 12.5,
    "tool_error_median_mm": 233.0,
    "deviation_median_deg": 1.0,
}

ABLATED = {
    "policy_search": {
        "printed_reward": {"mean_ratio": [1.02, 1.04]},
        "spline_2": {"mean_ratio": [1.01, 1.01]},
    },
    "gradient": {"polynomial": {"mean_ratio": 1.0002}, "spline_2": {"mean_ratio": 1.00001}},
}
UNVARIED = {
    **{name: {"mean_ratio_to_best": 1.0} for name in ("polynomial", "spline_2")},
    **{
        name: {"collision_free": share, "pairs": 5.0}
        for name, share in (
            ("with_variance", 0.8),
            ("without_variance", 0.4),
            ("straight_latent_line", None),
        )
    },
}
RATES = {"batch": 4096, "per_second": 50000.0, "naive_per_second": 200.0, "ratio_to_naive": 250.0}
STEPS = {
    "environments": 256,
    "steps_per_second": 20000.0,
    "dummy_vec_env_steps_per_second": 800.0,
    "ratio_to_dummy_vec_env": 25.0,
}
WALLED = {
    "queries": 100,
    "found": 1.0,
    "inside": 1.0,
    "over_dijkstra": {"mean": 0.97, "p95": 0.99, "max": 0.995},
    "over_reference": {"mean": 1.0001, "p95": 1.0002, "max": 1.001},
    "milliseconds": 250.0,
}
NO_LENGTHS = {
    kind: dict.fromkeys(("mean", "p95", "max")) for kind in ("over_dijkstra", "over_reference")
}
GEOMETRY = {
    "manifold": "planner",
    "constraint": "level_cup",
    "machine": {"processor": "a processor"},
    "curve_length": {
        **RATES,
        "chords_batched_per_second": 12500.0,
        "per_second_by_batch": {"1": 1000.0},
        "error": {
            "median": 1e-7,
            "p95": 1e-5,
            "max": 4e-4,
            "curves": 512,
            "reference_points": 2000,
        },
    },
    "curve_length_retracted": RATES,
    "environment": STEPS,
    "environment_retracted": STEPS,
    "solvers": {"plane": {"gradient": {"mean_ratio": 1.0, "milliseconds": 2.0}}},
    "policy_search": {
        "plane": {
            "mean_ratio": [1.001, 1.003],
            "first_mean_ratio": [1.25, 1.25],
            "descent_mean_ratio": [1.01, 1.01],
            "p95_ratio": [1.002, 1.004],
            "domain": "|x|, |y| ≤ 1.5",
        }
    },
    "grids_with_walls": {
        "gaps": {
            "combined": WALLED,
            "gradient, cubic": {**WALLED, "found": 0.0, "inside": None, **NO_LENGTHS},
        }
    },
}
QUADRATURE = [
    {
        "rule": rule,
        "points": n,
        "microseconds": n * cost,
        "error_p95": 10.0**-n,
        "error_max": 3 * 10.0**-n,
    }
    for rule, cost in (("chords", 1.0), ("gauss_legendre", 4.0), ("collocation", 1.1))
    for n in (3, 5, 7)
]

HISTORY = [
    *(
        {"epoch": e, "mean_loss": 1.0 / (e + 1), "mean_held_out_loss": 1.1 / (e + 1)}
        for e in range(4)
    ),
    *({"epoch": e, "variance_loss": -e, "variance_held_out_loss": 0.5 - e} for e in range(4, 6)),
]


def small_params():
    params = load_params(ROOT / "params.yaml")
    constraints = {name: params.constraints[name] for name in CONSTRAINTS}
    geodesics = params.geodesics.model_copy(
        update={"seeds": SEEDS, "illustrated_constraints": ("level_cup",), "analytic": ("plane",)}
    )
    submanifold = params.submanifold.model_copy(update={"grid": 20, "nodes": 30, "neighbours": 4})
    labels = params.labels.model_copy(update={"queries": QUERIES})
    return params.model_copy(
        update={
            "constraints": constraints,
            "geodesics": geodesics,
            "submanifold": submanifold,
            "labels": labels,
        }
    )


def write_json(file, content):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def write_csv(file, rows):
    file.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(file, index=False)


def path_row(
    planner, query, seed, length, *, valid=True, latents=("planner",), violation=1e-9, recording=""
):
    found = np.isfinite(length)
    return {
        "planner": planner,
        "query": query,
        "seed": seed,
        "status": "solved" if found else "not_found",
        "time_s": np.nan if planner == "straight_latent_line" else 0.5 + seed,
        "evaluations": 10,
        "valid": bool(found and valid),
        "reason": "" if valid else "constraint violated",
        "length_rad": length,
        "tool_length_m": length / 5,
        "max_violation_rad": violation if found else np.nan,
        "max_violation_m": 0.0 if found else np.nan,
        "max_step_rad": 0.05 if found else np.nan,
        "recording": recording,
        **{f"latent_length_{name}": 2 * length for name in latents},
    }


def searched_rows(manifold, constraint):
    keeps = manifold == "planner"
    options = {
        "valid": keeps,
        "latents": (manifold,),
        "violation": 1e-9 if keeps else np.radians(20.0),
    }
    rows = [path_row("straight_latent_line", q, 0, 4.0, **options) for q in range(QUERIES)]
    for seed in SEEDS:
        for query in range(QUERIES):
            folder = f"data/recordings/train_geodesics/{manifold}-{constraint}"
            file = f"{folder}/query{query}-learned_geodesic-seed{seed}.rrd"
            recording = file if query == 0 else ""
            rows.append(
                path_row(
                    "learned_geodesic",
                    query,
                    seed,
                    3.0 + 0.5 * seed,
                    recording=recording,
                    **options,
                )
            )
            rows.append(path_row("random_curves", query, seed, 3.8, **options))
    return rows


def sampled_rows():
    rows = []
    for planner, lengths in (
        ("birrt", (5.0, 6.0)),
        ("prm", (8.0, 9.0)),
        ("rrt_star", (np.nan, np.nan)),
    ):
        rows += [
            path_row(planner, q, s, lengths[s], latents=("paper", "planner"))
            for q in range(QUERIES)
            for s in SEEDS
        ]
    return rows


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Everything the stages before this one leave behind, and something that no one asked for."""
    params, layout = small_params(), Layout(tmp_path_factory.mktemp("run"))
    scene = Scene.from_params(params)
    rng = np.random.default_rng(0)
    for name in CONSTRAINTS:
        manifold = constraint_manifold(scene.robot, params.constraints[name])
        shards = [
            draw_shard(task)
            for task in shard_tasks(ShardTask(scene, manifold, 120, seed_of(name, 1)), 120)
        ]
        write_joints(shards, layout.joints(name), {"seed": "1"})
        card = data_card(shards)
        histograms = layout.report("label_joints", f"{name}-histograms")
        write_json(histograms, card.pop("histograms"))
        write_json(layout.report("label_joints", name), card)
        write_csv(layout.report("benchmark_planners", name, "csv"), sampled_rows())
    with scene.world() as world:
        for name, settings in params.manifolds.items():
            torch.manual_seed(settings.seed)
            vae = JointVae(scene.robot.dof, settings.latent_dim, (8,), 4)
            vae.precision.place(torch.randn(4, settings.latent_dim), torch.ones(4), 0.1, 1.0, 100.0)
            chart = LearnedManifold(vae.eval().requires_grad_(False))
            chart.save(layout.manifold(name))
            write_json(layout.report("train_manifold", name), HELD_OUT)
            write_csv(layout.report("train_manifold", name, "csv"), HISTORY)
            for constraint in CONSTRAINTS:
                free, own = (
                    read_joints(layout.joints(c)).free_joints for c in ("free", constraint)
                )
                constrained = constraint_manifold(scene.robot, params.constraints[constraint])
                surface = Surface(chart, constrained, world.free)
                found = extract(surface, free, own, params.submanifold)
                save_submanifold(found, layout.submanifold(name, constraint))
                figures = submanifold_figures(found, surface, free, own, params.submanifold)
                write_json(layout.report("extract_submanifold", f"{name}-{constraint}"), figures)
    for manifold, constraint in params.searched_items:
        item, own = f"{manifold}-{constraint}", read_joints(layout.joints(constraint)).free_joints
        write_csv(
            layout.report("train_geodesics", item, "csv"), searched_rows(manifold, constraint)
        )
        curve = [
            {"seed": s, "steps": t, "saving": 0.01 * t, "return": 0.1}
            for s in SEEDS
            for t in (1, 2, 3)
        ]
        if not params.manifolds[manifold].retract:
            write_csv(layout.report("train_geodesics", f"{item}-learning", "csv"), curve)
        write_csv(layout.report("train_policies", "joint_space-learning", "csv"), curve)
        write_json(layout.report("train_geodesics", item), {"success_mean": 0.875, "seeds": 2.0})
        layout.geodesics(manifold, constraint).mkdir(parents=True)
        size = 2 * params.manifolds[manifold].latent_dim
        np.savez(
            layout.geodesics(manifold, constraint) / "curves.npz",
            phi=rng.normal(size=(2, QUERIES, size)),
            seeds=np.array(SEEDS),
            starts=own[:QUERIES],
            goals=own[QUERIES : 2 * QUERIES],
        )
    t = np.linspace(0, 1, 20)[:, None]
    layout.analytic("plane").mkdir(parents=True)
    np.savez(
        layout.analytic("plane") / "curves.npz",
        sampled=np.stack([t * [1.0, k] for k in (1, 2)]),
        learned=t * [1, 1],
    )
    write_json(layout.report("train_analytic", "plane"), {"mean_ratio": [1.001, 1.003]})
    write_json(layout.report("ablate_analytic", "plane"), ABLATED)
    for name in params.manifolds:
        write_json(layout.report("ablate_manifold", name), UNVARIED)
    write_json(layout.root / "reports" / "geometry.json", GEOMETRY)
    write_csv(layout.report("benchmark_geometry", "quadrature", "csv"), QUADRATURE)
    write_csv(layout.report("benchmark_planners", "removed", "csv"), sampled_rows())
    write_study_reports(params, layout)
    write_arm_report(layout)
    benchmark = layout.root / "reports" / "benchmark"
    benchmark.mkdir()
    for name in ("overview.csv", "about.json"):
        shutil.copy(ROOT / "reports" / "benchmark" / name, benchmark)
    return params, layout


@pytest.fixture(scope="module")
def written(run):
    return write_report(*run)


@pytest.fixture(scope="module")
def page(run, written):
    return (run[1].root / "reports" / "index.html").read_text()


@pytest.fixture(scope="module")
def checked(run, page):
    return check_page(page, run[1].root / "reports", ("benchmark.html", "../docs/data_card.md"))


def test_the_page_asks_the_network_for_nothing_and_every_figure_is_on_it(checked, written):
    assert len(checked.sources) == len(checked.alts) == len(written)
    assert {"benchmark.html", "benchmark.html#parts", "../docs/data_card.md"} <= set(checked.links)
    assert "figures/fig2_analytic_submanifolds.png" in checked.links


def test_the_page_opens_with_the_planner_and_the_pipelines_findings_come_later(run, page, checked):
    row = planner_row(run[1])
    assert checked.tables[row.title][2:] == [list(cells) for cells in row.rows]
    assert checked.tables[row.title][1] == list(row.header)
    lead = html.unescape(page[page.index('class="lead"') : page.index("</p>")])
    assert " ".join(opening(run[1], measured=True)) in lead
    about = json.loads((ROOT / "reports" / "benchmark" / "about.json").read_text())
    assert about["commit"][:12] in page
    places = [page.index(f'id="{name}"') for name in ("learning", "published", "findings")]
    assert page.index('class="lead"') < places[0] < places[1] < places[2]
    assert places[2] < page.index("The learned search finds")
    added = learning(*run)
    assert html.escape(added.adds[0]).replace("&#x27;", "&#39;") in page
    assert len(checked.tables[added.table.title]) - 1 == len(added.table.rows) == 8


def test_without_a_benchmark_the_page_says_what_makes_one(run, page) -> None:
    params, layout = run
    file = layout.root / "reports" / "benchmark" / "about.json"
    aside = file.with_suffix(".aside")
    file.rename(aside)
    try:
        write_report(params, layout)
        text = (layout.root / "reports" / "index.html").read_text()
        assert NOT_RUN in text
        assert 'aria-label="The planner beside' not in text
    finally:
        aside.rename(file)
        write_report(params, layout)


def test_the_pages_tables_say_what_the_csv_says(run, checked):
    table = pd.read_csv(run[1].root / "reports" / "table.csv")
    for row in table.to_dict("records"):
        label = PLANNERS[row["planner"]].label
        cells = checked.rows(f"{row['manifold']}, {row['constraint']}")[label]
        assert cells[0] == f"{row['success']:.0%}"
        assert cells[1] == f"{row['compared']}/{row['queries']}"
        assert cells[2] == (
            "–" if np.isnan(row["latent_shortest"]) else f"{row['latent_shortest']:.2f}"
        )
        assert cells[5].split(" ± ")[0] == short(row["time_mean_s"])


def test_a_planner_has_its_colour_beside_its_name(checked):
    for title in ("planner, slide", "level_cup"):
        rows = checked.tables[title]
        named = {rows[place][0]: colour for place, colour in checked.colours[title].items()}
        assert "planner" in named or "learned geodesic" in named
        assert named == {name: planner_colour(name) for name in named}


def test_every_recorded_row_has_its_command_and_every_row_its_runs(run, checked):
    params, layout = run
    for stage in ("train_geodesics", "benchmark_planners"):
        for file in (layout.root / "reports" / stage).glob("*.csv"):
            rows = pd.read_csv(file)
            if "recording" in rows and file.stem != "removed":
                for recording in rows["recording"].dropna():
                    assert f"geodesics replay {recording}" in checked.commands
    results = [title for title in checked.tables if title.partition(", ")[0] in params.manifolds]
    assert len(results) == 4
    for title in results:
        rows = checked.rows(title)
        assert [row[-1] for name, row in rows.items() if name == "learned geodesic"] == [
            "2 recorded · runs"
        ]
        assert all(row[-1].endswith("runs") for name, row in rows.items() if name != "planner")


def test_links_to_runs_are_filters_that_mlflow_takes(checked):
    found = {link for link in checked.links if link.startswith(DASHBOARD)}
    wanted = set()
    for link in found:
        address = urlsplit(link)
        path, _, query = address.fragment.partition("?")
        assert path == "/experiments/1/runs"
        asked = parse_qs(query)
        assert asked["workflowType"] == ["machine_learning"], "not the page of language models"
        (text,) = asked["searchFilter"]
        stage, item = SearchUtils.parse_search_filter(text)
        assert (stage["key"], stage["comparator"], item["key"]) == ("stage", "=", "item")
        wanted.add((stage["value"], item["value"]))
    assert {
        ("train_geodesics", "planner-slide"),
        ("benchmark_planners", "slide"),
        ("execute_paths", "level_cup"),
        ("train_manifold", "paper"),
        ("ablate_analytic", "plane"),
        ("label_joints", "free"),
        ("benchmark_geometry", "planner"),
        ("benchmark_policies", "joint_space"),
    } <= wanted


def test_ablations_say_what_their_stages_measured(run):
    searched, variance, families = ablation_tables(*run)
    rows = {row[0]: row[1:] for row in searched.rows}
    assert rows["plane, corrected reward, cubic"] == ["0.200", "0.100", "0.300", "2", "0.020"]
    assert rows["plane, reward as printed"] == ["3.000", "2.000", "4.000", "2", "0.020"]
    assert rows["plane, 2 segments"] == ["1.000", "1.000", "1.000", "2", "0.001"]
    assert variance.rows[0][:3] == ["paper, with the variance term", "5", "0.8"]
    assert variance.rows[2][1:3] == ["5", "–"]
    assert families.header == ["manifold", "cubic", "2 segments"]


def test_every_figure_of_the_paper_has_its_counterpart(written):
    names = [file.stem for file in written]
    assert all(file.is_file() and file.stat().st_size < 150_000 for file in written)
    for expected in (
        "length_rules",
        "ablation",
        "fig2_analytic_submanifolds",
        "fig3_plane_search",
        "fig4a_latent_metric",
        "fig4b_submanifolds",
        "fig4c_geodesics",
        "metric_growth",
        "training_curves",
        "comparison_planner",
        "submanifolds_planner",
        "learning_curves",
        *(f"data_{name}" for name in CONSTRAINTS),
    ):
        assert expected in names


def test_a_second_report_is_the_same_to_the_byte(run, written, page):
    before = [file.read_bytes() for file in written]
    assert write_report(*run) == written
    assert [file.read_bytes() for file in written] == before
    assert (run[1].root / "reports" / "index.html").read_text() == page


def test_the_table_has_a_row_for_every_planner_also_one_that_found_nothing(run, written):
    with (run[1].root / "reports" / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * len(PLANNERS)  # three constraints on one manifold, one on the other
    assert [row["planner"] for row in rows[: len(PLANNERS)]] == list(PLANNERS)
    by_name = {(row["manifold"], row["constraint"], row["planner"]): row for row in rows}
    failed = by_name["planner", "slide", "rrt_star"]
    assert (float(failed["success"]), failed["latent_mean"], float(failed["time_mean_s"])) == (
        0.0,
        "",
        1.0,
    )
    learned = by_name["planner", "slide", "learned_geodesic"]
    assert [float(learned[k]) for k in ("success", "latent_shortest", "latent_mean")] == [
        1.0,
        6.0,
        6.5,
    ]
    assert float(learned["latent_std"]) == pytest.approx(np.sqrt(0.5), rel=1e-5)
    flat = by_name["paper", "level_cup", "learned_geodesic"]
    assert (float(flat["success"]), float(flat["latent_mean"]), flat["counted"]) == (
        0.0,
        6.5,
        "found",
    )
    assert float(flat["violation_median_deg"]) == pytest.approx(20.0)
    assert not any("removed" in row.values() for row in rows)


def test_the_printed_table_says_what_the_csv_says(run, written):
    text = result_table(run[1])
    written_text = (run[1].root / "reports" / "table.md").read_text()
    assert written_text.startswith("# ")
    assert written_text.endswith(f"\n\n{text}")
    for block in re.split(r"\n\n(?=`)", text.strip()):
        lines = block.split("\n")[2:]
        assert len({len(line) for line in lines}) == 1  # aligned
        assert len({line.count("|") for line in lines}) == 1
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.split("\n")
        if "learned geodesic" in line
    ]
    assert cells[0][1:5] == ["learned geodesic", "100%", "3/3", "6.00"]
    assert cells[0][5] == "6.50 ± 0.71"
    assert ["rrt" in line for line in text.split("\n")].count(True) == 0
    assert text.count("RRT*") == 4


def test_the_page_sets_the_papers_figures_beside_this_runs(page):
    section = page[page.index('id="published"') : page.index('id="planner"')]
    for figure in (
        "530.89 ± 24.43",
        "155.28 ± 17.84",
        "84.65 ± 25.52",
        "79.81 ± 7.64",
        "70.56",
        "6.65",
    ):
        assert figure in section
    assert "6.50 ± 0.71" in section
    assert section.count("<table>") == 1


def test_the_page_shows_the_other_stages_metrics(page):
    section = page[page.index('id="metrics"') : page.index('id="data"')]
    for cell in ("<td>12.5</td>", "<td>233</td>", "<td>0.875</td>", "<td>1.001, 1.003</td>"):
        assert cell in section
    assert '<th scope="row">planner, slide</th>' in section


def test_findings_come_from_the_tables(run):
    params, layout = run
    table = compare_planners(params, layout)
    told = findings(params, table, dict.fromkeys(params.manifolds, HELD_OUT))
    planner, paper, caution = told
    assert planner.about.startswith("planner: 6 latent dimensions, curves of joint space retracted")
    assert (
        "finds a valid path for 100% of the queries (free 100%, level_cup 100%, slide 100%)"
        in planner.sentences[0]
    )
    assert "BiRRT 100%" in planner.sentences[1]
    assert "RRT* 0%" in planner.sentences[1]
    assert "finds a valid path for 0% of the queries (level_cup 0%)" in paper.sentences[0]
    assert "by 20° at worst" in paper.sentences[2]
    assert "233 mm" in paper.sentences[4]
    assert f"{QUERIES} queries a constraint and {len(SEEDS)} policies" in caution.sentences[0]
    worse = table.assign(
        latent_mean=table["latent_mean"].where(table["planner"] != "learned_geodesic", 99.0)
    )
    assert (
        "under no constraint; another planner's is under free (BiRRT)"
        in findings(params, worse, dict.fromkeys(params.manifolds, HELD_OUT))[0].sentences[3]
    )


def test_recorded_paths_say_what_they_show(run):
    found = recorded_paths(*run, "planner", "level_cup")
    assert {name: len(paths) for name, paths in found.items()} == {"learned_geodesic": 2}
    first = found["learned_geodesic"][0]
    assert (
        first.file
        == "data/recordings/train_geodesics/planner-level_cup/query0-learned_geodesic-seed0.rrd"
    )
    assert first.command == f"geodesics replay {first.file}"
    assert "seed 0: valid, 3.00 rad" in first.text
    assert (
        "not valid: constraint violated"
        in recorded_paths(*run, "paper", "level_cup")["learned_geodesic"][-1].text
    )


def test_a_recording_is_found_in_any_checkout():
    assert in_checkout("/elsewhere/data/recordings/a b.rrd") == "data/recordings/a b.rrd"
    assert in_checkout("data/recordings/a.rrd") == "data/recordings/a.rrd"
    assert (
        Recorded("data/recordings/a b.rrd", "").command
        == "geodesics replay 'data/recordings/a b.rrd'"
    )


def test_drawn_curves_are_those_of_the_seeds_that_found_one(run, tmp_path):
    params, layout = run
    chart = LearnedManifold.load(layout.manifold("paper"))
    curves = latent_curves(params, layout, chart, "paper", "level_cup")
    assert curves.learned.shape == (len(SEEDS), 101, 2)
    own = read_joints(layout.joints("level_cup")).free_joints
    np.testing.assert_allclose(curves.straight[[0, -1]], chart.encode(own[[0, QUERIES]]), atol=1e-6)
    np.testing.assert_allclose(curves.learned[:, 0], curves.straight[[0, 0]], atol=1e-12)
    file = layout.report("train_geodesics", "paper-level_cup", "csv")
    original = file.read_text()
    rows = searched_rows("paper", "level_cup")
    rows[3]["status"] = "not_found"  # query 0 of the first seed
    try:
        write_csv(file, rows)
        assert (
            len(latent_curves(params, layout, chart, "paper", "level_cup").learned)
            == len(SEEDS) - 1
        )
    finally:
        file.write_text(original)


@pytest.mark.parametrize(
    "name",
    [
        "reports/benchmark_planners/slide.csv",
        "reports/train_geodesics/paper-level_cup.csv",
        "reports/train_policies/joint_space-learning.csv",
        "reports/train_manifold/paper.json",
        "reports/label_joints/level_cup.json",
        "reports/label_joints/level_cup-histograms.json",
        "data/submanifolds/planner-free/submanifold.json",
        "data/analytic/plane/curves.npz",
        "data/joints/free/joints.parquet",
    ],
)
def test_a_missing_file_is_one_line_that_names_it(run, name):
    params, layout = run
    file = layout.root / name
    aside = file.with_suffix(".aside")
    file.rename(aside)
    try:
        with pytest.raises(ReportError) as error:
            write_report(params, layout)
    finally:
        aside.rename(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_without_the_studies_of_time_there_is_a_report_all_the_same(run) -> None:
    params, layout = run
    file, figure = (layout.root / "reports" / name for name in ("geometry.json", "figures"))
    aside = file.with_suffix(".aside")
    file.rename(aside)
    try:
        write_report(params, layout)
        assert "length_rules" not in (layout.root / "reports" / "index.html").read_text()
        assert (figure / "comparison_planner.png").is_file()
    finally:
        aside.rename(file)
        write_report(params, layout)
    assert "length_rules" in (layout.root / "reports" / "index.html").read_text()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda rows: [row.pop("latent_length_planner") for row in rows], "latent_length_planner"),
        (lambda rows: rows[0].update(planner="magic"), "planner"),
        (lambda rows: rows[0].update(valid="perhaps"), "valid"),
        (lambda rows: rows[0].update(length_rad="long"), "length_rad"),
        (lambda rows: rows[0].update(query=0.5), "query"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_line_with_file_and_column(tmp_path, change, named):
    rows = sampled_rows()
    change(rows)
    file = tmp_path / "broken.csv"
    write_csv(file, rows)
    with pytest.raises(ReportError, match=named) as error:
        read_paths(file, "planner")
    assert str(error.value).startswith(str(file))
    assert "\n" not in str(error.value)


def test_a_metrics_file_that_is_not_json_is_named(run):
    params, layout = run
    file = layout.report("train_manifold", "planner")
    original = file.read_text()
    file.write_text("{")
    try:
        with pytest.raises(ReportError, match=r"planner\.json: not JSON"):
            write_report(params, layout)
    finally:
        file.write_text(original)


def test_the_page_says_what_the_geometry_core_reaches(page):
    assert "50,000 lengths a second in batches of 4096, 250 times" in page
    assert "plane: 0.20% against 3.00%" in page, "the reward as printed beside the corrected one"
    assert "paper: 80% with it, 40% without" in page
    assert "one thread of a processor" in page


def test_the_geometry_table_says_what_its_metrics_say(run, written):
    table = (run[1].root / "reports" / "geometry.md").read_text()
    rows = [
        [cell.strip() for cell in re.split(r"(?<!\\\\)\|", line)[1:-1]]
        for line in table.splitlines()
        if line.startswith("|")
    ]
    assert rows[2] == ["curve lengths, batches of 4096", "50,000", "200", "250"]
    assert rows[3][1:] == ["50,000", "12,500", "4.0"]
    assert rows[6][0] == "environment steps, PPO included, retracted onto level_cup"
    assert ["plane", "1.250", "1.0100", "1.0030", "1.0040", "1.00000"] in [r[:6] for r in rows]
    over = ["0.970", "0.990", "0.995", "1.0001", "1.0010"]
    assert rows[-2][1:] == ["100", "100 %", "100 %", *over, "250"]
    assert rows[-1] == ["gaps, gradient, cubic", "100", "0 %", *6 * ["–"], "250"]


def test_the_page_has_the_tables_of_arms_and_goals(run, page):
    text = (run[1].root / "reports" / "arms.md").read_text()
    for own in arm_tables(run[1]):
        assert f"<h3>{own.title}</h3>" in page
        assert f"## {own.title}\n" in text


def test_only_what_params_ask_for_was_searched():
    params = small_params()
    geodesics = params.geodesics.model_copy(update={"illustrated": (), "analytic": ()})
    assert params.model_copy(update={"geodesics": geodesics}).searched_items == [
        ("planner", c) for c in CONSTRAINTS
    ]


def test_numbers_are_written_for_people():
    assert [short(value) for value in (float("nan"), 0.0, 5.7e-8, 0.0512, 12.345)] == [
        "–",
        "0",
        "5.7e-08",
        "0.0512",
        "12.3",
    ]
    assert plus_minus(1.5, float("nan"), short) == "1.5"
    assert plus_minus(1.5, 0.25, short) == "1.5 ± 0.25"
