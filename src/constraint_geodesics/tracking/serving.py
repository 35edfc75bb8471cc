"""The registered planner over HTTP, as `geodesics serve` starts it: MLflow's scoring server behind
a door that lets in as many requests as may wait, and tells the others at once to come again.

MLflow's own command has no such door: what is too much waits in the queue of a thread pool, which
no model sees, until its client has given up.
"""

import math
import os
import signal
import sys
import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.tracking.store import (
    TrackingError,
    fetch_artifacts,
    mlflow_module,
    require_free,
)

RETRY_AFTER_S = 1
MOST_BYTES = 1_000_000
"""Of one request: some 3,000 queries."""
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
    """Lets `waiting` requests into an application; those beyond are answered 503 at once, unread.

    A request must say how long it is, and be no longer than MOST_BYTES: 411 and 413 otherwise.
    Those that only look, as /ping, always get in.  timeout_s: for how long a client waits.
    """

    def __init__(self, app: ASGIApp, waiting: int, timeout_s: float) -> None:
        self._app, self._waiting, self._timeout_s, self._inside = app, waiting, timeout_s, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one message of the server's own, as ASGI has them."""
        if scope["type"] != "http" or scope["method"] != "POST":
            await self._app(scope, receive, send)
            return
        refused = self._refusal(dict(scope["headers"]).get(b"content-length"))
        if refused is not None:
            await refused(scope, receive, send)
            return
        WANTED_UNTIL.set(time.monotonic() + self._timeout_s)
        self._inside += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._inside -= 1

    def _refusal(self, length: bytes | None) -> JSONResponse | None:
        if length is None:
            return _refused(411, "the request must have a Content-Length")
        if int(length) > MOST_BYTES:
            return _refused(413, f"the request has {int(length)} bytes: at most {MOST_BYTES}")
        if self._inside >= self._waiting:
            busy = f"{self._inside} requests wait already: ask again in {RETRY_AFTER_S} s"
            return _refused(503, busy, {"Retry-After": str(RETRY_AFTER_S)})
        return None


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
        read_bundle(files)  # here it is one line, in a worker it would be a traceback
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
