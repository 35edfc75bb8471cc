"""Rerun's viewer: recordings shown in a window or a local browser, or put together in one file."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import rerun as rr

from constraint_geodesics.recording.overlay import Opened, opened, overlaid, side_by_side
from constraint_geodesics.recording.recording import (
    APPLICATION,
    RecordingError,
    existing,
    rerun_command,
    write_recording,
)
from constraint_geodesics.text_files import written

LOOPBACK = "127.0.0.1"
VIEWER_PORT, WEB_PORT = 9876, 9090
STARTS_S = 20.0
"""Time that a viewer is given to start."""


def open_recordings(
    files: Sequence[Path], *, web: bool, apart: bool = False, web_port: int = WEB_PORT
) -> int:
    """Show recordings until the viewer is closed, in a window or (web) served to a browser on this
    machine alone.

    Several paths of one constraint are laid over each other, or each has a view of its own (apart);
    several executed paths are shown side by side; paths of several constraints are opened each by
    itself.  Prints the address to open.  Returns the viewer's exit code.  Raises RecordingError if
    a file is missing or is no recording, if what is asked for can't be shown together, or if there
    is no display for a window.
    """
    for file in files:
        existing(file)
    _require_display(web)
    with _stopped_like_interrupted(), tempfile.TemporaryDirectory(prefix="geodesics-") as folder:
        shown = [str(file) for file in prepared(files, Path(folder), apart=apart)]
        environment = _without_reports(Path(folder))
        options, _ = _announced(web=web, web_port=web_port)
        return subprocess.call(rerun_command(*options, *shown), env=environment)


@contextlib.contextmanager
def live_viewer(*, web: bool) -> Iterator[rr.RecordingStream]:
    """A stream that a viewer shows while it is written, in a window or (web) served to a browser on
    this machine alone; the viewer stays until it is closed.

    Prints the address to open.  Raises RecordingError if there is no display for a window, or the
    viewer does not start.
    """
    _require_display(web)
    with _stopped_like_interrupted(), tempfile.TemporaryDirectory(prefix="geodesics-") as folder:
        environment = _without_reports(Path(folder))
        options, port = _announced(web=web, web_port=WEB_PORT)
        # a session of its own, so that it can be ended with the viewer that it starts
        viewer = subprocess.Popen(
            rerun_command(*options),
            stdin=subprocess.DEVNULL,
            env={"RUST_LOG": "warn", **environment},
            start_new_session=True,
        )
        try:
            _wait_for(viewer, port)
            stream = rr.RecordingStream(APPLICATION)
            stream.connect_grpc(f"rerun+http://{LOOPBACK}:{port}/proxy")
            yield stream
            stream.flush()
            stream.disconnect()  # or it would complain of a viewer that is closed
            viewer.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGTERM)
            viewer.wait()


def _announced(*, web: bool, web_port: int) -> tuple[list[str], int]:
    """Options of a viewer that listens on this machine alone, and its port; the address to open is
    printed.
    """
    port, page = _free_port(VIEWER_PORT), _free_port(web_port)
    # without --bind the viewer listens on every address, the window's one too
    options = ["--bind", LOOPBACK, "--port", str(port)]
    source = f"http://{LOOPBACK}:{port}/proxy"
    if web:
        options += ["--serve-web", "--web-viewer-port", str(page)]
    web_page = f"http://{LOOPBACK}:{page}?url=rerun%2B{source}"
    print(web_page if web else f"rerun+{source}", flush=True)
    return options, port


def _without_reports(folder: Path) -> dict[str, str]:
    """The environment of a viewer that does not report how it is used.  Rerun has a setting for a
    user alone: this start has a settings' folder of its own.
    """
    environment = {**os.environ, "XDG_CONFIG_HOME": str(folder / "settings")}
    # where it failed, the viewer would hold this for its first start, which reports nothing
    subprocess.run(
        rerun_command("analytics", "disable"), env=environment, capture_output=True, check=False
    )
    return environment


def _wait_for(viewer: "subprocess.Popen[bytes]", port: int) -> None:
    """Until the viewer listens: what is sent before would be held back for seconds."""
    deadline = time.monotonic() + STARTS_S
    while viewer.poll() is None and time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), 1.0):
            return
        time.sleep(0.1)
    raise RecordingError("Rerun's viewer does not start: `python -m rerun` says why")


def _require_display(web: bool) -> None:
    if not web and not display():
        none = "there is no display for Rerun's window"
        raise RecordingError(f"{none}: add --web to open it in a browser")


def save_recordings(files: Sequence[Path], out: Path, *, apart: bool = False) -> None:
    """Write what `open_recordings` would show as one file that holds its meshes.

    Raises RecordingError as that does, and for what it would open as several recordings.
    """
    with tempfile.TemporaryDirectory(prefix="geodesics-") as folder:
        shown = prepared(files, Path(folder), apart=apart)
        if len(shown) > 1:
            several = "paths of several constraints can't be saved as one recording"
            raise RecordingError(f"{several}: add --side-by-side")
        with written(out) as part:
            shutil.copyfile(shown[0], part)


def prepared(files: Sequence[Path], folder: Path, *, apart: bool) -> list[Path]:
    """The files to open, one for each recording that the viewer lists; what is made for them goes
    to the folder.
    """
    sources = [opened(file) for file in files]
    apart = apart or any(source.about.executed for source in sources)
    if len(sources) > 1 and (apart or len({source.about.constraint for source in sources}) == 1):
        one = side_by_side(sources) if apart else overlaid(sources)
        file = folder / "together.rrd"
        write_recording(file, one.recording_id, one.name, one.chunks, one.blueprint)
        return [file]
    return [_with_meshes(source, folder / f"{k}.rrd") for k, source in enumerate(sources)]


def _with_meshes(source: Opened, file: Path) -> Path:
    """A recording as it is, or with the meshes that it lacks."""
    if not source.added:
        return source.file
    meshes = file.with_suffix(".meshes.rrd")
    write_recording(meshes, source.recording_id, "", source.added)
    merge = rerun_command("rrd", "merge", str(source.file), str(meshes))
    with file.open("wb") as whole:
        # one file: the viewer arranges what it sees first, and would not take the second one's
        # blueprint
        done = subprocess.run(merge, stdout=whole, stderr=subprocess.PIPE, check=False)
    if done.returncode:
        why = " ".join(done.stderr.decode(errors="replace").split())[-200:]
        raise RecordingError(f"{source.file}: Rerun can't add its meshes: {why}")
    return file


def display() -> bool:
    """Whether a window can be opened."""
    named = (os.environ.get(name) for name in ("WAYLAND_DISPLAY", "DISPLAY"))
    return not sys.platform.startswith("linux") or any(named)


@contextlib.contextmanager
def _stopped_like_interrupted() -> Iterator[None]:
    """Whoever ends this process ends the viewer with it, and what was written for it goes."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _free_port(preferred: int) -> int:
    """The preferred port of this machine, or another if it is taken."""
    for port in (preferred, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((LOOPBACK, port))
            return int(probe.getsockname()[1])
    raise RecordingError("there is no free port on this machine")
