"""Read a 32-bit ARM ELF image: what is loaded where, its symbols and sizes, and whether it computes in hardware.

Source: Tool Interface Standard, Executable and Linking Format 1.2; Arm, ELF for the Arm Architecture (IHI 0044), 5.2.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

from armsight.errors import InputError

_LOAD = 1
_SYMBOLS = 2
_ARM = 40
_WRITABLE = 2
_HARD_FLOAT = 0x400
#: Helpers that stand for an operation the floating-point unit would do (Arm run-time ABI, 4.1.2).
_SOFT_FLOAT = re.compile(r"__aeabi_[fd](?!p)")


@dataclass(frozen=True)
class ElfSegment:
    """A piece of memory the image fills: stored at ``load_address`` (flash), used at ``address``.

    ``size``: bytes it takes in use, zero beyond ``data``; ``writable``: whether it is RAM.
    """

    address: int
    load_address: int
    data: bytes
    size: int
    writable: bool


@dataclass(frozen=True)
class Elf:
    """An image: what is loaded, addresses (functions with the Thumb bit) and sizes of symbols by name.

    ``undefined``: names it needs from elsewhere; ``hard_float``: floats are passed in floating-point registers and no
    soft-float helper is in it.
    """

    segments: tuple[ElfSegment, ...]
    symbols: dict[str, int]
    sizes: dict[str, int]
    undefined: frozenset[str]
    hard_float: bool

    @property
    def flash_bytes(self) -> int:
        """Bytes stored in flash: code, constants and initial values."""
        return sum(len(segment.data) for segment in self.segments)

    @property
    def ram_bytes(self) -> int:
        """Bytes of RAM that variables take; the stack is not among them."""
        return sum(segment.size for segment in self.segments if segment.writable)


def read_elf(path: Path) -> Elf:
    """Read an image. Raises :class:`~armsight.errors.InputError` if it is none for a 32-bit ARM."""
    raw = path.read_bytes()
    try:
        if raw[:6] != b"\x7fELF\x01\x01" or struct.unpack_from("<H", raw, 18)[0] != _ARM:
            raise InputError(f"{path}: not a 32-bit little-endian ARM ELF image")
        programs_at, sections_at, flags = struct.unpack_from("<III", raw, 28)
        _, program_size, programs, section_size, sections, _ = struct.unpack_from("<6H", raw, 40)
        segments = [_segment(raw, programs_at + k * program_size) for k in range(programs)]
        table = _symbols(raw, [sections_at + k * section_size for k in range(sections)])
    except (struct.error, ValueError, IndexError) as error:
        raise InputError(f"{path}: not a whole ELF image: {error}") from error
    symbols = {name: value for name, value, _, section in table if section}
    undefined = frozenset(name for name, _, _, section in table if name and not section)
    sizes = {name: size for name, _, size, section in table if section}
    hard_float = bool(flags & _HARD_FLOAT) and not any(map(_SOFT_FLOAT.match, {*symbols, *undefined}))
    return Elf(tuple(segment for segment in segments if segment), symbols, sizes, undefined, hard_float)


def _segment(raw: bytes, at: int) -> ElfSegment | None:
    kind, offset, address, load_address, stored, size, flags = struct.unpack_from("<7I", raw, at)
    if kind != _LOAD or size == 0:
        return None
    return ElfSegment(address, load_address, raw[offset : offset + stored], size, bool(flags & _WRITABLE))


def _symbols(raw: bytes, headers: list[int]) -> list[tuple[str, int, int, int]]:
    """Return name, value, size and section of every symbol; section 0 is elsewhere."""
    sections = [struct.unpack_from("<10I", raw, at) for at in headers]
    found = []
    for _, kind, _, _, offset, length, link, _, _, entry in sections:
        if kind != _SYMBOLS:
            continue
        for at in range(offset, offset + length, entry):
            name_at, value, size, _, _, section = struct.unpack_from("<IIIBBH", raw, at)
            text = sections[link][4] + name_at
            found.append((raw[text : raw.index(b"\0", text)].decode(), value, size, section))
    return found
