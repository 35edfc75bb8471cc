"""The whole pipeline, from the first configuration to the report, and what it promises about
running again.
"""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from mlflow.tracking import MlflowClient

from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.recording.recording import read_recording
from constraint_geodesics.tracking.store import fetch_artifacts, flat
from constraint_geodesics.tracking.views import VIEWS
from tests.end_to_end import smoke
from tests.recording.files import same_recordings

pytestmark = pytest.mark.timeout(1200)

SHARED = {"train_policies", "build_planner", "build_learned", "record_paths", "report"}
"""What is made from all constraints together."""
STUDIES = """
import importlib, sys
sys.path.insert(0, "stages")
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout
for name, *items in (
    ("ablate_analytic", "plane"),
    ("ablate_manifold", "paper"),
    ("ablate_manifold", "planner"),
    ("benchmark_geometry", "planner", "level_cup"),
    ("train_path_diffusion",),
    ("benchmark_policies",),
    ("compare_charts",),
    ("benchmark_demonstrations",),
    ("learn_demonstrations",),
    ("report",),
):
    importlib.import_module(name).main(load_params(), Layout(), *items)
"""
"""Studies of stages/dvc.yaml in one process: each for itself would import the same for seconds."""
BENCHMARK = "stages/dvc.yaml:report_benchmark"
LEARNED = "data/recordings/train_geodesics/planner-level_cup/query0-learned_geodesic-seed0.rrd"


@contextmanager
def restored(*places: Path) -> Iterator[None]:
    """Files and folders of the checkout that all tests share, as they were whatever happens."""
    with TemporaryDirectory() as kept:
        copies = {place: Path(kept) / str(k) for k, place in enumerate(places)}
        for place, copy in copies.items():
            (shutil.copytree if place.is_dir() else shutil.copy2)(place, copy)
        try:
            yield
        finally:
            for place, copy in copies.items():
                if copy.is_dir():
                    shutil.rmtree(place, ignore_errors=True)
                    shutil.copytree(copy, place)
                else:
                    place.write_bytes(copy.read_bytes())


def stages_to_run(folder: Path) -> set[str]:
    """Names of the stages that `dvc repro` would run now; the benchmark of all planners is not
    among them.
    """
    result = smoke.dvc(folder, "status", "--json", "dvc.yaml")
    return set(yaml.safe_load(result.stdout))


def test_a_second_run_has_nothing_to_do(finished: Path) -> None:
    assert stages_to_run(finished) == set()
    result = smoke.dvc(finished, "repro")
    assert result.returncode == 0
    assert "Running stage" not in result.stdout


def test_every_query_keeps_its_row(finished: Path) -> None:
    learned = pd.read_csv(finished / "reports/train_geodesics/planner-level_cup.csv")
    sampled = pd.read_csv(finished / "reports/benchmark_planners/level_cup.csv")
    assert len(learned) == 2 * 3 * 2 + 3
    assert len(sampled) == 3 * 3
    for table in (learned, sampled):
        valid = table[table["valid"]]
        assert len(valid) > 0
        assert (valid["max_violation_rad"] <= 1e-4).all()
        assert (valid["length_rad"] > 0).all()
        assert valid.filter(like="latent_length").notna().all().all()


def test_the_report_opens_offline(finished: Path) -> None:
    page = re.sub(
        r'src="data:image/png;base64,[^"]*"', "", (finished / "reports/index.html").read_text()
    )
    assert not re.search(r"src=|<link|@import|url\((?!#)", page)
    # nothing but what a person may follow: the runs in the dashboard of this checkout
    assert not re.search(
        r"https?:|//", re.sub(r'<a href="http://127\.0\.0\.1:5000/#/[^"]*">', "", page)
    )
    for name in (
        "fig2_analytic_submanifolds",
        "fig3_plane_search",
        "fig4a_latent_metric",
        "fig4c_geodesics",
    ):
        assert (finished / f"reports/figures/{name}.png").stat().st_size > 5000
    assert "learned geodesic" in (finished / "reports/table.md").read_text()


def test_recordings_replay_the_path(finished: Path) -> None:
    table = pd.read_csv(finished / "reports/train_geodesics/planner-level_cup.csv")
    row = table[
        (table["planner"] == "learned_geodesic") & (table["query"] == 0) & (table["seed"] == 0)
    ].iloc[0]
    assert row["recording"] == LEARNED
    summary = read_recording(finished / LEARNED)
    queries = pd.read_csv(finished / "data/joints/level_cup/queries.csv")
    np.testing.assert_allclose(summary.joints[0], queries.filter(like="start_").iloc[0], atol=1e-9)
    np.testing.assert_allclose(summary.joints[-1], queries.filter(like="goal_").iloc[0], atol=1e-9)
    assert summary.meshes == 0, "`geodesics replay` adds them"
    assert summary.has_blueprint


def test_the_documented_replay_opens_valid_paths_of_both_planners(finished: Path) -> None:
    documented = (smoke.ROOT / "docs/rerun.md").read_text()
    (command,) = set(
        re.findall(r"^(geodesics replay --constraint .* --planner .*birrt)$", documented, re.M)
    )
    replay, asked = (
        [sys.executable, "-m", "constraint_geodesics.cli", "replay"],
        command.split()[2:],
    )
    run = {
        "cwd": finished,
        "env": smoke.environment(finished),
        "capture_output": True,
        "text": True,
    }
    done = subprocess.run([*replay, *asked, "--save", ".geodesics/both.rrd"], **run, check=False)
    assert done.returncode == 0, done.stderr
    numbers = re.findall(r"(\d+) \((?:learned_geodesic|birrt)\)", done.stderr)
    listed = subprocess.run([*replay, *asked[:4], "--json"], **run, check=True)
    entries = {str(entry["number"]): entry for entry in json.loads(listed.stdout)["recordings"]}
    assert [entries[number]["planner"] for number in numbers] == ["learned_geodesic", "birrt"]
    assert entries[numbers[0]]["manifold"] == "planner"
    for number in numbers:
        same = [
            entry for entry in entries.values() if entry["planner"] == entries[number]["planner"]
        ]
        assert entries[number]["valid"] or not any(entry["valid"] for entry in same)


def test_recordings_share_their_meshes(finished: Path) -> None:
    sizes = {file: file.stat().st_size for file in (finished / "data/recordings").rglob("*.rrd")}
    assert len(sizes) > 10
    assert max(sizes.values()) <= 300_000


def test_the_built_planner_is_the_registered_champion(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(finished)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with fetch_artifacts("models:/constraint_geodesics@champion") as registered:
        for name in ("planner.json", "roadmaps.safetensors"):
            assert (registered / name).read_bytes() == (
                finished / "data/planner" / name
            ).read_bytes()


def test_runs_are_grouped_in_mlflow(finished: Path) -> None:
    client = MlflowClient(f"sqlite:///{finished / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("constraint_geodesics")
    runs = client.search_runs([experiment.experiment_id], max_results=1000)
    parents = {run.info.run_name: run for run in runs if "mlflow.parentRunId" not in run.data.tags}
    assert len(parents) == len([run for run in runs if "mlflow.parentRunId" not in run.data.tags])
    parent = parents["train_geodesics planner-level_cup"]
    children = [
        run for run in runs if run.data.tags.get("mlflow.parentRunId") == parent.info.run_id
    ]
    assert len(children) == 2
    assert "seeds/success_mean" in parent.data.metrics
    assert parent.data.tags.items() >= {"constraint": "level_cup", "manifold": "planner"}.items()
    assert {run.data.tags["recording"] for run in children} == {
        LEARNED,
        LEARNED.replace("seed0", "seed1"),
    }
    shared = parents["train_policies joint_space"]
    assert len(client.get_metric_history(shared.info.run_id, "seeds/saving_mean")) > 1
    assert parent.data.tags["dvc_stage"] == "train_geodesics@planner-level_cup"
    assert {run.info.status for run in runs} == {"FINISHED"}


def test_every_stage_has_a_run_with_its_own_parameters_alone(finished: Path) -> None:
    client = MlflowClient(f"sqlite:///{finished / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("constraint_geodesics")
    search = "tags.child IS NULL"
    parents = client.search_runs([experiment.experiment_id], search, max_results=1000)
    stages = yaml.safe_load((finished / "dvc.yaml").read_text())["stages"]
    scripts = {Path(own["cmd"].split()[1]).stem for own in stages.values()}
    assert {run.data.tags["stage"] for run in parents} == scripts - {"digest_code"}
    written = flat(yaml.safe_load((finished / "params.yaml").read_text()), ".")
    lock = yaml.safe_load((finished / "dvc.lock").read_text())["stages"]
    other_names = {"rows", "steps", "episode_steps", "heads"}  # of params.yaml's, or fixed there
    for run in parents:
        known = flat(lock[run.data.tags["dvc_stage"]].get("params", {}).get("params.yaml", {}), ".")
        for name in set(run.data.params) - other_names:
            for own in ("constraint", "manifold"):
                if name.startswith(f"{own}."):
                    name = name.replace(own, f"{own}s.{run.data.tags[own]}", 1)
            group, _, leaf = name.rpartition(".")
            by_default = any(  # beside others of its group, and not in params.yaml
                f".{one}".endswith(f".{group}") and f"{one}.{leaf}" not in written
                for one in {key.rpartition(".")[0] for key in known}
                if group
            )
            named = any(f".{key}".endswith(f".{name}") for key in known)
            assert named or by_default, (run.info.run_name, name)


def test_what_the_first_view_shows_is_there(finished: Path) -> None:
    client = MlflowClient(f"sqlite:///{finished / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("constraint_geodesics")
    for view in VIEWS:
        found = client.search_runs([experiment.experiment_id], view.search)
        shown = set[str]().union(*({*run.data.tags, *run.data.metrics} for run in found))
        if view.key != "demonstrations":  # of the stages of stages/dvc.yaml
            assert shown >= {*view.tags, *view.metrics} - {"scene", "dvc_experiment"}, view.key


def test_the_same_seeds_give_the_same_figures_and_recordings(
    finished: Path, tmp_path: Path
) -> None:
    table = "reports/train_geodesics/planner-level_cup.csv"
    figures = "reports/train_geodesics/planner-level_cup.json"
    before = {name: tmp_path / Path(name).name for name in (table, figures, LEARNED)}
    for name, copy in before.items():
        shutil.copy2(finished / name, copy)
    # run by hand, the stage leaves DVC's record of what is up to date alone; equal recordings
    # differ in their bytes
    output = "data/recordings/train_geodesics/planner-level_cup"
    command = [sys.executable, "stages/train_geodesics.py", "planner", "level_cup"]
    with restored(finished / output, *(finished / name for name in before)):
        subprocess.run(
            command, cwd=finished, env=smoke.environment(finished), check=True, capture_output=True
        )
        old, new = (
            pd.read_csv(file).drop(columns="time_s") for file in (before[table], finished / table)
        )
        pd.testing.assert_frame_equal(old, new, rtol=0, atol=1e-6)
        assert (finished / figures).read_bytes() == before[figures].read_bytes()
        assert same_recordings(before[LEARNED], finished / LEARNED)
    for name, copy in before.items():
        assert (finished / name).read_bytes() == copy.read_bytes()


def changed_by(finished: Path, change: Callable[[dict[str, Any]], None]) -> set[str]:
    """Stages to run after a change of the parameters, which is taken back."""
    file = finished / "params.yaml"
    with restored(file):
        params = yaml.safe_load(file.read_text())
        change(params)
        file.write_text(yaml.safe_dump(params, sort_keys=False))
        return stages_to_run(finished)


def test_a_tolerance_reruns_its_constraint_only(finished: Path) -> None:
    tolerance = [0, 0, 0, 0.05, 0.05, 0]
    assert changed_by(
        finished, lambda params: params["constraints"]["level_cup"].update(tolerance=tolerance)
    ) == {
        "label_joints@level_cup",
        "extract_submanifold@paper-level_cup",
        "extract_submanifold@planner-level_cup",
        "train_geodesics@planner-level_cup",
        "train_paper_geodesics@paper-level_cup",
        "benchmark_planners@level_cup",
        "execute_paths",
        *SHARED,
    }


def test_a_new_constraint_reruns_what_is_its_own_or_shared(finished: Path) -> None:
    def another(params: dict[str, Any]) -> None:
        level = params["constraints"]["level_cup"]
        params["constraints"]["upright"] = {**level, "description": "another"}

    assert changed_by(finished, another) == {
        "label_joints@upright",
        "extract_submanifold@paper-upright",
        "extract_submanifold@planner-upright",
        "train_geodesics@planner-upright",
        "benchmark_planners@upright",
        *SHARED,
    }


def test_a_colour_retrains_nothing_and_a_comment_runs_nothing(finished: Path) -> None:
    file = finished / "src" / "constraint_geodesics" / "palette.py"
    kept = file.read_text()
    another = kept.replace('"#0072B2"', '"#0072B3"', 1)
    assert another != kept

    def digested(text: str) -> set[str]:
        file.write_text(text)
        assert "digest_code" in stages_to_run(finished)
        assert smoke.dvc(finished, "repro", "digest_code").returncode == 0
        return stages_to_run(finished)

    try:
        assert digested(kept + "# a comment\n") == set()
        assert digested(another) == {"record_paths", "report"}
    finally:  # DVC's record of the code as well
        assert digested(kept) == set()


def test_the_studies_of_make_bench_run_and_the_report_shows_them(finished: Path) -> None:
    reports = finished / "reports"
    page, lock = (reports / "index.html").read_text(), (finished / "dvc.lock").read_text()
    assert not (reports / "geometry.md").exists(), "the pipeline needs none of them"
    command, environment = [sys.executable, "-c", STUDIES], smoke.environment(finished)
    run = subprocess.run(
        command, cwd=finished, env=environment, check=False, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    for name in (
        "geometry.md",
        "policies.md",
        "charts.md",
        "demonstrations.md",
        "figures/charts.png",
        "figures/ablation.png",
        "figures/length_rules.png",
    ):
        assert (reports / name).stat().st_size > 100, name
    assert len((reports / "index.html").read_text()) > len(page)
    assert (finished / "dvc.lock").read_text() == lock
    assert smoke.dvc(finished, "repro", "--single-item", "--force", "report").returncode == 0


def test_the_benchmark_has_a_row_for_every_planner_and_says_where_it_is_from(
    finished: Path,
) -> None:
    result = smoke.dvc(finished, "repro", BENCHMARK)
    assert result.returncode == 0, result.stderr
    params = yaml.safe_load((finished / "params.yaml").read_text())["benchmark"]
    table, about = read_table(finished / "reports/benchmark.csv")
    assert set(table["planner"]) == set(params["planners"])
    assert set(table["constraint"]) == set(smoke.CONSTRAINTS)
    assert set(table["scene"]) == {"table", "keep_out"}
    seeds = {name: planner["seeds"] for name, planner in params["planners"].items()}
    assert (table.groupby("planner").size() == 4 * pd.Series(seeds).sort_index()).all()
    assert table[table["planner"] == "planner"]["valid"].any()
    assert {"commit", "dvc.lock", "processor", "date"} <= set(about)
    recorded = table[table["recording"] != ""]
    assert {"planner", "BiRRT"} <= set(recorded["planner"])
    for file, planner in recorded[["recording", "planner"]].itertuples(index=False):
        assert read_recording(finished / file).application_id == "constraint_geodesics", planner
    report = finished / "reports/benchmark"
    for name in ("overview.md", "summary.md", "table_i.md", "budgets.md", "break_even.md"):
        assert "planner" in (report / name).read_text()
    for name in ("overview", "break_even"):
        assert (report / f"{name}.png").stat().st_size > 5000
    assert "Running stage" not in smoke.dvc(finished, "repro", BENCHMARK).stdout
