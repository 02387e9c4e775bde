"""The closed forms against plain ray geometry and against our StereoRig; each misprint against its right form.

A misprinted formula stands here as printed; the test asserts that it is wrong where ours is right.
"""

import operator
import re
from pathlib import Path

import closed_form
import numpy as np
import pytest
from closed_form import (
    T_world_camera,
    VergingRig,
    image_coordinates,
    orientation,
    rotation,
    rotation_from_angles,
    stereo_rig,
    triangulate_parallel,
    triangulate_verging,
)
from hypothesis import assume, given

from armsight.data import Body, Correspondences, PoseEstimate
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rigid import fit_rigid
from armsight.geometry.rotation import euler_zyx, exp_so3
from armsight.vision.pose.locate import locate
from armsight.vision.triangulate import triangulate
from asserts import assert_rotation
from strategies import finite, poses, rotation_vectors, verging_rigs

PITCH, SIZE = 3e-6, (1280, 720)
EXACT_M = 1e-9  # what the issue asks for
WRONG_M = 1e-6  # a thousand times more: a misprint must be off by at least this


def see(rig, P):
    """Image coordinates (u1, v1, u2, v2) of a world point, from 18.6 and plain rotations, nothing of 18.7 or 18.8."""
    out = []
    for side in (1, -1):
        beta, F = (rig.beta1, rig.F1) if side == 1 else (rig.beta2, rig.F2)
        position = [-rig.X01, -rig.Y01, rig.Z01] if side == 1 else [rig.X02, -rig.Y02, rig.Z02]
        a = side * beta
        x_axis, z_axis = np.array([np.cos(a), 0, -np.sin(a)]), np.array([np.sin(a), 0, np.cos(a)])
        d = P - np.array(position)
        x, y, z = d @ x_axis, d[1], d @ z_axis
        assert z - F > 0.05, "the strategies keep every point in front of both cameras"
        out += [-x * F / (z - F), -y * F / (z - F)]
    return out


st_points = finite(-0.3, 0.3).flatmap(
    lambda x: finite(-0.3, 0.3).flatmap(lambda y: finite(0.4, 3.0).map(lambda z: np.array([x, y, z])))
)


def auxiliaries(rig, u1, u2):
    """m1, m2, n1, n2 as 18.8 prints them."""
    m1 = rig.F1 * np.cos(rig.beta1) + u1 * np.sin(rig.beta1)
    m2 = rig.F2 * np.cos(rig.beta2) - u2 * np.sin(rig.beta2)
    n1 = u1 * np.cos(rig.beta1) - rig.F1 * np.sin(rig.beta1)
    n2 = u2 * np.cos(rig.beta2) + rig.F2 * np.sin(rig.beta2)
    return m1, m2, n1, n2


# --- triangulation ---------------------------------------------------------------------------------------------------


@given(verging_rigs(), st_points)
def test_verging_agrees_with_the_stereo_rig(rig, P):
    see(rig, P)  # in front of both
    general = stereo_rig(rig, pitch=PITCH, image_size_px=SIZE)
    p_left = transform(inverse(T_world_camera(rig, "left")), P)[None]
    uv_left = general.left.project(p_left)
    uv_right = general.right.project(transform(inverse(general.T_left_right), p_left))
    u1, v1 = image_coordinates(uv_left, pitch=PITCH, image_size_px=SIZE)
    u2, _ = image_coordinates(uv_right, pitch=PITCH, image_size_px=SIZE)
    p_world = triangulate_verging(rig, u1, v1, u2)
    np.testing.assert_allclose(p_world[0], P, atol=EXACT_M)
    np.testing.assert_allclose(transform(inverse(T_world_camera(rig, "left")), p_world), p_left, atol=EXACT_M)


@given(finite(2e-3, 16e-3), finite(0.05, 0.5), st_points)
def test_parallel_is_the_verging_form_without_angles(F, B, P):
    rig = VergingRig.symmetric(F, B)  # 18.9
    u1, v1, u2, _ = see(rig, P)
    np.testing.assert_allclose(triangulate_parallel(F, B, u1, v1, u2)[0], P, atol=EXACT_M)
    np.testing.assert_allclose(triangulate_verging(rig, u1, v1, u2)[0], P, atol=EXACT_M)


@given(verging_rigs(), st_points)
def test_the_two_rays_of_18_7(rig, P):
    u1, _, u2, _ = see(rig, P)
    m1, m2, n1, n2 = auxiliaries(rig, u1, u2)
    X, _, Z = P
    scale = 1e-15 * 64 * (rig.F1 + rig.F2) * 4
    assert m1 * (X + rig.X01) + n1 * (Z - rig.Z01) == pytest.approx(u1 * rig.F1, abs=scale)
    assert m2 * (X - rig.X02) + n2 * (Z - rig.Z02) == pytest.approx(u2 * rig.F2, abs=scale)


def correspondences(general, p_left):
    """What both cameras see of points (N, 3) in the left frame, without noise."""
    uv_right = general.right.project(transform(inverse(general.T_left_right), p_left))
    uv = np.stack([general.left.project(p_left), uv_right], axis=1)
    return Correspondences(np.arange(len(uv)), uv, np.zeros((len(uv), 2, 2, 2)))


@given(verging_rigs(), st_points)
def test_verging_agrees_with_the_general_triangulation(rig, P):
    general = stereo_rig(rig, pitch=PITCH, image_size_px=SIZE)
    seen = correspondences(general, transform(inverse(T_world_camera(rig, "left")), P)[None])
    points = triangulate(general, Body("point", ("P",), np.zeros((1, 3))), seen)
    (u1, v1), (u2, _) = (image_coordinates(seen.uv[:, i], pitch=PITCH, image_size_px=SIZE) for i in range(2))
    closed = triangulate_verging(rig, u1, v1, u2)
    assert points.dropped == ()
    np.testing.assert_allclose(transform(T_world_camera(rig, "left"), points.p_left), closed, atol=EXACT_M)


def test_both_cameras_look_inward_for_positive_angles():
    rig = VergingRig.symmetric(4e-3, 0.2, 0.3)
    assert T_world_camera(rig, "left")[0, 2] > 0 > T_world_camera(rig, "right")[0, 2]
    general = stereo_rig(rig, pitch=PITCH, image_size_px=SIZE)
    assert general.convergence_deg == pytest.approx(np.degrees(0.6))
    # The projection centres lie a focal length in front of the image planes, rotated inward with them.
    assert general.baseline_m == pytest.approx(0.2 - 2 * 4e-3 * np.sin(0.3), abs=1e-15)


# --- misprints of the triangulation ----------------------------------------------------------------------------------


@given(finite(0.02, 1.5))
def test_misprint_18_4_is_no_rotation(beta):
    c, s = np.cos(beta), np.sin(beta)
    printed = np.array([[c, 0, s], [0, 1, 0], [s, 0, c]])
    assert abs(np.linalg.det(printed) - 1) > 2 * s * s * (1 - 1e-12)  # its determinant is cos 2 beta
    assert np.abs(printed @ printed.T - np.eye(3)).max() > s * c
    assert_rotation(rotation(beta))
    np.testing.assert_allclose(rotation(beta) @ [0, 0, 1], [s, 0, c], atol=1e-15)


@given(verging_rigs(), st_points)
def test_misprint_18_7_depth_with_x_minus_x01(rig, P):
    u1, v1, u2, _ = see(rig, P)
    m1, m2, n1, n2 = auxiliaries(rig, u1, u2)
    rest = m1 * rig.F2 * u2 - m2 * rig.F1 * u1 + m1 * n2 * rig.Z02 - m2 * n1 * rig.Z01
    assume(abs(P[0] - 2 * rig.X01 - rig.X02) > 1e-3)  # where X - X01 happens to be X01 + X02
    printed = (m1 * m2 * (P[0] - rig.X01) + rest) / (m1 * n2 - m2 * n1)
    assert abs(printed - P[2]) > WRONG_M
    assert abs(triangulate_verging(rig, u1, v1, u2)[0, 2] - P[2]) <= EXACT_M


@given(verging_rigs(), st_points)
def test_misprint_18_7_height_with_x_minus_x01(rig, P):
    u1, v1, u2, _ = see(rig, P)
    assume(abs(v1) > 1e-3 * rig.F1)  # on the axis any factor does
    s, c = np.sin(rig.beta1), np.cos(rig.beta1)
    printed = v1 - rig.Y01 - v1 / rig.F1 * ((P[0] - rig.X01) * s + (P[2] - rig.Z01) * c)
    assert abs(printed - P[1]) > WRONG_M
    assert printed - P[1] == pytest.approx(v1 / rig.F1 * 2 * rig.X01 * s, rel=1e-6)
    assert abs(triangulate_verging(rig, u1, v1, u2)[0, 1] - P[1]) <= EXACT_M


@given(verging_rigs(), st_points)
def test_misprint_18_7_signs_of_z0(rig, P):
    u1, v1, u2, _ = see(rig, P)
    m1, m2, n1, n2 = auxiliaries(rig, u1, u2)
    right = m1 * n2 * rig.Z02 - m2 * n1 * rig.Z01
    assume(abs(2 * right / (m1 * n2 - m2 * n1)) > 2 * WRONG_M)  # without displacement in depth nothing shows
    base = m1 * m2 * (rig.X01 + rig.X02) + m1 * rig.F2 * u2 - m2 * rig.F1 * u1
    printed = (base - right) / (m1 * n2 - m2 * n1)
    assert abs(printed - P[2]) > WRONG_M
    assert abs(triangulate_verging(rig, u1, v1, u2)[0, 2] - P[2]) <= EXACT_M


def test_misprint_18_10_has_no_disparity():
    F, B, P = 4e-3, 0.2, np.array([0.1, 0.05, 1.0])
    u1, v1, u2, _ = see(VergingRig.symmetric(F, B), P)
    with np.errstate(divide="ignore"):
        printed = F - np.divide(B * F, u2 - u2)
    assert not np.isfinite(printed)
    np.testing.assert_allclose(triangulate_parallel(F, B, u1, v1, u2)[0], P, atol=EXACT_M)


# --- orientation -----------------------------------------------------------------------------------------------------

PLATE = np.array([[-0.055, 0.0, 0.0], [0.055, 0.0, 0.0], [0.0, 0.0, -0.085]])  # P3 below the middle of P1 P2


@given(poses())
def test_orientation_of_an_isosceles_plate(T):
    found = orientation(*transform(T, PLATE))
    np.testing.assert_allclose(found.R, T[:3, :3], atol=1e-13)
    np.testing.assert_allclose(found.R, fit_rigid(PLATE, transform(T, PLATE))[:3, :3], atol=EXACT_M)
    assert not found.orthonormalised


@given(rotation_vectors(0.8))
def test_orientation_agrees_with_locate(phi):
    rig = VergingRig.symmetric(4e-3, 0.22, 0.1)
    general = stereo_rig(rig, pitch=PITCH, image_size_px=SIZE)
    plate = Body("plate", ("P1", "P2", "P3"), PLATE)
    seen = correspondences(general, transform(pose(exp_so3(phi), np.array([0.1, 0.02, 0.8])), PLATE))
    points = triangulate(general, plate, seen)
    located = locate(general, plate, points)
    assert isinstance(located, PoseEstimate)
    np.testing.assert_allclose(orientation(*points.p_left).R, located.T_left_body[:3, :3], atol=1e-9)


@pytest.mark.parametrize("pitch", [90, -90])
def test_singular_pitch_is_reported(pitch):
    found = orientation(*(PLATE @ rotation_from_angles(*np.radians([40, pitch, 15])).T))
    assert found.singular_pitch
    np.testing.assert_allclose(np.degrees(found.euler_zyx), [40 - np.sign(pitch) * 15, pitch, 0], atol=1e-6)


@given(poses(), finite(-0.04, 0.04))
def test_a_skew_plate_is_made_square_and_says_so(T, aside):
    plate = PLATE + np.array([[0, 0, 0], [0, 0, 0], [aside, 0, 0]])
    found = orientation(*transform(T, plate))
    assert_rotation(found.R, atol=1e-13)
    np.testing.assert_allclose(found.R, T[:3, :3], atol=1e-12)
    assert found.off_square_rad == pytest.approx(np.arctan2(abs(aside), 0.085), abs=1e-13)
    if abs(aside) > 1e-9:
        assert found.orthonormalised
        # As printed, the three columns are no rotation: x_b . z_b is not zero.
        x_b, z_b = T[:3, 0], transform(T, plate[:2].mean(axis=0)) - transform(T, plate[2])
        assert abs(x_b @ z_b) > 1e-10


# --- misprints of the orientation ------------------------------------------------------------------------------------


@given(finite(-3, 3), finite(-1.4, 1.4), finite(-3, 3))
def test_misprint_18_15_row_1_column_3(phi, theta, psi):
    R = rotation_from_angles(phi, theta, psi)
    right = np.cos(phi) * np.sin(theta) * np.cos(psi) + np.sin(phi) * np.sin(psi)
    assert R[0, 2] == pytest.approx(right, abs=1e-14)
    printed = np.cos(phi) * np.sin(theta) * np.sin(psi) + np.sin(phi) * np.sin(psi)
    difference = np.cos(phi) * np.sin(theta) * (np.sin(psi) - np.cos(psi))
    assume(abs(difference) > 1e-3)
    assert abs(printed - R[0, 2]) > 1e-4
    wrong = R.copy()
    wrong[0, 2] = printed
    assert np.abs(wrong @ wrong.T - np.eye(3)).max() > 1e-8


@given(finite(-np.pi, np.pi), finite(-1.5, 1.5), finite(-np.pi, np.pi))
def test_misprint_18_16_arctan_loses_the_quadrant(phi, theta, psi):
    assume(min(abs(np.cos(phi)), abs(np.cos(psi))) > 1e-3)
    R = rotation_from_angles(phi, theta, psi)
    (roll, pitch, yaw), _ = euler_zyx(R)
    assert np.abs(np.exp(1j * np.array([roll, pitch, yaw])) - np.exp(1j * np.array([phi, theta, psi]))).max() < 1e-12
    printed_roll, printed_yaw = np.arctan(R[1, 0] / R[0, 0]), np.arctan(R[2, 1] / R[2, 2])
    assert (abs(printed_roll - phi) > 3) == (np.cos(phi) < 0)
    assert (abs(printed_yaw - psi) > 3) == (np.cos(psi) < 0)


# --- the table in docs/concepts/method.md -------------------------------------------------------------------------------


def test_the_page_lists_every_number_and_names_what_stands():
    page = (Path(__file__).resolve().parents[2] / "docs" / "concepts" / "method.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| 18.") or line.startswith("| table")]
    listed = {number for row in rows for number in re.findall(r"\b18\.\d+", row.split("|")[1])}
    assert listed == {f"18.{n}" for n in range(1, 22)}
    assert any(row.startswith("| table 18.1 ") for row in rows)
    of_the_arm = (Path(__file__).resolve().parents[1] / "robot" / "models" / "test_six_r.py").read_text(
        encoding="utf-8"
    )
    for name in re.findall(r"`(test_\w+)`", page):
        assert name in globals() or f"def {name}(" in of_the_arm, (
            f"docs/concepts/method.md names {name}, which is no test"
        )
    for name in re.findall(r"`(?:chapter|closed_form)\.([\w.]+)`", page):
        assert operator.attrgetter(name)(closed_form)
