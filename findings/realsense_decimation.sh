#!/bin/sh
# pyrealsense2 2.59.1: the intrinsics of decimated depth are those of other pixels: points are displaced sideways.
#
# decimation_filter puts n x n pixels into one: pixel u of the result covers n u to n u + n - 1 and has its centre at
# n u + (n - 1) / 2. The filter's profile has the principal point divided by n, as if pixel u were at n u (pixel (0, 0) is
# documented as a pixel's centre). Deprojected points are displaced by (n - 1) / 2 f of their distance against those of the
# full image: 0.8 mm a metre at n = 2 and f 600 px, 5.8 mm at n = 8. The rest of the field uses (c + 0.5) / n - 0.5. Where n
# does not divide the size (3, 6, 7), columns of zeros, no depth, are appended.
#
# A mark of 16 x 16 px, its centre at pixel (407.5, 247.5) of 640 x 480, 1 m away; principal point (320, 240), f 600 px.
#
# Seen: full image x 145.8 mm; n = 2 145.0, n = 4 143.3, n = 8 140.0 mm: that is 0.8, 2.5, 5.8 mm to the left.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pyrealsense2==2.59.1.11053
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pyrealsense2 as rs

WIDTH, HEIGHT, F, CX, CY = 640, 480, 600.0, 320.0, 240.0
NEAR, FAR = 1000, 3000  # mm


def camera():
    """A depth camera of software, and the function that gives its frames."""
    device = rs.software_device()
    sensor = device.add_sensor("Depth")
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, F, F, CX, CY
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid, stream.fmt = rs.stream.depth, 0, 0, rs.format.z16
    stream.width, stream.height, stream.fps, stream.bpp, stream.intrinsics = WIDTH, HEIGHT, 30, 2, lens
    profile = sensor.add_video_stream(stream)
    sensor.add_read_only_option(rs.option.depth_units, 0.001)
    queue = rs.frame_queue(10)
    sensor.open(profile)
    sensor.start(queue)

    def frame(image):
        one = rs.software_video_frame()
        one.pixels, one.bpp, one.stride, one.timestamp, one.frame_number = image, 2, 2 * WIDTH, 1.0, 1
        one.profile, one.domain = profile.as_video_stream_profile(), rs.timestamp_domain.hardware_clock
        sensor.on_video_frame(one)
        return queue.wait_for_frame()

    return device, sensor, frame


def mark(frame):
    """Where the mark's points are on the mean, x y, mm, and the frame's intrinsics."""
    lens = frame.profile.as_video_stream_profile().intrinsics
    depth = np.asanyarray(frame.get_data())
    rows, columns = np.nonzero(depth == NEAR)
    points = [rs.rs2_deproject_pixel_to_point(lens, [float(u), float(v)], NEAR) for u, v in zip(columns, rows, strict=True)]
    return np.mean(points, axis=0)[:2], lens


image = np.full((HEIGHT, WIDTH), FAR, np.uint16)
image[240:256, 400:416] = NEAR
device, sensor, frame = camera()
full = frame(image)
there, _ = mark(full.as_video_frame())
print(f"full image: x {there[0]:.1f}, y {there[1]:.1f} mm")
assert np.allclose(there, [(407.5 - CX) / F * NEAR, (247.5 - CY) / F * NEAR], atol=0.01)
for n in (2, 4, 8):
    filtered = rs.decimation_filter()
    filtered.set_option(rs.option.filter_magnitude, n)
    found, lens = mark(filtered.process(full).as_video_frame())
    off = found - there
    print(f"n = {n}: principal point {lens.ppx:.1f} {lens.ppy:.1f}, x {found[0]:.1f}, y {found[1]:.1f} mm, off {off.round(1)}")
    assert (lens.ppx, lens.ppy, lens.fx) == (CX / n, CY / n, F / n)
    assert np.allclose(off, -(n - 1) / 2 / F * NEAR, atol=0.01)
PYTHON
