#!/bin/sh
# OpenCV 5 (opencv-python-headless 5.0.0.93) takes a one-dimensional numpy array for a row, OpenCV 4 took it for a column.
#
# The same lines of Python do another thing, most of them without an error:
#   filter2D(image, -1, kernel)      a kernel (3,) filtered down the columns, and now filters along the rows
#   flip(v, 0) and flip(v, 1)        exchanged: 0 reversed a vector (3,) and now leaves it, 1 the other way about
#   sort(v, SORT_EVERY_COLUMN)       sorted (3,), and now leaves it as it is
#   mulTransposed(v, False)          was (3, 3), the outer product, and now is (1, 1), the inner one
#   hconcat([v, v])                  was (3, 2), two columns, and now is one row (1, 6)
# Where the shape no longer fits, an error comes from inside: stereoRectify with T (3,), KalmanFilter.correct with (2,).
# Arrays (n, 1) give in both what (n,) gave in OpenCV 4.
#
# Seen: 4.14.0 down, reversed, sorted, (3, 3), (3, 2), right, right; 5.0.0 along, kept, kept, (1, 1), (1, 6), error, error.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.14.0.94 5.0.0.93; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==$version
    "$folder/$version/bin/python" - <<'PYTHON'
import cv2
import numpy as np

v = np.array([3.0, 1.0, 2.0])
image = np.zeros((5, 5))
image[2, 2] = 1.0
K = np.diag([800.0, 800.0, 1.0])


def filtered(kernel):
    out = cv2.filter2D(image, -1, kernel)
    return "down" if np.count_nonzero(out[:, 2]) == 3 else "along"


def tried(call):
    try:
        call()
    except cv2.error:
        return "error"
    return "right"


def corrected(z):
    follower = cv2.KalmanFilter(2, 2, 0, cv2.CV_64F)
    follower.measurementMatrix = follower.measurementNoiseCov = follower.transitionMatrix = np.eye(2)
    follower.statePost, follower.errorCovPost, follower.processNoiseCov = np.zeros((2, 1)), np.eye(2), np.eye(2)
    follower.predict()
    return follower.correct(z)


def seen(v, z, T):
    return (
        filtered(v),
        "reversed" if np.ravel(cv2.flip(v, 0))[0] == 2.0 else "kept",
        "sorted" if np.ravel(cv2.sort(v, cv2.SORT_EVERY_COLUMN))[0] == 1.0 else "kept",
        cv2.mulTransposed(v, False).shape,
        cv2.hconcat([v, v]).shape,
        tried(lambda: corrected(z)),
        tried(lambda: cv2.stereoRectify(K, np.zeros(5), K, np.zeros(5), (640, 480), np.eye(3), T)),
    )


z, T = np.array([1.0, 2.0]), np.array([-0.06, 0.0, 0.0])
flat = seen(v, z, T)
print(cv2.__version__, *flat, sep=", ")
columns = ("down", "reversed", "sorted", (3, 3), (3, 2), "right", "right")
assert seen(v[:, None], z[:, None], T[:, None]) == columns
assert flat == (columns if cv2.__version__ < "5" else ("along", "kept", "kept", (1, 1), (1, 6), "error", "error"))
PYTHON
done
