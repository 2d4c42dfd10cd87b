"""Server of `spn-data report --serve`: the page and the state of one area, for this machine only."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock

from spn_data.area.area import Area
from spn_data.area.names import REPORT
from spn_data.errors import InputError
from spn_data.pipeline.live_state import LiveState, read_state
from spn_data.report.live import live_page

LOOPBACK = "127.0.0.1"
_HTML, _JSON, _TEXT = "text/html; charset=utf-8", "application/json", "text/plain; charset=utf-8"
_LIVE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "frame-src 'self'; frame-ancestors 'none'"
)
_TIMEOUT_S = 30.0

# What is served at a path: the kind of content and the content; None if there is none at the moment.
Answers = dict[str, tuple[str, Callable[[], bytes | None]]]


class AreaServer(ThreadingHTTPServer):
    """Server of an area that listens on the loopback interface only.

    Raises InputError if the port cannot be used; port 0 takes a free one.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, area: Area, port: int) -> None:
        page, report, lock = live_page(), area.root / REPORT, Lock()
        live = LiveState(area)

        def state() -> bytes:
            with lock:
                return json.dumps(read_state(live), allow_nan=False).encode()

        self.answers: Answers = {
            "/": (_HTML, lambda: page),
            "/report.html": (_HTML, lambda: report.read_bytes() if report.is_file() else None),
            "/state.json": (_JSON, state),
        }
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            raise InputError(
                f"port {port} cannot be used ({error.strerror}); choose another by --port"
            ) from error

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections that the browser closed."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    """Answer what the server has; the path of a request is only compared with the names of that."""

    server: AreaServer
    timeout = _TIMEOUT_S
    server_version, sys_version = "spn-data", ""

    def do_GET(self) -> None:
        """Answer a request with its content."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer a request without its content."""
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        path = self.path.partition("?")[0]
        kind, content = self.server.answers.get(path, (_TEXT, lambda: None))
        port = self.server.server_port
        # A page of another site may send requests here under a name of its own.
        if self.headers.get("Host") not in (f"{LOOPBACK}:{port}", f"localhost:{port}"):
            status, kind, body = HTTPStatus.FORBIDDEN, _TEXT, b"Only for this machine.\n"
        else:
            found = content()
            status = HTTPStatus.NOT_FOUND if found is None else HTTPStatus.OK
            kind, body = (_TEXT, b"Nothing here.\n") if found is None else (kind, found)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header(
            "Content-Security-Policy", _LIVE_POLICY if path == "/" else "frame-ancestors 'self'"
        )
        self.end_headers()
        if with_body:
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Write no line for each request."""
