"""Calibration and poses in images of another program: boards path-traced by Mitsuba 3 before two pinhole cameras.

    pip install mitsuba
    python benchmarks/path_traced.py [circles|chessboard] [--seed 11] [--pairs 14] [--shots 6]

A glossy board in a room, a lamp of 0.14 m half a metre away, indirect light, 32 samples a pixel (so neighbours' noise is
correlated by the film's filter, and grows in the dark), gamma 1/2.2, 8 bits. Poses are drawn anew where a camera would not
see the whole board. Nothing of armsight renders here; half a minute of computing a pair. Errors are those of the board's
middle, against the truth, of shots that were not calibrated with.
"""

from __future__ import annotations

import argparse

import numpy as np

from armsight import Missed, Pair, Shot, calibrate_boards, measure, open_board, open_target
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3, skew

SIZE_PX, PITCH_M, COLUMNS, ROWS, RADIUS_M = (800, 600), 0.025, 9, 6, 0.007
#: fx = fy, cx, cy of the left and the right camera, px; the right one's pose in the left one's frame.
CAMERAS = ((820.0, 406.8, 295.4), (828.2, 394.3, 305.9))
T_LEFT_RIGHT = pose(exp_so3(np.array([-0.005, 0.06, -0.01])), np.array([0.12, 0.004, -0.003]))
TEXELS = 10_000  # a metre
EXPOSURE = 1.9


def texture(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the print (H, W), reflectance, and where its first point is on it, m."""
    extra = 1 if kind == "circles" else 2
    width, height = (COLUMNS + extra) * PITCH_M, (ROWS + extra) * PITCH_M
    x, y = ((np.arange(round(TEXELS * side)) + 0.5) / TEXELS for side in (width, height))
    if kind == "circles":
        off = [np.abs((axis + PITCH_M / 2) % PITCH_M - PITCH_M / 2) for axis in (x, y)]
        dark = np.hypot(off[1][:, None], off[0]) < RADIUS_M
        rim = [(axis > PITCH_M / 2) & (axis < side - PITCH_M / 2) for axis, side in ((x, width), (y, height))]
        return np.where(dark & rim[1][:, None] & rim[0], 0.07, 0.92), np.full(2, PITCH_M)
    column, row = (np.floor(axis / PITCH_M - 0.5).astype(int) for axis in (x, y))
    inside = ((row >= 0) & (row <= ROWS))[:, None] & (column >= 0) & (column <= COLUMNS)
    return np.where(inside & ((row[:, None] + column) % 2 == 0), 0.07, 0.92), np.full(2, 1.5 * PITCH_M)


def project(T_camera_board: np.ndarray, p_board: np.ndarray, camera: tuple[float, float, float]) -> np.ndarray:
    """Return the pixels (N, 2) of points (N, 3) on the board."""
    p = transform(T_camera_board, p_board)
    return camera[0] * p[:, :2] / p[:, 2:] + camera[1:]


def draw(rng: np.random.Generator, corners: np.ndarray) -> np.ndarray:
    """Return T_left_board (4, 4) of a board that both cameras see whole, its middle the origin."""
    while True:
        R = exp_so3(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.4])
        T = pose(R, np.array([rng.uniform(-0.12, 0.24), rng.uniform(-0.15, 0.15), rng.uniform(0.42, 0.8)]))
        both = [
            project(each @ T, corners, camera)
            for each, camera in zip((np.eye(4), inverse(T_LEFT_RIGHT)), CAMERAS, strict=True)
        ]
        if all((uv > 5).all() and (uv < np.array(SIZE_PX) - 5).all() for uv in both):
            return T


class Room:
    """Renders the board where it is held."""

    def __init__(self, print_: np.ndarray) -> None:
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        self.mi = mi
        bitmap = mi.Bitmap(np.repeat(print_[..., None], 3, 2).astype(np.float32))
        reflectance = {
            "type": "bitmap",
            "raw": True,
            "bitmap": bitmap,
            "to_uv": mi.ScalarTransform4f().scale([1, -1, 1]),
        }
        glossy = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.35, "diffuse_reflectance": reflectance}
        self.paper = {"type": "twosided", "of": glossy}
        self.half = np.array(print_.shape[::-1]) / (2 * TEXELS)

    def scene(self, T_left_board: np.ndarray) -> object:
        """Return the room with the board at a pose (4, 4) of its middle."""
        mi, at = self.mi, self.mi.ScalarTransform4f
        wall = {"type": "checkerboard", "color0": 0.35, "color1": 0.45, "to_uv": at().scale([9, 7, 1])}
        matt = [{"type": "twosided", "of": {"type": "diffuse", "reflectance": each}} for each in (wall, 0.3)]
        lamp = at().look_at(origin=[-0.5, -0.6, 0.1], target=[0.1, 0, 0.6], up=[0, 0, 1]).scale(0.07)
        board = at(T_left_board @ np.diag([*self.half, 1.0, 1.0]))
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 4},
                "board": {"type": "rectangle", "to_world": board, "of": self.paper},
                "wall": {"type": "rectangle", "to_world": at().translate([0, 0, 1.6]).scale(2.0), "of": matt[0]},
                "table": {
                    "type": "rectangle",
                    "to_world": at().translate([0, 0.5, 1]).rotate([1, 0, 0], 90).scale(1.5),
                    "of": matt[1],
                },
                "lamp": {"type": "rectangle", "to_world": lamp, "of": {"type": "area", "radiance": 28.0}},
                "sky": {"type": "constant", "radiance": 0.35},
            }
        )

    def shot(self, name: str, T_left_board: np.ndarray, rng: np.random.Generator) -> Shot:
        """Return both images."""
        scene, images = self.scene(T_left_board), []
        width, height = SIZE_PX
        for T_left_camera, (f, cx, cy) in zip((np.eye(4), T_LEFT_RIGHT), CAMERAS, strict=True):
            film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"}
            film["rfilter"] = {"type": "gaussian", "stddev": 0.5}
            sensor = {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(2 * np.degrees(np.arctan(width / 2 / f))),
                "principal_point_offset_x": -(cx + 0.5 - width / 2) / width,  # Mitsuba: + is to the left
                "principal_point_offset_y": -(cy + 0.5 - height / 2) / height,
                "to_world": self.mi.ScalarTransform4f(T_left_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
                "film": film,
                "sampler": {"type": "independent", "sample_count": 32},
            }
            seed = int(rng.integers(2**30))
            light = np.array(self.mi.render(scene, sensor=self.mi.load_dict(sensor), seed=seed))[..., 0]
            images.append(np.round(255 * np.clip(EXPOSURE * light, 0, 1) ** (1 / 2.2)).astype(np.uint8))
        return Shot(name, images[0], images[1], None)


def main() -> None:
    """Render, calibrate, measure; print errors beside their sigmas."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="?", choices=("circles", "chessboard"), default="circles")
    for name, default in (("seed", 11), ("pairs", 14), ("shots", 6)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    print_, first = texture(given.kind)
    room, spec = Room(print_), f"{given.kind}:{COLUMNS}x{ROWS}:{1e3 * PITCH_M:g}mm"
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)]) * [*room.half, 1.0]
    truth = [draw(rng, corners) for _ in range(given.pairs + given.shots)]
    shots = []
    for k, T in enumerate(truth):
        shots.append(room.shot(f"{k:02d}", T, rng))
        print(f"rendered {k + 1} of {len(truth)}", end="\r", flush=True)
    print()

    board = open_board(spec)
    pairs = [Pair(each.name, board.detect(each.left), board.detect(each.right)) for each in shots[: given.pairs]]
    found = calibrate_boards(board, pairs, (SIZE_PX, SIZE_PX))
    rig, held = found.rig, found.held_out
    print(f"{spec}, seed {given.seed}: {given.pairs} pairs, held-out epipolar {held.epipolar_rms_px:.3f} px, ", end="")
    print(f"board {1e3 * held.rigid_rms_m:.3f} mm RMS; baseline {1e3 * rig.baseline_m:.3f} mm, ", end="")
    print(f"truth {1e3 * np.linalg.norm(T_LEFT_RIGHT[:3, 3]):.3f}")
    for side, camera, (f, cx, cy) in zip(("left", "right"), (rig.left, rig.right), CAMERAS, strict=True):
        own = camera.intrinsics
        print(f"  {side}: fx {own[0]:.2f} fy {own[1]:.2f} (truth {f}), cx {own[2]:.2f} cy {own[3]:.2f} ({cx}, {cy}) px")

    target, middle = open_target(spec), np.append(room.half - first, 0.0)
    errors, nees, claimed = [], [], []
    for T, shot in zip(truth[given.pairs :], shots[given.pairs :], strict=True):
        estimate = measure(rig, target, shot)
        if isinstance(estimate, Missed):
            print(f"  {shot.name} missed: {estimate.reason}")
            continue
        R = estimate.T_left_body[:3, :3]
        J = np.hstack([R, -R @ skew(middle)])
        cov = J @ estimate.cov @ J.T
        errors.append(transform(estimate.T_left_body, middle[None])[0] - T[:3, 3])
        nees.append(errors[-1] @ np.linalg.solve(cov, errors[-1]) / 3)
        claimed.append(np.trace(cov))
    e = 1e3 * np.array(errors)
    rms, scatter, sigma = (
        np.sqrt((e**2).sum(axis=1).mean()),
        np.sqrt(e.var(axis=0).sum()),
        1e3 * np.sqrt(np.mean(claimed)),
    )
    print(f"  {len(e)} of {given.shots} shots measured: middle off by {rms:.3f} mm RMS, sigma {sigma:.3f}; ", end="")
    print(f"about their mean {scatter:.3f} mm; NEES per number {np.mean(nees):.2f}")


if __name__ == "__main__":
    main()
