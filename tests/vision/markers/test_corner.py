"""X corners against brute-force paintings: error, bias, honesty of the covariance, and what is refused."""

import cv2
import numpy as np
import pytest
from supersampled import checks, expose, paint, project, view

from armsight.vision.markers import crossing
from armsight.vision.markers.corner import MOVED_MAX_PX, VERDICTS, refine_corners
from asserts import assert_jacobian

NEIGHBOURS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def scene(rng, pitch_px, tilt, blur_px):
    """Return a painted corner of a random view, its place and the sides of its square."""
    samples = 16 if pitch_px < 28 else 10
    size = int(3.2 * pitch_px) | 1
    centre = size // 2 + rng.uniform(-0.5, 0.5, 2)
    H = view(pitch_px, tilt, *rng.uniform(0.0, 2 * np.pi, 2), centre, distance=40.0)
    p = project(H, NEIGHBOURS)
    sides = [min(p[1] - p[0], p[0] - p[2], key=np.linalg.norm), min(p[3] - p[0], p[0] - p[4], key=np.linalg.norm)]
    return paint(checks, H, (size, size), blur_px, samples), p[0], np.array(sides)


def trials(rng, pitch_px, tilt, blur_px, contrast, noise, scenes=6, draws=50):
    """Return errors (scenes, draws, 2), squared errors over covariance, and the errors of cv2.cornerSubPix."""
    errors, normalised, theirs = [], [], []
    half = int(np.clip(0.42 * pitch_px * np.cos(tilt), 2, 12))
    for _ in range(scenes):
        painted, truth, sides = scene(rng, pitch_px, tilt, blur_px)
        for _ in range(draws):
            image = expose(painted, contrast, noise, rng)
            start = truth + rng.normal(0.0, 0.4, 2)
            fit = refine_corners(image, start[None], sides[None])
            assert fit.kept.all(), VERDICTS[fit.verdict[0]]
            e = fit.uv[0] - truth
            errors.append(e)
            normalised.append(e @ np.linalg.solve(fit.cov_uv[0], e))
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
            found = cv2.cornerSubPix(image, start.astype(np.float32).reshape(1, 1, 2), (half, half), (-1, -1), stop)
            theirs.append(found.ravel() - truth)
    shape = (scenes, draws, 2)
    return np.reshape(errors, shape), np.array(normalised), np.reshape(theirs, shape)


@pytest.mark.parametrize(
    ("pitch_px", "tilt", "blur_px", "contrast", "noise"),
    [
        (20, 0.0, 1.0, 120, 2),
        (13, 0.3, 0.6, 120, 2),
        (30, 0.8, 0.5, 200, 4),
        (40, 1.05, 1.5, 60, 1),
        (24, 0.6, 0.3, 150, 1),
        (16, 0.5, 1.2, 100, 3),
    ],
)
def test_errors_are_small_unbiased_and_as_large_as_predicted(pitch_px, tilt, blur_px, contrast, noise):
    rng = np.random.default_rng(pitch_px)
    errors, normalised, theirs = trials(rng, pitch_px, tilt, blur_px, contrast, noise)
    rms = np.sqrt(np.mean(errors**2))
    # 600 degrees of freedom: the ratio scatters by 0.029, and 0.1 is what is promised.
    assert 0.9 < np.sqrt(np.mean(normalised) / 2) < 1.1
    bias = errors.mean(axis=1)
    by_chance = np.mean(errors.var(axis=1)) / errors.shape[1]
    assert np.mean(bias**2) < 0.003**2 + 2.0 * by_chance
    assert rms < 0.75 * np.sqrt(np.median(np.sum(theirs**2, axis=2)) / (2 * np.log(2)))


def test_uneven_light_does_not_move_a_corner():
    rng = np.random.default_rng(2)
    painted, truth, sides = scene(rng, 24, 0.4, 0.8)
    x = np.arange(painted.shape[1]) - truth[0]
    lit = (128 + 60 * painted) * (1.0 + 0.008 * x)  # 20% over a square
    errors = [
        refine_corners(np.rint(lit + rng.normal(0, 1, lit.shape)).astype(np.uint8), truth[None], sides[None]).uv[0]
        - truth
        for _ in range(50)
    ]
    assert np.abs(np.mean(errors, axis=0)).max() < 0.004


def test_known_bow_is_taken_out():
    bow = 0.002  # 1/px: a strong webcam lens near the image's corner

    def bowed(x, y):
        return checks(x - bow * 24.0 * y**2, y + bow * 24.0 * x**2)

    truth, size = np.array([38.3, 37.6]), 77
    H = np.array([[24.0, 0.0, truth[0]], [0.0, 24.0, truth[1]], [0.0, 0.0, 1.0]])
    image = np.rint(128 + 60 * paint(bowed, H, (size, size), 0.8)).astype(np.uint8)
    sides, bows = np.diag([24.0, 24.0])[None], np.array([[[0.0, -bow], [bow, 0.0]]])
    straight = refine_corners(image, truth[None], sides).uv[0] - truth
    known = refine_corners(image, truth[None], sides, bows).uv[0] - truth
    assert np.abs(straight).min() > 0.02
    assert np.abs(known).max() < 0.006  # grey levels are rounded here, and the edges run along the pixels


def test_derivatives_hold_against_finite_differences():
    rng = np.random.default_rng(4)
    n = 200
    px = np.vstack([rng.uniform(-8, 8, (2, n)), rng.uniform(0, 255, n)])
    sides, bow = np.array([[0.96, 0.28], [-0.1, 0.99]]), np.array([[0.0005, -0.001], [0.001, 0.0004]])
    q = np.array([0.3, -0.2, 1.8, 0.1, 0.5, 0.9, 120.0, 55.0, 0.003, -0.002])

    def residuals(q):
        J, r = np.empty((crossing.PARAMETERS, n)), np.empty(n)
        crossing._evaluate(n, px, q, sides, bow, J, r)
        return r

    J, r = np.empty((crossing.PARAMETERS, n)), np.empty(n)
    crossing._evaluate(n, px, q, sides, bow, J, r)
    # Profiles come from tables, and are cut off at four sigma with 6e-5 of the contrast left: over a step of 0.02 this
    # is 0.003 of a derivative.
    assert_jacobian(-J.T, residuals, q, np.array([0.02, 0.02, 0.01, 0.01, 0.02, 0.02, 1, 1, 0.01, 0.01]), rtol=4e-3)


def test_a_start_far_off_is_refused():
    painted, truth, sides = scene(np.random.default_rng(5), 30, 0.2, 0.8)
    image = expose(painted, 120, 1, np.random.default_rng(5))
    fit = refine_corners(image, truth[None] + MOVED_MAX_PX + 0.5, sides[None])
    assert not fit.kept[0]


@pytest.mark.parametrize("what", ["blank", "noise", "edge", "outside", "unknown", "covered"])
def test_what_is_no_corner_is_refused(what):
    rng = np.random.default_rng(6)
    painted, truth, sides = scene(rng, 24, 0.2, 0.8)
    image = expose(painted, 120, 2, rng)
    if what == "blank":
        image = np.full_like(image, 128)
    elif what == "noise":
        image = rng.integers(0, 256, image.shape, dtype=np.uint8)
    elif what == "edge":
        image[:, : int(truth[0])], image[:, int(truth[0]) :] = 60, 190
    elif what == "outside":
        truth = np.array([1.0, 1.0])
    elif what == "unknown":
        truth = np.array([np.nan, 10.0])
    else:
        image[int(truth[1]) - 1 :, :] = 128
    assert not refine_corners(image, truth[None], sides[None]).kept[0]


def test_contrast_tells_the_colours_and_does_not_depend_on_which_way_the_sides_point():
    painted, truth, sides = scene(np.random.default_rng(7), 24, 0.2, 0.8)
    image = expose(painted, 120, 1, np.random.default_rng(7))
    fit = refine_corners(image, np.repeat(truth[None], 3, axis=0), np.array([sides, -sides, sides * [[1], [-1]]]))
    assert fit.contrast[0] < -50  # checks are dark between the first and the second side
    np.testing.assert_allclose(fit.contrast[1], fit.contrast[0], rtol=1e-3)
    np.testing.assert_allclose(fit.contrast[2], -fit.contrast[0], rtol=1e-3)
