import cv2
import numpy as np
import pytest
from handeye_motions import error, recording
from scipy.stats import chi2

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.loop.handeye import poses as handeye_start
from armsight.loop.handeye.handeye import calibrate_handeye


@pytest.mark.parametrize("eye", ["to_hand", "in_hand"])
def test_the_covariance_holds_the_error_and_blunders_are_left_out(eye):
    squares = []
    for seed in range(16):
        A, B, cov, Z, X = recording(seed, eye, gross=seed % 4)
        h = calibrate_handeye(A, B, cov, eye=eye, quick=True)
        assert (h.used == (np.arange(len(A)) >= seed % 4)).all()
        e = error(h, Z, X)
        squares.append(e @ np.linalg.solve(h.cov, e))
    # Chance 1e-3 at either end; the sigmas themselves are estimated from 180 numbers, which widens the upper end by 10 %.
    assert chi2.ppf(1e-3, 12 * 16) < sum(squares) < 1.1 * chi2.isf(1e-3, 12 * 16)


@pytest.mark.parametrize("eye", ["to_hand", "in_hand"])
def test_without_noise_the_answer_is_exact(eye):
    A, _, _, Z, X = recording(3, eye)
    B = inverse(Z) @ A @ X if eye == "to_hand" else inverse(A @ X) @ Z
    h = calibrate_handeye(A, B, eye=eye.replace("_", "-"))  # as the command has it
    assert h.eye == eye
    assert np.abs(error(h, Z, X)).max() < 1e-9
    assert h.held_out.most()[0] < 1e-9
    assert np.abs(h.predict(A) - B).max() < 1e-9


def test_the_held_out_error_is_what_new_poses_show():
    A, B, cov, _, _ = recording(11, n=60)
    h = calibrate_handeye(A[:30], B[:30], cov[:30])
    new = np.linalg.norm((h.predict(A[30:]) - B[30:])[:, :3, 3], axis=1)
    assert h.held_out.rms()[0] == pytest.approx(np.sqrt(np.mean(new**2)), rel=0.25)  # 90 numbers each: 7 % sigma a side


def test_the_closed_form_start_is_exact_without_noise():
    A, _, _, Z, X = recording(3)
    found_X, found_Z = handeye_start.kronecker(A, inverse(Z) @ A @ X)
    np.testing.assert_allclose(found_X, X, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found_Z, Z, rtol=0, atol=1e-9)


@pytest.mark.opencv
@pytest.mark.skipif(not hasattr(cv2, "calibrateRobotWorldHandEye"), reason="this OpenCV has no hand-eye calibration")
def test_the_own_start_is_as_good_as_opencvs():
    A, B, _, _, _ = recording(2)
    parts = [[T[:3, part] for T in Ts] for Ts in (A, B) for part in (slice(3), [3])]  # OpenCV 5.1 wants columns
    RX, tX, RZ, tZ = cv2.calibrateRobotWorldHandEye(*parts, method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH)
    for own, R, t in zip(handeye_start.kronecker(A, B), (RX, RZ), (tX, tZ), strict=True):
        assert np.abs(own - pose(R, t.ravel())).max() < 0.02


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda A, B: (A[:3], B[:3]), "needs 4 or more poses, got 3"),
        (lambda A, B: (A, B[:-1]), "Ts_rig_body has shape"),
        (lambda A, B: (A * np.nan, B), "NaN"),
        (lambda A, B: (A, B * 2), "pose 0 is no rigid motion"),
    ],
)
def test_what_is_no_recording_is_rejected(change, said):
    A, B, _, _, _ = recording(3)
    with pytest.raises(InputError, match=said):
        calibrate_handeye(*change(A, B))


def test_an_unknown_mounting_and_a_transform_of_the_other_one_are_rejected():
    A, B, cov, _, _ = recording(3)
    with pytest.raises(InputError, match="to_hand, in_hand"):
        calibrate_handeye(A, B, cov, eye="on_foot")
    with pytest.raises(InputError, match="belongs to 'in_hand'"):
        _ = calibrate_handeye(A, B, cov).T_flange_rig


def test_millimetres_and_what_is_no_rigid_motion_are_named():
    flange, body = (np.tile(np.eye(4), (5, 1, 1)) for _ in range(2))
    flange[:, :3, 3], body[:, 2, 3] = 400.0, 0.8
    with pytest.raises(
        InputError, match=r"Ts_base_flange: positions of up to 400 m: are they millimetres\? give metres"
    ):
        calibrate_handeye(flange, body)
    flange[:, :3, 3], body[2, 3, 3] = 0.4, 1000.0
    with pytest.raises(InputError, match="Ts_rig_body: pose 2 is no rigid motion: its last row is not 0 0 0 1"):
        calibrate_handeye(flange, body)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("eye", "given"), [("to_hand", "in_hand"), ("in_hand", "to_hand")])
def test_poses_of_the_other_mounting_are_rejected(eye, given, seed):
    A, B, cov, _, _ = recording(seed, eye)
    with pytest.raises(
        InputError, match=f'these poses fit eye="{eye}", not "{given}".*or one of the lists holds inverse'
    ):
        calibrate_handeye(A, B, cov, eye=given)
    with pytest.raises(InputError, match="inverse transforms"):
        calibrate_handeye(A, inverse(B), cov, eye=eye)


@pytest.mark.parametrize("eye", ["to_hand", "in_hand"])
@pytest.mark.parametrize("way", ["still", "held"])
def test_what_was_displaced_midway_is_named_and_the_covariance_holds_both_states(eye, way):
    A, B, cov, Z, X = recording(902, eye, n=40)
    by = {way: exp_se3(np.array([0, 0, 3e-3, 0.004, 0, 0]))}
    there = Z @ by.get("still", np.eye(4)), X @ by.get("held", np.eye(4))
    before, after = (inverse(Zs) @ A @ Xs if eye == "to_hand" else inverse(A @ Xs) @ Zs for Zs, Xs in ((Z, X), there))
    B = np.concatenate([B[:18], (after @ inverse(before) @ B)[18:]])
    h = calibrate_handeye(A, B, cov, eye=eye)
    assert h.change is not None
    assert h.change.way == way
    assert abs(h.change.row - 18) <= 1
    assert "stands elsewhere" in repr(h)
    said, of = h.to_dict()["change"], {"still": h.T_base_still, "held": h.T_flange_held}[way]
    assert said["row"] == h.change.row
    assert h.to_dict()[said["way"]] == of.tolist()
    assert np.allclose(said["step_m_rad"], [0, 0, 3e-3, 0.004, 0, 0], atol=1e-3)
    for state in ((Z, X), there):
        e = error(h, *state)
        assert e @ np.linalg.solve(h.cov, e) < chi2.isf(1e-3, 12)


def test_an_arm_that_is_off_by_its_reach_was_not_displaced_where_its_poses_are_in_order():
    for seed in range(905, 913):
        A, B, cov, Z, _ = recording(seed, n=40)
        droop = np.tile(np.eye(4), (len(A), 1, 1))
        droop[:, 2, 3] = -8e-3 * (A[:, :2, 3] ** 2).sum(axis=1)
        B, order = inverse(Z) @ droop @ Z @ B, np.argsort(A[:, 0, 3])
        change = calibrate_handeye(A[order], B[order], cov[order]).change
        assert change is None or not change.sure
