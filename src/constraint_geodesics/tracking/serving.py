"""The registered planner over HTTP, as `geodesics serve` starts it: MLflow's scoring server behind
a door that lets in as many requests as may wait, and tells the others at once to come again.

MLflow's own command has no such door: what is too much waits in the queue of a thread pool, which
no model sees, until its client has given up.
"""

import asyncio
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from constraint_geodesics.bundle import open_bundle
from constraint_geodesics.tracking.store import (
    TrackingError,
    fetch_artifacts,
    mlflow_module,
    require_free,
)

RETRY_AFTER_S = 1
MOST_BYTES = 1_000_000
"""Of one request: some 3,000 queries, more than are answered in the minute that MLflow gives."""
SENT_WITHIN_S = 5.0
"""A request that comes more slowly is not waited for."""
WANTED_UNTIL = ContextVar("WANTED_UNTIL", default=math.inf)
"""When the client of the request that is answered here gets 504 from MLflow (`time.monotonic`):
what is answered later nobody reads."""
_MODEL, _WAITING = "GEODESICS_SERVED_MODEL", "GEODESICS_SERVED_WAITING"


@dataclass(frozen=True)
class Served:
    """host, port: where it listens.  workers: processes, each with a planner of its own.  waiting:
    requests that one worker has let in at most, the one that it answers among them.
    """

    host: str
    port: int
    workers: int
    waiting: int


class Door:
    """Lets `waiting` requests into an application; those beyond are answered 503 at once.

    A request must say how long it is, be no longer than MOST_BYTES, and be there SENT_WITHIN_S
    after its first line: 411, 413 and 408 otherwise.  It takes a place when it is there, so that
    nobody holds one by sending nothing.  Those that only look, as /ping, always get in.  timeout_s:
    for how long a client waits.
    """

    def __init__(self, app: ASGIApp, waiting: int, timeout_s: float) -> None:
        self._app, self._waiting, self._timeout_s, self._inside = app, waiting, timeout_s, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one message of the server's own, as ASGI has them."""
        if scope["type"] != "http" or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        found = await self._asked(scope, receive)
        if isinstance(found, JSONResponse):
            await found(scope, receive, send)
            return
        WANTED_UNTIL.set(time.monotonic() + self._timeout_s)
        self._inside += 1
        try:
            await self._app(scope, _after(found, receive), send)
        finally:
            self._inside -= 1

    async def _asked(self, scope: Scope, receive: Receive) -> Message | JSONResponse:
        """The whole request as one message, or why it is not let in."""
        refused = _unfit(dict(scope["headers"])) or self._busy()
        if refused is not None:
            return refused
        whole = await _whole(receive)
        if whole is None:
            return _refused(408, f"the request was not there within {SENT_WITHIN_S:g} s")
        return self._busy() or whole  # others may have come in since

    def _busy(self) -> JSONResponse | None:
        if self._inside < self._waiting:
            return None
        busy = f"{self._inside} requests wait already: ask again in {RETRY_AFTER_S} s"
        return _refused(503, busy, {"Retry-After": str(RETRY_AFTER_S)})


def _unfit(headers: Mapping[bytes, bytes]) -> JSONResponse | None:
    length = headers.get(b"content-length")
    if length is None or b"transfer-encoding" in headers:  # which would say another length
        return _refused(411, "the request must have a Content-Length, and no Transfer-Encoding")
    if int(length) > MOST_BYTES:
        return _refused(413, f"the request has {int(length)} bytes: at most {MOST_BYTES}")
    return None


async def _whole(receive: Receive) -> Message | None:
    """A request as one message; None where it does not come in time, or its client left."""
    body = bytearray()
    try:
        async with asyncio.timeout(SENT_WITHIN_S):
            while (message := await receive())["type"] == "http.request":
                body += message.get("body", b"")
                if not message.get("more_body", False):
                    return {"type": "http.request", "body": bytes(body), "more_body": False}
    except TimeoutError:
        pass
    return None


def _after(whole: Message, receive: Receive) -> Receive:
    """What gives a whole request first."""
    left = [whole]

    async def next_message() -> Message:
        return left.pop() if left else await receive()

    return next_message


def _refused(status: int, message: str, headers: dict[str, str] | None = None) -> JSONResponse:
    # the rest of what is sent is not read: no other request can follow on this connection
    closing = {"Connection": "close"} if status != 503 else {}
    return JSONResponse({"message": message}, status, {**closing, **(headers or {})})


def app() -> Door:
    """What each worker process runs."""
    mlflow_module()
    from mlflow import pyfunc
    from mlflow.environment_variables import MLFLOW_SCORING_SERVER_REQUEST_TIMEOUT
    from mlflow.pyfunc import scoring_server

    model = pyfunc.load_model(os.environ[_MODEL])
    timeout_s = MLFLOW_SCORING_SERVER_REQUEST_TIMEOUT.get()
    return Door(scoring_server.init(model), int(os.environ[_WAITING]), timeout_s)


def serve(address: str, root: Path, served: Served, tell: Callable[[], None]) -> None:
    """Answer requests with a registered planner until this process is told to stop.

    address: models:/… in the store of the checkout at `root`.  tell: called when nothing stands
    against it, before planners are loaded.
    Raises TrackingError if the store has no such planner or nobody can listen there, BundleError if
    its files are altered.
    """
    require_free(served.port, served.host)
    # uvicorn ends with the signal that stopped it: files that were fetched must go before that
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with fetch_artifacts(address, root) as files:
        model = files.parent.parent
        if not (model / "MLmodel").is_file():
            raise TrackingError(f"{address}: no registered planner, as models:/NAME@ALIAS")
        open_bundle(files)  # here it is one line, in a worker it would be a traceback
        os.environ.update({_MODEL: str(model), _WAITING: str(served.waiting)})
        tell()
        uvicorn.run(
            f"{__name__}:{app.__name__}",
            factory=True,
            host=served.host,
            port=served.port,
            workers=served.workers,
            log_level="warning",
        )
