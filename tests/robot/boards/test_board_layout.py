"""What Python knows of the firmware's records, codes and ranges is what its headers say."""

import ctypes
import re
from pathlib import Path

import numpy as np
import pytest

from armsight import firmware
from armsight.robot.boards import codes, configuration, frames
from armsight.robot.boards.configuration import CONFIG, ENCODER, GAINS, JOINT, MOTOR, POT, TRANSMISSION

FIRMWARE = Path(__file__).resolve().parents[3] / "firmware"
NUMBERS = {"JOINTS": 6, "POT_NODES": 9, "FRAME_BYTES": 512}
KINDS = {"float": "<f4", "uint32_t": "<u4", "uint16_t": "<u2", "int32_t": "<i4", "uint8_t": "|u1"}


def header(*path):
    return re.sub(r"/\*.*?\*/", "", FIRMWARE.joinpath(*path).read_text(encoding="utf-8"), flags=re.DOTALL)


TYPES, FRAMES, CONFIG_H = header("core", "types.h"), header("boards", "pil", "frame.h"), header("core", "config.h")
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
def test_records_are_laid_out_as_in_the_header(name):
    body = re.search(rf"typedef struct {name} \{{(.*?)\}}", TYPES + FRAMES, flags=re.DOTALL)[1]
    listed = re.findall(r"(\w+) (\w+)(?:\[(\w+)\])?;", body)
    ours = []
    for field in RECORDS[name].names:
        base, shape = RECORDS[name][field].subdtype or (RECORDS[name][field], ())
        ours.append((field, base, shape))
    assert [field for _, field, _ in listed] == [field for field, _, _ in ours]
    for (kind, _, length), (_, base, shape) in zip(listed, ours, strict=True):
        assert base == RECORDS[kind] if kind in RECORDS else base.str == KINDS[kind]
        assert shape == ((NUMBERS[length],) if length else ())


@pytest.mark.parametrize("name", RECORDS)
def test_records_are_as_long_as_a_compiler_makes_them(name):
    library = ctypes.CDLL(str(firmware.host_library()))
    library.host_size.argtypes = [ctypes.c_char_p]
    assert RECORDS[name].itemsize == library.host_size(name.encode())


def listed(which, text=TYPES):
    body = re.search(rf"#define {which}_LIST\(X\)(.*?[^\\])\n", text, flags=re.DOTALL)[1]
    found = re.findall(r"X\((\w+), (\d+),(?: \w+,)?\s*\"([^\"]*)\"\)", body)
    return {name: (int(code), said) for name, code, said in found}


@pytest.mark.parametrize(
    ("which", "ours", "texts"),
    [
        ("FAULT", codes.Fault, codes.FAULT_TEXTS),
        ("STATE", codes.BoardState, codes.STATE_TEXTS),
        ("REJECTION", codes.Rejection, codes.REJECTION_TEXTS),
    ],
)
def test_codes_and_texts_are_the_headers(which, ours, texts):
    theirs = listed(which)
    assert len(theirs) > 5
    reported = {member.name: (member.value, texts[member]) for member in ours if member.name != "NONE"}
    assert reported == theirs


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


def test_numbers_are_the_headers():
    assert f"0x{frames.REQUEST_MAGIC:08X}u" in FRAMES
    assert f"0x{frames.ANSWER_MAGIC:08X}u" in FRAMES
    assert re.search(rf"FRAME_VERSION {frames.VERSION}u", FRAMES)
    assert re.search(rf"FRAME_BYTES {frames.WIRE_BYTES}u", FRAMES)
    assert re.search(rf"RESTART_POWER = {frames.RESTART_POWER}, RESTART_WATCHDOG = {frames.RESTART_WATCHDOG}", FRAMES)
    assert re.search(rf"CONFIG_VERSION {configuration.CONFIG_VERSION}u", CONFIG_H)


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
