"""OpenIGTLink, for 3D Slicer and other programs of image-guided surgery: TRANSFORM, POSITION and STATUS.

``igtl:PORT`` listens (18944 is usual). Of each shot the pose of the body in the left camera's frame is sent as TRANSFORM
(``armsight_body``) and POSITION (``armsight_position``), and whether or why not it was measured as STATUS
(``armsight_status``); of joints the tool's pose in the base (``armsight_tool``). Lengths are in mm.

Version 1 of the protocol: openigtlink.org, "Header", "TRANSFORM", "POSITION", "STATUS"; big endian, CRC-64 of ECMA-182.
"""

from __future__ import annotations

import struct
from functools import cache

import numpy as np

from armsight.app.stream.network import TcpSink
from armsight.data import Array, Missed, PoseEstimate
from armsight.loop.running.data import Datum, JointsDatum, NoteDatum, ShotDatum, quaternion

_HEADER = struct.Struct(">H12s20sQQQ")
_VERSION = 1
_POLYNOMIAL, _MASK = 0x42F0E1EBA9EA3693, (1 << 64) - 1
#: Codes of STATUS: all is well; the device is not ready.
_OK, _NOT_FOUND = 1, 7


def message(kind: str, name: str, t_s: float, body: bytes) -> bytes:
    """Return a message of OpenIGTLink, of TRANSFORM, POSITION or STATUS; the name has at most 20 characters."""
    stamp = int(max(t_s, 0.0) * 2**32)  # in units of 2^-32 s
    return _HEADER.pack(_VERSION, kind.encode(), name.encode()[:20], stamp, len(body), crc64(body)) + body


def transform_body(T: Array) -> bytes:
    """Return the content of TRANSFORM: three columns of the rotation, then the translation, mm."""
    values = np.concatenate([T[:3, :3].T.ravel(), 1e3 * T[:3, 3]])
    return struct.pack(">12f", *values.tolist())


def position_body(T: Array) -> bytes:
    """Return the content of POSITION: position, mm, and quaternion x y z w."""
    w, x, y, z = quaternion(T[:3, :3])
    return struct.pack(">7f", *(1e3 * T[:3, 3]).tolist(), x, y, z, w)


def status_body(code: int, name: str, text: str) -> bytes:
    """Return the content of STATUS: code, name of the error, and text."""
    return struct.pack(">Hq20s", code, 0, name.encode()[:20]) + text.encode() + b"\0"


def crc64(data: bytes) -> int:
    """Return the CRC-64 of ECMA-182, most significant bit first, from 0."""
    table, crc = _table(), 0
    for byte in data:
        crc = table[(crc >> 56) ^ byte] ^ ((crc << 8) & _MASK)
    return crc


@cache
def _table() -> tuple[int, ...]:
    found = []
    for byte in range(256):
        crc = byte << 56
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc >> 63 else crc << 1) & _MASK
        found.append(crc)
    return tuple(found)


class IgtlSink(TcpSink):
    """Sends messages of OpenIGTLink to every reader that has connected."""

    kind = "igtl"

    def encoded(self, datum: Datum) -> list[bytes]:
        """Return a datum as messages."""
        t_s = datum.time_s
        if isinstance(datum, JointsDatum):
            T = datum.T_base_tool
            return [] if T is None else [message("TRANSFORM", "armsight_tool", t_s, transform_body(T))]
        if isinstance(datum, NoteDatum):
            return [message("STATUS", "armsight_log", t_s, status_body(_OK, "", datum.text))]
        if not isinstance(datum, ShotDatum):
            return []
        if isinstance(datum.result, PoseEstimate):
            T = datum.result.T_left_body
            return [
                message("TRANSFORM", "armsight_body", t_s, transform_body(T)),
                message("POSITION", "armsight_position", t_s, position_body(T)),
                message("STATUS", "armsight_status", t_s, status_body(_OK, "", "ok")),
            ]
        reason = datum.result.reason if isinstance(datum.result, Missed) else "not measured"
        return [message("STATUS", "armsight_status", t_s, status_body(_NOT_FOUND, "missed", reason))]
