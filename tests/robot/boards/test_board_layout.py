"""What Python knows of the firmware's records, codes and ranges is what its headers say."""

import ctypes
import re
from pathlib import Path

import numpy as np
import pytest

from armsight import firmware
from armsight.robot.boards import codes, configuration, frames, headers
from armsight.robot.boards.configuration import CONFIG, ENCODER, GAINS, JOINT, MOTOR, POT, TRANSMISSION

FIRMWARE = Path(__file__).resolve().parents[3] / "firmware"


def header(*path):
    return re.sub(r"/\*.*?\*/", "", FIRMWARE.joinpath(*path).read_text(encoding="utf-8"), flags=re.DOTALL)


TYPES, FRAMES = header("core", "types.h"), header("boards", "pil", "frame.h")
RECORDS = {
    "joint_gains": GAINS,
    "pot_config": POT,
    "motor_config": MOTOR,
    "encoder_config": ENCODER,
    "transmission_config": TRANSMISSION,
    "joint_config": JOINT,
    "core_config": CONFIG,
    "core_outputs": frames.OUTPUTS,
    "pil_request": frames.REQUEST,
    "pil_answer": frames.ANSWER,
}


@pytest.mark.parametrize("name", RECORDS)
def test_records_are_as_long_as_a_compiler_makes_them(name):
    library = ctypes.CDLL(str(firmware.host_library()))
    library.host_size.argtypes = [ctypes.c_char_p]
    assert RECORDS[name].itemsize == library.host_size(name.encode())


def test_codes_have_the_headers_numbers_and_texts():
    assert [each.value for each in codes.Fault] == list(range(1, len(codes.Fault) + 1))
    assert codes.Fault.MOTOR.text.startswith("motor: weak, or a winding shorted")
    assert (codes.BoardState.STOPPED, codes.BoardState.STOPPED.name, len(codes.BoardState)) == (5, "STOPPED", 6)
    assert codes.Rejection(0).text == "acknowledged"
    assert codes.Rejection.NOT_HOMED.text.endswith("bring the arm to its home and give HOME")


@pytest.mark.parametrize(
    ("prefix", "ours"),
    [
        ("LIMITED_", codes.Limited),
        ("CONFIG_", codes.ConfigSource),
        ("REACTION_", codes.Reaction),
        ("COMMAND_", codes.Command),
        ("SENSOR_", codes.SensorKind),
    ],
)
def test_enumerations_are_the_headers(prefix, ours):
    theirs = {name: int(value) for name, value in re.findall(rf"{prefix}(\w+) = (\d+)", TYPES)}
    assert theirs
    for member in ours:
        assert theirs[member.name] == member.value


def test_numbers_and_ranges_are_the_headers():
    assert frames.REQUEST_MAGIC.to_bytes(4, "little") + frames.ANSWER_MAGIC.to_bytes(4, "little") == b"ASRQASAN"
    assert f"RESTART_POWER = {frames.RESTART_POWER}, RESTART_WATCHDOG = {frames.RESTART_WATCHDOG}" in FRAMES
    assert (frames.VERSION, frames.WIRE_BYTES, configuration.ENCODER_REV) == (4, 512, 16384)
    assert headers.ranges("encoder_config")["zero_counts"] == (0, 16383)
    assert headers.ranges("pot_config") == {"node_count": (2, 9), **POT_RANGES}
    assert "sync_led_pin" not in headers.ranges("core_config")


POT_RANGES = {"jump_rad": (1e-4, 1), "frozen_rad": (1e-3, 1), "inverted_rad": (1e-3, 1)}


def test_what_a_tick_packs_and_reads_is_laid_out_alike():
    rng = np.random.default_rng(0)
    numbers, said = rng.integers(0, 2**31, 20).tolist(), rng.bytes(512)
    request = np.frombuffer(frames.REQUEST_FIELDS.pack(*numbers, said), frames.REQUEST)[0]
    assert np.hstack([request[name] for name in frames.REQUEST.names[:-1]]).tolist() == numbers
    assert request["bytes"].tobytes() == said
    packed = rng.bytes(frames.ANSWER.itemsize)
    answer = np.frombuffer(packed, frames.ANSWER)[0]
    outputs = answer["outputs"]
    reported = [
        answer["magic"],
        answer["version"],
        answer["tick"],
        *(outputs[name] for name in ("drives_on", "windings_shorted", "brakes_open")),
    ]
    reported += [answer["sync_led"], answer["length"]]
    assert list(frames.ANSWER_FIELDS.unpack_from(packed)) == reported
    assert packed[frames.DUTY_AT : frames.DUTY_AT + 24] == outputs["duty"].tobytes()
    assert packed[frames.BYTES_AT :] == answer["bytes"].tobytes()
