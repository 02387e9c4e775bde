"""The wire alone, without core or board, at any baud rate: bytes in, reports in, bytes out."""

import ctypes

from firmware_arm import lab_config
from firmware_layout import c
from firmware_pil import Host

BITS_PER_BYTE = 10


class Setup(ctypes.Structure):
    """wire_setup."""

    _fields_ = (
        ("board", ctypes.c_char_p),
        ("baud", ctypes.c_uint32),
        ("config_source", ctypes.c_uint32),
        ("config", ctypes.c_void_p),
        ("crash", ctypes.c_uint32 * 4),
        ("abilities", ctypes.c_uint32 * 3),
    )


class Periods(ctypes.Structure):
    """wire_periods."""

    _fields_ = (("angles", ctypes.c_uint32), ("joints", ctypes.c_uint32), ("status", ctypes.c_uint32))


def declare_wire(library):
    """Declare to ctypes what the wire's functions take and give."""
    pointer, word = ctypes.c_void_p, ctypes.c_uint32
    library.wire_periods_at.restype, library.wire_periods_at.argtypes = Periods, [word]
    library.wire_init.argtypes = [pointer, ctypes.POINTER(Setup)]
    library.wire_receive.argtypes = [pointer, ctypes.c_char_p, word, word]
    library.wire_output.restype = word
    library.wire_output.argtypes = [pointer, ctypes.POINTER(ctypes.POINTER(ctypes.c_uint8))]
    library.wire_sent.argtypes = [pointer, word]
    library.wire_to_store.restype, library.wire_to_store.argtypes = pointer, [pointer]
    library.wire_stored.argtypes = [pointer, ctypes.c_bool]
    for name in ("wire_poll", "wire_before_tick", "wire_after_tick"):
        getattr(library, name).argtypes = [pointer] * {"wire_poll": 1, "wire_before_tick": 2, "wire_after_tick": 3}[
            name
        ]
    return library


class BareWire:
    """A wire whose ticks do nothing but take commands and give reports."""

    def __init__(self, library, baud: int, *, name: bytes = b"bare"):
        self.library, self.baud = declare_wire(library), baud
        self.state = ctypes.create_string_buffer(library.host_size(b"wire_state"))
        self.config = lab_config(library)
        self.inputs, self.outputs = c.core_inputs(), c.core_outputs()
        setup = Setup(name, baud, c.CONFIG_NEWEST, ctypes.addressof(self.config))
        library.wire_init(self.state, ctypes.byref(setup))
        self.sent, self.waiting, self.line = bytearray(), bytearray(), 0.0
        self.host = Host(self)

    def receive(self, data: bytes, *, overrun: int = 0) -> None:
        """Let these bytes come in, and so many be lost."""
        self.library.wire_receive(self.state, data, len(data), overrun)

    def to_store(self) -> bool:
        """Return whether a configuration waits to be stored."""
        return self.library.wire_to_store(self.state) is not None

    def stored(self, done: bool) -> None:
        """Report to the wire what became of it."""
        self.library.wire_stored(self.state, done)

    def tick(self, ticks: int = 1) -> None:
        """Run ticks; the wire takes away what its baud rate carries."""
        for _ in range(ticks):
            self.library.wire_poll(self.state)
            self.library.wire_before_tick(self.state, ctypes.byref(self.inputs))
            self.outputs.tick = (self.outputs.tick + 1) % 2**32
            if self.inputs.command.kind:
                self.outputs.acknowledged_count += 1
                self.outputs.acknowledged_sequence = self.inputs.command.sequence
            self.library.wire_after_tick(self.state, ctypes.byref(self.inputs), ctypes.byref(self.outputs))
            self.library.wire_poll(self.state)
            self.line = self.line % 1.0 + self.baud / BITS_PER_BYTE / c.TICKS_PER_S
            self._take()

    def _take(self) -> None:
        start = ctypes.POINTER(ctypes.c_uint8)()
        while self.line >= 1.0:
            length = min(self.library.wire_output(self.state, ctypes.byref(start)), int(self.line))
            if length == 0:
                return
            self.sent += ctypes.string_at(start, length)
            self.library.wire_sent(self.state, length)
            self.line -= length
