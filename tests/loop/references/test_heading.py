"""A magnetometer as a witness of the heading: motors disturb it, which its model does not know."""

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3, log_so3
from armsight.loop.references.calibrate import calibrate
from armsight.loop.references.file import MESSAGES, RANGE, read_ranges, read_recording
from armsight.loop.references.heading import EARTH_T, Magnetometer, heading_off
from armsight.loop.references.reference import Reading, ToolMotion

NOISE_T = 0.4e-6
#: Central Europe: 20 uT north, 45 uT down; in a base that looks somewhere.
FIELD = exp_so3(np.array([0.0, 0.0, 0.7])) @ np.array([20e-6, 0.0, -45e-6])


def dipole(at, moment):
    """The field (3,), T, of a dipole (3,), A m2, at the base's axis 0.3 m above it."""
    apart = at - [0.0, 0.0, 0.3]
    r = np.linalg.norm(apart)
    return 1e-7 * (3 * apart * (apart @ moment) / r**2 - moment) / r**3


def recorded(rng, sensor, count, rotated=0.0, motor=0.3):
    """Return readings and poses: the base rotated about z, a motor with changing current near, rounded numbers."""
    Ts, readings = [], []
    back = exp_so3(np.array([0.0, 0.0, -rotated]))
    for k in range(count):
        R, p = exp_so3(rng.normal(0, 1.0, 3)), rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 0.6])
        p[:2] += 0.15 * np.sign(p[:2])
        field = back @ FIELD + dipole(p, motor * rng.normal(size=3))
        z = sensor.soft @ (R @ sensor.R_tool_sensor).T @ field + sensor.hard_t + rng.normal(0, NOISE_T, 3)
        Ts.append(pose(R, p))
        readings.append(Reading(float(k), 0, np.round(z / 0.15e-6) * 0.15e-6, NOISE_T**2 * np.eye(3)))
    return readings, lambda t: ToolMotion(Ts[int(t)])


def some(rng):
    """A sensor mounted anyhow, near iron."""
    A = rng.normal(0, 0.05, (3, 3))
    soft = np.eye(3) + (A + A.T) / 2
    mounting = exp_so3(rng.normal(0, 1.5, 3))
    return Magnetometer(
        name="m",
        cov=np.zeros((15, 15)),
        R_tool_sensor=mounting,
        soft=soft,
        hard_t=rng.normal(0, 60e-6, 3),
        field_t=FIELD,
    )


def calibrated(rng, sensor, count=60):
    readings, motion = recorded(rng, sensor, count)
    return calibrate(Magnetometer.of("m").begun(readings, motion), readings, motion)


def test_the_closed_form_finds_exact_readings():
    rng = np.random.default_rng(3)
    sensor = some(rng)
    readings, motion = recorded(rng, sensor, 20, motor=0.0)
    exact = [Reading(each.t_s, 0, sensor.expected(motion(each.t_s), 0).z, each.cov) for each in readings]
    found = Magnetometer.of("m").begun(exact, motion)
    assert np.linalg.norm(log_so3((found.R_tool_sensor.T @ sensor.R_tool_sensor)[None])) < 1e-7
    scale = np.linalg.norm(FIELD) / EARTH_T  # length of the field and size of the soft iron are not observable apart
    np.testing.assert_allclose(found.soft, sensor.soft * scale, atol=1e-9)
    np.testing.assert_allclose(found.hard_t, sensor.hard_t, atol=1e-12)


def test_derivatives():
    rng = np.random.default_rng(4)
    sensor, T = some(rng), pose(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    at = sensor.expected(ToolMotion(T), 0)
    for k in range(15):
        step = np.zeros(15)
        step[k] = 1e-6
        ahead, behind = (sensor.moved(sign * step).expected(ToolMotion(T), 0).z for sign in (1, -1))
        np.testing.assert_allclose(at.by_parameters[:, k], (ahead - behind) / 2e-6, atol=1e-9)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        ahead, behind = (
            sensor.expected(ToolMotion(pose(T[:3, :3] @ exp_so3(sign * step), T[:3, 3])), 0).z for sign in (1, -1)
        )
        np.testing.assert_allclose(at.by_tool[:, 3 + k], (ahead - behind) / 2e-6, atol=1e-10)


def test_a_base_that_was_rotated_is_found_within_its_sigma_beside_motors():
    off, sigmas = [], []
    for seed in range(30):
        rng = np.random.default_rng([7, seed])
        sensor, rotated = some(rng), np.radians(rng.uniform(-20, 20))
        found = heading_off(calibrated(rng, sensor).reference, *recorded(rng, sensor, 20, rotated))
        off.append(found.angle_rad - rotated)
        sigmas.append(found.sigma_rad)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], len(off))
    assert low < np.sum(np.square(off) / np.square(sigmas)) < high
    assert np.sqrt(np.mean(np.square(off))) < np.radians(2.0)  # what such a sensor is good for


def test_readings_near_a_motor_show_its_field_and_sigma_grows_there():
    rng = np.random.default_rng(11)
    sensor = some(rng)
    reference = calibrated(rng, sensor).reference
    quiet, loud = (heading_off(reference, *recorded(rng, sensor, 20, motor=motor)) for motor in (0.0, 3.0))
    assert np.median(loud.disturbance_t) > 5 * np.median(quiet.disturbance_t)
    assert loud.sigma_rad > 2 * quiet.sigma_rad
    assert abs(loud.angle_rad) < 3 * loud.sigma_rad


def test_a_tool_at_rest_shows_its_field_once_however_it_drifts():
    rng = np.random.default_rng(12)
    sensor = some(rng)
    reference = calibrated(rng, sensor).reference
    readings, motion = recorded(rng, sensor, 6)
    at, drift = motion(0.0), 2e-6 * np.array([1.0, -1.0, 0.5])  # 5 degrees of heading in a minute
    z = sensor.expected(at, 0).z
    rest = [Reading(100.0 + k, 0, z + drift * k / 300, NOISE_T**2 * np.eye(3)) for k in range(300)]
    there = lambda t: at if t >= 100.0 else motion(t)  # noqa: E731
    assert heading_off(reference, rest, there).sigma_rad == np.inf
    found = heading_off(reference, readings + rest, there)
    assert abs(found.angle_rad) < 3 * found.sigma_rad
    assert found.sigma_rad > 0.7 * heading_off(reference, readings, there).sigma_rad


@pytest.mark.parametrize("angle", [0.0, 0.0625, 0.25, np.pi, 3 * np.pi / 2])
def test_jitter_at_rest_is_one_attitude_wherever_it_is(angle):
    """Also at pi, where rotation vectors jump, and beside another attitude, at the angle that divides them."""
    rng = np.random.default_rng(13)
    sensor = some(rng)

    def found(*angles):
        axis = np.array([0.6, 0.0, 0.8])
        Rs = [exp_so3(each * axis) @ exp_so3(rng.normal(0, 0.3e-3, 3)) for each in angles for _ in range(100)]
        there = lambda t: ToolMotion(pose(Rs[int(t)], np.zeros(3)))  # noqa: E731
        drift = np.linspace(0.0, 2e-6, len(Rs))[:, None] * [1.0, -1.0, 0.5]
        z = [sensor.expected(there(k), 0).z + drift[k] for k in range(len(Rs))]
        return heading_off(
            sensor, [Reading(float(k), 0, each, NOISE_T**2 * np.eye(3)) for k, each in enumerate(z)], there
        )

    assert found(angle).sigma_rad == np.inf
    assert found(angle, angle + 0.2).sigma_rad < np.inf
    beside, apart = found(angle, angle + 0.1), found(angle, angle + 0.1005)
    assert beside.sigma_rad == pytest.approx(apart.sigma_rad, rel=0.5)


def test_too_few_or_flat_attitudes_are_rejected():
    rng = np.random.default_rng(5)
    sensor = some(rng)
    readings, motion = recorded(rng, sensor, 11)
    with pytest.raises(InputError, match="11 attitudes; 12 at least"):
        Magnetometer.of("m").begun(readings, motion)
    Ts = [pose(exp_so3(np.array([0, 0, 0.3 * k])), np.zeros(3)) for k in range(20)]
    flat = [Reading(float(k), 0, sensor.expected(ToolMotion(T), 0).z, np.eye(3)) for k, T in enumerate(Ts)]
    with pytest.raises(InputError, match="about one axis alone"):
        Magnetometer.of("m").begun(flat, lambda t: ToolMotion(Ts[int(t)]))
    stuck = [Reading(float(k), 0, z, np.eye(3)) for k, z in enumerate(3e-5 + rng.normal(0, NOISE_T, (30, 3)))]
    attitudes = [pose(exp_so3(rng.normal(0, 1.0, 3)), np.zeros(3)) for _ in stuck]
    with pytest.raises(InputError, match="do not follow the tool's attitude"):
        Magnetometer.of("m").begun(stuck, lambda t: ToolMotion(attitudes[int(t)]))
    steep = Magnetometer(**{**vars(sensor), "field_t": np.array([1e-7, 0, -45e-6])})
    with pytest.raises(InputError, match="horizontal part"):
        heading_off(steep, readings, motion)


@pytest.mark.parametrize("ros1", [True, False])
def test_a_bags_fields_and_ranges_are_read(tmp_path, ros1):
    """Of ranges those that their message calls out of range, as infinity is by REP 117, are no measurement."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    path = tmp_path / ("a.bag" if ros1 else "a")
    writer = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    types, given = store.types, np.array([[20e-6, -3e-6, 40e-6], [21e-6, 0.0, 41e-6]])

    def write(connection, ns, kind, *content):
        header = types["std_msgs/msg/Header"](
            *([0] if ros1 else []), types["builtin_interfaces/msg/Time"](5, ns), "imu"
        )
        message = types[kind](header, *content)
        writer.write(connection, 10**9, (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, kind))

    with writer:
        kind, of_range = MESSAGES[Magnetometer].replace("/", "/msg/"), RANGE.replace("/", "/msg/")
        field = writer.add_connection("/imu/mag", kind, typestore=store)
        ranges = [writer.add_connection(f"/range/{name}", of_range, typestore=store) for name in ("right", "left")]
        for k, value in enumerate(given):
            write(field, k, kind, types["geometry_msgs/msg/Vector3"](*value), np.zeros(9))
        for k, value in enumerate((0.5, 1.25, np.inf, 2.5)):
            write(ranges[k % 2], 10 - k, of_range, 0, 0.1, 0.2, 2.0, value, *([] if ros1 else [0.01]))
    t_s, z = read_recording(path, Magnetometer)
    np.testing.assert_array_equal(z, given)
    np.testing.assert_allclose(t_s, [5.0, 5.0 + 1e-9], rtol=0, atol=1e-12)
    topics, t_s, channel, z = read_ranges(path)
    assert topics == ("/range/left", "/range/right")
    assert (channel.tolist(), z.tolist()) == ([0, 1], [1.25, 0.5])
    np.testing.assert_allclose(t_s, [5.0 + 9e-9, 5.0 + 1e-8], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="expected one topic of sensor_msgs/Imu; there are 0"):
        read_recording(path)
