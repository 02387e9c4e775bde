"""A joint's motor from a recorded swing, and its potentiometer from a movement by hand.

In: what the converters read while a joint swings to and fro (voltages, currents, angles; 100 readings a second and more).
Out: a :class:`JointFit`. All is linear least squares: on integrals over time, so that no noisy reading has to be
differentiated for the motor, and all is smoothed alike for the load (Ljung, "System Identification", 1999, section 4.2):

    flux    integral of V  =  R integral of i + K (q + b/2 sign(w)) + drift
    torque  K i  =  J dw/dt + B w + C sign(w) + gravity

A joint that is read behind a spring is recognised by duties at :data:`DITHER_HZ` on top of the swing
(:func:`fit_spring`): with L and M the speeds of joint and motor at each of them, M from its back-EMF, and p the joint's
inertia over the stiffness,

    M = L (1 - p w^2 + j w d) / (1 + j w d),    V = R I + K M,    K I = J_motor jw M + J_joint jw L + B M

Gravity is a cosine and a sine of the angle, and b the backlash between the motor and the joint with its potentiometer:
the motor leads the joint by half of it. Readings near a reversal, where the sign of the speed w is not certain, are
left out of the sums, but not of the integrals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.robot.boards.tuning import Elasticity, MotorFigures

_SMOOTH_S = 0.015  # standard deviation of the Gaussian that angles are smoothed by before they are differentiated
#: Shares of the greatest speed: faster than so, the sign of the joint's speed, and of the motor's, is certain.
_SURE, _MOTOR_SURE = 0.2, 0.1
_LEAST_READINGS = 100
_LEAST_SWING_RAD = 0.02
#: Frequencies, Hz, of the duties that show a spring; apart by more than a segment of the recording blurs them.
DITHER_HZ = np.array([4, 5, 6, 7, 9, 11, 13, 16, 19, 23, 28, 34], dtype=float)
_SEGMENT_S, _ROUNDS = 1.0, 10
_SLOW_SMOOTH_S = 0.04  # s; takes the dither out of a slow swing; half: the resonance stays, double: the swing goes
_SPRING_SIGMAS = 7.0  # of a compliance that is a spring: backlash shows 5; half: it is one, double: stiff ones are none
_SPRING_EXPLAINED = 0.7  # share of what lies between joint and motor; half: noise is a spring, double: none is
_LEAST_LINK_SHARE = 0.15  # of the inertia; less behind a spring is no matter, and noise alone looks like it
_READING_NOISE_RAD, _CURRENT_NOISE_A = 5e-4, 0.02  # relative weight of both in the lines
_LONGEST_DAMPING_S = 0.02  # of damping over stiffness: a spring with more is none


@dataclass(frozen=True, eq=False)
class JointFit(Record):
    """What a swing says of a joint."""

    motor: MotorFigures  #: its motor
    backlash_rad: float  #: between motor and potentiometer, from stop to stop
    gravity_n_m: float  #: greatest torque of gravity over all angles, as far as the swing shows it
    resistance_sigma_ohm: float  #: standard deviation of the resistance, by the residuals
    constant_sigma_v_s: float  #: of the motor constant
    t_s: Array  #: (n,) the readings' times from the first one on, s
    voltage_v: Array  #: (n,) what the board put to the motor, smoothed
    predicted_v: Array  #: (n,) what the fit says of it


def fit_swing(t_s: Array, voltage_v: Array, current_a: Array, angle_rad: Array) -> JointFit:
    """Identify a joint's motor from a swing.

    ``t_s``: (n,) times of the readings, rising, s. ``voltage_v``: (n,) duty times supply, V, positive where it drives the
    joint towards greater angles. ``current_a``: (n,) current of the motor, A, of the same sign; of one sign only from
    sensors that know no other. ``angle_rad``: (n,) angles of the joint. Raises InputError: there are too few readings, or
    the joint did not move, or nothing of it looks like a motor.
    """
    if len(t_s) < _LEAST_READINGS or np.ptp(angle_rad) < _LEAST_SWING_RAD:
        raise InputError(
            f"{len(t_s)} readings over {np.ptp(angle_rad) if len(t_s) else 0:.4f} rad are too few to identify a motor by;"
            f" {_LEAST_READINGS} over {_LEAST_SWING_RAD} rad are needed"
        )
    step_s, t, (volts, amperes, q) = _evenly(t_s, voltage_v, current_a, angle_rad)
    speed = _smooth(q, step_s, derivative=True)
    sure = _sure(speed, step_s, _SURE)
    if (amperes > -0.02 * np.abs(amperes).max()).all():
        amperes = _signed(t, volts, amperes, q, speed, sure)
    (resistance, constant, half), sigma = _fit_flux(t, volts, amperes, q, speed, sure)
    if not (resistance > 0 and constant > 0):
        raise InputError(
            f"the swing fits no motor: resistance {resistance:.3g} ohm, constant {constant:.3g} V s/rad; both must be"
            " positive: are current and voltage those of this motor?"
        )
    motor_rad_s = (volts - resistance * amperes) / constant
    viscous, dry, gravity, inertia = _fit_torque(constant * amperes, motor_rad_s, q, step_s)
    if not inertia > 0:
        raise InputError(f"the swing fits no motor: its inertia comes out as {inertia:.3g} kg m^2; it must be positive")
    motor = MotorFigures(resistance, constant, inertia, max(viscous, 0.0), max(dry, 0.0))
    smooth_v = _smooth(volts, step_s)
    predicted = resistance * _smooth(amperes, step_s) + constant * speed
    return JointFit(motor, max(2 * half, 0.0), gravity, sigma[0], sigma[1], t, smooth_v, predicted)


def _evenly(t_s: Array, *recorded: Array) -> tuple[float, Array, list[Array]]:
    """Return the step, s, times from 0 on in such steps, and what was recorded at them."""
    step_s = float(np.median(np.diff(t_s)))
    t = np.arange(0.0, float(t_s[-1] - t_s[0]) + 0.5 * step_s, step_s)
    return step_s, t, [np.interp(t, t_s - t_s[0], each) for each in recorded]


def fit_spring(t_s: Array, voltage_v: Array, current_a: Array, angle_rad: Array) -> tuple[JointFit, Elasticity] | None:
    """Identify a joint that is read behind a spring, from a swing with duties at :data:`DITHER_HZ`; None if it is rigid.

    ``t_s``: (n,) times of the readings, rising, s; 1.5 s and more. ``voltage_v``: (n,) duty times supply, V, as in
    :func:`fit_swing`. ``current_a``: (n,) current of the motor, A, with its sign. ``angle_rad``: (n,) angles of the joint.
    """
    if (
        len(t_s) < _LEAST_READINGS
        or min(map(np.ptp, (voltage_v, current_a))) <= 0.0
        or np.ptp(angle_rad) < _LEAST_SWING_RAD
    ):
        return None  # fit_swing says what is missing
    step_s, t, (volts, amperes, q) = _evenly(t_s, voltage_v, current_a, angle_rad)
    if t[-1] < 1.5 * _SEGMENT_S or (amperes > -0.02 * np.abs(amperes).max()).all():
        return None
    w = 2 * np.pi * DITHER_HZ
    speed = np.gradient(q, step_s)
    v, i, link_speed = _lines(volts, volts, step_s), _lines(amperes, volts, step_s), _lines(speed, volts, step_s)
    link_speed = link_speed * w * step_s / np.sin(w * step_s)  # central differences show a little less
    resistance, p, damping, m = float(np.real(i.conj() @ v / (i.conj() @ i))), 0.0, 0.0, link_speed
    for _ in range(_ROUNDS):
        constant, half = _slow_constant(t, volts - resistance * amperes, amperes, q)
        if not constant > 0:
            return None
        weights = 1 / np.hypot(resistance * _CURRENT_NOISE_A, constant * _READING_NOISE_RAD * w * (1 - p * w * w))
        columns = np.column_stack([i, -constant * w * w * link_speed, constant * 1j * w * (link_speed - m)])
        (resistance, p, damping), sigma, _ = _complex_fit(columns, v - constant * link_speed, weights)
        damping = float(np.clip(damping, 0.0, _LONGEST_DAMPING_S))
        m = link_speed * (1 - p * w * w + 1j * w * damping) / (1 + 1j * w * damping)
    m = (v - resistance * i) / constant
    between = np.column_stack([w * w * link_speed, -1j * w * (link_speed - m)])
    _, _, explained = _complex_fit(between, link_speed - m, weights)
    inertias = np.column_stack([1j * w * m, 1j * w * link_speed, m])
    (rotor, link, _), _, _ = _complex_fit(inertias, constant * i, np.ones(len(w)))
    found = p > _SPRING_SIGMAS * sigma[1] and explained > _SPRING_EXPLAINED
    if not (found and resistance > 0 and link > _LEAST_LINK_SHARE * max(rotor + link, 0.0)):
        return None
    rotor = max(rotor, 0.05 * link)
    elastic = Elasticity(link / p, damping * link / p, link / (rotor + link))
    motor_rad_s = (volts - resistance * amperes) / constant
    viscous, dry, gravity = _fit_torque(constant * amperes, motor_rad_s, q, step_s, (rotor, link))
    motor = MotorFigures(resistance, constant, rotor + link, max(viscous, 0.0), max(dry, 0.0))
    predicted = resistance * _smooth(amperes, step_s) + constant * _smooth(q, step_s, derivative=True)
    smooth_v = _smooth(volts, step_s)
    return JointFit(motor, max(2 * half, 0.0), gravity, float(sigma[0]), np.nan, t, smooth_v, predicted), elastic


#: Periods a revolution of the joint of an eccentric drum that are tried; double: noise finds one, half: slow ones.
_DRUMS_PER_REV = np.arange(1.0, 12.5, 0.5)
_DRUM_SIGMAS = 8.0  # of an amplitude that is a drum's; half: friction is one, double: only large ones are found
_LEAST_DRUM_RAD = 0.004  # rad; a table's bend looks like less; half: bends are drums, double: small ones are missed


def fit_drum(
    t_s: Array, voltage_v: Array, current_a: Array, angle_rad: Array, motor: MotorFigures, twist_rad_per_a: float
) -> tuple[float, float] | None:
    """Return amplitude, rad, and periods a revolution by which a joint leads its motor, as by an eccentric drum; or None.

    Args:
        t_s: (n,) times of the readings of a travel to and fro, rising, s.
        voltage_v: (n,) duty times supply, V.
        current_a: (n,) current of the motor, A, with its sign.
        angle_rad: (n,) angles of the joint.
        motor: its motor; the constant is fitted once more.
        twist_rad_per_a: of its transmission.
    """
    if len(t_s) < _LEAST_READINGS or np.ptp(angle_rad) < _LEAST_SWING_RAD:
        return None
    step_s, t, (volts, amperes, q) = _evenly(t_s, voltage_v, current_a, angle_rad)
    flux = _smooth(_integral(t, volts - motor.resistance_ohm * amperes), step_s, sigma_s=_SLOW_SMOOTH_S)
    angle = _smooth(q + twist_rad_per_a * amperes, step_s, sigma_s=_SLOW_SMOOTH_S)
    load = _smooth(_integral(t, amperes), step_s, sigma_s=_SLOW_SMOOTH_S)
    way = _smooth(np.sign(np.gradient(angle, step_s)), step_s, sigma_s=_SLOW_SMOOTH_S)
    plain = [angle, way, load, np.ones(len(t)), t]
    alike = _SLOW_SMOOTH_S * 4 / step_s  # so many readings are one
    fits = []
    for n in _DRUMS_PER_REV:
        columns = np.column_stack([*plain, np.cos(n * angle), np.sin(n * angle)])
        factors = np.linalg.lstsq(columns, flux, rcond=None)[0]
        left = float(np.sum((flux - columns @ factors) ** 2))
        covariance = np.linalg.pinv(columns.T @ columns) * left / max(len(t) - alike * columns.shape[1], 1.0) * alike
        size = factors[5:] / factors[0]
        chance = float(np.sqrt(size @ np.linalg.pinv(covariance[5:, 5:] / factors[0] ** 2) @ size))
        fits.append((left, float(np.hypot(*size)), float(n), chance))
    _, amplitude, per_rev, chance = min(fits)
    return (amplitude, per_rev) if chance > _DRUM_SIGMAS and amplitude > _LEAST_DRUM_RAD else None


def _lines(values: Array, reference: Array, step_s: float) -> Array:
    """Return the complex amplitudes (12,) of values (n,) at the dither's frequencies, as they follow a reference's."""
    length = round(_SEGMENT_S / step_s)
    window = np.hanning(length + 1)[:length]
    waves = np.exp(-2j * np.pi * DITHER_HZ[:, None] * np.arange(length) * step_s) * window * (2 / window.sum())
    starts = range(0, len(values) - length + 1, length // 2)
    ours, theirs = (np.array([waves @ each[k : k + length] for k in starts]) for each in (values, reference))
    return np.asarray((theirs.conj() * ours).sum(0) / np.sqrt((np.abs(theirs) ** 2).sum(0) * len(starts)))


def _complex_fit(columns: Array, right: Array, weights: Array) -> tuple[Array, Array, float]:
    """Return real factors of complex columns by least squares, their standard deviations, and the share they explain."""
    a, b = columns * weights[:, None], right * weights
    a, b = np.concatenate([a.real, a.imag]), np.concatenate([b.real, b.imag])
    factors = np.linalg.lstsq(a, b, rcond=None)[0]
    left = float(np.sum((b - a @ factors) ** 2))
    covariance = np.linalg.pinv(a.T @ a) * left / (len(b) - a.shape[1])
    return (
        np.asarray(factors, dtype=float),
        np.asarray(np.sqrt(np.diag(covariance)), dtype=float),
        1 - left / float(b @ b),
    )


def _slow_constant(t: Array, emf_v: Array, amperes: Array, q: Array) -> tuple[float, float]:
    """Return the motor constant and half the backlash by the slow swing alone, of which the current twists the spring."""
    step_s = float(t[1] - t[0])
    flux, angle, twisting = (
        _smooth(each, step_s, sigma_s=_SLOW_SMOOTH_S) for each in (_integral(t, emf_v), q, amperes)
    )
    way = _smooth(np.sign(np.gradient(angle, step_s)), step_s, sigma_s=_SLOW_SMOOTH_S)
    columns = np.column_stack([angle, way, twisting, np.vander(t / t[-1] - 0.5, 4)])
    ends = round(3 * _SLOW_SMOOTH_S / step_s)
    solution = np.linalg.lstsq(columns[ends:-ends], flux[ends:-ends], rcond=None)[0]
    return float(solution[0]), float(solution[1] / solution[0]) if solution[0] else 0.0


def dead_spots(counts: Array, noise_counts: float, low: float, high: float) -> list[tuple[int, int]]:
    """Return where a potentiometer moved evenly by hand lost contact: first and last reading of each spot.

    counts (n,) come a few milliseconds apart; below ``low`` is a short circuit, above ``high`` an open wiper.
    """
    width = 15
    middle = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(counts, width // 2, mode="edge"), width), axis=1)
    slope = np.abs(np.gradient(middle))
    lost = (counts < low) | (counts > high) | (np.abs(counts - middle) > 400 + 12 * noise_counts + 10 * slope)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    spots: list[tuple[int, int]] = []
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if spots and first - spots[-1][1] < 2 * width:
            spots[-1] = (spots[-1][0], end - 1)
        else:
            spots.append((first, end - 1))
    return spots


def _smooth(values: Array, step_s: float, *, derivative: bool = False, sigma_s: float = _SMOOTH_S) -> Array:
    """Return values (n,) convolved with a Gaussian, or their derivative by time."""
    reach = max(2, round(4 * sigma_s / step_s))
    at = np.arange(-reach, reach + 1) * step_s
    kernel = np.exp(-0.5 * (at / sigma_s) ** 2)
    kernel /= kernel.sum()
    if derivative:
        kernel = -at * kernel
        kernel /= -(kernel * at).sum()
    smoothed: Array = np.convolve(np.pad(values, reach, mode="reflect", reflect_type="odd"), kernel, mode="valid")
    return smoothed


def _sure(speed: Array, step_s: float, share: float) -> NDArray[np.bool_]:
    """Return where (n,) the sign of the speed has been certain for long enough that no smoothing reaches a reversal."""
    slow = np.abs(speed) < share * np.abs(speed).max()
    reach = round(3 * _SMOOTH_S / step_s)
    near = np.convolve(slow, np.ones(2 * reach + 1), mode="same") > 0.5
    near[: 2 * reach] = near[-2 * reach :] = True
    return np.asarray(~near)


def _integral(t: Array, values: Array) -> Array:
    """Return the integral (n,) of values by time, by the trapezoidal rule."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t))])


def _fit_flux(
    t: Array, volts: Array, amperes: Array, q: Array, speed: Array, sure: NDArray[np.bool_]
) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return resistance, constant and half the backlash, and the standard deviations of the first two."""
    columns = np.column_stack([_integral(t, amperes), q, np.sign(speed), np.vander(t / t[-1] - 0.5, 4)])[sure]
    right = _integral(t, volts)[sure]
    solution, _, rank, _ = np.linalg.lstsq(columns, right, rcond=None)
    if rank < columns.shape[1]:
        raise InputError("the swing does not show the motor's resistance: its current never changed")
    residual = right - columns @ solution
    variance = float(residual @ residual) / (len(right) - columns.shape[1])
    sigma = np.sqrt(np.diag(variance * np.linalg.inv(columns.T @ columns)))
    resistance, constant, jump = (float(each) for each in solution[:3])
    # Residuals of integrals are alike from one reading to the next: as many are independent as the smoothing leaves.
    alike = np.sqrt(_SMOOTH_S / (t[1] - t[0]))
    half = jump / constant if constant else 0.0
    return (resistance, constant, half), (float(alike * sigma[0]), float(alike * sigma[1]))


def _fit_torque(
    torque: Array, motor_rad_s: Array, q: Array, step_s: float, inertias: tuple[float, float] | None = None
) -> tuple[float, ...]:
    """Return viscous and dry friction, gravity's greatest torque, and, where motor's and joint's are unknown, the inertia.

    The speed (n,) is the motor's by its back-EMF: at a reversal the joint stands while the motor crosses the backlash.
    """
    speed, right = _smooth(motor_rad_s, step_s), _smooth(torque, step_s)
    gained, off = _smooth(motor_rad_s, step_s, derivative=True), q - q.mean()
    columns = [speed, *(_smooth(each, step_s) for each in (np.sign(speed), np.cos(off), np.sin(off)))]
    sure = _sure(speed, step_s, _MOTOR_SURE)
    if inertias is None:
        columns.append(gained)
    else:
        right -= inertias[0] * gained + inertias[1] * _smooth(np.gradient(q, step_s), step_s, derivative=True)
        sure |= sure.sum() <= _LEAST_READINGS
    viscous, dry, cosine, sine, *inertia = np.linalg.lstsq(np.column_stack(columns)[sure], right[sure], rcond=None)[0]
    return float(viscous), float(dry), float(np.hypot(cosine, sine)), *map(float, inertia)


def _signed(t: Array, volts: Array, amperes: Array, q: Array, speed: Array, sure: NDArray[np.bool_]) -> Array:
    """Return currents with the signs that a motor's equation gives them, from a sensor that knows their size only."""
    signed = np.abs(amperes) * np.sign(volts)
    for _ in range(4):
        (_, constant, _), _ = _fit_flux(t, volts, signed, q, speed, sure)
        signed = np.abs(amperes) * np.sign(_smooth(volts, float(t[1] - t[0])) - constant * speed)
    return signed
