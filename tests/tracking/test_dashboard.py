"""`geodesics ui` opens the runs in a browser, a real server's page, and ends it with itself."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from tests.ports import free_port

from constraint_geodesics.tracking.dashboard import serve_and_open
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STARTS_S = 300


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "params.yaml").touch()
    with tracked_stage(Work("train", "cup"), "own", tmp_path):
        pass
    return tmp_path


@pytest.fixture
def browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the browser of this environment was told to open, a line each."""
    opened, script = tmp_path / "opened.txt", tmp_path / "browser"
    script.write_text(f'#!/bin/sh\necho "$1" >> {opened}\n')
    script.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(script))
    return opened


def test_the_printed_page_is_opened_once_it_answers_and_the_server_ends_with_the_command(
    checkout: Path, browser: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # which nobody is to ask
    monkeypatch.delenv("no_proxy", raising=False)
    words = ["-m", "constraint_geodesics.cli", "ui", "--open", "--port", str(port)]
    process = subprocess.Popen(
        [sys.executable, *words], cwd=checkout, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    page = process.stdout.readline().split()[0]
    try:
        deadline = time.monotonic() + STARTS_S
        while not browser.is_file() and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.2)
        assert browser.read_text().split() == [page]
        assert "/runs?workflowType=machine_learning" in page  # no view finds such a run
        monkeypatch.delenv("http_proxy")
        assert urllib.request.urlopen(page, timeout=10).status == 200
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", port))  # the server is gone


def test_a_server_that_ends_at_once_opens_nothing_and_its_code_is_the_answer(browser: Path) -> None:
    ends = [sys.executable, "-c", "raise SystemExit(3)"]
    assert serve_and_open(ends, f"http://127.0.0.1:{free_port()}/#/runs") == 3
    killed = [sys.executable, "-c", "import os; os.kill(os.getpid(), 15)"]
    assert serve_and_open(killed, f"http://127.0.0.1:{free_port()}/#/runs") == 143
    assert not browser.exists()


@pytest.mark.parametrize("options", [("--no-open",), ("--json",), ()])
def test_nothing_is_opened_where_it_is_not_wanted_or_there_is_no_desktop(
    options: tuple[str, ...], checkout: Path, browser: Path
) -> None:
    port = free_port()
    words = ["-m", "constraint_geodesics.cli", "ui", *options, "--port", str(port)]
    known = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    if options:
        known["DISPLAY"] = ":0"
    log = checkout / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, *words],
            cwd=checkout,
            env=known,
            stdout=subprocess.PIPE,
            stderr=output,
            text=True,
        )
    try:
        assert process.stdout is not None
        assert f"http://127.0.0.1:{port}/#/" in process.stdout.readline()
        deadline = time.monotonic() + STARTS_S
        while True:
            assert process.poll() is None, log.read_text()
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5)
                break
            except OSError:
                assert time.monotonic() < deadline, log.read_text()
                time.sleep(0.2)
        time.sleep(1.0)
        assert not browser.exists()
    finally:
        process.terminate()
        process.wait(30)
