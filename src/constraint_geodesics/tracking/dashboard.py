"""The dashboard's server beside a browser that opens it."""

import contextlib
import signal
import subprocess
import time
import urllib.request
import webbrowser
from collections.abc import Sequence

STARTS_S = 300.0
"""Time that the server is given to answer."""


def serve_and_open(command: Sequence[str], page: str) -> int:
    """Run a server until it ends, and open a page of it in the browser once it answers; returns its
    exit code.

    Who stops this process stops the server.
    """
    server = subprocess.Popen(command)
    before = signal.signal(signal.SIGTERM, lambda *_: server.terminate())
    try:
        if _answers(server, page.partition("#")[0]):
            webbrowser.open(page)
        code = server.wait()
    except KeyboardInterrupt:  # the terminal has told the server as well
        code = server.wait()
    finally:
        signal.signal(signal.SIGTERM, before)
    return code if code >= 0 else 128 - code


def _answers(server: "subprocess.Popen[bytes]", address: str) -> bool:
    deadline = time.monotonic() + STARTS_S
    # this machine's own address: a proxy that the user has set would be asked outside
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    while server.poll() is None and time.monotonic() < deadline:
        with contextlib.suppress(OSError), direct.open(address, timeout=5):
            return True
        time.sleep(0.2)
    return False
