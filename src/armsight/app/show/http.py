"""A few pages over HTTP, read only, in threads of their own: for health checks, metrics, and people on this computer.

Another computer needs the address with the token that :attr:`Pages.address` has. A name that is not this server's gets
no answer: a foreign page in the same browser could bring one (DNS rebinding).
"""

from __future__ import annotations

import hmac
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

from armsight.errors import InputError

#: Names and addresses of this computer alone.
HERE = ("127.0.0.1", "localhost", "::1")
#: Code, type and content.
Answer = tuple[int, str, bytes]
#: Path -> what answers it; it is given the first value of each key of the query.
Routes = Mapping[str, Callable[[dict[str, str]], Answer]]
#: s, between two looks whether to stop; half: more wake-ups, double: the end of a service takes longer.
_LOOK_S = 0.1
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}


def host_and_port(address: str, what: str, *, least: int = 0) -> tuple[str, int]:
    """Return the two parts of HOST:PORT, an IPv6 host without its brackets.

    Args:
        address: HOST:PORT.
        what: names the option or key it is given by.
        least: lowest port; 0 is any that is free.

    Raises:
        InputError: it is no address.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not least <= int(port) <= 65535:
        raise InputError(f"{what} is {address!r}: expected HOST:PORT, such as 127.0.0.1:9110; PORT is {least} to 65535")
    return host.strip("[]"), int(port)


class Pages:
    """Serves pages until it is closed.

    Args:
        address: ``HOST:PORT``; port 0 is any that is free.
        routes: what is answered.
        what: names the option or key of the address, for messages.
        open_to: whether other computers may read without a token.

    Raises:
        InputError: it is no address, or something listens there already.
    """

    def __init__(self, address: str, routes: Routes, what: str, *, open_to: bool = False) -> None:
        host, port = host_and_port(address, what)
        here = host in HERE
        self._token = None if here or open_to else secrets.token_urlsafe(18)
        pages = self

        class Handler(BaseHTTPRequestHandler):
            timeout = 5

            def do_GET(self) -> None:
                url = urlsplit(self.path)
                query = {key: values[0] for key, values in parse_qs(url.query).items()}
                named = not here or self.headers.get("Host", "").rpartition(":")[0].strip("[]") in HERE
                if not named or not pages._knows(query.get("token", "")):
                    self._answer(403, "text/plain", b"open the address that was printed, with its token\n")
                elif (answer := routes.get(url.path)) is None:
                    self._answer(404, "text/plain", f"{', '.join(routes)} are here\n".encode())
                else:
                    self._answer(*answer(query))

            def _answer(self, code: int, kind: str, data: bytes) -> None:
                self.send_response(code)
                for name, value in {"Content-Type": kind, "Content-Length": str(len(data)), **_HEADERS}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, format: str, *arguments: object) -> None:
                """Log no request."""

            def handle(self) -> None:
                """Answer; a reader that is gone is no error."""
                try:
                    super().handle()
                except ConnectionError:
                    self.close_connection = True

        class Server(ThreadingHTTPServer):
            address_family = socket.AF_INET6 if ":" in host else socket.AF_INET

        try:
            self._server = Server((host, port), Handler)
        except OSError as error:
            raise InputError(
                f"{what} {address}: cannot listen there ({error.strerror}): does another one run?"
            ) from None
        self._host = f"[{host}]" if ":" in host else host
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(_LOOK_S,), daemon=True).start()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_address[1])

    @property
    def address(self) -> str:
        """The address to open."""
        return f"http://{self._host}:{self.port}/" + (f"?token={self._token}" if self._token else "")

    def _knows(self, token: str) -> bool:
        return self._token is None or hmac.compare_digest(token.encode(), self._token.encode())

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


def metrics_text(metrics: Mapping[str, tuple[str, str]], rows: Mapping[str, Mapping[str, float]]) -> bytes:
    """Return values in Prometheus' text format.

    Args:
        metrics: name -> kind and help; what has no value is left out.
        rows: name -> labels as they stand in braces, empty without any -> value.
    """
    lines = []
    for name, (kind, text) in metrics.items():
        if values := rows.get(name):
            lines += [f"# HELP armsight_{name} {text}", f"# TYPE armsight_{name} {kind}"]
            lines += [f"armsight_{name}{labels} {value:.9g}" for labels, value in values.items()]
    return ("\n".join(lines) + "\n").encode()
