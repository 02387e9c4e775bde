#!/bin/sh
# pyxdf 1.17.5: a stream at 100 Hz that pauses for 4 s gets times that are up to 2 s wrong, so that no pause is left.
#
# Lab Streaming Layer records robots, motion capture, IMUs and cameras into one XDF file, on one clock, each sample with its time.
# load_xdf removes jitter by default: it replaces the times of a stream with a nominal rate by a straight line through them. It
# begins another line only at a pause that is longer than both 1 s and 500 samples: at 100 Hz 5 s, at 30 Hz 17 s.
# A shorter one, as of an arm whose controller stops sending or a body that was hidden, is spread over the whole stream, before
# it as well: the samples before it come too late, those behind it too early, or the other way. Streams without a nominal rate keep their times, and so do those
# whose description has synchronization/can_drop_samples. A video whose frames are dropped one by one is moved in the same way. A
# warning of the rate comes where it is off by 10 % or more.
#
# A minute, joints at 100 Hz that pause from 30 to 34 s, a camera at 30 Hz that loses 3 % of its frames, events without a
# rate; each sample's value is its own time.
#
# Seen, time less true time, s, from / to: joints -1.93 / 2.08, camera -0.16 / 0.14, events 0 / 0; the joints' longest step
# 0.011 s, the true one 4.02 s; all 0 with dejitter_timestamps=False.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pyxdf==1.17.5
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import struct
from pathlib import Path

import numpy as np
import pyxdf

INFO = (
    "<info><name>{name}</name><type>{kind}</type><channel_count>1</channel_count><nominal_srate>{rate}</nominal_srate>"
    "<channel_format>double64</channel_format></info>"
)
RANGE = "<info><first_timestamp>{0}</first_timestamp><last_timestamp>{1}</last_timestamp><sample_count>{2}</sample_count></info>"


def chunk(tag, *parts):
    """Return a chunk of XDF 1.0: its length, what it is, and its content."""
    content = struct.pack("<H", tag) + b"".join(parts)
    return b"\x04" + struct.pack("<I", len(content)) + content


def stream(number, name, kind, rate, times):
    """Return the chunks of a stream with one channel, whose values are the times."""
    which = struct.pack("<I", number)
    samples = b"".join(b"\x08" + struct.pack("<dd", t, t) for t in times)
    clocks = b"".join(chunk(4, which, struct.pack("<dd", t, 0.0)) for t in np.arange(100.0, 160.0, 5.0))  # each 5 s, as LabRecorder
    return (
        chunk(2, which, INFO.format(name=name, kind=kind, rate=rate).encode())
        + chunk(3, which, b"\x04" + struct.pack("<I", len(times)), samples)
        + clocks
        + chunk(6, which, RANGE.format(times[0], times[-1], len(times)).encode())
    )


joints, camera = 100.0 + np.arange(6000) / 100, 100.0 + np.arange(1800) / 30
joints = joints[(joints < 130) | (joints > 134)]
camera = camera[np.random.default_rng(0).random(camera.size) >= 0.03]
streams = (("joints", "Mocap", 100, joints), ("camera", "Video", 30, camera), ("events", "Markers", 0, np.arange(101.0, 160.0)))
Path("one.xdf").write_bytes(
    b"XDF:"
    + chunk(1, b"<info><version>1.0</version></info>")
    + b"".join(stream(number, *each) for number, each in enumerate(streams, 1))
)

expected = {"joints": (-1.93, 2.08), "camera": (-0.16, 0.14), "events": (0.0, 0.0)}
for dejitter in (True, False):
    for found in pyxdf.load_xdf("one.xdf", dejitter_timestamps=dejitter)[0]:
        name, times, true = found["info"]["name"][0], found["time_stamps"], found["time_series"][:, 0]
        off = times - true
        steps = np.diff(times).max(), np.diff(true).max()
        print(f"{name} {off.min():5.2f} to {off.max():5.2f} s, longest step {steps[0]:.3f} s, true {steps[1]:.3f} s")
        assert np.allclose((off.min(), off.max()), expected[name] if dejitter else (0, 0), atol=0.01)
        if name == "joints" and dejitter:
            assert steps[0] < 0.012
PYTHON
