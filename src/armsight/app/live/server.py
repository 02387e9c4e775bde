"""The server of ``armsight live``: it carries states, events, images and commands between a session and pages.

Out: one HTML file, and two WebSockets for each page: ``/live`` for everything, and ``/stop`` for the stop alone, so that no
image and no state is ever before it in a queue.

- Text to a page is ``{"section": NAME, "state": {...}}``, ``{"event": {}}``, ``{"you": {}}`` or ``{"rejected": TEXT}``.
- An image is binary: one byte side, four bytes number, JPEG. The next image of a side, the newest then, is sent when the
  page has said that it showed the last one (``{"shown": [SIDE, NUMBER]}``).
- While a loop moves the arm, states and images are made between the command that followed from a shot and the next shot:
  the loop shares the interpreter, and an image must not wait for a page.
- One page commands; the others look on and can stop. Where it is silent while the arm moves, the arm is held.

All is bound to 127.0.0.1 unless a host is given; then the address needs a token. Only pages of this server (their Origin)
open a WebSocket.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import importlib.resources
import json
import logging
import re
import secrets
import socket
import struct
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from armsight.app.live.capture import LiveShot
from armsight.app.live.records import LONGEST, command_of, json_text
from armsight.app.live.session import LOG, LiveSession
from armsight.app.live.step import why
from armsight.app.show.encode import jpeg
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import as_input_error, read_bytes
from armsight.loop.running.loop import SWITCH_S

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

#: How often states are looked at, s; how often a newer shot is looked for while a page waits for one, s.
_STATE_S, _POLL_S = 0.1, 0.01
#: JPEG quality of the views, and the longest side that is sent, px.
_JPEG, _SIDE_PX = 72, 1280
#: A page that commands and says nothing for so long is gone, s; pages say something twice a second.
SILENT_S = 1.5
_MALFORMED_BEGIN = ("a command ", "no command ")
_HEADER = struct.Struct("<BI")
_CSP = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src blob: data:; "
    "connect-src 'self'{sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: Files in the folder of the session that a page can open, and their types.
FILES = {"/board.pdf": "application/pdf", "/body.pdf": "application/pdf", f"/{LOG}": "text/plain; charset=utf-8"}


@dataclass
class _Client:
    """A page: what it was sent, and what it said last."""

    socket: ServerConnection
    number: int
    visible: bool = True
    heard_s: float = field(default_factory=time.monotonic)
    sent: dict[str, str] = field(default_factory=dict)
    event: int = 0
    #: For each side: number of the newest image sent, and whether the page has shown it.
    images: list[tuple[int, bool]] = field(default_factory=lambda: [(0, True), (0, True)])
    malformed: int = 0
    wake: asyncio.Event = field(default_factory=asyncio.Event)

    def send(self, text: str) -> None:
        task = asyncio.ensure_future(self.socket.send(text))
        task.add_done_callback(lambda done: done.exception() if not done.cancelled() else None)


class LiveServer:
    """Serves one session in a thread of its own; port 0 takes a free one; without a token only this computer may come."""

    def __init__(
        self, session: LiveSession, host: str = "127.0.0.1", port: int = 8000, token: str | None = None
    ) -> None:
        self.session, self.host, self.port, self.token = session, host, port, token
        self._clients: dict[int, _Client] = {}
        self._commander, self._number = 0, 0  # number of the page that commands, and of the newest
        self._loop: asyncio.AbstractEventLoop | None = None
        self._work, self._stops = ThreadPoolExecutor(8, "serve"), ThreadPoolExecutor(2, "stop")
        self._page = importlib.resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
        self._jpeg: list[tuple[int, bytes]] = [(0, b""), (0, b"")]
        self._encoding: list[asyncio.Lock] = []
        self._ended: asyncio.Event | None = None
        self._failed: ArmsightError | None = None
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        host = self.host if self.host not in ("0.0.0.0", "::") else socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def start(self) -> None:
        """Begin to serve; an error says why the address cannot be bound."""
        sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_S))  # a stop waits no longer for whoever computes
        self._thread.start()
        self._ready.wait()
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """End all connections and the thread."""
        if self._thread.is_alive() and self._ended is not None and self._loop is not None:
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(5.0)
        self._work.shutdown(wait=False, cancel_futures=True)
        self._stops.shutdown(wait=False)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        self._encoding = [asyncio.Lock(), asyncio.Lock()]
        silent = logging.getLogger("armsight.live")  # what fails is handled here, and not logged
        silent.setLevel(logging.CRITICAL)
        how: dict[str, Any] = {"process_request": self._request, "compression": None, "logger": silent}
        how |= {"max_size": 2 * LONGEST, "max_queue": 16, "write_limit": 1 << 16}
        how |= {"ping_interval": 5, "ping_timeout": 10}
        try:
            server = await serve(self._connected, self.host, self.port, **how)
        except OSError as error:
            self._failed = _bind_error(error, self.host, self.port)
            return
        self.port = int(server.sockets[0].getsockname()[1])
        self._ready.set()
        states = asyncio.create_task(self._states())
        await self._ended.wait()
        states.cancel()
        server.close()
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(server.wait_closed(), 2.0)

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        url, host = urlsplit(request.path), request.headers.get("Host", "")
        rejected: tuple[HTTPStatus, str] | None = None
        if not self._named(host):
            rejected = HTTPStatus.MISDIRECTED_REQUEST, "this server is not the one of that name\n"
        elif not self._knows(url.query):
            rejected = HTTPStatus.UNAUTHORIZED, "open the address that armsight live printed: its token is missing\n"
        elif url.path in ("/live", "/stop"):
            if request.headers.get("Origin") in (f"http://{host}", f"https://{host}"):
                return None
            rejected = HTTPStatus.FORBIDDEN, "only pages of this server may connect\n"
        elif url.path == "/":
            return self._html(connection, host)
        elif url.path in FILES:  # drawings are printed from the computer that shows the page
            try:
                data = read_bytes(self.session.folder / url.path.removeprefix("/"))
                return _answer(connection, data, {"Content-Type": FILES[url.path]})
            except InputError:
                rejected = HTTPStatus.NOT_FOUND, "it is not there yet\n"
        return connection.respond(*(rejected or (HTTPStatus.NOT_FOUND, "there is only /\n")))

    def _named(self, host: str) -> bool:
        """Whether a Host header is one of ours: a foreign name on our address is another page's (DNS rebinding)."""
        ours = {f"{name}:{self.port}" for name in ("127.0.0.1", "localhost", "[::1]", self.host)}
        return self.token is not None or host in ours

    def _knows(self, query: str) -> bool:
        given = parse_qs(query).get("token", [""])[0]
        return self.token is None or hmac.compare_digest(given.encode(), self.token.encode())

    def _html(self, connection: ServerConnection, host: str) -> Response:
        nonce = secrets.token_urlsafe(16)
        safe = f" ws://{host} wss://{host}" if re.fullmatch(r"[\w.\-:\[\]]+", host) else ""
        headers = {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Security-Policy": _CSP.format(nonce=nonce, sockets=safe),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }
        return _answer(connection, self._page.replace("NONCE", nonce).encode(), headers)

    async def _connected(self, socket: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        assert socket.request is not None
        with contextlib.suppress(ConnectionClosed):
            if urlsplit(socket.request.path).path == "/live":
                await self._live_socket(socket)
                return
            async for message in socket:  # stops, and the question whether this socket is alive
                if message == "stop":
                    answer = await asyncio.get_running_loop().run_in_executor(self._stops, self.session.stop)
                    await socket.send(json_text(answer))
                elif message == "alive":
                    await socket.send("alive")

    async def _live_socket(self, socket: ServerConnection) -> None:
        self._number += 1
        client = self._clients[self._number] = _Client(socket, self._number)
        self._commander = self._commander or client.number
        images = asyncio.create_task(self._images(client))
        try:
            self._introduce()
            async for message in socket:
                client.heard_s = time.monotonic()
                if not await self._heard(client, message):
                    break
        finally:
            images.cancel()
            del self._clients[client.number]
            if client.number == self._commander:
                self._hold("the page that commanded was closed, or its connection was lost")
                self._commander = min(self._clients, default=0)
                self._introduce()

    def _hold(self, why: str) -> None:
        self._stops.submit(self.session.arm.hold_for, why)

    def _introduce(self) -> None:
        for number, client in self._clients.items():
            you = {"number": number, "commands": number == self._commander, "pages": len(self._clients)}
            client.send(json.dumps({"you": you}))

    async def _heard(self, client: _Client, message: str | bytes) -> bool:
        """Take a message of a page; False ends its connection."""
        try:
            if isinstance(message, bytes):
                raise InputError("a command is text")
            if message == "alive":
                return True
            if not message.startswith('{"command"'):
                self._said(client, message)
                return True
            command = command_of(message)
            if client.number != self._commander:
                raise InputError("another page commands: this one looks on, and can stop; or take over")
            await asyncio.get_running_loop().run_in_executor(self._work, self.session.execute, command)
        except Exception as error:  # noqa: BLE001 - a mistake of ours is said, and does not look like a page that left
            client.malformed += isinstance(error, InputError) and str(error).startswith(_MALFORMED_BEGIN)
            if client.malformed > 200:
                client.socket.transport.abort()
                return False
            client.send(json.dumps({"rejected": why(error)}))
        return True

    def _said(self, client: _Client, message: str) -> None:
        """Take what a page says of itself: what it showed, whether it is visible, that it takes over."""
        with as_input_error("a command is JSON that begins with the key command", json.JSONDecodeError, RecursionError):
            said = json.loads(message)
        match said:
            case {"shown": [0 | 1 as side, int(number)]} if not isinstance(side, bool):
                if number == client.images[side][0]:
                    client.images[side] = (number, True)
                    client.wake.set()
            case {"visible": bool(visible)}:
                client.visible = visible
                client.images = [(0, True), (0, True)]
                client.wake.set()
            case {"take_over": True}:
                if client.number != self._commander:
                    self._hold("another page took over")
                    self._commander = client.number
                    self._introduce()
            case _:
                raise InputError("a command is an object with the key command")

    async def _images(self, client: _Client) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while True:
                if client.visible and self._due(client):
                    if self.session.arm.busy:
                        await asyncio.get_running_loop().run_in_executor(self._work, self.session.arm.between_shots)
                    for side in self._due(client):
                        if (encoded := await self._encoded(side)) is not None:
                            number, data = encoded
                            client.images[side] = (number, False)
                            await client.socket.send(_HEADER.pack(side, number) + data)
                    continue
                awaited = client.visible and any(shown for _, shown in client.images)  # the cameras, not the page
                client.wake.clear()
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(client.wake.wait(), _POLL_S if awaited else 0.5)

    def _due(self, client: _Client) -> list[int]:
        """Return the sides of which a page has shown the last image, and there is a newer one."""
        newest = self.session.capture.newest
        if newest is None:
            return []
        return [side for side, (number, shown) in enumerate(client.images) if shown and newest.number != number]

    async def _encoded(self, side: int) -> tuple[int, bytes] | None:
        """Return the number of the newest shot and its view as JPEG, encoded once for all pages; None without a shot."""
        async with self._encoding[side]:
            live = self.session.capture.newest
            if live is None:  # other cameras are being opened
                return None
            if self._jpeg[side][0] != live.number:
                data = await asyncio.get_running_loop().run_in_executor(self._work, _jpeg, live, side)
                self._jpeg[side] = live.number, data
            return self._jpeg[side]

    async def _states(self) -> None:
        """Send every page what has changed; watch whether the one that commands is still there."""
        said = ""
        while True:
            await asyncio.sleep(_STATE_S)
            if not self._clients:
                continue
            texts: dict[str, str] = {}
            wrong = ""
            try:
                texts = await asyncio.get_running_loop().run_in_executor(self._work, self._texts)
            except Exception as error:  # noqa: BLE001 - this task also watches the page that commands
                wrong = why(error)
            if wrong and wrong != said:
                self.session.say("error", wrong)
            said = wrong
            for client in list(self._clients.values()):
                self._update(client, texts)
            commander = self._clients.get(self._commander)
            if commander is not None and time.monotonic() - commander.heard_s > SILENT_S and self.session.arm.busy:
                self._hold("the page that commands does not answer")

    def _texts(self) -> dict[str, str]:
        self.session.arm.between_shots()
        return {name: json_text({"section": name, "state": state}) for name, state in self.session.sections().items()}

    def _update(self, client: _Client, texts: dict[str, str]) -> None:
        """Send a page what has changed, unless it has not taken what it was sent before."""
        if client.socket.transport.get_write_buffer_size() > 1 << 18 or not client.visible:
            return
        for name, text in texts.items():
            if client.sent.get(name) != text:
                client.sent[name] = text
                client.send(text)
        for event in self.session.events(client.event):
            client.event = event.number
            client.send(json.dumps({"event": vars(event)}))


def _jpeg(live: LiveShot, side: int) -> bytes:
    image = live.shot.left if side == 0 else live.shot.right
    assert image is not None
    return jpeg(image, _SIDE_PX, _JPEG)


def _answer(connection: ServerConnection, body: bytes, headers: dict[str, str]) -> Response:
    """Return an answer whose body is no plain text."""
    response = connection.respond(HTTPStatus.OK, "")
    response.body = body
    for name, value in {"Content-Length": str(len(body)), **headers}.items():
        with contextlib.suppress(KeyError):
            del response.headers[name]
        response.headers[name] = value
    return response


def _bind_error(error: OSError, host: str, port: int) -> ArmsightError:
    if error.errno == errno.EADDRINUSE:
        return InputError(f"port {port} is in use, perhaps by another armsight live: give another, --http {host}:PORT")
    if error.errno == errno.EACCES:
        return InputError(f"port {port} needs rights that you do not have: give one above 1023, --http {host}:PORT")
    return DeviceError(f"{host}:{port} cannot be bound: {error.strerror or error}; is it an address of this computer?")
