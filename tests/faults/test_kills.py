"""Processes that are killed, and what they leave: the next run ends as if nothing had happened."""

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest
import yaml
from dvc.schema import COMPILED_LOCKFILE_SCHEMA
from dvc.utils.serialize import parse_yaml
from mlflow import MlflowClient
from safetensors.numpy import load_file

from constraint_geodesics import doctor
from constraint_geodesics.benchmark.row import KEY, read_table
from constraint_geodesics.geodesics.policy_search import save_policy, train_policy
from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.lock_files import is_whole, keep_locks, recover_locks
from constraint_geodesics.pipeline.threads import one_thread
from constraint_geodesics.studies.geodesic_search import analytic_problem, curve_family
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, begin_run, tracked_stage
from constraint_geodesics.tracking.left import AtWorkError, left_runs
from constraint_geodesics.tracking.sending import recover
from constraint_geodesics.tracking.store import (
    MOST_RUNS,
    TrackingError,
    open_store,
    tracking_uri,
    ui_command,
)
from tests.end_to_end import smoke
from tests.faults.effort import SOAK, Effort, counting
from tests.ports import free_port

STAGE = """
import sys
from pathlib import Path
from constraint_geodesics.tracking.experiment import Work, tracked_stage

with tracked_stage(Work("train", sys.argv[1]), "kills", Path()) as run:
    with run.child("seed 0", {"seed": 0}) as child:
        child.log(1, {"loss": 0.5})
        print("within", flush=True)
        sys.stdin.readline()
        child.log(2, {"loss": 0.25})
    with run.child("seed 1", {"seed": 1}) as child:
        child.log(1, {"loss": 0.75})
    run.summarise([{"length": 1.0}, {"length": 3.0}])
    run.report({"length": 2.0, "more": {"count": 3}}, Path("report.json"))
"""
PPO = """
from pathlib import Path
from tests.faults.test_kills import train
train(Path())
"""


@pytest.fixture(autouse=True)
def own_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.delenv("DVC_STAGE", raising=False)


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store without runs: to make one takes seconds."""
    folder = tmp_path_factory.mktemp("store")
    open_store(tracking_uri(folder), "kills")
    return folder / "mlflow.db"


def started(program: str, folder: Path, *words: str) -> subprocess.Popen[str]:
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = [sys.executable, "-c", program, *words]
    path = os.pathsep.join([str(smoke.ROOT / "src"), str(smoke.ROOT)])
    how: dict[str, Any] = {"env": os.environ | {"PYTHONPATH": path}, "start_new_session": True}
    return subprocess.Popen(command, cwd=folder, text=True, **pipes, **how)


def within(folder: Path, item: str = "cup") -> subprocess.Popen[str]:
    """A stage's process that has told its store something and waits."""
    process = started(STAGE, folder, item)
    assert process.stdout.readline() == "within\n", process.communicate()[1]
    return process


def statuses(folder: Path) -> dict[str, list[str]]:
    """Of the runs of one name, oldest first."""
    client, found = MlflowClient(f"sqlite:///{folder / 'mlflow.db'}"), dict[str, list[str]]()
    ids = [own.experiment_id for own in client.search_experiments()]
    order = ["attributes.start_time ASC"]
    for run in client.search_runs(ids, max_results=MOST_RUNS, order_by=order):
        found.setdefault(run.info.run_name, []).append(run.info.status)
    return found


def test_runs_of_a_process_that_is_gone_for_sure_are_ended_and_no_others(
    tmp_path: Path, empty: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    here, copy = tmp_path / "here", tmp_path / "copy"
    here.mkdir()
    shutil.copy2(empty, here)
    process = within(here)
    shutil.copytree(here, copy)  # as on a machine with a copy of the folder
    for folder in (here, copy):
        assert list(recover(folder)) == []
        assert statuses(folder) == {"train cup": ["RUNNING"], "cup seed 0": ["RUNNING"]}
    with pytest.raises(AtWorkError, match=f"train cup: process {process.pid} is at work"):
        begin_run(Work("train", "cup"), "kills", here)
    process.kill()
    process.communicate()
    assert list(recover(copy)) == []
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/other.db")
    elsewhere = "left as it is, for it is in the store sqlite:///mlflow.db"
    assert list(recover(here)) == [f"train cup: {elsewhere}"]
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    findings = doctor.examine(here, checks={"mlflow": doctor.check_mlflow})
    (found,) = [own for own in findings if "RUNNING" in own.message]
    assert "train cup" in found.message
    assert found.mend == "geodesics recover"
    with tracked_stage(Work("label", "cup"), "kills", here):
        pass
    told = capfd.readouterr().err
    assert told == "MLflow: train cup: ended as KILLED, 2 of its runs were still running\n"
    ended = {"train cup": ["KILLED"], "cup seed 0": ["KILLED"], "label cup": ["FINISHED"]}
    assert statuses(here) == ended
    assert not list((here / ".geodesics/runs").glob("[!.]*"))


def test_what_a_store_that_is_gone_did_not_take_is_sent_later(
    tmp_path: Path, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy2(empty, tmp_path)
    process = within(tmp_path)
    store, away = tmp_path / "mlflow.db", tmp_path / "away.db"
    store.rename(away)
    store.mkdir()  # no database can be opened there
    said = process.communicate("\n")[1]
    assert process.returncode == 0, said
    assert len(said.splitlines()) == 1
    assert "geodesics recover" in said
    assert json.loads((tmp_path / "report.json").read_text())["length"] == 2
    (left,) = left_runs(tmp_path)
    assert left.unsent > 5
    with pytest.raises(TrackingError, match="MLflow store sqlite:.*unable to open database file"):
        list(recover(tmp_path))
    assert left_runs(tmp_path) == [left], "nothing is lost by a try that fails"
    store.rmdir()
    away.rename(store)
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "constraint_geodesics.cli", "recover", "--json"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (line,) = json.loads(said)["done"]
    assert re.fullmatch(r"train cup: told MLflow \d+ things that it had not taken", line)
    client = MlflowClient(f"sqlite:///{store}")
    (experiment,) = [own for own in client.search_experiments() if own.name == "kills"]
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    first, second, parent = (runs[name] for name in ("cup seed 0", "cup seed 1", "train cup"))
    losses = client.get_metric_history(first.info.run_id, "loss")
    assert [(own.step, own.value) for own in losses] == [(1, 0.5), (2, 0.25)]
    assert second.data.metrics == {"loss": 0.75, "final/length": 3.0}
    assert second.data.params["seed"] == "1"
    assert parent.data.metrics["seeds/length_mean"] == 2.0
    assert parent.data.metrics["more/count"] == 3
    (kept,) = (tmp_path / "mlartifacts").rglob("reports/report.json")
    assert kept.read_bytes() == (tmp_path / "report.json").read_bytes()
    assert not left_runs(tmp_path)


def train(folder: Path) -> list[int]:
    """A small training of a policy, from a checkpoint in the folder if there is one; says at which
    steps it reports, and returns them.
    """
    own = load_params(smoke.ROOT / "params.yaml").geodesics
    ppo = own.ppo.model_copy(update={"rollout_steps": 10, "batch_size": 80, "epochs": 2})
    small = {"steps": 6400, "environments": 32, "checkpoint_steps": 640, "ppo": ppo}
    own, steps = own.model_copy(update=small), list[int]()

    def report(step: int, _: dict[str, float]) -> None:
        steps.append(step)
        print(step, flush=True)

    problem = analytic_problem("plane", curve_family(2, own))
    with one_thread():
        save_policy(train_policy(problem, own, 0, folder / "scratch", report), folder, 0)
    return steps


def test_a_killed_training_of_a_policy_ends_as_one_that_was_not(
    tmp_path: Path, effort: Effort
) -> None:
    rng, hurt = random.Random(0), tmp_path / "hurt"
    steps = train(tmp_path / "whole")
    hurt.mkdir()
    began = {steps[0]}
    for _ in range(min(effort.kills, 5)):
        process = started(PPO, hurt)
        said = [int(process.stdout.readline()) for _ in range(rng.randrange(2, 4))]
        time.sleep(rng.uniform(0.0, 0.05))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        began.add(said[0])
    began.add(train(hurt)[0])
    assert len(began) > 1, "it went on from a checkpoint"
    (checkpoint,) = (hurt / "scratch").glob("*.pt")
    damaged = bytearray(checkpoint.read_bytes())
    for place in range(len(damaged) // 2, len(damaged) // 2 + 1024, 8):  # more than filling
        damaged[place] ^= 1
    checkpoint.write_bytes(damaged)
    assert train(hurt) == steps, "what is damaged is not gone on from"
    once, again = (load_file(own / "policy-0.safetensors") for own in (tmp_path / "whole", hurt))
    assert once.keys() == again.keys()
    for name, values in once.items():
        np.testing.assert_array_equal(again[name], values)


def test_a_lock_file_that_is_cut_short_is_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, effort: Effort
) -> None:
    monkeypatch.setenv("DVC_STAGE", "train")
    lock, whole = tmp_path / "dvc.lock", (smoke.ROOT / "dvc.lock").read_bytes()
    lock.write_bytes(whole)
    keep_locks(tmp_path)
    rng = random.Random(1)
    cuts = [rng.randrange(len(whole)) for _ in range(effort.faults // 10)]
    ends = [own.start() for own in re.finditer(rb"^  \S", whole, re.M)][1:]
    named = [whole.index(key) + len(key) for key in (b"    params:\n", b"      params.yaml:\n")]
    for cut in (0, 8192, len(whole) - 1, ends[0], ends[-1], *named, *cuts):
        lock.write_bytes(whole[:cut])
        recovered = recover_locks(tmp_path)
        assert lock.read_bytes() == (whole if recovered else whole[:cut])
        # cut where a stage ends, it is a lock file of fewer stages, which DVC runs again
        assert not (recovered and cut in ends)
        if not recovered:
            COMPILED_LOCKFILE_SCHEMA(parse_yaml(lock.read_text(), str(lock)))
    lock.write_bytes(whole[:100])
    keep_locks(tmp_path)
    assert recover_locks(tmp_path), "what is cut short is not kept"
    assert lock.read_bytes() == whole


# The whole pipeline on small parameters


BENCHMARK = "stages/dvc.yaml:run_benchmark"
UNTIMED = ("planner", "BiRRT")
"""Planners that no clock stops: asked again they give the same path."""
SECONDS_ALONE = "benchmark_training.json"
"""A report of `BENCHMARK`'s that has nothing which does not tell of the machine."""
LATEST = 100
"""Times that a stage may be done before it is killed: no kill that did not hit it is counted."""
BESIDE = pytest.mark.xdist_group("runs")
"""On the other worker: the kills of all stages take as long as the rest."""
OF_ALL, OF_BENCHMARK = (
    pytest.mark.parametrize("pair", [(name, stages)], ids=[name], indirect=True)
    for name, stages in (("kills", ()), ("benchmark", (BENCHMARK,)))
)
"""Of all of the root's stages, and of the benchmark with those that it hangs on."""


@dataclass(frozen=True)
class Pair:
    """Two checkouts: in one stages ran undisturbed, in the other they are disturbed."""

    folder: Path

    @property
    def whole(self) -> Path:
        return self.folder / "whole"

    @property
    def hurt(self) -> Path:
        return self.folder / "hurt"

    def kills(self) -> dict[str, int]:
        """Of each stage, so far."""
        file = self.folder / "kills.json"
        return json.loads(file.read_text()) if file.is_file() else {}

    def note(self, stage: str) -> None:
        kills = self.kills()
        write_text(self.folder / "kills.json", json.dumps(kills | {stage: kills.get(stage, 0) + 1}))


@pytest.fixture(scope="module")
def pair(
    tmp_path_factory: pytest.TempPathFactory, effort: Effort, request: pytest.FixtureRequest
) -> Pair:
    """`make soak` keeps them, of the same code, and goes on after an interruption."""
    name, stages = request.param
    folder = tmp_path_factory.mktemp(name)
    if effort == SOAK:
        files = ["--", ".", ":!reports"]  # which these tests write to
        told = [
            subprocess.run(["git", *words, *files], cwd=smoke.ROOT, capture_output=True).stdout
            for words in (["ls-files", "--stage"], ["diff"])
        ]
        key = hashlib.sha256(b"".join(told)).hexdigest()[:12]
        folder = smoke.ROOT / ".geodesics" / "soak" / f"{name}-{key}"
    made = Pair(folder)
    if not (folder / "made").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        for checkout in (made.whole, made.hurt):
            checkout.mkdir(parents=True)
            smoke.copy_checkout(checkout)
            smoke.shrink_params(checkout)
        undisturbed = smoke.dvc(made.whole, "repro", *stages)
        assert undisturbed.returncode == 0, undisturbed.stderr
        (folder / "made").touch()
    return made


def one_of_each(folder: Path) -> list[str]:
    """A stage of each kind, in the order in which they ran."""
    stages = yaml.safe_load((folder / "dvc.lock").read_text())["stages"]
    order = list(yaml.safe_load((folder / "dvc.yaml").read_text())["stages"])
    last = {name.partition("@")[0]: name for name in stages}
    return [last[kind] for kind in order if kind in last]


def repro(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "dvc", "repro", *words]
    pipes: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    environment = smoke.environment(folder)
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, start_new_session=True, **pipes
    )


def process_of(stage: str, dvc: subprocess.Popen[str]) -> psutil.Process | None:
    """The Python of a stage that DVC runs, as soon as there is one; None if DVC ends before."""
    while dvc.poll() is None:
        with suppress(psutil.Error):
            for child in psutil.Process(dvc.pid).children(recursive=True):
                if child.environ().get("DVC_STAGE") == stage and "python" in child.name():
                    return child
        time.sleep(0.02)
    return None


def kill_once(pair: Pair, stage: str, number: int) -> bool:
    """Kill a stage at a random moment; returns whether it was at work then."""
    rng = random.Random(f"{stage} {number}")
    script, *items = lock_of(pair.whole)[stage]["cmd"].split()[1:]
    times = pd.read_csv(pair.whole / "reports/stage_times.csv").set_index("stage")["seconds"]
    lasts = float(times[" ".join([Path(script).stem, *items])])
    done = stage in lock_of(pair.hurt)
    dvc = repro(pair.hurt, *(["--single-item", "--force"] if done else []), stage)
    process = process_of(stage, dvc)
    if process is None:
        raise AssertionError(f"{stage} did not begin: {dvc.communicate()[1]}")
    time.sleep(rng.uniform(0.0, lasts + 1.0))  # it also imports
    kill_now(process, dvc, number)
    return dvc.returncode != 0


def kill_now(process: psutil.Process, dvc: subprocess.Popen[str], number: int) -> None:
    """Kill a stage's process alone or, of every other number, with all of its group, DVC too."""
    with suppress(psutil.Error):
        if number % 2:
            process.kill()
        else:
            for one in (*process.children(recursive=True), process):
                one.kill()
            os.killpg(dvc.pid, signal.SIGKILL)
    dvc.communicate()


def lock_of(folder: Path) -> dict[str, Any]:
    """What DVC knows of each stage that ran."""
    file = folder / "dvc.lock"
    if not file.is_file():
        return {}
    if not is_whole(file):  # DVC itself was killed while it wrote
        assert recover_locks(folder)
    return yaml.safe_load(file.read_text())["stages"]


def differences(pair: Pair) -> list[str]:
    """Files of the disturbed checkout that are not what the undisturbed one has."""
    found = []
    for file in sorted((pair.whole / "reports").rglob("*.json")):
        name = file.relative_to(pair.whole)
        if name.name == SECONDS_ALONE:
            continue
        other = pair.hurt / name
        if not other.is_file() or timeless(json.loads(file.read_text())) != timeless(
            json.loads(other.read_text())
        ):
            found.append(str(name))
    for pattern in ("manifolds/*/*.safetensors", "policies/*/*.safetensors", "planner/*"):
        for file in sorted((pair.whole / "data").glob(pattern)):
            other = pair.hurt / file.relative_to(pair.whole)
            if not other.is_file() or other.read_bytes() != file.read_bytes():
                found.append(str(file.relative_to(pair.whole)))
    return found


def timeless(value: Any) -> Any:
    """Figures without what a clock or the machine says: RRT* gets further where nothing else
    runs.
    """
    if isinstance(value, dict):
        return {
            name: timeless(own)
            for name, own in value.items()
            if not re.search(r"((_s|_ms|seconds|memory_mb)(_mean|_std)?|machine)$|^rrt_star$", name)
        }
    return [timeless(own) for own in value] if isinstance(value, list) else value


@pytest.mark.long
@OF_ALL
@pytest.mark.timeout(12 * 3600)
def test_stages_that_are_killed_again_and_again_end_as_if_they_had_not(
    pair: Pair, effort: Effort
) -> None:
    with counting("kills", effort) as row:
        _kill_all(pair, effort)
        _recover(pair)
        last = smoke.dvc(pair.hurt, "repro")
        assert last.returncode == 0, last.stderr
        lost, found = differences(pair), statuses(pair.hurt)
        row["injected"] = sum(pair.kills().values())
        row["survived"] = row["injected"] if not lost else 0
        row["results_lost"] = len(lost)
        row["runs_left_running"] = sum(own.count("RUNNING") for own in found.values())
        assert not lost
        assert not row["runs_left_running"]
        # not the last of each: what is run again by force and killed before it wrote is still done
        assert all("FINISHED" in own for own in found.values())
        assert "Running stage" not in smoke.dvc(pair.hurt, "repro").stdout
        assert not left_runs(pair.hurt)


def _kill_all(pair: Pair, effort: Effort) -> None:
    """A stage of each kind, as often as asked for."""
    for stage in one_of_each(pair.whole):
        late = 0  # times that it was done by then
        while (done := pair.kills().get(stage, 0)) < effort.kills:
            if kill_once(pair, stage, done + late):
                pair.note(stage)
            else:
                late += 1
                assert late <= LATEST, f"{stage} was done {late} times before it was killed"


def _recover(pair: Pair) -> None:
    """From a dvc.lock that was cut short too, as DVC leaves it, killed while it writes."""
    cut = pair.hurt / "dvc.lock"
    keep = cut.read_bytes()
    cut.write_bytes(keep[: len(keep) * 2 // 3 + 7])
    recovered = subprocess.run(
        [sys.executable, "-m", "constraint_geodesics.cli", "recover"],
        cwd=pair.hurt,
        env=smoke.environment(pair.hurt),
        capture_output=True,
        text=True,
    )
    assert recovered.returncode == 0, recovered.stderr


def benchmark_rows(folder: Path) -> set[str]:
    """The lines of the rows that are there."""
    found = set()
    for file in (folder / "data/benchmark_rows").glob("*.jsonl"):
        for line in file.read_text().splitlines():
            with suppress(json.JSONDecodeError):  # killed while it was written
                if "status" in json.loads(line):
                    found.add(line)
    return found


@pytest.mark.long
@BESIDE
@OF_BENCHMARK
@pytest.mark.timeout(3600)
def test_a_benchmark_that_is_killed_keeps_its_rows_and_makes_the_others(
    pair: Pair, effort: Effort
) -> None:
    with counting("benchmark_kills", effort) as row:
        wanted = len(benchmark_rows(pair.whole))
        made = len(benchmark_rows(pair.hurt))
        if made == wanted:  # of a run that was ended after its last kill
            shutil.rmtree(pair.hurt / "data/benchmark_rows")
            made = 0
        # by what is done, not by time: each kill hits the run, and another part of the rows
        rng, part = random.Random(2), (wanted - made) / effort.kills
        moments = [made + int((k + rng.random()) * part) for k in range(effort.kills)]
        kept = set[str]()
        for number, moment in enumerate(moments):
            dvc = repro(pair.hurt, BENCHMARK)
            process = process_of(BENCHMARK, dvc)
            assert process is not None, dvc.communicate()[1]
            while len(benchmark_rows(pair.hurt)) < moment:
                assert dvc.poll() is None, dvc.communicate()[1]
                time.sleep(0.05)
            kill_now(process, dvc, number)
            assert dvc.returncode != 0
            recover_locks(pair.hurt)  # DVC itself may have been killed while it wrote
            kept |= benchmark_rows(pair.hurt)
        last = smoke.dvc(pair.hurt, "repro", BENCHMARK)
        assert last.returncode == 0, last.stderr
        lost = kept - benchmark_rows(pair.hurt)
        tables = [
            read_table(folder / "reports/benchmark.csv")[0].set_index(list(KEY)).sort_index()
            for folder in (pair.whole, pair.hurt)
        ]
        same = [table.loc[list(UNTIMED), ["valid", "length_rad"]] for table in tables]
        row |= {
            "injected": len(moments),
            "survived": len(moments) if not lost else 0,
            "rows": len(tables[1]),
            "rows_kept": len(kept),
            "rows_lost": len(lost),
        }
        assert not lost
        assert tables[0].index.equals(tables[1].index)
        pd.testing.assert_frame_equal(*same)
        assert "Running stage" not in smoke.dvc(pair.hurt, "repro", BENCHMARK).stdout
        assert not any("RUNNING" in own for own in statuses(pair.hurt).values())


@pytest.mark.long
@BESIDE
@OF_BENCHMARK
@pytest.mark.timeout(2000)  # `pair`, where no test before made it
def test_a_worker_that_dies_fails_its_stage_in_one_line_and_the_next_run_ends_it(
    pair: Pair,
) -> None:
    params = pair.hurt / "params.yaml"
    kept = params.read_text()
    params.write_text(kept.replace("workers: 1", "workers: 2"))
    try:
        dvc = repro(pair.hurt, "--single-item", "--force", "train_policies")
        stage, workers = process_of("train_policies", dvc), list[psutil.Process]()
        while not workers:
            assert dvc.poll() is None
            with suppress(psutil.Error):
                own = stage.children(recursive=True)
                workers = [
                    w
                    for w in own
                    if "joblib" in " ".join(w.cmdline()) and "popen_loky" in " ".join(w.cmdline())
                ]
        deadline = time.monotonic() + 300.0
        while workers[0].cpu_times().user < 0.5:  # it is at work
            assert dvc.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        workers[0].kill()
        said = dvc.communicate()[1]
        assert dvc.returncode != 0
        assert len([line for line in said.splitlines() if line.startswith("error: ")]) == 1
        assert "a worker process died" in said
        assert "Traceback" not in said
        again = smoke.dvc(pair.hurt, "repro", "train_policies")
        assert again.returncode == 0, again.stderr
    finally:
        params.write_text(kept)
    assert not differences(pair)


@pytest.mark.long
@BESIDE
@OF_BENCHMARK
@pytest.mark.timeout(2000)  # `pair`, where no test before made it
def test_two_runs_at_once_are_one_run(pair: Pair) -> None:
    stage = "train_manifold@planner"
    both = [repro(pair.hurt, "--single-item", "--force", stage) for _ in range(2)]
    said = [own.communicate()[1] for own in both]
    codes = sorted(own.returncode != 0 for own in both)
    assert codes in ([False, True], [False, False]), said
    words = [sys.executable, "stages/train_manifold.py", "planner"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    where: dict[str, Any] = {"cwd": pair.hurt, "env": smoke.environment(pair.hurt)}
    first = subprocess.Popen(words, **pipes, **where)
    while "RUNNING" not in statuses(pair.hurt)["train_manifold planner"]:
        assert first.poll() is None
    first.send_signal(signal.SIGSTOP)
    second = subprocess.Popen(words, **pipes, **where)
    said = second.communicate()[1]
    first.send_signal(signal.SIGCONT)
    assert second.returncode == 1
    *_, last = said.splitlines()  # before it stands what the stage is
    assert re.fullmatch(rf"error: .*process {first.pid} is at work on it already", last)
    assert "Traceback" not in said
    said = first.communicate()[1]
    assert first.returncode == 0, said
    assert not differences(pair)


@pytest.mark.long
@BESIDE
@OF_BENCHMARK
@pytest.mark.timeout(2000)  # `pair`, where no test before made it
def test_a_server_that_goes_in_the_middle_of_a_stage_fails_nothing(pair: Pair) -> None:
    own = pair.hurt
    environment = smoke.environment(own)
    command = ui_command(own, free_port())
    address = f"http://127.0.0.1:{command[command.index('--port') + 1]}"
    served = serving(command, address)
    words = [sys.executable, "stages/train_policies.py"]
    stage = subprocess.Popen(
        words,
        cwd=own,
        env=environment | {"MLFLOW_TRACKING_URI": address},
        stderr=subprocess.PIPE,
        text=True,
    )
    while "RUNNING" not in statuses(own).get("train_policies joint_space", []):
        assert stage.poll() is None
        time.sleep(0.1)
    os.killpg(served.pid, signal.SIGKILL)
    served.wait()
    said = stage.communicate()[1]
    assert stage.returncode == 0, said
    assert len([line for line in said.splitlines() if "geodesics recover" in line]) >= 1
    assert "Traceback" not in said
    served = serving(command, address)
    try:
        recovered = subprocess.run(
            [sys.executable, "-m", "constraint_geodesics.cli", "recover"],
            cwd=own,
            env=environment | {"MLFLOW_TRACKING_URI": address},
            capture_output=True,
            text=True,
        )
        assert "things that it had not taken" in recovered.stdout, recovered.stderr
    finally:
        os.killpg(served.pid, signal.SIGKILL)
        served.wait()
    found = statuses(own)
    assert not any("RUNNING" in each for each in found.values())
    assert found["train_policies joint_space"][-1] == "FINISHED"
    assert not differences(pair)


def serving(command: list[str], address: str) -> subprocess.Popen[bytes]:
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, start_new_session=True, **quiet)
    for _ in range(900):
        with suppress(OSError):
            urllib.request.urlopen(f"{address}/health")
            return process
        time.sleep(0.1)
    raise AssertionError("MLflow's server does not answer")
