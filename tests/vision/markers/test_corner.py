"""X corners against brute-force paintings: error, bias, honesty of the covariance, and what is rejected."""

import cv2
import numpy as np
import pytest
from supersampled import checks, expose, paint, project, view

from armsight.vision.markers import crossing
from armsight.vision.markers.corner import MOVED_MAX_PX, OUTCOMES, refine_corners
from armsight.vision.normal import edge, edge_single
from asserts import assert_jacobian

NEIGHBOURS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def scene(rng, pitch_px, tilt, blur_px):
    """Return a painted corner of a random view, its position and the sides of its square."""
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
            assert fit.kept.all(), OUTCOMES[fit.outcome[0]]
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


def crossing_work(px):
    """Return a work space with the pixels px (3, n): x, y, grey."""
    work = np.zeros(crossing.WORK, np.float32)
    for row, values in zip((0, crossing.Y, crossing.GREY), px, strict=True):
        work[row : row + len(values)] = values
    return work


Q = np.array([0.3, -0.2, 1.8, 0.1, 0.5, 0.9, 120.0, 55.0, 0.003, -0.002])
SIDES, BOW = np.array([[0.96, 0.28], [-0.1, 0.99]]), np.array([[0.0005, -0.001], [0.001, 0.0004]])


def test_derivatives_hold_against_finite_differences():
    rng = np.random.default_rng(4)
    n = 200
    px = np.vstack([rng.uniform(-8, 8, (2, n)), rng.uniform(0, 255, n)])

    def evaluated(q):
        work = crossing_work(px)
        crossing.evaluate(n, work, 0.0, 0.0, q, SIDES, BOW)
        rows = work[crossing.JACOBIAN :].reshape(-1, crossing.ROOM)[: crossing.PARAMETERS + 1, :n]
        return rows.astype(np.float64)

    # Single precision: residuals of up to 200 are good to 2e-5, differences of two over a step of 0.02 to 1e-3, where a
    # derivative is up to 50. The model's own C has 6e-5 of the contrast left.
    steps = np.array([0.02, 0.02, 0.01, 0.01, 0.02, 0.02, 1, 1, 0.01, 0.01])
    assert_jacobian(-evaluated(Q)[:-1].T, lambda q: evaluated(q)[-1], Q, steps, rtol=4e-3)


def test_pixels_of_plain_squares_count_by_their_moments_as_one_by_one():
    rng = np.random.default_rng(8)
    x, y = (array.ravel() for array in np.mgrid[-11:12, -11:12].astype(np.float64))
    u = np.stack([np.cos(Q[2]) * x + np.sin(Q[2]) * y, np.cos(Q[3]) * x + np.sin(Q[3]) * y])
    far = np.abs(u).min(axis=0) > 7.0  # beyond any blur: both ways of counting see M = 1 or -1
    px = np.stack([x, y, rng.uniform(60, 180, len(x))])
    moments = np.zeros((2, crossing.MOMENTS))
    for row, side in enumerate((u[0] * u[1] > 0, u[0] * u[1] < 0)):
        x_, y_, grey = px[:, far & side]
        moments[row] = [
            np.sum(v) for v in (x_ * 0 + 1, x_, y_, x_**2, x_ * y_, y_**2, grey, grey * x_, grey * y_, grey**2)
        ]
    found = []
    for pixels, flat in ((px, np.zeros_like(moments)), (px[:, ~far], moments)):
        H = np.zeros((crossing.PARAMETERS + 2, crossing.PARAMETERS + 2))
        work, n = crossing_work(pixels), pixels.shape[1]
        cost = crossing._assemble(n, work, flat, 0.0, 0.0, Q, SIDES, BOW, H)
        found.append(np.append(H[np.tril_indices(crossing.PARAMETERS)], [*H[crossing.PARAMETERS, :10], cost]))
    scale = np.abs(found[0]) + 1e-3 * np.abs(found[0]).max()
    assert (np.abs(found[1] - found[0]) / scale).max() < 1e-4  # single precision on one side only


def test_a_start_far_off_is_rejected():
    painted, truth, sides = scene(np.random.default_rng(5), 30, 0.2, 0.8)
    image = expose(painted, 120, 1, np.random.default_rng(5))
    fit = refine_corners(image, truth[None] + MOVED_MAX_PX + 0.5, sides[None])
    assert not fit.kept[0]


@pytest.mark.parametrize("what", ["blank", "noise", "edge", "outside", "unknown", "covered"])
def test_what_is_no_corner_is_rejected(what):
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


def test_a_corner_that_is_not_kept_does_not_change_the_sigma_of_others():
    rng = np.random.default_rng(9)
    size, pitch = 200, 22.0
    H = view(pitch, 0.2, 0.3, 0.2, np.array([100.0, 100.0]), distance=40.0)
    image = expose(paint(checks, H, (size, size), 0.8, 8), 120, 2, rng)
    grid = np.array([[x, y] for y in range(-3, 4) for x in range(-3, 4)], float)
    uv = project(H, grid)
    squares = np.stack([project(H, grid + step) - uv for step in ((1, 0), (0, 1))], axis=1)
    alone = refine_corners(image, uv, squares)
    beside = refine_corners(image, np.vstack([uv, uv[:3] + 9.0]), np.vstack([squares, squares[:3]]))
    assert alone.kept.all()
    assert not beside.kept[len(uv) :].any()
    np.testing.assert_allclose(beside.cov_uv[: len(uv)], alone.cov_uv, rtol=1e-9)


@pytest.mark.filterwarnings("error")
def test_squares_of_any_shape_in_any_image_give_finite_numbers():
    rng = np.random.default_rng(12)
    for _ in range(60):
        image = np.clip(rng.normal(30, rng.choice([0.0, 1.0, 20.0]), (90, 120)), 0, 255).astype(np.uint8)
        uv = rng.uniform(0, 120, (12, 2))
        squares = rng.normal(0, rng.choice([0.0, 0.5, 8.0, 60.0], (12, 1, 1)), (12, 2, 2))
        first = refine_corners(image, uv, squares, rough=True)
        for like in (None, first):
            fits = refine_corners(image, uv, squares, like=like)
            assert np.isfinite(fits.cov_uv).all()
            assert np.isfinite(fits.residual).all()


def test_contrast_gives_the_colours_and_does_not_depend_on_which_way_the_sides_point():
    painted, truth, sides = scene(np.random.default_rng(7), 24, 0.2, 0.8)
    image = expose(painted, 120, 1, np.random.default_rng(7))
    fit = refine_corners(image, np.repeat(truth[None], 3, axis=0), np.array([sides, -sides, sides * [[1], [-1]]]))
    assert fit.contrast[0] < -50  # checks are dark between the first and the second side
    np.testing.assert_allclose(fit.contrast[1], fit.contrast[0], rtol=1e-3)
    np.testing.assert_allclose(fit.contrast[2], -fit.contrast[0], rtol=1e-3)


def test_edges_in_single_precision_are_those_from_tables():
    u = np.linspace(-15.0, 15.0, 3001)
    for s, w in ((0.17, 1.0), (0.5, 0.8), (1.3, 0.71)):
        # Tables end at four sigma, where 6e-5 is left and a density of 1.3e-4.
        exact = np.array([edge(x, s, w) for x in u])
        arguments = (1.0 / s, 2.0 * s, 0.5 * w, 1.0 / w)
        single = np.array([edge_single(np.float32(x), *map(np.float32, arguments)) for x in u])
        np.testing.assert_allclose(single, exact, atol=5e-4)
        inside = np.abs(u) < 4.0 * s - 0.5 * w  # both ends of the box are within the tables
        np.testing.assert_allclose(single[inside], exact[inside], atol=1e-5)
