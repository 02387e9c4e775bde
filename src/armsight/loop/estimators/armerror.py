"""What makes potentiometers wrong, as one vector: its layout, its prior, and the tool's pose and derivative by it.

The true pose is modelled as

    T_base_tool = T_base_0 E_0 A_1(q_1 + d_1) E_1 ... A_n(q_n + d_n) E_n T_n_tool exp(x)

with E_i = exp(e_i) a small motion of every link's frame (lengths, twists and zeros that differ from the table, and how the
arm stands and holds its tool), d_i the error of its potentiometer

    d_i = c_i . b(q_i) - s_i w_i / 2 - f_i v_i / 2 + k_i (g_i(q) + h_i) + r_i + n_i

(b: linearity, a line and harmonics; w_i: backlash, s_i its side if friction decides on that; v_i and f_i: the same if
gravity and inertia do; k_i: compliance, g_i the gravity torque of a unit load, h_i that of its inertia; r_i: the rest,
which is forgotten as the joint moves; n_i: noise that smoothing left in its readings), and x what no joint explains,
forgotten likewise. The derivatives are by the
right tangent of the pose; a small motion E of an inner frame comes out as Ad(T_tool_frame) e (Sola, "A micro Lie theory",
2018, eq. 31).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armsight.data import Array, Ids
from armsight.kernels import kernel
from armsight.robot.kinematics.chain import Frame, after, after_link, after_rotation, first_frame, sincos
from armsight.robot.kinematics.table import TOOL

#: Harmonics of a potentiometer's linearity: an eccentric wiper makes the first, its bow the second.
HARMONICS = 3
#: Functions of one joint's linearity.
BASIS = 1 + 2 * HARMONICS
#: The trace of a rotation by 3 rad.
_MIN_TRACE = 1.0 + 2.0 * math.cos(3.0)


class ErrorLayout(NamedTuple):
    """Where each part begins in the vector of an arm of n joints."""

    joints: int  #: n
    linearity: int  #: of n times BASIS; before it stand the tangents of n + 1 frames
    backlash: int  #: its width as far as friction decides on the side, and the next where gravity and inertia do
    floats: int  #: see ``backlash``
    compliance: int  #: of each joint, and so are the next two
    rest: int  #: what else a joint is off
    reading: int  #: noise that smoothing left in the readings
    pose: int  #: what no joint explains, six numbers
    delay: int  #: of the camera, the last
    size: int  #: of the vector

    @property
    def zeros(self) -> Ids:
        """Zeros of the joints (n,): the rotation about z of the frame before each."""
        return np.arange(self.joints) * 6 + 5

    @property
    def noise(self) -> slice:
        """Of the vector the noise that smoothing left in the readings (n,)."""
        return slice(self.reading, self.pose)


@functools.cache
def layout(joints: int) -> ErrorLayout:
    """Return the layout of the vector of an arm of so many joints."""
    linearity = 6 * (joints + 1)
    backlash = linearity + joints * BASIS
    floats, compliance, rest, reading, pose = (backlash + joints * n for n in range(1, 6))
    return ErrorLayout(joints, linearity, backlash, floats, compliance, rest, reading, pose, pose + 6, pose + 7)


@dataclass(frozen=True)
class Prior:
    """How far an arm may be off before anything is measured: standard deviations.

    The defaults are of a table-top arm with plastic-film potentiometers. With priors below the truth a filter trusts the
    potentiometers too much; with priors above it the filter needs vision a little longer to learn.
    """

    link_m: float = 1e-3  #: translation of a link's frame along each axis, m
    link_rad: float = float(np.deg2rad(0.3))  #: rotation about each, rad
    stand_m: float = 2e-3  #: translation of the base and of the tool in the hand, beyond that, m
    stand_rad: float = float(np.deg2rad(0.3))  #: rotation of them, rad
    zero_rad: float = float(np.deg2rad(0.5))  #: zero of a potentiometer, rad
    gain: float = 2e-3  #: its scale, relative
    #: amplitude of the first harmonic of its linearity; the k-th has it over k^1.5, rad.
    harmonic_rad: float = float(np.deg2rad(0.2))
    #: width of the backlash between potentiometer and link, rad, as far as friction decides on its side
    backlash_rad: float = float(np.deg2rad(0.2))
    float_rad: float = float(np.deg2rad(0.2))  #: the same as far as gravity and inertia do
    compliance: float = 5e-3  #: angle per gravity torque of a unit load, rad/m
    rest_rad: float = float(np.deg2rad(0.03))  #: what else a joint is off, rad
    rest_travel_rad: float = 0.05  #: travel in which it forgets that, rad
    creep_rad: float = 0.0  #: how far a link creeps in its backlash in a second while its potentiometer stands, rad
    #: how uncertain a joint is after a change of side by friction, beyond the width, rad
    flip_rad: float = float(np.deg2rad(0.015))
    flip_float_rad: float = float(np.deg2rad(0.05))  #: the same of a change by gravity and inertia, rad
    pose_m: float = 1e-4  #: what no joint explains, m
    pose_rad: float = float(np.deg2rad(0.01))  #: the same of the rotation, rad
    pose_travel_rad: float = 1.0  #: travel of all joints together in which that is forgotten, rad
    reading_rad: float = float(np.deg2rad(0.02))  #: noise of one reading of a potentiometer, rad
    #: what readings are rounded to where their noise does not exceed it, as counts of an encoder, rad
    rounded_rad: float = 0.0

    def sigmas(self, sigma_delay_s: float, joints: int = 6) -> Array:
        """Return the standard deviations (size,) of the vector of an arm of so many joints."""
        links = np.tile(np.repeat([self.link_m, self.link_rad], 3), (joints + 1, 1))
        stand = np.repeat([self.stand_m, self.stand_rad], 3)
        links[[0, -1]] = np.hypot(links[[0, -1]], stand)
        links, zeros = links.ravel(), layout(joints).zeros
        links[zeros] = np.hypot(links[zeros], self.zero_rad)
        harmonics = np.repeat(self.harmonic_rad / np.arange(1, HARMONICS + 1) ** 1.5, 2)
        linearity = np.tile(np.append(self.gain, harmonics), joints)
        # What is left of the readings' noise depends on the readings at hand.
        each = np.repeat([self.backlash_rad, self.float_rad, self.compliance, self.rest_rad, 0.0], joints)
        rest = np.repeat([self.pose_m, self.pose_rad], 3)
        return np.concatenate([links, linearity, each, rest, [sigma_delay_s]])


@kernel
def _small_motions(x: Array, motions: Array) -> None:
    """Write exp of the tangents (6,) at the head of x into motions (K * 12,), row by row; angles below 0.3 rad."""
    for i in range(motions.shape[0] // 12):
        rx, ry, rz, a, b, c = x[6 * i], x[6 * i + 1], x[6 * i + 2], x[6 * i + 3], x[6 * i + 4], x[6 * i + 5]
        u = a * a + b * b + c * c
        f, g = 1 - u / 6 + u * u / 120, 0.5 - u / 24 + u * u / 720  # sin(t)/t and (1 - cos t)/t^2, t^2 = u
        h = 1 / 6.0 - u / 120 + u * u / 5040  # (t - sin t)/t^3
        m = motions[12 * i : 12 * i + 12]
        m[0], m[5], m[10] = 1 - g * (b * b + c * c), 1 - g * (a * a + c * c), 1 - g * (a * a + b * b)
        m[1], m[4] = g * a * b - f * c, g * a * b + f * c
        m[2], m[8] = g * a * c + f * b, g * a * c - f * b
        m[6], m[9] = g * b * c - f * a, g * b * c + f * a
        # V rho = rho + g (phi x rho) + h (phi x (phi x rho))
        kx, ky, kz = b * rz - c * ry, c * rx - a * rz, a * ry - b * rx
        m[3] = rx + g * kx + h * (b * kz - c * ky)
        m[7] = ry + g * ky + h * (c * kx - a * kz)
        m[11] = rz + g * kz + h * (a * ky - b * kx)


@kernel
def _loads(table: Array, q: Array, g: Array) -> None:
    """Write the gravity torques (n,) about the joints of unit loads spread over the links beyond them, m."""
    joints = q.shape[0]
    axes = np.empty((joints + 1, 6))
    F = first_frame(table)
    for i in range(joints):
        axes[i] = np.array([F[6], F[7], F[8], F[9], F[10], F[11]])
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        F = after_link(table, i, after_rotation(table, i, c, s, F))
    F = after(table, TOOL, F)
    axes[joints] = np.array([F[6], F[7], F[8], F[9], F[10], F[11]])
    x = y = 0.0
    for i in range(joints - 1, -1, -1):
        x, y = x + axes[i + 1, 3], y + axes[i + 1, 4]
        n = joints - i
        # z . (p x -up) = z_y p_x - z_x p_y, p the mean of the frames beyond, seen from the axis
        torque = axes[i, 1] * (x / n - axes[i, 3]) - axes[i, 0] * (y / n - axes[i, 4])
        g[i] = table[6 * i + 5] * torque


@kernel("const f8[::1], f8[::1], f8[:, ::1], f8[:, ::1]")
def offsets_by(table: Array, q: Array, unseen: Array, B: Array) -> None:
    """Write the derivative (n, size) of what the joints are beyond their readings by the vector x, the zeros left out.

    What is unseen (3, n) is that of ``readings.Smoothed``: the two sides of the backlash, the lever of inertia.
    """
    joints = q.shape[0]
    g = np.empty(joints)
    _loads(table, q, g)
    B[:] = 0.0
    linearity = 6 * (joints + 1)
    backlash = linearity + BASIS * joints
    for i in range(joints):
        at = linearity + BASIS * i
        B[i, at] = q[i]
        s, c = sincos(q[i])
        sk, ck = s, c
        for k in range(HARMONICS):
            B[i, at + 1 + 2 * k], B[i, at + 2 + 2 * k] = sk, ck
            sk, ck = sk * c + ck * s, ck * c - sk * s
        k = backlash + i
        B[i, k], B[i, k + joints] = -0.5 * unseen[0, i], -0.5 * unseen[1, i]
        B[i, k + 2 * joints], B[i, k + 3 * joints], B[i, k + 4 * joints] = g[i] + unseen[2, i], 1.0, 1.0


@kernel
def _adjoint(F: Frame, G: Frame, out: Array) -> None:
    """Write Ad(F^-1 G), (6, 6), which maps small motions in the axes of G to those in the axes of F."""
    px, py, pz = G[9] - F[9], G[10] - F[10], G[11] - F[11]
    for row in range(3):
        fx, fy, fz = F[3 * row], F[3 * row + 1], F[3 * row + 2]
        for col in range(3):
            gx, gy, gz = G[3 * col], G[3 * col + 1], G[3 * col + 2]
            entry = fx * gx + fy * gy + fz * gz
            out[row, col] = out[3 + row, 3 + col] = entry
            out[3 + row, col] = 0.0
            out[row, 3 + col] = fx * (py * gz - pz * gy) + fy * (pz * gx - px * gz) + fz * (px * gy - py * gx)


@kernel("const f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]")
def pose_and_derivative(table: Array, x: Array, q: Array, unseen: Array, T: Array, H: Array) -> None:
    """Write the tool's pose (4, 4) at readings q (n,), unseen (3, n), and its derivative (6, size) by the vector x."""
    joints, size = q.shape[0], x.shape[0]
    linearity, pose = 6 * (joints + 1), size - 7
    backlash = linearity + BASIS * joints
    motions, B = np.empty(12 * (joints + 1)), np.empty((joints, size))
    _small_motions(x, motions)
    offsets_by(table, q, unseen, B)
    F = after(motions, 0, first_frame(table))
    frames = [F]
    for i in range(joints):
        angle = q[i]
        for k in range(linearity, pose):
            angle += B[i, k] * x[k]
        s, c = sincos(table[6 * i + 5] * angle + table[6 * i + 4])
        F = after(motions, 12 * (i + 1), after_link(table, i, after_rotation(table, i, c, s, F)))
        frames.append(F)
    F = after(table, TOOL, F)
    for row in range(6):
        H[row, :] = 0.0
        H[row, pose + row] = 1.0
    for i in range(joints + 1):
        _adjoint(F, frames[i], H[:, 6 * i : 6 * i + 6])
    for i in range(joints):
        for row in range(6):
            J = table[6 * i + 5] * H[row, 6 * i + 5]
            for k in range(linearity + BASIS * i, linearity + BASIS * (i + 1)):
                H[row, k] = J * B[i, k]
            for part in range(5):
                k = backlash + part * joints + i
                H[row, k] = J * B[i, k]
    _store_moved(F, x[pose : pose + 6], T)


@kernel
def _store_moved(F: Frame, x: Array, T: Array) -> None:
    """Write a frame, moved by a tangent (6,) of less than some mrad (third powers left out), into T (4, 4)."""
    a, b, c = x[3], x[4], x[5]
    R = np.array(
        [
            [1 - 0.5 * (b * b + c * c), 0.5 * a * b - c, 0.5 * a * c + b],
            [0.5 * a * b + c, 1 - 0.5 * (a * a + c * c), 0.5 * b * c - a],
            [0.5 * a * c - b, 0.5 * b * c + a, 1 - 0.5 * (a * a + b * b)],
        ]
    )
    for row in range(3):
        for col in range(3):
            T[row, col] = F[row] * R[0, col] + F[3 + row] * R[1, col] + F[6 + row] * R[2, col]
        T[row, 3] = F[9 + row] + F[row] * x[0] + F[3 + row] * x[1] + F[6 + row] * x[2]
    T[3, 0] = T[3, 1] = T[3, 2] = 0.0
    T[3, 3] = 1.0


@kernel("f8[:, ::1], const f8[:, ::1], f8[::1]")
def tangent(T: Array, T_to: Array, xi: Array) -> None:
    """Write the tangent (6,) from a pose (4, 4) to another, ``T exp(xi) = T_to``, for rotations of less than 3 rad, to xi.

    The rotation vector comes from its quaternion, the translation from the closed inverse of V (Sola, 2018, eq. 145, 174).
    """
    R, d = np.empty((3, 3)), np.empty(3)
    for row in range(3):
        d[row] = 0.0
        for k in range(3):
            d[row] += T[k, row] * (T_to[k, 3] - T[k, 3])
        for col in range(3):
            R[row, col] = T[0, row] * T_to[0, col] + T[1, row] * T_to[1, col] + T[2, row] * T_to[2, col]
    if R[0, 0] + R[1, 1] + R[2, 2] < _MIN_TRACE:
        xi[0], xi[1], xi[2], xi[3], xi[4], xi[5] = d[0], d[1], d[2], math.pi, 0.0, 0.0
        return
    w = 0.5 * math.sqrt(1.0 + R[0, 0] + R[1, 1] + R[2, 2])
    a, b, c = (R[2, 1] - R[1, 2]) / (4 * w), (R[0, 2] - R[2, 0]) / (4 * w), (R[1, 0] - R[0, 1]) / (4 * w)
    sine = math.sqrt(a * a + b * b + c * c)
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    a, b, c = scale * a, scale * b, scale * c
    square = a * a + b * b + c * c
    half = 0.5 * math.sqrt(square)
    bend = 1 / 12 + square / 720 if half < 1e-2 else (1.0 - half / math.tan(half)) / square
    u, v, h = b * d[2] - c * d[1], c * d[0] - a * d[2], a * d[1] - b * d[0]
    xi[0] = d[0] - 0.5 * u + bend * (b * h - c * v)
    xi[1] = d[1] - 0.5 * v + bend * (c * u - a * h)
    xi[2] = d[2] - 0.5 * h + bend * (a * v - b * u)
    xi[3], xi[4], xi[5] = a, b, c


@kernel("const f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1]")
def poses_and_derivatives(table: Array, x: Array, q: Array, unseen: Array, Ts: Array, Hs: Array) -> None:
    """Write the same for readings q (N, n), unseen (N, 3, n) and vectors x (N, size) into (N, 4, 4) and (N, 6, size)."""
    for n in range(len(q)):
        pose_and_derivative(table, x[n], q[n], unseen[n], Ts[n], Hs[n])
