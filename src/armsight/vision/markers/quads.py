"""Dark quadrilaterals on brighter ground: the outlines of square code markers, and which code each one shows, quickly.

A grey image goes in; (4, 2) corners come out, and, with the codes of a family, identities. A pixel is dark where it is
below the middle of the darkest and brightest around it (tiles of four pixels, three by three; Olson, "AprilTag", ICRA
2011), if those differ by more than noise does. Borders of dark regions are followed from pixel to pixel. Most of those
in clutter are longer than the outline of a convex region of their width and height, which costs no arithmetic. What is
left gets four corners, the outermost points, and four lines by least squares, which meet in the corners that are
returned. Cells are compared with the level half-way between the dark border and the white around it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids
from armsight.geometry.matrix import solved_vector
from armsight.kernels import kernel

#: A marker smaller than this cannot be read: eight cells across need more than a pixel each.
SIDE_MIN_PX = 10.0
#: Side of a tile, px.
_TILE = 4
#: Least difference between the darkest and the brightest pixel around one on an edge: grey levels, and in ranges of the
#: pixels in a tile that nine of ten tiles exceed. That range is 2.6 deviations of the noise; 144 pixels span 5.2.
_STEP, _STEP_RANGES, _PLAIN = 4.0, 4.0, 0.1  # half: outlines in noise cost time; double: faint markers are missed
#: A border is at most so many times as long as that of a convex region as wide and high.
_LONGER = 1.4  # 1.2: noisy markers are missed; 2: outlines in clutter cost time
#: Smallest side of a dark region that is looked at, of the smallest marker's: half: specks are; 1: tilted ones are missed.
_SMALLEST = 0.6
#: Share of a side at each end that is not fitted, for corners are round; largest distance of a side from its line, RMS,
#: px and as a share of the side.
_ROUND, _BENT_PX, _BENT = 0.12, 0.7, 0.02  # bent: half: markers under lens distortion are missed; double: blobs pass
Grey = NDArray[np.uint8]


@kernel
def _extremes(image: Grey, low: Grey, high: Grey) -> float:
    """Fill the least and the greatest grey of three by three tiles; return by how much they must differ at an edge.

    low, high (H / 4 + 2, W / 4 + 2), rounded up, have a tile more around the image.
    """
    height, width = image.shape
    rows, columns = low.shape[0] - 2, low.shape[1] - 2
    low[:], high[:] = np.uint8(255), np.uint8(0)
    a, b, ranges = np.empty(width, np.uint8), np.empty(width, np.uint8), np.zeros(256, np.int64)
    for j in range(rows):
        a[:], b[:] = image[_TILE * j], image[_TILE * j]
        for y in range(_TILE * j + 1, min(_TILE * j + _TILE, height)):
            row = image[y]
            for x in range(width):
                a[x] = row[x] if row[x] < a[x] else a[x]
                b[x] = row[x] if row[x] > b[x] else b[x]
        for i in range(columns):
            least, most = a[_TILE * i], b[_TILE * i]
            for x in range(_TILE * i + 1, min(_TILE * i + _TILE, width)):
                least = a[x] if a[x] < least else least
                most = b[x] if b[x] > most else most
            low[j + 1, i + 1], high[j + 1, i + 1] = least, most
            ranges[most - least] += 1
    for values, sign in ((low, -1), (high, 1)):  # the greatest of three along rows, then along columns
        for j in range(rows + 2):
            before = values[j, 0]
            for i in range(1, columns + 1):
                here, after = values[j, i], values[j, i + 1]
                most = before if sign * np.int64(before) > sign * np.int64(here) else here
                values[j, i] = after if sign * np.int64(after) > sign * np.int64(most) else most
                before = here
        for i in range(1, columns + 1):
            before = values[0, i]
            for j in range(1, rows + 1):
                here, after = values[j, i], values[j + 1, i]
                most = before if sign * np.int64(before) > sign * np.int64(here) else here
                values[j, i] = after if sign * np.int64(after) > sign * np.int64(most) else most
                before = here
    plain, left = 0, int(_PLAIN * rows * columns)
    while ranges[plain] <= left:
        left -= ranges[plain]
        plain += 1
    return float(max(_STEP, _STEP_RANGES * plain))


@kernel
def _threshold(image: Grey, dark: Grey) -> NDArray[np.bool_]:
    """Mark dark pixels in ``dark`` (H + 2, W + 2), zero before; (H + 2,) whether a row may have some."""
    height, width = image.shape
    rows, columns = (height + _TILE - 1) // _TILE, (width + _TILE - 1) // _TILE
    low, high = np.empty((rows + 2, columns + 2), np.uint8), np.empty((rows + 2, columns + 2), np.uint8)
    least = _extremes(image, low, high)
    some, level = np.zeros(height + 2, np.bool_), np.zeros(_TILE * columns, np.uint8)
    for j in range(rows):
        edges = False
        for i in range(columns):
            bottom, top = np.int64(low[j + 1, i + 1]), np.int64(high[j + 1, i + 1])
            edge = bool(top - bottom >= least)
            edges |= edge
            level[_TILE * i : _TILE * i + _TILE] = np.uint8((top + bottom + 1) // 2) if edge else np.uint8(0)
        if not edges:
            continue
        for y in range(_TILE * j, min(_TILE * j + _TILE, height)):
            row, out = image[y], dark[y + 1, 1 : width + 1]
            for x in range(width):
                out[x] = row[x] < level[x]
            some[y + 1] = True
    return some


@kernel
def _follow(dark: Grey, start: int, stride: int, at: NDArray[np.int32]) -> tuple[int, int]:
    """Follow the border of a dark region from the left side of the pixel ``start``, the region to the right.

    Pixels with only a corner in common are not connected. Left sides that are passed are marked in ``dark`` (N,), of
    rows ``stride`` long; at (2, M) receives the middles of the steps, twice column and row. Return the number of steps,
    or M + 1 where they are more; the area inside, px^2, negative for a hole.
    """
    most, n, area = at.shape[1], 0, 0
    point, way = start + stride, 0  # a pixel's upper left corner, and up, right, down or left
    x, y = 2 * (point % stride), 2 * (point // stride)
    ahead = (-stride, 0, -1, -stride - 1)  # of the pixels before a corner the right one, then the left one
    beside = (-stride - 1, -stride, 0, -1)
    step, dx, dy = (-stride, 1, stride, -1), (0, 1, 0, -1), (-1, 0, 1, 0)
    while True:
        if way == 0:
            dark[point - stride] = 3
        x, y = x + dx[way], y + dy[way]
        if n < most:
            at[0, n], at[1, n] = x, y
        n += 1
        x, y = x + dx[way], y + dy[way]
        area += x * dy[way]
        point += step[way]
        if dark[point + ahead[way]] == 0:
            way = (way + 1) & 3
        elif dark[point + beside[way]] != 0:
            way = (way + 3) & 3
        if way == 0 and point == start + stride:
            return min(n, most + 1), area // 2


@kernel
def _farthest(n: int, at: NDArray[np.int32], first: int, last: int, a: Array, b: Array) -> int:
    """Return which border point from ``first`` to ``last``, modulo n, is farthest to the left of the line from a to b."""
    best, most = first, -np.inf
    nx, ny = b[1] - a[1], a[0] - b[0]
    for k in range(first + 1, last):
        i = k if k < n else k - n
        far = nx * at[0, i] + ny * at[1, i]
        if far > most:
            best, most = k, far
    return best


@kernel
def _outermost(n: int, at: NDArray[np.int32], p: Array) -> int:
    """Return which border point is farthest from p (2,)."""
    best, most = 0, -1.0
    for i in range(n):
        far = (at[0, i] - p[0]) ** 2 + (at[1, i] - p[1]) ** 2
        if far > most:
            best, most = i, far
    return best


@kernel
def _line(n: int, at: NDArray[np.int32], first: int, last: int, line: Array) -> bool:
    """Fit a line (3,), nx x + ny y = d, to border points by least squares; whether they are on it, and enough."""
    cut = int(_ROUND * (last - first)) + 1
    first, last = first + cut, last - cut
    count = last - first
    if count < 4:
        return False
    x, y, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
    i0, j0 = at[0, first % n], at[1, first % n]
    for k in range(first, last):
        i = k if k < n else k - n
        u, v = float(at[0, i] - i0), float(at[1, i] - j0)
        x, y, xx, xy, yy = x + u, y + v, xx + u * u, xy + u * v, yy + v * v
    x, y = x / count, y / count
    xx, xy, yy = xx / count - x * x, xy / count - x * y, yy / count - y * y
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    line[0], line[1] = -np.sin(angle), np.cos(angle)
    line[2] = line[0] * (x + i0) + line[1] * (y + j0)
    off = line[0] * line[0] * xx + 2.0 * line[0] * line[1] * xy + line[1] * line[1] * yy
    length = np.sqrt(12.0 * max(xx + yy - off, 0.0))
    return bool(off <= (2.0 * _BENT_PX + _BENT * length) ** 2)


@kernel
def _marks(n: int, at: NDArray[np.int32], ends: Array, marks: NDArray[np.int64]) -> bool:
    """Find where a border bends most: steps (5,), the first once more, and points (4, 2); return whether they follow."""
    p = np.zeros(2)
    for i in range(n):
        p[0] += at[0, i] / n
        p[1] += at[1, i] / n
    a = _outermost(n, at, p)
    p[0], p[1] = at[0, a], at[1, a]
    b = _outermost(n, at, p)
    marks[0], marks[2] = min(a, b), max(a, b)
    for k in (0, 2):
        ends[k, 0], ends[k, 1] = at[0, marks[k]], at[1, marks[k]]
    marks[1] = _farthest(n, at, marks[0], marks[2], ends[0], ends[2])
    marks[3] = _farthest(n, at, marks[2], marks[0] + n, ends[2], ends[0])
    for k in (1, 3):
        ends[k, 0], ends[k, 1] = at[0, marks[k] % n], at[1, marks[k] % n]
    for k in range(8):  # a first guess may have two of them on one side
        i, before, after = k % 4, (k + 3) % 4, (k + 1) % 4
        first, last = marks[before], marks[after]
        if i == 0:
            first -= n
        if i == 3:
            last += n
        if first < 0:
            first, last = first + n, last + n
        m = _farthest(n, at, first, last, ends[before], ends[after])
        marks[i] = m - n if i < 3 and m >= n and marks[i] < n else m
        ends[i, 0], ends[i, 1] = at[0, m % n], at[1, m % n]
    while marks[3] < marks[2]:
        marks[3] += n
    if marks[0] > marks[1]:
        marks[0] -= n
    marks[4] = marks[0] + n
    return bool(marks[0] < marks[1] < marks[2] < marks[3] < marks[4])


@kernel
def _quad(n: int, at: NDArray[np.int32], area: float, quad: Array) -> bool:
    """Find the corners (4, 2), clockwise as seen, of a border (n points, area in px^2); whether it is a quadrilateral."""
    ends, lines, marks = np.empty((4, 2)), np.empty((4, 3)), np.zeros(5, np.int64)
    if not _marks(n, at, ends, marks):
        return False
    shift = n if marks[0] < 0 else 0
    for k in range(4):
        if not _line(n, at, marks[k] + shift, marks[k + 1] + shift, lines[k]):
            return False
    for k in range(4):
        u, v = lines[(k + 3) % 4], lines[k]
        det = u[0] * v[1] - u[1] * v[0]
        if abs(det) < 0.1:
            return False
        quad[k, 0] = (u[2] * v[1] - u[1] * v[2]) / det
        quad[k, 1] = (u[0] * v[2] - u[2] * v[0]) / det
        side = np.hypot(ends[(k + 1) % 4, 0] - ends[k, 0], ends[(k + 1) % 4, 1] - ends[k, 1])
        if not np.hypot(quad[k, 0] - ends[k, 0], quad[k, 1] - ends[k, 1]) < 6.0 + 0.25 * side:
            return False
    covered, right = 0.0, 0
    for k in range(4):
        i, j = (k + 1) % 4, (k + 2) % 4
        covered += 0.5 * (quad[k, 0] * quad[i, 1] - quad[k, 1] * quad[i, 0])
        cross = (quad[i, 0] - quad[k, 0]) * (quad[j, 1] - quad[i, 1])
        right += cross > (quad[i, 1] - quad[k, 1]) * (quad[j, 0] - quad[i, 0])
    for k in range(4):
        quad[k, 0], quad[k, 1] = 0.5 * quad[k, 0] - 1.5, 0.5 * quad[k, 1] - 1.5
    return right == 4 and 0.75 < 0.25 * covered / area < 1.33


@kernel("const u1[:, ::1], u1[:, ::1], i4[:, ::1], f8[:, :, ::1]")
def outlines(image: Grey, dark: Grey, at: NDArray[np.int32], quads: Array) -> tuple[int, int]:
    """Find the dark quadrilaterals of an image, quads (N, 4, 2), corners clockwise as seen, px.

    dark (H + 2, W + 2), zeros, is overwritten; at (2, M) is room for a border of M steps. Return their number, and how
    many dark regions are large enough for a marker.
    """
    some, pixels, stride, count, regions = _threshold(image, dark), dark.reshape(-1), dark.shape[1], 0, 0
    for y in range(1, dark.shape[0] - 1):
        if not some[y]:
            continue
        row = dark[y]
        for x in range(1, stride - 1):
            if row[x] != 1 or row[x - 1] != 0:
                continue
            n, area = _follow(pixels, y * stride + x, stride, at)
            if n < 4.0 * _SMALLEST * SIDE_MIN_PX or area < (_SMALLEST * SIDE_MIN_PX) ** 2:
                continue
            regions += 1
            left, right, top, bottom = at[0, 0], at[0, 0], at[1, 0], at[1, 0]
            for i in range(min(n, at.shape[1])):
                left, right = min(left, at[0, i]), max(right, at[0, i])
                top, bottom = min(top, at[1, i]), max(bottom, at[1, i])
            if n > at.shape[1] or n > _LONGER * (right - left + bottom - top) or count == len(quads):
                continue
            if _quad(n, at, float(area), quads[count]):
                count += 1
    return count, regions


@kernel
def square_to_quad(quad: Array, H: Array) -> None:
    """Fill the homography H (3, 3) to a quadrilateral (4, 2) from the square (-1, -1), (1, -1), (1, 1), (-1, 1)."""
    A, b = np.zeros((8, 8)), np.empty(8)
    for k in range(4):
        x, y = (1.0 if k in (1, 2) else -1.0), (1.0 if k > 1 else -1.0)
        for m in range(2):
            row, to = 2 * k + m, quad[k, m]
            A[row, 3 * m], A[row, 3 * m + 1], A[row, 3 * m + 2] = x, y, 1.0
            A[row, 6], A[row, 7], b[row] = -to * x, -to * y, to
    h = solved_vector(A, b)
    for k in range(8):
        H[k // 3, k % 3] = h[k]
    H[2, 2] = 1.0


@kernel
def _cells_seen(image: Grey, quad: Array, spread: float, seen: Array) -> None:
    """Sample the cells of a marker with corners ``quad`` (4, 2), px, and a ring around it, into seen (N + 2, N + 2).

    Each is the mean of three by three samples, ``spread`` cells apart.
    """
    height, width = image.shape
    H, count = np.empty((3, 3)), len(seen)
    square_to_quad(quad, H)
    for j in range(count):
        for i in range(count):
            total = 0.0
            for m in range(9):
                x = 2.0 * (i - 0.5 + spread * (m % 3 - 1)) / (count - 2) - 1.0
                y = 2.0 * (j - 0.5 + spread * (m // 3 - 1)) / (count - 2) - 1.0
                w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
                u = min(max((H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w, 0.0), width - 1.001)
                v = min(max((H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w, 0.0), height - 1.001)
                p, q = int(u), int(v)
                fu, fv = u - p, v - q
                upper = (1.0 - fu) * image[q, p] + fu * image[q, p + 1]
                total += (1.0 - fv) * upper + fv * ((1.0 - fu) * image[q + 1, p] + fu * image[q + 1, p + 1])
            seen[j, i] = total / 9.0


@kernel
def _plane(seen: Array, first: int, last: int, plane: Array) -> None:
    """Fit a plane (3,), level and slopes by row and column, to rings of cells about the middle, from first to last."""
    count, plane[:] = len(seen), 0.0
    n, square, half = 0, 0.0, 0.5 * (len(seen) - 1)
    for j in range(count):
        for i in range(count):
            if first <= min(min(i, j), min(count - 1 - i, count - 1 - j)) <= last:
                n += 1
                square += (i - half) ** 2
                plane[0] += seen[j, i]
                plane[1] += (j - half) * seen[j, i]
                plane[2] += (i - half) * seen[j, i]
    plane[0] /= n
    plane[1] /= square
    plane[2] /= square


#: The white around a marker exceeds its dark border by this many grey levels at least.
_RING_STEP = 10.0  # half: noise is read; double: faint markers are missed
#: Share of the cells of the border that may be on the wrong side.
_BORDER_WRONG = 0.25
#: Half way between two samples of a cell that are sampled: neighbours blur into its edges.
_SPREAD = 0.22
_NONE, _ONE = np.uint64(0), np.uint64(1)


@kernel
def _match(seen: Array, border: int, level: Array, shift: float, codes: NDArray[np.uint64], allowed: int) -> int:
    """Return 4 times the number of the code that cells show, plus its rotation; -1 where there is none.

    seen (N + 2, N + 2) has a ring around the cells, bright above the plane ``level`` (3,) + ``shift``; up to
    ``allowed`` cells may be wrong.
    """
    count, half, code = len(seen), 0.5 * (len(seen) - 1), np.uint64(0)
    for j in range(border + 1, count - border - 1):
        for i in range(border + 1, count - border - 1):
            bright = seen[j, i] > level[0] + level[1] * (j - half) + level[2] * (i - half) + shift
            code = (code << _ONE) | np.uint64(bright)
    best, least = -1, allowed + 1
    for k in range(codes.shape[0]):
        for r in range(4):
            left, bits = codes[k, r] ^ code, 0
            while left != _NONE and bits < least:
                left &= left - _ONE
                bits += 1
            if bits < least:
                best, least = 4 * k + r, bits
    return best


@kernel("const u1[:, ::1], const f8[:, :, ::1], const u8[:, ::1], i8, i8, i8, i8[::1]")
def read_codes(
    image: Grey, quads: Array, codes: NDArray[np.uint64], cells: int, border: int, allowed: int, found: Ids
) -> None:
    """Read the codes of quadrilaterals (K, 4, 2), px, clockwise as seen.

    codes (M, 4): the family's in four rotations, row by row, the first cell in the highest bit; ``cells``: along a
    side, with the border; ``allowed``: that may be wrong. found (K,) receives four times the number of the code plus
    its rotation, -1 for no marker.
    """
    seen, dark, white, level = np.empty((cells + 2, cells + 2)), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(quads)):
        _cells_seen(image, quads[k], _SPREAD, seen)
        found[k] = -1
        _plane(seen, 1, border, dark)
        _plane(seen, 0, 0, white)
        if not white[0] - dark[0] >= _RING_STEP:
            continue
        level[:] = 0.5 * (dark + white)
        half, wrong, total = 0.5 * (cells + 1), 0, 0
        bright, brights = 0.0, 0
        for j in range(1, cells + 1):
            for i in range(1, cells + 1):
                above = seen[j, i] - level[0] - level[1] * (j - half) - level[2] * (i - half)
                if min(min(i, j), min(cells + 1 - i, cells + 1 - j)) <= border:
                    total += 1
                    wrong += above > 0.0
                elif above > 0.0:
                    brights += 1
                    bright += above
        if wrong > _BORDER_WRONG * total:
            continue
        found[k] = _match(seen, border, level, 0.0, codes, allowed)
        if found[k] < 0 and brights > 0:  # what is around may be no paper: from the bright cells themselves
            shift = 0.5 * (bright / brights - 0.5 * (white[0] - dark[0]))
            found[k] = _match(seen, border, level, shift, codes, allowed)
