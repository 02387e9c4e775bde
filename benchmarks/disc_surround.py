"""What stands around and between discs: textures, and clutter that holds no disc. All from a seed."""

from __future__ import annotations

import cv2
import numpy as np

WIDTH, HEIGHT = 1280, 720


def plaster(rng: np.random.Generator, blur: float) -> np.ndarray:
    """Return noise of all scales, each octave weaker than the coarser one."""
    total = np.zeros((HEIGHT, WIDTH), np.float32)
    for scale in (64, 32, 16, 8, 4, 2):
        cells = (HEIGHT // scale + 4, WIDTH // scale + 4)
        noise = rng.standard_normal(cells, dtype=np.float32)
        whole = cv2.resize(noise, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        top, left = rng.integers(0, scale, 2)
        total += np.float32((scale / 64) ** 0.5) * whole[top : top + HEIGHT, left : left + WIDTH]
    return _through_lens(total, blur)


def wood(rng: np.random.Generator, blur: float) -> np.ndarray:
    """Return grain: stripes that wander, with fibres along them."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    angle = rng.uniform(0, np.pi)
    along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
    bend = 40 * np.sin(along / rng.uniform(150, 400) + rng.uniform(0, 6)) + 12 * np.sin(along / 61.0)
    rings = np.sin(2 * np.pi * (across + bend) / rng.uniform(18, 45)) ** 3
    fibres = rng.standard_normal((HEIGHT, WIDTH), dtype=np.float32)
    kernel = np.zeros((31, 31), np.float32)
    end = (round(15 + 14 * np.cos(angle)), round(15 + 14 * np.sin(angle)))
    cv2.line(kernel, (30 - end[0], 30 - end[1]), end, 1.0)
    fibres = cv2.filter2D(fibres, cv2.CV_32F, kernel / kernel.sum())
    return _through_lens((rings + 1.5 * fibres / fibres.std() * 0.4).astype(np.float32), blur)


def bricks(rng: np.random.Generator, blur: float) -> np.ndarray:
    """Return bricks of uneven colour with mortar between them, over fine noise."""
    height, width, mortar = int(rng.integers(18, 36)), int(rng.integers(40, 80)), int(rng.integers(2, 5))
    rows, columns = HEIGHT // height + 2, WIDTH // width + 3
    image = np.full((HEIGHT, WIDTH), -1.2, np.float32)
    for j in range(rows):
        for i in range(columns):
            left, top = i * width - (width // 2 if j % 2 else 0) - width // 3, j * height - height // 3
            grey = rng.normal(0.3, 0.5)
            cv2.rectangle(image, (left, top), (left + width - mortar, top + height - mortar), float(grey), -1)
    return _through_lens(image + 0.25 * rng.standard_normal(image.shape, dtype=np.float32), blur)


def _through_lens(image: np.ndarray, blur: float) -> np.ndarray:
    """Lay the lens's and the pixel's blur over a texture."""
    return cv2.GaussianBlur(image, (0, 0), float(np.hypot(blur, 0.3))).astype(np.float64)


TEXTURES = {"plaster": plaster, "wood": wood, "bricks": bricks}


def clutter(
    rng: np.random.Generator,
    width: int = WIDTH,
    items: int = 90,
    blur: float = 0.8,
    discs: int = 0,
    radius: float = 9.0,
) -> np.ndarray:
    """Return the light (HEIGHT, width) of things that are no discs, rendered at twice the size and averaged.

    Text, lines, boxes, squares, half and cut discs, rings, merged and touching discs, glints, chessboard corners; and on
    top so many loose bright discs of a radius, for those who ask for them.
    """
    scale = 2
    canvas = np.full((scale * HEIGHT, scale * width), int(rng.integers(60, 160)), np.uint8)
    for kind in rng.integers(0, len(ITEMS), items):
        middle = rng.uniform((0, 0), (scale * width, scale * HEIGHT))
        size = scale * np.exp(rng.uniform(np.log(4), np.log(25)))
        ITEMS[kind](canvas, middle, size, float(rng.uniform(15, 240)), rng)
    for middle in rng.uniform((0, 0), (scale * width, scale * HEIGHT), (discs, 2)):
        _fill(canvas, _circle(middle, scale * (radius + 12), rng), 40.0)
        _fill(canvas, _circle(middle, scale * radius, rng), 220.0)
    image = cv2.resize(canvas, (width, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(image, (0, 0), blur)


def one_kind(kind: int, rng: np.random.Generator, blur: float = 0.8) -> tuple[np.ndarray, int]:
    """Return the light of things of one kind, apart from each other, 5 to 25 px in radius, and how many there are."""
    pitch = 120
    canvas = np.full((2 * HEIGHT, 2 * WIDTH), 130, np.uint8)
    spots = [(u, v) for v in range(pitch // 2, HEIGHT, pitch) for u in range(pitch // 2, WIDTH, pitch)]
    for u, v in spots:
        grey = 130.0 + (1 if rng.random() < 0.5 else -1) * rng.uniform(50, 115)
        middle = 2 * (np.array([u, v]) + rng.uniform(-5, 5, 2))
        ITEMS[kind](canvas, middle, 2 * np.exp(rng.uniform(np.log(5), np.log(25))), grey, rng)
    image = cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(image, (0, 0), blur), len(spots)


def _fill(canvas: np.ndarray, points: np.ndarray, grey: float) -> None:
    cv2.fillPoly(canvas, [np.round(points * 16).astype(np.int32)], grey, cv2.LINE_AA, 4)


def _circle(
    middle: np.ndarray, radius: float, rng: np.random.Generator, start: float = 0.0, end: float = 2 * np.pi
) -> np.ndarray:
    """Return points along a tilted disc's rim."""
    t, angle, flat = np.linspace(start, end, 90), rng.uniform(0, np.pi), rng.uniform(0.6, 1.0)
    p, q = radius * np.cos(t), radius * flat * np.sin(t)
    return middle + np.stack([p * np.cos(angle) - q * np.sin(angle), p * np.sin(angle) + q * np.cos(angle)], axis=1)


def _text(canvas, middle, radius, grey, rng) -> None:
    letters = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVWXYZ12345679"), rng.integers(2, 8)))
    face = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX]))
    size = radius / 12
    cv2.putText(canvas, letters, middle.astype(int).tolist(), face, size, grey, max(1, int(size * 2)), cv2.LINE_AA)


def _line(canvas, middle, radius, grey, rng) -> None:
    end = middle + rng.normal(0, 8 * radius, 2)
    cv2.line(canvas, middle.astype(int).tolist(), end.astype(int).tolist(), grey, int(rng.integers(1, 14)))


def _box(canvas, middle, radius, grey, rng) -> None:
    sides = radius * rng.uniform(0.8, 8.0, 2)
    _fill(canvas, cv2.boxPoints((middle.tolist(), sides.tolist(), rng.uniform(0, 180))), grey)


def _square(canvas, middle, radius, grey, rng) -> None:
    _fill(canvas, cv2.boxPoints((middle.tolist(), (1.8 * radius, 1.8 * radius), rng.uniform(0, 180))), grey)


def _polygon(canvas, middle, radius, grey, rng) -> None:
    t = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
    _fill(canvas, middle + radius * np.stack([np.cos(t), np.sin(t)], axis=1), grey)


def _part_disc(canvas, middle, radius, grey, rng) -> None:
    """Half a disc, or one with a piece cut off."""
    start = rng.uniform(0, 2 * np.pi)
    _fill(canvas, _circle(middle, radius, rng, start, start + rng.uniform(2.6, 5.2)), grey)


def _pie(canvas, middle, radius, grey, rng) -> None:
    start = rng.uniform(0, 2 * np.pi)
    rim = _circle(middle, radius, rng, start, start + rng.uniform(2.0, 5.6))
    _fill(canvas, np.vstack([rim, middle]), grey)


def _ring(canvas, middle, radius, grey, rng) -> None:
    rim = np.round(_circle(middle, radius, rng) * 16).astype(np.int32)
    cv2.polylines(canvas, [rim], True, grey, max(2, int(radius * rng.uniform(0.1, 0.35))), cv2.LINE_AA, 4)


def _merged(canvas, middle, radius, grey, rng) -> None:
    """Two discs that touch or overlap."""
    way = radius * rng.uniform(0.8, 1.9)
    angle = rng.uniform(0, 2 * np.pi)
    _fill(canvas, _circle(middle, radius, rng), grey)
    other = middle + way * np.array([np.cos(angle), np.sin(angle)])
    _fill(canvas, _circle(other, radius * rng.uniform(0.6, 1.0), rng), grey)


def _glint(canvas, middle, radius, grey, rng) -> None:
    """A bright disc with a lamp's reflection on it, or a streak."""
    if rng.random() < 0.5:
        _fill(canvas, _circle(middle, radius, rng), grey)
        _fill(
            canvas, _circle(middle + rng.normal(0, 0.3 * radius, 2), radius * rng.uniform(0.3, 0.5), rng), 255.0 - grey
        )
    else:
        angle = rng.uniform(0, np.pi)
        t = np.linspace(0, 2 * np.pi, 60)
        p, q = 2.5 * radius * np.cos(t) ** 3, 0.5 * radius * np.sin(t) ** 3
        points = np.stack([p * np.cos(angle) - q * np.sin(angle), p * np.sin(angle) + q * np.cos(angle)], axis=1)
        _fill(canvas, middle + points, 255.0)


def _checker(canvas, middle, radius, grey, rng) -> None:
    """A piece of a chessboard."""
    angle, side = rng.uniform(0, np.pi), radius * rng.uniform(0.6, 2.0)
    across, down = side * np.array([np.cos(angle), np.sin(angle)]), side * np.array([-np.sin(angle), np.cos(angle)])
    for i in range(4):
        for j in range(3):
            corner = middle + i * across + j * down
            square = np.array([corner, corner + across, corner + across + down, corner + down])
            _fill(canvas, square, grey if (i + j) % 2 else 255.0 - grey)


def _bent(canvas, middle, radius, grey, rng) -> None:
    """A blob that is round but no ellipse."""
    t = np.linspace(0, 2 * np.pi, 120)
    r = radius * (1 + rng.uniform(0.1, 0.3) * np.cos(rng.integers(3, 6) * t + rng.uniform(0, 6)))
    _fill(canvas, middle + np.stack([r * np.cos(t), r * np.sin(t)], axis=1), grey)


ITEMS = (_text, _line, _box, _square, _polygon, _part_disc, _pie, _ring, _merged, _glint, _checker, _bent)
