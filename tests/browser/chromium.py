"""A headless Chromium that reaches this machine's own pages and files alone: `python
tests/browser/chromium.py` makes sure that there is one.

The system's browser is driven; Playwright's own downloads are never asked for.
"""

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page, Request, Route, WebSocket

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HERE = "http://127.0.0.1:"
ROOT = Path(__file__).resolve().parents[2]
FLAGS = (
    # WebGL without a graphics card
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # no name is looked up, whoever asks: what is let through by mistake fails here
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)
PATIENCE_S = 90


@dataclass
class Traffic:
    """What a page asked for beyond this machine, none of it let through, and the errors it
    reported.
    """

    outside: list[str] = field(default_factory=list)
    local: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def note(self, url: str) -> bool:
        """Keep an address that was asked for; whether it is one of this machine."""
        is_local = url.startswith((HERE, "ws://127.0.0.1:", "file:", "data:", "blob:"))
        (self.local if is_local else self.outside).append(url)
        return is_local

    def note_socket(self, opened: "WebSocket") -> None:
        """Sockets are not routed as requests are; the browser's own rule keeps them from going
        anywhere.
        """
        self.note(opened.url)


def program() -> str | None:
    """The system's Chromium."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


def missing() -> str:
    """What a browser test lacks, or nothing."""
    if not os.environ.get("GEODESICS_BROWSER"):
        return "a browser's tests run by `make test-browser` (or with GEODESICS_BROWSER=1)"
    if importlib.util.find_spec("playwright") is None:
        return "Playwright is not installed: run `make test-browser`"
    return "" if program() else f"no browser: install one of {', '.join(PROGRAMS)}"


@contextlib.contextmanager
def chromium() -> "Iterator[Browser]":
    """The browser, closed when the context ends."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program(), args=list(FLAGS))
        yield browser
        browser.close()


@contextlib.contextmanager
def visit(browser: "Browser", **options: Any) -> "Iterator[tuple[Page, Traffic]]":
    """A page in a context of its own, with what it asks for; options are those of Playwright's
    contexts.
    """
    traffic = Traffic()
    context = browser.new_context(**options)
    context.set_default_timeout(1e3 * PATIENCE_S)
    _guard(context, traffic)
    page = context.new_page()
    page.on("pageerror", lambda error: traffic.errors.append(str(error)))
    page.on(
        "console",
        lambda message: traffic.errors.append(message.text) if message.type == "error" else None,
    )
    page.on("websocket", traffic.note_socket)
    yield page, traffic
    context.close()


def _guard(context: "BrowserContext", traffic: Traffic) -> None:
    def decide(route: "Route", request: "Request") -> None:
        route.continue_() if traffic.note(request.url) else route.abort()

    context.route("**/*", decide)


@contextlib.contextmanager
def served(
    command: Sequence[str], folder: Path, environment: Mapping[str, str] | None = None
) -> Iterator[str]:
    """The address that a command prints when it starts a server, once it answers; the server ends
    with the context.

    Raises RuntimeError with what the command said if it ends instead.
    """
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=dict(environment or os.environ),
            start_new_session=True,
            stdout=said,
            stderr=subprocess.STDOUT,
        )
        try:
            until(lambda: _answers(_address(process, said)), "the server's address answers")
            yield _address(process, said)
        finally:
            with contextlib.suppress(ProcessLookupError):  # the viewer is a child of the command
                os.killpg(process.pid, signal.SIGTERM)
            process.wait(timeout=PATIENCE_S)


def _address(process: "subprocess.Popen[bytes]", said: IO[str]) -> str:
    said.seek(0)
    text = said.read()
    if process.poll() is not None:
        raise RuntimeError(f"no server: {text.strip()[-500:]}")
    return next((word for word in text.split() if word.startswith(HERE)), "")


def _answers(address: str) -> bool:
    if not address:
        return False
    try:
        with urllib.request.urlopen(address.partition("?")[0], timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def free_port() -> int:
    """A port of this machine that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(holds: Any, what: str, every_s: float = 0.5) -> None:
    """Wait for something that a page does without telling.  Raises AssertionError, saying what did
    not happen.
    """
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, f"within {PATIENCE_S} s: {what}"
        time.sleep(every_s)


def main() -> int:
    """Install the browser where that can be done."""
    if program():
        return 0
    if os.geteuid() == 0 and shutil.which("apt-get"):
        for command in (["apt-get", "update"], ["apt-get", "install", "--yes", "chromium"]):
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    if program():
        return 0
    print(f"error: there is no browser: install one of {', '.join(PROGRAMS)}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    raise SystemExit(main())
