"""One answer wherever the work runs, and one line where it can't."""

import io
import logging
import os
import pty
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import ShardTask, draw_shard, shard_tasks
from constraint_geodesics.params import ComputeParams, Params
from constraint_geodesics.pipeline import compute
from constraint_geodesics.pipeline.compute import ComputeError, as_finished, parallel_map
from constraint_geodesics.pipeline.threads import ONE_THREAD
from constraint_geodesics.progress import progress, waiting
from constraint_geodesics.scene.scene import Scene
from tests.pipeline.cluster import DEAD, cluster

TWO = ComputeParams(backend="loky", workers=2)
ONE = ComputeParams(backend="loky", workers=1)
SEEDS = range(6)


def products(seed: int) -> tuple[float, float, float]:
    """Sums whose last bits depend on how many threads share them; the first items take longest."""
    time.sleep(0.2 / (1 + seed))
    values = np.random.default_rng(seed).normal(size=(400, 400))
    single = torch.from_numpy(values.astype(np.float32))
    return float((values @ values).sum()), float((single @ single).sum()), float(single.sum())


def threads(_: int) -> tuple[int, set[int]]:
    return torch.get_num_threads(), {pool["num_threads"] for pool in threadpool_info()}


def first_waits_for_word(file: Path) -> str:
    """The first task ends when it is told that the others' results have arrived."""
    for _ in range(6000 if file.name == "0" else 0):
        if file.with_name("go").is_file():
            break
        time.sleep(0.01)
    return file.name


def touch(file: Path) -> None:
    file.touch()


def fail_at_three(item: int) -> int:
    if item == 3:
        raise ValueError("no\nsolution")
    return item


def die_at_three(item: int) -> int:
    if item == 3:
        os._exit(DEAD)
    return item


def overwrite(values: np.ndarray) -> float:
    values[0] = 1.0
    return float(values.sum())


@pytest.fixture(scope="module")
def dask(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ComputeParams]:
    """A real scheduler with two workers, on loopback."""
    with cluster(tmp_path_factory.mktemp("dask")) as machines:
        yield machines.compute


def test_results_are_those_of_a_plain_loop_in_its_order() -> None:
    def square(item: int) -> int:
        time.sleep(0.1 if item == 0 else 0)
        return item * item

    for settings in (ONE, TWO, ComputeParams(backend="loky", workers=0)):
        assert parallel_map(square, range(7), settings) == [0, 1, 4, 9, 16, 25, 36]
    assert parallel_map(square, [], TWO) == []


def test_results_are_there_as_soon_as_they_are_finished(dask: ComputeParams, tmp_path) -> None:
    for settings in (TWO, dask):
        folder = tmp_path / settings.backend
        folder.mkdir()
        files = [folder / str(k) for k in range(4)]
        found = []
        for outcome in as_finished(first_waits_for_word, files, settings):
            found.append(outcome)
            if len(found) == 3:
                (folder / "go").touch()
        assert found[-1] == (0, "0"), "the others' results came while the first was at work"
        assert sorted(found) == [(k, str(k)) for k in range(4)]
    assert list(as_finished(touch, [tmp_path / "a", tmp_path / "b"], ONE)) == [(0, None), (1, None)]
    assert list(as_finished(touch, [], TWO)) == []


def test_what_is_no_longer_wanted_is_not_begun(tmp_path: Path) -> None:
    items = [tmp_path / str(k) for k in range(50)]
    outcomes = as_finished(touch, items, ONE)
    next(outcomes)
    outcomes.close()
    assert [file.name for file in tmp_path.iterdir()] == ["0"]


def test_dask_loky_and_this_process_give_the_same_bits(dask: ComputeParams) -> None:
    expected = parallel_map(products, SEEDS, ONE)
    assert parallel_map(products, SEEDS, TWO) == expected
    assert parallel_map(products, SEEDS, dask) == expected


def test_a_stages_own_tasks_run_on_dask_as_on_loky(
    dask: ComputeParams, scene: Scene, params: Params
) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    tasks = shard_tasks(ShardTask(scene, manifold, 200, (1,)), 100)
    for ours, theirs in zip(
        parallel_map(draw_shard, tasks, TWO), parallel_map(draw_shard, tasks, dask), strict=True
    ):
        assert ours.frame.equals(theirs.frame)


def test_dask_leaves_nothing_behind(dask: ComputeParams) -> None:
    parallel_map(fail_at_three, [1, 2], dask)
    before = {thread.ident for thread in threading.enumerate()}
    parallel_map(fail_at_three, [1, 2], dask)
    names = [thread.name for thread in threading.enumerate() if thread.ident not in before]
    assert not [name for name in names if "Profile" in name or "IO loop" in name], names


def test_a_task_has_one_thread_everywhere(dask: ComputeParams) -> None:
    before = torch.get_num_threads()
    environment = dict(os.environ)
    torch.set_num_threads(2)
    try:
        for settings in (ONE, TWO, dask):
            assert parallel_map(threads, [1, 2], settings) == [(1, {1}), (1, {1})], settings
        assert torch.get_num_threads() == 2
        assert dict(os.environ) == environment
    finally:
        torch.set_num_threads(before)


def test_large_arrays_arrive_writable() -> None:
    items = [np.zeros(400_000), np.zeros(400_000)]  # above joblib's limit for sharing memory
    assert parallel_map(overwrite, items, TWO) == [1.0, 1.0]


def test_workers_are_where_the_caller_is(
    dask: ComputeParams, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files that a task names from there must not be written elsewhere."""
    for settings in (TWO, dask):
        for name in ("before", "now"):
            folder = tmp_path / settings.backend / name
            folder.mkdir(parents=True)
            monkeypatch.chdir(folder)
            parallel_map(touch, [Path("0"), Path("1")], settings)
            assert {file.name for file in folder.iterdir()} == {"0", "1"}
    monkeypatch.setattr(os, "getcwd", lambda: "/on/no/other/machine")
    with pytest.raises(ComputeError, match="touch: the Dask worker on .* does not see /on/no"):
        parallel_map(touch, [Path("0"), Path("1")], dask)


def test_the_failing_item_is_named_in_one_line(dask: ComputeParams) -> None:
    for settings in (ONE, TWO, dask):
        with pytest.raises(ComputeError) as caught:
            parallel_map(fail_at_three, [1, 2, 3, 4], settings, description="label free")
        assert str(caught.value) == "label free, item 2 (3): ValueError: no solution"


def test_a_worker_that_dies_is_an_error_not_a_wait(dask: ComputeParams) -> None:
    for settings in (TWO, dask):
        with pytest.raises(ComputeError, match="died") as caught:
            parallel_map(die_at_three, [1, 2, 3, 4], settings)
        assert "\n" not in str(caught.value)


def test_a_scheduler_that_is_killed_is_one_line(tmp_path: Path) -> None:
    logged, handler = list[logging.LogRecord](), logging.Handler()
    handler.emit = logged.append
    logging.getLogger("distributed").addHandler(handler)
    with cluster(tmp_path, workers=1) as machines:
        outcomes = as_finished(time.sleep, [0.2] * 20, machines.compute)
        next(outcomes)
        machines.scheduler.kill()
        began = time.monotonic()
        with pytest.raises(ComputeError, match="sleep: lost the Dask scheduler at tcp") as caught:
            list(outcomes)
        assert time.monotonic() - began < 20
    logging.getLogger("distributed").removeHandler(handler)
    assert "\n" not in str(caught.value)
    assert not logged, "a traceback beside it"


def test_a_worker_with_several_threads_is_refused(tmp_path: Path) -> None:
    """Seeds that run together would draw from one generator."""
    with (
        cluster(tmp_path, workers=1, threads=2) as machines,
        pytest.raises(ComputeError, match="start it with --nthreads 1") as caught,
    ):
        parallel_map(abs, [1, 2], machines.compute)
    assert "\n" not in str(caught.value)


def test_workers_do_not_outlive_a_killed_run(tmp_path: Path) -> None:
    """They would go on with the run's items beside the one that continues it."""
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from constraint_geodesics.pipeline.compute import parallel_map\n"
        "from constraint_geodesics.params import ComputeParams\n"
        "def wait(item):\n"
        "    (Path(sys.argv[1]) / f'{item}-{os.getpid()}').touch()\n"
        "    time.sleep(60)\n"
        "parallel_map(wait, [0, 1], ComputeParams(backend='loky', workers=2))\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    began = time.monotonic()
    while len(list(tmp_path.iterdir())) < 2 and time.monotonic() - began < 60:
        time.sleep(0.1)
    workers = [int(file.name.split("-")[1]) for file in tmp_path.iterdir()]
    assert len(workers) == 2
    run.kill()
    run.wait()
    while any(_runs(worker) for worker in workers) and time.monotonic() - began < 90:
        time.sleep(0.1)
    assert not any(_runs(worker) for worker in workers)


def _runs(process: int) -> bool:
    state = Path(f"/proc/{process}/stat")
    return state.is_file() and state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://127.0.0.1:1"])
def test_a_bad_address_is_one_line_within_seconds(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compute, "DASK_CONNECT_S", 1)
    start = time.monotonic()
    with pytest.raises(ComputeError) as caught:
        parallel_map(
            fail_at_three, [1, 2], ComputeParams(backend="dask", workers=0, dask_address=address)
        )
    assert time.monotonic() - start < 25, "Dask itself waits for 30 s"
    assert address in str(caught.value)
    assert "\n" not in str(caught.value)


def test_progress_in_a_log_is_a_line_a_quarter(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CI", raising=False)
    parallel_map(abs, range(8), ONE, description="label free")
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [
        f"label free: {done}/8" for done in (2, 4, 6, 8)
    ]
    assert all(" left" in line for line in lines[:-1])
    monkeypatch.setenv("CI", "true")
    parallel_map(abs, range(8), ONE, description="label free")
    assert [line.split(",")[0] for line in capfd.readouterr().err.splitlines()] == [
        "label free: 8/8"
    ]
    parallel_map(abs, range(8), ONE)
    assert capfd.readouterr().err == ""


def on_a_terminal(program: str) -> str:
    """What a program's standard error shows on a terminal."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    subprocess.run([sys.executable, "-c", program], stderr=theirs, env=environment, check=True)
    os.close(theirs)
    shown = os.read(ours, 100_000).decode()
    os.close(ours)
    return shown


def test_progress_on_a_terminal_is_a_bar() -> None:
    program = (
        "from constraint_geodesics.pipeline.compute import parallel_map\n"
        "from constraint_geodesics.params import ComputeParams\n"
        "parallel_map(abs, [1, 2], ComputeParams(backend='loky', workers=1), "
        "description='label [free]')\n"
    )
    shown = on_a_terminal(program)
    assert "label [free]" in shown
    assert "━" in shown
    assert "2/2" in shown


class Cell(io.StringIO):
    """Standard error of a notebook's cell, as Jupyter's kernel calls it."""


Cell.__module__ = "ipykernel.iostream"


def test_progress_in_a_notebook_is_a_bar_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Cell())
    monkeypatch.setattr("constraint_geodesics.progress.CELL_EVERY_S", 0.0)
    with progress("label [free]", 4) as advance:
        for _ in range(4):
            advance()
    shown = sys.stderr.getvalue()
    assert shown.count("\n") == 1
    assert shown.endswith("\n")
    lines = [line.strip() for line in shown.split("\r")[1:]]
    assert [re.search(r" (\d)/4", line)[1] for line in lines] == list("01234")
    assert [line.count("━") for line in lines] == [0, 7, 15, 22, 30]
    assert all(line.startswith("label [free] ") for line in lines)
    assert "took" in lines[-1]


def test_waiting_in_a_log_or_a_notebook_is_one_line_where_it_is_long(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with waiting("loading the planner"):
        pass
    assert capfd.readouterr() == ("", "")
    monkeypatch.setattr("constraint_geodesics.progress.LINE_AFTER_S", 0.05)
    for description, line in (("loading [it]", "loading [it] …\n"), ("", "")):
        with waiting(description):
            time.sleep(0.3)
        assert capfd.readouterr() == ("", line)


def test_waiting_on_a_terminal_gives_way_to_a_bar() -> None:
    program = (
        "from constraint_geodesics.progress import progress, waiting\n"
        "with waiting('loading [it]'):\n"
        "    with progress('a bar within', 2) as advance:\n"
        "        advance(); advance()\n"
    )
    shown = on_a_terminal(program)
    assert "loading [it]" in shown
    before, bar = shown.split("a bar within", 1)
    assert "loading [it]" in before
    assert "loading [it]" not in bar.split("2/2")[0], "it gives way to the bar"


def test_waiting_on_a_terminal_gives_way_to_another() -> None:
    program = (
        "import time\n"
        "from constraint_geodesics.progress import waiting\n"
        "with waiting('the planner'):\n"
        "    with waiting('its arm'):\n"
        "        time.sleep(0.2)\n"
        "    time.sleep(0.2)\n"
    )
    before, within = on_a_terminal(program).split("its arm", 1)
    assert "the planner" in before
    inner, after = within.rsplit("its arm", 1)
    assert "the planner" not in inner
    assert "the planner" in after


STAGE = """
import numpy as np, torch
from threadpoolctl import threadpool_info
from constraint_geodesics.pipeline import stage

def main(params, layout):
    values = np.random.default_rng(0).normal(size=(700, 700))
    single = torch.from_numpy(values.astype(np.float32))
    sums = (values @ values).sum(), (single @ single).sum(), single.sum()
    print(repr([float(value) for value in sums]))
    print(torch.get_num_threads(), {pool["num_threads"] for pool in threadpool_info()})

stage.note_stage_time = lambda *_: None
stage.run_stage(main, [])
"""


def test_a_stage_computes_the_same_whatever_number_of_threads_it_is_started_with() -> None:
    """`make` sets one; a bare `dvc repro` leaves it to the machine."""
    answers = set()
    for number in ("1", "2", ""):
        environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
        environment |= {"OMP_NUM_THREADS": number, "MKL_NUM_THREADS": number} if number else {}
        command = [sys.executable, "-c", STAGE]
        root = Path(__file__).parents[2]
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, check=True
        )
        answers.add(done.stdout)
    assert len(answers) == 1
    assert answers.pop().splitlines()[1] == "1 {1}"
