#!/bin/sh
# opencv-python-headless 4.14.0.94, 5.0.0.93: remap's better interpolations displace an image, the plain one does not; and in
# version 5 only two of the three stopped rounding positions to 1/32 px.
#
# On a ramp, whose interpolation is exact for any kernel that reproduces a straight line, INTER_CUBIC (a = -0.75) is off by up
# to 0.048 px and INTER_LANCZOS4 by 0.015 px before rounding; INTER_LINEAR is exact. A registration by Gauss-Newton of a smooth image that was
# shifted by 0.05 px (by the Fourier theorem) finds 0.036, 0.039 and 0.052 px. Version 4 rounds positions to 1/32 px for all
# three; version 5 does for INTER_LANCZOS4 alone, whose numbers are those of version 4 to the digit.
#
# Seen (error on a ramp at most, px; share of 0.05 px that is found):
#   4.14.0 linear 0.0150 0.97, cubic 0.0569 0.57, lanczos 0.0267 0.78
#   5.0.0  linear 0.0000 1.03, cubic 0.0481 0.72, lanczos 0.0267 0.78
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import sys

import cv2
import numpy as np

cv2.setNumThreads(1)
x = np.arange(40, dtype=np.float32)
ramp, at = np.repeat(x[None], 9, 0), np.linspace(10, 20, 1001, dtype=np.float32)[None]
n, edge = 400, 20
scene = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 60, (n, n)), (0, 0), 2.5)
spectrum, frequency = np.fft.fft2(scene), np.fft.fftfreq(n)[None]


def shifted(d):
    return np.real(np.fft.ifft2(spectrum * np.exp(-2j * np.pi * frequency * d))).astype(np.float32)


inner = slice(edge, n - edge)
template, moved, shift = shifted(0.0), shifted(0.05), 0.05
slope = ((np.roll(template, -1, 1) - np.roll(template, 1, 1)) / 2)[inner, inner]
v, u = np.mgrid[inner, inner].astype(np.float32)
found = {}
for name in ("LINEAR", "CUBIC", "LANCZOS4"):
    kernel = getattr(cv2, f"INTER_{name}")
    off = np.abs(cv2.remap(ramp, at, np.full_like(at, 4), kernel) - at).max()
    d = 0.0
    for _ in range(10):
        left = cv2.remap(moved, u + np.float32(d), v, kernel) - template[inner, inner]
        d -= float((left * slope).sum() / (slope * slope).sum())
    found[name] = round(float(off), 4), round(d / shift, 2)
print(cv2.__version__, found)
seen = {
    "4": {"LINEAR": (0.0150, 0.97), "CUBIC": (0.0569, 0.57), "LANCZOS4": (0.0267, 0.78)},
    "5": {"LINEAR": (0.0, 1.03), "CUBIC": (0.0481, 0.72), "LANCZOS4": (0.0267, 0.78)},
}[sys.argv[1]]
for name, (off, share) in seen.items():
    assert abs(found[name][0] - off) < 0.001 and abs(found[name][1] - share) < 0.02, (name, found[name], (off, share))
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet opencv-python-headless==$version numpy
    "$folder/$version/bin/python" "$folder/try.py" "${version%%.*}"
done
