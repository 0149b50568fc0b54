"""A server for one page on this machine alone."""

from __future__ import annotations

from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

#: The page is seen from this machine alone.
LOOPBACK = "127.0.0.1"


class PageServer(ThreadingHTTPServer):
    """Serves a page at ``/`` and nothing else, on a free port of the loopback interface.

    Parameters
    ----------
    html : str
    port : int
        0 takes one that is free.
    """

    daemon_threads = True

    def __init__(self, html: str, port: int = 0) -> None:
        self.content = html.encode("utf-8")
        super().__init__((LOOPBACK, port), _Handler)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        # A page elsewhere that resolves its own name to this address is not answered.
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in (LOOPBACK, "localhost") or self.path.split("?")[0] != "/":
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self.server.content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if body:
            self.wfile.write(self.server.content)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the command line says where the page is."""
