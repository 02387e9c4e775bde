#!/bin/sh
# python-can 4.6.1: an ASC log whose header says "timestamps relative" is read as if each difference were a time.
#
# Vector's ASC has a line "base hex  timestamps absolute" or "relative". Absolute times count from the start of the
# measurement, relative ones from the message before (asc2log of can-utils adds them up). ASCReader parses the word, keeps it in an
# attribute, and treats both alike: the drive's positions of ten seconds lie within one period, the
# order of messages by time is lost, and a velocity computed from them is a division by 0. Its own argument relative_timestamp is
# about something else, the date of the header. Nothing is said.
#
# One joint's positions, sent each 10 ms and one of them late by 2 ms, in both notations.
#
# Seen, seconds: absolute 0.010 0.020 0.032 0.040; relative 0.010 0.010 0.012 0.008.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet python-can==4.6.1
"$folder/venv/bin/python" - <<'PYTHON'
import io

import can

TRUE = [0.010, 0.020, 0.032, 0.040]


def read(word, times):
    head = f"date Mon Nov 30 10:00:00.000 am 2026\nbase hex  timestamps {word}\nno internal events logged\n"
    lines = "".join(f"   {t:.6f} 1  181             Rx   d 4 {i:02X} 00 00 00\n" for i, t in enumerate(times))
    messages = list(can.ASCReader(io.StringIO(head + "Begin Triggerblock Mon Nov 30 10:00:00.000 am 2026\n" + lines)))
    assert [m.data[0] for m in messages] == [0, 1, 2, 3]
    return [round(m.timestamp, 6) for m in messages]


steps = [round(b - a, 6) for a, b in zip([0, *TRUE], TRUE)]
absolute, relative = read("absolute", TRUE), read("relative", steps)
print("absolute", *absolute, "relative", *relative)
assert absolute == TRUE and relative == steps == [0.010, 0.010, 0.012, 0.008]
PYTHON
