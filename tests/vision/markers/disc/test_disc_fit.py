"""Discs in images: centres against truth and against the bound of the model, what is no disc, and images of all kinds."""

import cv2
import numpy as np
import pytest
from disc_painter import grey, outline, share

from armsight.vision.markers import discs
from armsight.vision.markers.disc.fit import REASONS
from disc_views import discs_of

BRIGHT, DARK = (discs_of(np.eye(3) * 0.05, bright=kind) for kind in (True, False))


def bound(window, contrast, blur, noise, c, a, b, rotation, step=1e-3):
    """Cramer-Rao bound of the centre, px^2: derivatives of brute-force images by the centre and all nuisances."""
    v, u = np.mgrid[: len(window), : len(window)]

    def image(x):
        return contrast * share([outline(x[:2], x[2], x[3], x[4])], x[5], np.zeros(2), len(window))

    x0 = np.array([*c, a, b, rotation, blur])
    J = [
        (image(x0 + e) - image(x0 - e)) / (2 * step * 10)
        for e in np.diag(np.full(6, 10 * step))
        if not (a == b and e[4])
    ]
    J += [window, np.ones_like(window), (u - c[0]) * (1 - window), (v - c[1]) * (1 - window)]
    J = np.stack([j.ravel() for j in J], axis=1)
    scale = np.linalg.norm(J, axis=0)
    return np.linalg.inv((J / scale).T @ (J / scale))[:2, :2] / np.outer(scale[:2], scale[:2]) * (noise**2 + 1 / 12)


@pytest.mark.parametrize(
    ("a", "b", "blur", "contrast", "noise"),
    [
        (4.0, 4.0, 0.6, 60.0, 2.0),
        (5.0, 2.6, 0.8, 150.0, 2.0),
        (9.0, 8.0, 1.0, -100.0, 2.0),
        (16.0, 9.0, 1.4, 80.0, 3.0),
    ],
)
def test_centre_reaches_the_bound(a, b, blur, contrast, noise):
    rng = np.random.default_rng(1)
    size = 2 * int(a + 4 * blur + 6) + 2
    errors, normed = [], []
    target = BRIGHT if contrast > 0 else DARK
    for _ in range(6):
        c, rotation = size / 2 + rng.uniform(-0.5, 0.5, 2), rng.uniform(0, np.pi)
        window = share([outline(c, a, b, rotation)], blur, np.zeros(2), size)
        limit = bound(window, contrast, blur, noise, c, a, b, rotation)
        for _ in range(40):
            found = target.find(grey((45.0 if contrast > 0 else 190.0) + contrast * window, noise, rng))
            assert len(found.uv) == 1
            e = found.uv[0] - c
            errors.append(e @ np.linalg.solve(limit, e) / 2)
            normed.append(e @ np.linalg.solve(found.cov_uv[0], e) / 2)
    # Each is chi-square over its 2 degrees on average 1; of 240 the mean scatters by 1/sqrt(240) = 0.065.
    assert np.sqrt(np.mean(errors)) < 1.3
    assert 1 - 4 * 0.065 < np.mean(normed) < 1 + 4 * 0.065 + 0.1


def nine_discs(rng, size, at, radius, blur):
    """A dark image of nine bright discs from a corner on, one about the middle of each square, and their centres."""
    light, true = np.full((336, 480), 45.0), []
    for x, y in [(at[0] + size * column, at[1] + size * row) for column in range(3) for row in range(3)]:
        c = size / 2 + rng.uniform(-0.5, 0.5, 2)
        light[y : y + size, x : x + size] += 130 * share([outline(c, radius, radius, 0)], blur, np.zeros(2), size)
        true.append(c + np.array([x, y]))
    return light, np.array(true)


def in_order(found, true):
    """Which found disc is each true one, errors (N, 2) and squares (N,) of their sizes in sigmas, of two directions."""
    order = [int(np.argmin(np.linalg.norm(found.uv - c, axis=1))) for c in true]
    e = found.uv[order] - true
    return order, e, np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov_uv[order]), e) / 2


def test_an_uneven_surround_and_uneven_light_do_not_pull():
    rng = np.random.default_rng(2)
    size, c, b = 64, np.array([31.3, 31.7]), 1.0
    v, u = np.mgrid[:size, :size] - 32.0
    window = share([outline(c, 10, 9, 0.4)], b, np.zeros(2), size)
    slope = 0.4 * u - 0.3 * v
    kinds = {
        "surround": 70 + slope * (1 - window) + 110 * window,
        "light": (40 + 120 * window) * (1 + slope / 100),
        "glare": 60 + 110 * window + slope,
    }
    for light in kinds.values():
        e = np.array([BRIGHT.find(grey(light, 1.0, rng)).uv[0] - c for _ in range(60)])
        assert np.abs(e.mean(axis=0)).max() < 0.003 + 4 * e.std() / np.sqrt(len(e))


def test_vignetting_that_no_single_disc_shows_does_not_pull_all_of_them():
    rng = np.random.default_rng(8)
    width, height, corner = 480, 336, 0.05
    v, u = np.mgrid[:height, :width].astype(float)
    shade = 1 - corner * ((u - (width - 1) / 2) ** 2 + (v - (height - 1) / 2) ** 2) / ((width**2 + height**2) / 4)
    light, true = nine_discs(rng, 48, (330, 190), 12, 0.8)
    errors, normed, along = [], [], []
    p = true - [(width - 1) / 2, (height - 1) / 2]
    for _ in range(12):
        found = BRIGHT.find(grey(light * shade, 3.0, rng))
        order, e, squares = in_order(found, true)
        cov, together = found.cov_uv[order], found.common[1]
        errors.append(e.mean(axis=0))
        normed += list(squares)
        np.testing.assert_allclose(together[:2] + together[2] * true, together[2] * p, atol=1e-12)
        own = np.einsum("ni,nij,nj->", p, cov, p) / (p**2).sum() ** 2
        along.append(((e * p).sum() / (p**2).sum()) ** 2 / (own + together[2] ** 2))
        assert together[2] ** 2 > 0.2 * own
    # Fitted as flat, all nine are 0.005 px nearer to the middle; noise leaves 0.001 px of that mean.
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.0025
    assert 0.7 < np.mean(normed) < 1.3
    assert 0.35 < np.mean(along) < 2.0  # chi-square of 12 over 12


def test_a_large_thing_that_slopes_is_no_vignetting():
    rng = np.random.default_rng(9)
    size = 96
    v, _ = np.mgrid[:336, :480].astype(float)
    light, true = nine_discs(rng, 48, (250, 150), 12, 0.8)
    large = share([outline(np.array([48.2, 47.7]), 30, 28, 0.3)], 0.8, np.zeros(2), size)
    light[2:98, 190:286] += 130 * large * (1 + 0.002 * (v - 50))[2:98, 190:286]
    errors, normed = [], []
    for _ in range(12):
        _, e, squares = in_order(BRIGHT.find(grey(light, 3.0, rng)), true)
        errors.append(e.mean(axis=0))
        normed += list(squares)
    # Taken for vignetting, it moves all nine by 0.008 px; noise leaves 0.001 px of their mean.
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.003
    assert np.mean(normed) < 1.4


def test_discs_before_level_surrounds_are_fitted_without_a_gradient():
    rng = np.random.default_rng(10)
    size, together, alone, normed = 40, [], [], []
    for _ in range(12):
        light, true = nine_discs(rng, size, (180, 108), 5, 1.4)
        image = grey(light, 3.0, rng)
        _, e, squares = in_order(BRIGHT.find(image), true)
        together += list(e)
        normed += list(squares)
        for c in true:
            x, y = np.rint(c - size / 2).astype(int)  # the corner of its square
            alone.append(BRIGHT.find(np.ascontiguousarray(image[y : y + size, x : x + size])).uv[0] - c + (x, y))
    # One disc alone does not show whether its surround is level: the gradient is estimated, and moves the centre.
    assert np.mean(np.square(together)) < 0.95 * np.mean(np.square(alone))
    assert 0.75 < np.mean(normed) < 1.25  # 108 chi-squares: 0.1


def test_a_disc_on_something_faint_is_found():
    rng = np.random.default_rng(12)
    spot, c = share([outline(np.array([48.0, 48.0]), 26, 26, 0)], 1.0, np.zeros(2), 96), np.array([56.3, 54.6])
    disc = share([outline(c, 6, 6, 0)], 1.0, np.zeros(2), 96)
    found = BRIGHT.find(grey(40 + 14 * spot + 130 * disc, 0.5, rng))
    assert np.linalg.norm(found.uv - c, axis=1).min() < 0.05


def test_noise_that_is_correlated_and_grows_with_contrast_is_that_of_each_discs_like():
    rng = np.random.default_rng(21)
    size, normed = 44, {30.0: [], 130.0: []}
    for _ in range(6):
        light, noise, true = np.full((3 * size, 6 * size), 60.0), rng.normal(size=(3 * size, 6 * size)), []
        for _ in range(4):  # of 3 px, as processing leaves it
            noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1) + np.roll(noise, (1, 1), (0, 1))) / 2
        noise *= 2.0 / noise.std()
        for k in range(18):
            c, contrast, at = (
                size / 2 + rng.uniform(-0.5, 0.5, 2),
                (30.0, 130.0)[k % 2],
                np.array([k % 6, k // 6]) * size,
            )
            here = (slice(at[1], at[1] + size), slice(at[0], at[0] + size))
            light[here] += contrast * share([outline(c, 11, 10, 0.3)], 1.0, np.zeros(2), size)
            noise[here] *= contrast / 60.0
            true.append((c + at, contrast))
        found = BRIGHT.find(grey(light + noise, 0.0, rng))
        for c, contrast in true:
            k = int(np.argmin(np.linalg.norm(found.uv - c, axis=1)))
            e = found.uv[k] - c
            normed[contrast].append(e @ np.linalg.solve(found.cov_uv[k], e) / 2)
    # 54 chi-squares each: 0.14; taken as white, 4 and more. The covariance is never below that of white noise.
    assert 0.6 < np.mean(normed[30.0]) < 1.35
    assert 0.6 < np.mean(normed[130.0]) < 1.35


def test_an_edge_that_is_skewed_leaves_a_centre_as_uncertain_as_blur_moves_it():
    rng = np.random.default_rng(31)
    size, light = 44, np.full((132, 132), 50.0)
    for k in range(9):
        at, c = np.array([k % 3, k // 3]) * size, size / 2 + rng.uniform(-0.5, 0.5, 2)
        light[at[1] : at[1] + size, at[0] : at[0] + size] += 130 * share(
            [outline(c, 11, 10, 0.3)], 0.7, np.zeros(2), size
        )
    sigmas = {}
    skewed = 0.85 * light + 0.15 * np.roll(light, 2, 1)  # so much of the light arrives 2 px further right
    one = light.copy()
    one[:size, :size] = skewed[:size, :size]
    for name, part in (("even", light), ("skewed", skewed), ("one", one)):
        image = grey(part, 0.5, rng)
        sharp, soft = BRIGHT.find(image), BRIGHT.find(cv2.GaussianBlur(image, (0, 0), 1.2))
        e, cov = soft.uv - sharp.uv, soft.cov_uv + sharp.cov_uv
        own = np.sqrt(sharp.cov_uv[:, [0, 1], [0, 1]])
        shift = sharp.common[0, :2] + sharp.common[0, 2] * sharp.uv  # a standard deviation
        for c in (*sharp.common, *soft.common):
            field = c[:2] + c[2] * sharp.uv
            cov = cov + field[:, :, None] * field[:, None, :]
        assert np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)) / 2 < 1.5
        sigmas[name] = own, np.abs(shift).mean(axis=0)
    (even, together), (own, shift), (odd, least) = (sigmas[name] for name in ("even", "skewed", "one"))
    assert not together.any()
    assert not least.any()
    assert shift[0] > 10 * even[:, 0].mean()
    assert shift[0] > 3 * shift[1]  # and not down
    assert own[:, 0].mean() < 1.5 * own[:, 1].mean()  # what all have in common weighs none less
    first = np.linalg.norm(BRIGHT.find(image).uv - size / 2, axis=1).argmin()
    assert odd[first, 0] > 10 * np.delete(odd, first, axis=0)[:, 0].max()


def test_motion_smears_a_disc_about_its_middle_or_is_reported():
    rng = np.random.default_rng(3)
    size, c, r = 72, np.array([35.6, 35.2]), 8.0
    for length in (4.0, 8.0, 12.0, 16.0):
        way = np.linspace(-length / 2, length / 2, 25)
        smear = np.mean(
            [share([outline(c + s * np.array([0.8, 0.6]), r, r, 0)], 0.8, np.zeros(2), size) for s in way], 0
        )
        found = [BRIGHT.find(grey(50 + 120 * smear, 2.0, rng)) for _ in range(12)]
        good = [d for d in found if len(d.uv)]
        assert len(good) == 12 or length > r
        assert all(len(d.rejected) >= 1 for d in found if not len(d.uv))
        if good:  # what the model does not hold widens the covariance
            e = np.array([d.uv[0] - c for d in good])
            assert np.sqrt((e**2).mean()) < np.sqrt(np.mean([np.trace(d.cov_uv[0]) / 2 for d in good]))


def square(c, half, rotation):
    return c + half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) @ [
        [np.cos(rotation), np.sin(rotation)],
        [-np.sin(rotation), np.cos(rotation)],
    ]


def test_what_is_no_disc_is_rejected_with_its_reason():
    rng = np.random.default_rng(4)
    size, c = 96, np.array([47.4, 47.6])
    two = [outline((c[0] - 7, c[1]), 8, 8, 0), outline((c[0] + 7, c[1]), 8, 8, 0)]
    cut = outline(c, 12, 12, 0)
    cut[:, 0] = np.minimum(cut[:, 0], c[0] + 5)
    ring = share([outline(c, 14, 14, 0)], 0.8, np.zeros(2), size) - share([outline(c, 7, 7, 0)], 0.8, np.zeros(2), size)
    shapes = {
        "square": share([square(c, 10, 0.3)], 0.8, np.zeros(2), size),
        "merged": np.minimum(share(two, 0.8, np.zeros(2), size), 1.0),
        "cut": share([cut], 0.8, np.zeros(2), size),
        "bar": share([c + np.array([[21, 4], [21, -4], [-21, -4], [-21, 4]])], 0.8, np.zeros(2), size),
        "ring": ring,
        "border": share([outline((48.0, 4.0), 8, 8, 0)], 0.8, np.zeros(2), size),
    }
    for name, window in shapes.items():
        found = BRIGHT.find(grey(50 + 120 * window, 2.0, rng))
        assert len(found.uv) == 0, name
        assert found.rejected, name
        assert all(r.reason in REASONS.values() for r in found.rejected)


@pytest.mark.parametrize("target", [BRIGHT, DARK])
@pytest.mark.parametrize(
    ("r", "ring"), [(5.0, 1.25), (6.0, 1.0), (8.0, 0.8), (8.0, 2.0), (12.0, 0.5), (15.0, 0.4), (40.0, 0.3)]
)
def test_discs_in_printed_rings_are_found(target, r, ring):
    rng = np.random.default_rng(57)
    size = 2 * int(r * (1 + ring) + 10)
    true, rows = [], []
    for j in range(2):
        row = []
        for i in range(3):
            c, angle = size / 2 + rng.uniform(-1, 1, 2), rng.uniform(0, np.pi)
            inner, outer = (share([outline(c, a, 0.9 * a, angle)], 0.7, np.zeros(2), size) for a in (r, r * (1 + ring)))
            row.append(outer - inner)
            true.append(c + size * np.array([i, j]))
        rows.append(np.hstack(row))
    light = np.vstack(rows)
    found = target.find(grey(200 - 160 * light if target is BRIGHT else 40 + 160 * light, 1.5, rng))
    off = np.linalg.norm(np.array(true)[:, None] - found.uv, axis=2)
    assert off.shape[1] > 0
    assert off.min(axis=1).max() < 0.1


@pytest.mark.parametrize("gap", [2.0, 3.0])
def test_a_disc_between_bright_squares_is_found(gap):
    rng = np.random.default_rng(58)
    size, r = 96, 14.0
    c = np.array([47.6, 48.2])
    beside = (r + gap) * np.sqrt(0.5) + 10
    squares = [square(c + beside * np.array([i, j]), 10, 0) for i in (-1, 1) for j in (-1, 1)]
    light = share([outline(c, r, r, 0)], 0.6, np.zeros(2), size)
    light += sum(share([s], 0.6, np.zeros(2), size) for s in squares)
    found = BRIGHT.find(grey(40 + 160 * light, 1.5, rng))
    assert np.linalg.norm(found.uv - c, axis=1).min(initial=9.0) < 0.1


def test_brightness_of_the_whole_does_not_matter():
    rng = np.random.default_rng(5)
    window = share([outline((31.2, 30.8), 9, 8, 0.2)], 0.9, np.zeros(2), 64)
    for base, contrast, noise in ((3.0, 14.0, 0.7), (20.0, 40.0, 1.5), (120.0, 130.0, 2.0), (10.0, 400.0, 2.0)):
        found = BRIGHT.find(grey(base + contrast * window, noise, rng))
        assert len(found.uv) == 1
        assert np.linalg.norm(found.uv[0] - (31.2, 30.8)) < 5 * np.sqrt(np.trace(found.cov_uv[0]))


def test_both_kinds_at_once():
    rng = np.random.default_rng(6)
    light = np.full((80, 160), 120.0)
    light[:, :80] += 90 * share([outline((40.2, 39.9), 10, 9, 0)], 0.8, np.zeros(2), 80)
    light[:, 80:] -= 90 * share([outline((40.2, 39.9), 10, 9, 0)], 0.8, np.zeros(2), 80)
    found = discs_of(np.eye(3) * 0.05, bright=[True, False, True]).find(grey(light, 2.0, rng))
    order = np.argsort(found.uv[:, 0])
    assert found.bright[order].tolist() == [True, False]
    assert np.allclose(found.uv[order], [[40.2, 39.9], [120.2, 39.9]], atol=0.1)


@pytest.mark.parametrize(("contrast", "noise"), [(120.0, 2.0), (16.0, 0.4)])
def test_discs_of_any_size_are_found_beside_each_other(contrast, noise):
    rng = np.random.default_rng(16)
    true = np.array([[70.3, 69.8], [250.4, 180.1], [210.2, 420.7], [451.0, 60.0]])
    halves = ((62.0, 50.0), (118.0, 105.0), (46.0, 45.0), (7.0, 6.0))
    shapes = [outline(c, a, b, 0.3) for c, (a, b) in zip(true, halves, strict=True)]
    image = grey(40 + contrast * share(shapes, 1.2, np.zeros(2), 512), noise, rng)
    found = discs_of(np.arange(12.0).reshape(4, 3) ** 2).find(image)
    assert len(found.uv) == 4
    off = found.uv[:, None] - true
    nearest = np.linalg.norm(off, axis=2).argmin(axis=1)
    assert sorted(nearest) == [0, 1, 2, 3]
    for k, at in enumerate(nearest):
        assert off[k, at] @ np.linalg.solve(found.cov_uv[k], off[k, at]) < 14.0
        assert np.linalg.norm(off[k, at]) < 0.05


@pytest.mark.parametrize("size", [(720, 1280), (719, 1277), (40, 33), (7, 7), (2, 2), (1, 1)])
@pytest.mark.parametrize("level", [0, 128, 255])
def test_empty_images_of_any_size(size, level):
    for target in (BRIGHT, DARK):
        found = target.find(np.full(size, level, np.uint8))
        assert len(found.uv) == 0
        assert found.cov_uv.shape == (0, 2, 2)


def test_a_width_that_is_no_multiple_of_eight_and_a_view_with_gaps():
    rng = np.random.default_rng(7)
    window = share([outline((40.3, 30.6), 9, 8, 0.2)], 0.9, np.zeros(2), 72)
    image = grey(50 + 100 * window, 2.0, rng)
    whole = BRIGHT.find(image)
    for width in (71, 69, 67):
        part = BRIGHT.find(image[:, :width])
        assert np.allclose(part.uv, whole.uv, atol=1e-9)
    doubled = np.repeat(image, 2, axis=1)
    assert np.allclose(BRIGHT.find(doubled[:, ::2]).uv, whole.uv)


def test_thousands_of_discs_are_all_found():
    rng = np.random.default_rng(8)
    tile = share([outline((7.6, 7.4), 4.2, 4.2, 0)], 0.7, np.zeros(2), 16)
    image = grey(40 + 150 * np.tile(tile, (60, 90)), 1.5, rng)
    found = BRIGHT.find(image)
    v, u = np.divmod(np.arange(5400), 90)
    truth = np.column_stack([16 * u + 7.6, 16 * v + 7.4])
    order = np.lexsort((found.uv[:, 0].round(-1), (found.uv[:, 1] // 16)))
    assert len(found.uv) == 5400
    assert np.abs(found.uv[order][:, 1] - truth[:, 1]).max() < 0.2


def test_noise_alone_shows_no_disc(monkeypatch):
    rng = np.random.default_rng(9)
    for noise in (12.0, 3.0, 0.5):
        assert len(BRIGHT.find(grey(np.full((480, 640), 100.0), noise, rng)).uv) == 0
        monkeypatch.setattr(discs, "_larger", None)  # where nothing differs no smaller copy is searched


def test_an_image_with_too_many_positions_is_said_to_be():
    image = (255 * np.random.default_rng(12).integers(0, 2, (2160, 3840))).astype(np.uint8)

    def full(part):
        return "no more are examined" in BRIGHT.find(part).rejected[0].reason

    row = round(BRIGHT.find(image).rejected[0].uv[1])
    assert full(image)
    assert full(image[: row + 12])
    assert not full(image[: row - 12])


def test_discs_side_by_side_are_each_found_once():
    rng = np.random.default_rng(10)
    tile = share([outline((6.3, 6.1), 3.6, 3.6, 0)], 0.6, np.zeros(2), 13)
    found = BRIGHT.find(grey(40 + 150 * np.tile(tile, (30, 40)), 1.5, rng))
    assert 1190 <= len(found.uv) <= 1200  # neighbours stand in each other's surround; a few at the border are not taken
    assert min(np.sort(np.linalg.norm(found.uv - uv, axis=1))[1] for uv in found.uv) > 10


def test_a_disc_that_is_a_little_covered_is_rejected_or_knows_it():
    rng = np.random.default_rng(11)
    for radius, cut in ((8.0, 1.0), (15.0, 1.5), (25.0, 2.5), (12.0, 0.5)):
        size = 2 * int(radius + 9)
        c = np.array([size / 2 + 0.2, size / 2 - 0.3])
        rim = outline(c, radius, radius, 0)
        rim[:, 0] = np.minimum(rim[:, 0], c[0] + radius - cut)
        window = share([rim], 0.8, np.zeros(2), size)
        for _ in range(8):
            found = BRIGHT.find(grey(50 + 120 * window, 2.0, rng))
            for uv, cov in zip(found.uv, found.cov_uv, strict=True):
                assert np.linalg.norm(uv - c) < 4 * np.sqrt(np.trace(cov) / 2)


def test_a_saturated_disc_does_not_claim_too_much():
    rng = np.random.default_rng(12)
    window = share([outline((31.3, 30.8), 9, 9, 0)], 0.9, np.zeros(2), 64)
    squares = []
    for _ in range(80):
        found = BRIGHT.find(grey(60 + 320 * window, 2.5, rng))
        e = found.uv[0] - (31.3, 30.8)
        squares.append(e @ np.linalg.solve(found.cov_uv[0], e) / 2)
    assert np.mean(squares) < 1.3  # a clipped edge is not that of the model, and the covariance holds it


def test_what_in_the_background_is_skewed_and_faint_moves_no_disc():
    rng = np.random.default_rng(41)
    size = 44
    for _ in range(6):
        light = np.full((4 * size, 4 * size), 50.0)
        for k in range(8):
            at, c = np.array([k % 4, k // 4 * 2]) * size, size / 2 + rng.uniform(-0.5, 0.5, 2)
            part = share([outline(c, 11, 10, 0.3)], 0.7, np.zeros(2), size)
            if k >= 5:
                part = 0.2 * (0.7 * part + 0.3 * np.roll(part, 3, k % 2))
            light[at[1] : at[1] + size, at[0] : at[0] + size] += 130 * part
        found = BRIGHT.find(grey(light, 1.0, rng))
        assert len(found.uv) == 8
        assert not found.common[0].any()


def wall(seed, count=16):
    """Return an image of a brick wall (480, 640) with discs of 90 levels before it, and their centres."""
    rng = np.random.default_rng(seed)
    fine = np.full((4 * 480, 4 * 640), 45.0)
    for top in range(0, 4 * 480, 96):
        for column in range(11):
            left = 208 * column - 100 + 104 * (top // 96 % 2)
            cv2.rectangle(fine, (left, top), (left + 193, top + 81), float(np.clip(rng.normal(75, 12), 50, 120)), -1)
    cells = rng.permutation(48)[:count]
    uv = np.stack([60 + 74 * (cells % 8), 50 + 76 * (cells // 8)], axis=1) + rng.uniform(-15, 15, (count, 2))
    for centre, radius in zip(uv, rng.uniform(5, 9, count), strict=True):
        cv2.circle(fine, tuple(np.rint(64 * centre + 24).astype(int).tolist()), int(64 * radius), 165.0, -1, shift=4)
    image = cv2.GaussianBlur(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    return grey(image, 2.0, rng), uv


def test_bricks_are_rejected_by_their_outlines_and_hide_no_disc():
    image, uv = wall(0)
    found = BRIGHT.find(image)
    assert np.linalg.norm(uv[:, None] - found.uv[None], axis=2).min(axis=1).max() < 0.2
    assert len(found.uv) == len(uv)
    assert {each.reason for each in found.rejected} == {REASONS[5]}
