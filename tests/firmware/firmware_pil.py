"""The emulated board as a shared library, and a host on its wire: frames in, frames out, one tick at a time."""

import ctypes
import shutil
import zlib
from pathlib import Path

from firmware_arm import lab_config
from firmware_layout import c

from armsight import firmware

BAUD = 921600
REST = 32768
PART = 200


class PilBoard:
    """A fresh board: a copy of the library of its own, so that nothing is stored yet."""

    def __init__(self, library: Path, folder: Path):
        copy = folder / f"board_{len(list(folder.iterdir()))}.so"
        shutil.copy(library, copy)
        self.library = ctypes.CDLL(str(copy))
        self.request = c.pil_request.in_dll(self.library, "pil_request_frame")
        self.answer = c.pil_answer.in_dll(self.library, "pil_answer_frame")
        self.library.pil_start()
        self.request.magic, self.request.version = c.FRAME_REQUEST, c.FRAME_VERSION
        self.request.supply_mv = 12000
        self.request.counts[:] = [REST] * c.JOINTS
        self.request.tick = 0
        self.sent = bytearray()
        self.frames: list[bytes] = []

    def tick(self, data: bytes = b"", *, restart: int = c.RESTART_NONE):
        """Run one tick with these bytes on the wire; returns the outputs."""
        self.request.length = len(data)
        self.request.bytes[: len(data)] = data
        self.request.restart = restart
        self.frames.append(bytes(self.request))
        self.library.pil_tick()
        assert self.answer.magic == c.FRAME_ANSWER
        self.sent += bytes(self.answer.bytes[: self.answer.length])
        self.request.tick = (self.request.tick + 1) % 2**32
        return self.answer.outputs

    def run(self, ticks: int, data: bytes = b"", *, baud: int = BAUD):
        """Run ticks while these bytes come in, as fast as the wire carries them."""
        carried = 0.0
        for _ in range(ticks):
            carried = min(carried + baud / 10_000, len(data))
            now, data = data[: int(carried)], data[int(carried) :]
            carried -= len(now)
            self.tick(now)
        assert not data, "the bytes did not fit into the ticks"
        return self.answer.outputs


class Host:
    """The other end of the wire: packs messages, reads what came back."""

    def __init__(self, board: PilBoard):
        self.board = board
        self.dialect = firmware.dialect()
        self.out = self.dialect.MAVLink(None, 255, 1)
        self.back = self.dialect.MAVLink(None)
        self.back.robust_parsing = True
        self.sequence = 0
        self.heard: list = []
        self._session: int | None = None

    def pack(self, kind: str, *fields) -> bytes:
        """A message as bytes, the next in the count of the frames."""
        data = getattr(self.dialect, f"MAVLink_{kind}_message")(*fields).pack(self.out)
        self.out.seq = (self.out.seq + 1) % 256
        return data

    def hello(self, *, dialect=None, config=c.CONFIG_VERSION, nonce=7) -> bytes:
        version = self.dialect.ARMSIGHT_DIALECT_VERSION if dialect is None else dialect
        self._session = None
        return self.pack("hello", version, config, nonce)

    @property
    def session(self) -> int:
        """The session the board gave after the last hello; 0 before."""
        if self._session is None and self.board is not None:
            peek = self.dialect.MAVLink(None)
            peek.robust_parsing = True
            came = [*self.heard, *(peek.parse_buffer(bytes(self.board.sent)) or [])]
            welcomes = [message for message in came if message.get_type() == "WELCOME"]
            self._session = welcomes[-1].session if welcomes else None
        return self._session or 0

    def next(self) -> int:
        self.sequence += 1
        return self.sequence

    def move(self, position_rad=0.0, *, ticks=4, sequence=None, speed_rad_s=0.0) -> bytes:
        sequence = self.next() if sequence is None else sequence
        return self.pack("move", sequence, self.session, ticks, [position_rad] * 6, [speed_rad_s] * 6, [0.0] * 6)

    def command(self, kind: int, *, sequence=None) -> bytes:
        return self.pack("command", self.next() if sequence is None else sequence, self.session, kind)

    def stop(self) -> bytes:
        return self.pack("stop", self.next())

    def parts(self, config) -> list[bytes]:
        """The messages that bring a configuration across."""
        raw = bytes(config)
        found = []
        for offset in range(0, len(raw), PART):
            part = raw[offset : offset + PART]
            padded = [*part, *[0] * (PART - len(part))]
            found.append(self.pack("config_part", offset, len(raw), len(part), padded))
        return found

    def store(self, config, *, crc=None) -> bytes:
        crc = zlib.crc32(bytes(config)) if crc is None else crc
        return self.pack("config_store", self.next(), crc, self.session)

    def listen(self) -> list:
        """The messages that came since the last call."""
        data, self.board.sent[:] = bytes(self.board.sent), b""
        found = self.back.parse_buffer(data) or []
        self.heard += found
        return found

    def newest(self, kind: str):
        """The newest message of this kind that came at all."""
        self.listen()
        return next(message for message in reversed(self.heard) if message.get_type() == kind)


def working_board(library: Path, folder: Path) -> tuple[PilBoard, Host]:
    """A board with a good configuration, greeted, its readings settled."""
    board = PilBoard(library, folder)
    host = Host(board)
    board.tick(host.hello())
    config = lab_config(board.library)
    for part in host.parts(config):
        board.run(4, part)
    board.run(4, host.store(config))
    board.tick(restart=c.RESTART_POWER)
    board.run(20, host.hello())
    host.sequence = 0
    assert (board.answer.outputs.state, board.answer.outputs.faults) == (c.STATE_DISABLED, 0)
    host.listen()
    return board, host
