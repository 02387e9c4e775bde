"""The image of a disc by brute force: its rim, point by point through the lens, and the ellipse through what that gives.

The slow and obvious oracle of ``vision/discs/bias.py``, which has the ellipse in closed form. Nothing of that is used here.
"""

import numpy as np

POINTS = 96


def rim(p, normal, radius_m, points=POINTS):
    """Return points (points, 3) of a disc's rim, m, in the frame of its centre and normal."""
    x = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    x /= np.linalg.norm(x)
    angle = 2 * np.pi * np.arange(points) / points
    return p + radius_m * (np.outer(np.cos(angle), x) + np.outer(np.sin(angle), np.cross(normal, x)))


def ellipse_through(uv):
    """Return centre (2,) and shape (2, 2) of the ellipse (uv - c)^T S^-1 (uv - c) = 1 through points (N, 2), px.

    A conic by least squares. A lens that distorts bends the ellipse; what that leaves is of the fourth order in its size.
    """
    middle, scale = uv.mean(axis=0), uv.std()
    x, y = ((uv - middle) / scale).T
    a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None)[0]
    Q = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(Q, [-d / 2, -e / 2])
    return middle + scale * centre, scale**2 * (1 + centre @ Q @ centre) * np.linalg.inv(Q)


def disc_ellipses(project, p, normals, radii_m):
    """Return centres (N, 2), px, and shapes (N, 3) S11, S12, S22, px^2, of discs in a camera's frame.

    Args:
        project: maps points (N, 3) of the camera's frame to pixels (N, 2).
        p: (N, 3) centres of the discs, m.
        normals: (N, 3) their unit normals.
        radii_m: (N,) radii, m.

    NaN where a rim is not all in front of the camera.
    """
    centres, shapes = np.full((len(p), 2), np.nan), np.full((len(p), 3), np.nan)
    for k, (at, normal, radius_m) in enumerate(zip(p, normals, radii_m, strict=True)):
        edge = rim(at, normal, radius_m)
        if (edge[:, 2] > 0).all():
            centres[k], S = ellipse_through(project(edge))
            shapes[k] = S[0, 0], S[0, 1], S[1, 1]
    return centres, shapes
