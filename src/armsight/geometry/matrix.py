"""Products and solutions of small matrices inside kernels; outside of kernels numpy's own are used.

All make a new array: A @ B, A @ x (A may be a transposed view), and A^-1 B by elimination with partial pivoting (Golub
and Van Loan, "Matrix Computations", 3.4).
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel


@kernel
def product(A: Array, B: Array) -> Array:
    """Return A (n, m) times B (m, k)."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            for k in range(B.shape[1]):
                out[i, k] += A[i, j] * B[j, k]
    return out


@kernel
def applied(A: Array, x: Array) -> Array:
    """Return A (n, m) times x (m,)."""
    out = np.zeros(A.shape[0])
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i] += A[i, j] * x[j]
    return out


@kernel
def dot(a: Array, b: Array) -> float:
    """Return the sum of products of a (n,) and b (n,)."""
    s = 0.0
    for i in range(len(a)):
        s += a[i] * b[i]
    return s


@kernel
def solved(A: Array, B: Array) -> Array:
    """Return A^-1 B, A (n, n), B (n, k); all NaN where a pivot is zero."""
    n, columns = B.shape
    left, x = A.copy(), B.copy()
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            if abs(left[j, i]) > abs(left[pivot, i]):
                pivot = j
        if left[pivot, i] == 0.0:
            x[:, :] = np.nan
            return x
        for k in range(n):
            left[i, k], left[pivot, k] = left[pivot, k], left[i, k]
        for k in range(columns):
            x[i, k], x[pivot, k] = x[pivot, k], x[i, k]
        for j in range(i + 1, n):
            factor = left[j, i] / left[i, i]
            for k in range(i + 1, n):
                left[j, k] -= factor * left[i, k]
            for k in range(columns):
                x[j, k] -= factor * x[i, k]
    for i in range(n - 1, -1, -1):
        for k in range(columns):
            s = x[i, k]
            for j in range(i + 1, n):
                s -= left[i, j] * x[j, k]
            x[i, k] = s / left[i, i]
    return x


@kernel
def solved_vector(A: Array, b: Array) -> Array:
    """Return A^-1 b, b (n,); see :func:`solved`."""
    B = np.empty((len(b), 1))
    B[:, 0] = b
    return solved(A, B)[:, 0].copy()
