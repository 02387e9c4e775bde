"""What is said of data with a mistake in their columns, on made-up worn arms where the mistake is known."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worn_arm import poses, worn

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.identify.fit import prior_sigma
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.misread import check_plausible, placed_change, points_off, without_tool
from armsight.loop.identify.model import Model
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.read import read_poses
from armsight.loop.identify.selection import PLACEMENT, lacking
from armsight.loop.identify.validate import with_change_allowed
from armsight.robot.arm_file import open_arm
from armsight.tables.rotations import ROTATIONS

#: One whose axes lie in a plane but for its shoulder, one with a round wrist, and two with none.
ARMS = ("six_r", "ur5", "ur10", "puma560")
FRAME = "two of the instrument's axes are exchanged"


def made(name, seed, n=40):
    """A worn arm and full poses of it, as a file of an instrument that gives no covariance holds them."""
    w, rng = worn(seed, open_arm(name)), np.random.default_rng(100 + seed)
    return w, replace(w.seen(*poses(w.nominal, n, rng), rng), cov=None, approach=None)


def points(measured, p=None, q=None):
    """The same with one point only, and a mistake in them."""
    return Measured(measured.q if q is None else q, seen_at(measured) if p is None else p)


def seen_at(measured, body_point=(0.1, 0.05, 0.12)):
    """Where a point of the body is seen; by default one far enough from the wrist for every joint to move it."""
    return measured.p_rig + (measured.R_rig_body @ np.array(body_point))[:, None]


def said(w, measured):
    with pytest.raises(InputError) as caught:
        check_plausible(without_tool(w.nominal), measured)
    return str(caught.value)


def proposed(text):
    """What is proposed first, apart from what the data do not show."""
    return text.split("(off by")[0]


@pytest.mark.parametrize("name", ARMS)
def test_right_data_pass(name):
    w, measured = made(name, 1)
    check_plausible(without_tool(w.nominal), measured)
    check_plausible(without_tool(w.nominal), points(measured))


@pytest.mark.parametrize("zero", ["p", "q"])
def test_a_few_gross_rows_do_not_make_the_data_of_another_arm(zero):
    w, measured = made("ur5", 2, 60)
    p, q = seen_at(measured).copy(), measured.q.copy()
    {"p": p, "q": q}[zero][[7, 30, 31]] = 0.0
    spoilt = points(measured, p, q)
    check_plausible(without_tool(w.nominal), spoilt)
    assert {7, 30, 31} <= set(identify(w.nominal, spoilt).left_out.tolist())
    assert "are they in mm, not m?" in said(w, points(measured, p=1e3 * spoilt.p_rig, q=spoilt.q))


@pytest.mark.parametrize(("name", "seed"), [("ur5", 5), ("six_r", 6)])
def test_a_few_poses_of_zeros_do_not_make_the_data_of_another_arm(name, seed):
    w, measured = made(name, seed, 60)
    p, R = measured.p_rig.copy(), measured.R_rig_body.copy()
    p[[7, 30, 31]], R[[7, 30, 31]] = 0.0, np.eye(3)
    found = identify(w.nominal, replace(measured, p_rig=p, R_rig_body=R))
    assert found.left_out.tolist() == [7, 30, 31]


MIRRORS = (np.eye(3)[[1, 0, 2]], np.eye(3)[[0, 2, 1]], np.diag([1.0, 1, -1]), np.diag([-1.0, 1, 1]))


@pytest.mark.parametrize(("name", "mirror"), [*zip(ARMS, MIRRORS, strict=True)])
def test_a_left_handed_frame_is_reported(name, mirror):
    w, measured = made(name, 1)
    text = said(w, points(measured, p=seen_at(measured) @ mirror))
    assert FRAME in proposed(text)
    assert "sign is wrong of joint" not in proposed(text)
    assert "order" not in proposed(text)


@pytest.mark.parametrize("name", ARMS)
def test_the_handedness_is_that_of_the_frame(name):
    w, measured = made(name, 4)
    right = points_off(without_tool(w.nominal), measured.q, measured.p_rig)
    left = points_off(without_tool(w.nominal), measured.q, measured.p_rig @ np.diag([1.0, -1, 1]))
    assert (left.left, left.right) == pytest.approx((right.right, right.left), rel=1e-6)
    assert left.scale == pytest.approx(right.scale, rel=1e-9)


#: Every joint of one arm with axes in a plane, and others of the arms without.
SIGNS = [*(("six_r", joint) for joint in range(1, 6)), ("ur5", 2), ("ur10", 4), ("puma560", 3), ("puma560", 5)]


@pytest.mark.parametrize(("name", "joint"), SIGNS)
def test_one_wrong_sign_is_reported_as_one(name, joint):
    w, measured = made(name, 1)
    text = said(w, points(measured, q=measured.q * np.where(np.arange(1, 7) == joint, -1, 1)))
    assert proposed(text) == f"the data fit this arm if the sign is wrong of joint {joint} "


def test_a_sign_that_hardly_moves_the_tool_is_not_changed_by_chance():
    """A point 1 mm off joint 6's axis of an arm off by some mm: its sign takes up a part of that in one seed of two."""
    for seed in range(4):
        w, measured = made("puma560", seed)
        near_axis = np.linalg.inv(w.T_flange_body) @ np.array([0.001, 0, 0.06, 1])
        p = seen_at(measured, near_axis[:3])
        text = said(w, points(measured, p=p, q=measured.q * [1, 1, -1, 1, 1, 1]))
        assert proposed(text) == "the data fit this arm if the sign is wrong of joint 3 "
        assert "they do not show whether the sign of joint 6 is right" in text


ORDERS = ((1, 0, 2, 3, 4, 5), (0, 2, 1, 3, 4, 5), (0, 1, 2, 4, 3, 5), (5, 4, 3, 2, 1, 0))


@pytest.mark.parametrize(("name", "order"), [*zip(ARMS, ORDERS, strict=True), ("six_r", ORDERS[3]), ("ur5", ORDERS[2])])
def test_an_order_is_reported_with_no_sign(name, order):
    w, measured = made(name, 1)
    text = said(w, points(measured, q=measured.q[:, order]))
    back = ", ".join(f"q{i + 1}" for i in np.argsort(order))
    assert proposed(text) == f"the data fit this arm if the joints' order is {back} "


def test_a_sign_and_a_unit_are_reported_together():
    w, measured = made("ur5", 1)
    text = said(w, points(measured, p=1e3 * seen_at(measured), q=measured.q * [1, 1, -1, 1, 1, 1]))
    assert "the sign is wrong of joint 3 and the points are in mm, not m" in text


@pytest.mark.parametrize(("name", "other"), [("six_r", "ur10"), ("puma560", "ur5"), ("ur5", "puma560")])
def test_nothing_is_proposed_for_another_arm(name, other):
    _, measured = made(name, 1)
    w, _ = made(other, 1)
    assert "not of this arm" in said(w, points(measured))


def test_nothing_is_proposed_where_positions_have_nothing_to_do_with_angles():
    w, measured = made("ur5", 1)
    assert "not of this arm" in said(w, points(measured, p=np.random.default_rng(0).permutation(seen_at(measured))))


def with_angles(path, measured, rotation):
    """Write a file whose angles follow ``rotation``."""
    R = Rotation.from_matrix(measured.R_rig_body)
    if rotation == "rotvec":
        angles = np.degrees(R.as_rotvec())
    else:
        angles = R.as_euler(rotation, degrees=True)
        angles = angles if rotation == "ZYZ" else angles[:, np.argsort([*rotation.lower()])]
    names = [f"q{i}_rad" for i in range(1, 7)] + [f"p1_{a}_mm" for a in "xyz"] + [f"r{a}_deg" for a in "xyz"]
    rows = np.column_stack([measured.q, 1e3 * measured.p_rig[:, 0], angles])
    path.write_text("\n".join([",".join(names), *(",".join(f"{v:.6f}" for v in row) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize("rotation", ["rotvec", "xyz", "ZYZ"])
def test_another_convention_of_angles_is_rejected_and_the_right_one_named(tmp_path, rotation):
    w, measured = made("six_r", 1)
    path = with_angles(tmp_path / "poses.csv", measured, rotation)
    arm, right = without_tool(w.nominal), names_of(rotation)
    for given in set(ROTATIONS) - set(right):
        text = said(w, read_poses(path, rotation=given).measured)
        assert f"meant as {' or '.join(right)}, not as {given} " in text
        assert text.endswith(f"give --columns rotation={right[0]}")
    for given in right:
        check_plausible(arm, read_poses(path, rotation=given).measured)


def test_doosans_angles_read_as_kukas_are_named(tmp_path):
    w, measured = made("six_r", 1)
    path = with_angles(tmp_path / "poses.csv", measured, "ZYZ")
    path.write_text(path.read_text().replace("rx_deg,ry_deg,rz_deg", "rz_deg,ry_deg,rx_deg"))
    assert said(w, read_poses(path, rotation="xyz").measured).endswith("give --columns rotation=ZYZ")


def names_of(rotation):
    """Rotations about fixed axes are those about rotated axes in the other order: two names of one convention."""
    same = {rotation, rotation if rotation == "rotvec" else rotation[::-1].swapcase()}
    return [name for name in ROTATIONS if name in same]


def test_a_sign_that_only_rotations_show_is_reported(tmp_path):
    w, measured = made("ur5", 1)
    flipped = replace(measured, q=measured.q * [1, 1, 1, 1, 1, -1])
    assert "fit this arm if the sign is wrong of joint 6 (" in said(w, flipped)
    path = with_angles(tmp_path / "poses.csv", flipped, "xyz")
    assert "fit this arm if the sign is wrong of joint 6 (" in said(w, read_poses(path, rotation="xyz").measured)


def test_rotations_of_something_else_are_rejected():
    w, measured = made("ur5", 1)
    other = Rotation.random(len(measured), rng=0).as_matrix()
    assert "rotations are not of this arm" in said(w, replace(measured, R_rig_body=other))


@pytest.mark.parametrize(
    ("joint", "read", "expected"),
    [
        (2, lambda q: q[:, 2] + q[:, 1], "joint 3 (.*) is given together with joint 2: subtract q2 from q3"),
        (2, lambda q: q[:, 2] - q[:, 1], "joint 3 (.*) is given together with joint 2: add q2 to q3"),
        (5, lambda q: q[:, 5] + q[:, 4], "joint 6 (.*) is given together with joint 5: subtract q5 from q6"),
        (3, lambda q: np.radians(q[:, 3]), "joint 4 (.*) alone is in radians: convert q4"),
        (1, lambda q: q[:, 1] - np.radians(40), "joint 2 (.*) has another zero than .*: add (39|40)"),
        (
            3,
            lambda q: np.pi / 2 - q[:, 3],
            "joint 4 (.*) counts the other way, and .*the sign of q4, and then add (89|9[01])",
        ),
    ],
)
@pytest.mark.parametrize("name", ["ur5", "six_r"])
def test_one_joint_that_is_read_wrongly_is_named(name, joint, read, expected):
    w, measured = made(name, 31 + joint)
    q = measured.q.copy()
    q[:, joint] = read(q)
    assert re.search(expected, said(w, replace(measured, q=q)))


@pytest.mark.parametrize("seed", range(971, 979))
@pytest.mark.parametrize(("name", "joint"), [("six_r", 4), ("ur5", 3), ("six_r", 2)])
def test_any_zero_of_an_inner_joint_is_named_with_its_size(name, joint, seed):
    w, measured = made(name, seed)
    rng = np.random.default_rng(seed)
    sign, zero_deg, q = rng.choice((1, -1)), rng.choice((1, -1)) * rng.uniform(40, 150), measured.q.copy()
    q[:, joint] = sign * (q[:, joint] - np.radians(zero_deg))
    text = said(w, replace(measured, q=q))
    assert f"joint {joint + 1} (" in text
    assert ("change the sign" in text) == (sign < 0)
    assert float(re.search(r"add (-?[\d.]+) deg", text)[1]) == pytest.approx(zero_deg, abs=2.5)


def test_a_zero_that_can_be_fitted_is_not_rejected():
    w, measured = made("six_r", 904)
    check_plausible(without_tool(w.nominal), replace(measured, q=measured.q - np.radians(10) * np.eye(6)[4]))


@pytest.mark.parametrize("shift", [1, -2])
def test_rows_that_are_shifted_are_reported(shift):
    w, measured = made("ur5", 1)
    text = said(w, points(measured, q=np.roll(measured.q, shift, axis=0)))
    rows = (
        "angles of row 2 belong to the pose of row 1" if shift == 1 else "angles of row 1 belong to the pose of row 3"
    )
    assert f"shifted by {abs(shift)}" in text
    assert rows in text


def test_inverse_poses_are_reported():
    w, measured = made("ur5", 1, n=60)
    poses_seen = np.tile(np.eye(4), (60, 1, 1))
    poses_seen[:, :3, :3], poses_seen[:, :3, 3] = measured.R_rig_body, measured.p_rig[:, 0]
    back = inverse(poses_seen)
    assert "inverse transforms" in said(w, replace(measured, p_rig=back[:, None, :3, 3], R_rig_body=back[:, :3, :3]))


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_joint_that_slipped_between_two_poses_is_found(joint):
    w, measured = made("ur5", 2)
    assert placed_change(without_tool(w.nominal), measured) is None
    q = measured.q.copy()
    q[25:, joint - 1] -= np.radians(1.5)
    text = said(w, replace(measured, q=q))
    assert f"joint {joint} changed by +1." in text
    assert re.search("the first 2[456] poses", text)


def test_a_base_that_was_displaced_between_two_poses_is_found():
    w, measured = made("ur5", 3)
    by = exp_se3(np.array([0.006, -0.004, 0.004, 0.01, 0.005, -0.01]))
    p, R = measured.p_rig.copy(), measured.R_rig_body.copy()
    p[15:], R[15:] = p[15:] @ by[:3, :3].T + by[:3, 3], by[:3, :3] @ R[15:]
    text = said(w, replace(measured, p_rig=p, R_rig_body=R))
    assert "base, or the instrument, was displaced" in text
    assert re.search("the first 1[456] poses", text)


def test_a_coupled_joint_and_an_instrument_of_another_scale_are_named():
    w, rng = worn(71, waves=0, backlash=False, compliance=False), np.random.default_rng(71)
    q, sides = poses(w.nominal, 40, rng)
    seen = w.seen(q, sides, rng)
    read = q.copy()
    read[:, 4] += 0.03 * q[:, 3]
    coupled = replace(seen, q=read, p_rig=1.1 * seen.p_rig)
    lacks = with_change_allowed(identify(w.nominal, coupled), coupled).lacks
    assert len(lacks) == 2
    assert "all lengths come out +1" in lacks[0]
    assert "joint 5 seems to move by -0.0" in lacks[1]
    assert "of the reading of joint 4" in lacks[1]
    assert with_change_allowed(identify(w.nominal, seen), seen).lacks == ()


def test_exact_data_lack_nothing():
    arm, q = open_arm("six_r"), np.random.default_rng(30).uniform(-1.0, 1.0, (30, 6))
    T = replace(arm, offset=arm.offset + 0.01).forward(q)
    measured = Measured(q, T[:, None, :3, 3], T[:, :3, :3])
    assert with_change_allowed(identify(arm, measured), measured).lacks == ()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_coupling_has_the_sign_that_it_has_in_an_arm_file(direction):
    arm, q = open_arm("six_r"), np.random.default_rng(31).uniform(-1.0, 1.0, (30, 6))
    arm, coupling = replace(arm, direction=np.array([1.0, 1.0, 1.0, 1.0, direction, 1.0])), np.eye(6)
    coupling[4, 3] = 0.03
    T = replace(arm, coupling=coupling).forward(q)
    measured = Measured(q, T[:, None, :3, 3], T[:, :3, :3])
    model, x = with_placement(Model.of(arm, measured, backlash=False), measured)
    free = np.array([p.kind in PLACEMENT for p in model.parameters])
    (said,) = lacking(model, x, measured, free, prior_sigma(model, {}), (1e-3, 1e-3))
    assert re.match("joint 5 seems to move by [+]0[.]0[23].* of the reading of joint 4", said)


@pytest.mark.parametrize("seed", [72, 73, 74])
def test_a_wrong_sign_near_the_tool_is_named_though_positions_nearly_fit(seed):
    w, rng = worn(seed), np.random.default_rng(seed)
    seen = w.seen(*poses(w.nominal, 60, rng), rng)
    points = replace(seen, R_rig_body=None, cov=None)
    check_plausible(w.nominal, points)
    with pytest.raises(InputError, match="the sign is wrong of joint 6"):
        check_plausible(w.nominal, replace(points, q=points.q * [1, 1, 1, 1, 1, -1]))
