"""Identification of a worn arm whose truth is known."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worn_arm import distance_m, poses, truth_of, worn

import armsight
from armsight.errors import CalibrationError, InputError
from armsight.estimate.select import Folds
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.identify.backlash import joint_backlashes
from armsight.loop.identify.corrected import Corrected, table_text
from armsight.loop.identify.fit import fit, prior_sigma, with_joint_noise
from armsight.loop.identify.identify import contributions, identify
from armsight.loop.identify.measured import Measured, Read
from armsight.loop.identify.model import FRICTION_M, Model
from armsight.loop.identify.observable import observed
from armsight.loop.identify.placement import with_placement
from armsight.loop.identify.plan import free_of_collision, plan_joints
from armsight.loop.identify.selection import PLACEMENT
from armsight.loop.identify.validate import validate
from armsight.robot.arm_file import open_arm


def points_of(measured, w, body_points):
    """What a tracker sees of points on the body, with 0.05 mm of noise."""
    rng = np.random.default_rng(9)
    T = w.T_rig_body(measured.q, measured.approach)
    p = np.stack([T[:, :3, :3] @ b + T[:, :3, 3] for b in body_points], axis=1)
    return Measured(measured.q, p + rng.normal(0, 5e-5, p.shape), None, None, measured.approach)


@pytest.fixture(scope="module")
def scene():
    w, rng = worn(1), np.random.default_rng(101)
    measured = w.seen(*poses(w.nominal, 60, rng), rng)
    return w, measured, identify(w.nominal, measured), rng


def test_a_worn_arm_is_found_out(scene):
    w, _, found, _ = scene
    rng = np.random.default_rng(3)
    q, approach = poses(w.nominal, 200, rng)
    truth = w.T_rig_body(q, approach)
    before, after = (distance_m(found.model, x, truth, q, approach).mean() for x in (found.nominal, found.solution.x))
    assert after < before / 8  # the metric asked for
    assert after < 0.25e-3
    for i in range(6):
        assert found.value(f"backlash{i + 1}")[0] == pytest.approx(w.backlash[i], abs=np.deg2rad(0.02))


def test_what_few_poses_leave_open_elsewhere_is_in_the_sigma_and_is_said(scene, tmp_path, caplog):
    assert "no better than" not in repr(scene[2])
    squares = []
    for seed in (21, 22, 23):
        w, rng = worn(seed), np.random.default_rng(seed)
        q, sides = w.nominal.home + rng.uniform(-0.2, 0.2, (14, 6)), rng.choice([-1.0, 1.0], (14, 6))
        found = identify(w.nominal, w.seen(q, sides, rng))
        model, q = found.model, rng.uniform(-np.pi, np.pi, (200, 6)).clip(w.nominal.q_min, w.nominal.q_max)
        T = model.T_rig_base(found.solution.x) @ model.tool_in_base(found.solution.x, q, None)
        off = np.linalg.norm((T - w.T_rig_body(q, np.zeros((200, 6))))[:, :3, 3], axis=1)
        squares.append(np.mean(off**2) / found.moved_all_over()[1] ** 2)
    assert 0.25 < np.mean(squares) < 4.0
    weak = replace(found, cov=found.cov * (found.moved_all_over()[0] / found.moved_all_over()[1]) ** 2)
    assert "no better than the nominal arm away from its poses" in repr(weak)
    Corrected.of(weak).save(tmp_path / "corrected.toml")
    open_arm(tmp_path / "corrected.toml")
    assert "corrected.toml: no better than the nominal arm" in caplog.text


@pytest.mark.parametrize(("name", "seed"), [("ur10", 34), ("so101", 35)])
def test_poses_beyond_the_readings_fitted_are_within_their_sigma(name, seed):
    w, rng = worn(seed, open_arm(name)), np.random.default_rng(seed)
    found = identify(w.nominal, w.seen(*poses(w.nominal, 100, rng), rng))
    q = rng.uniform(np.maximum(w.nominal.q_min, -np.pi), np.minimum(w.nominal.q_max, np.pi), (200, w.nominal.joints))
    sides = rng.choice([-1.0, 1.0], q.shape)
    T = w.T_rig_body(q, sides)
    unseen = Measured(q, T[:, None, :3, 3], T[:, :3, :3], None, sides)
    e, C = found.model.residuals(found.solution.x, unseen), found.pose_cov(unseen)
    assert 0.1 < np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e).mean() / 6 < 2.0
    assert np.trace(C[:, :3, :3].mean(axis=0)) < 16 * np.mean((e[:, :3] ** 2).sum(axis=1))


def test_what_is_observable_alone_is_within_its_sigma(scene):
    w, _, found, _ = scene
    seen = {name: true for name, true in truth_of(w).items() if name not in found.reasons and found.value(name)[1] > 0}
    assert len(seen) > 15
    off = np.array([(found.value(name)[0] - true) / found.value(name)[1] for name, true in seen.items()])
    assert np.abs(off).max() < 4  # of 20 numbers: 0.1 % by chance
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_predicted_poses_and_a_tied_sum_are_within_their_sigma(scene):
    """The covariance of poses not fitted is neither the fit's alone, nor one that forgets what is correlated."""
    w, _, found, _ = scene
    q, approach = poses(w.nominal, 100, np.random.default_rng(5))
    T = w.T_rig_body(q, approach)
    unseen = Measured(q, T[:, None, :3, 3], T[:, :3, :3], None, approach)
    e = found.model.residuals(found.solution.x, unseen)
    squares = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.pose_cov(unseen)), e) / 6
    assert 0.4 < squares.mean() < 2.5
    value, sigma = found.value("d2")  # axes 2, 3 and 4 are parallel: it holds the offsets along all of them
    assert abs(value - w.nominal.d[1] - (w.true.d - w.nominal.d)[1:4].sum()) < 3 * sigma
    assert "its value also holds what is off in d3, d4" in str(found)


def test_hayatis_angle_stands_where_axes_are_parallel_and_nowhere_else(scene):
    _, _, found, _ = scene
    assert "not needed" in found.reasons["beta1"]
    assert "not needed" in found.reasons["beta4"]
    assert "not needed" not in found.reasons.get("beta2", "")
    assert "not needed" not in found.reasons.get("beta3", "")
    for name in ("d3", "d4"):  # axes 2, 3 and 4 are parallel: only the sum of their offsets is observable
        assert found.reasons[name] == "kept at its nominal value: no pose can distinguish it from d2"
    assert found.reasons["d2"] == "tied: its value also holds what is off in d3, d4"


def test_the_gauge_is_observable():
    arm, rng = open_arm("puma560"), np.random.default_rng(0)
    q = rng.uniform(-1, 1, (60, 6))
    measured = Measured(q, (arm.forward(q) @ [0.05, 0.03, 0.1, 1.0])[:, None, :3])
    model, x = with_placement(Model.of(arm, measured, backlash=False), measured)
    seen = observed(model, x, measured, prior_sigma(model), (1e-5, 0.0))
    table = [p.name for p, f in zip(model.parameters, seen.free, strict=True) if f and p.kind not in PLACEMENT]
    geometric = [name for name in table if name.rstrip("123456") in ("a", "d", "alpha", "offset", "beta")]
    # A complete model of six revolute joints and one point has 4 x 6 + 6 - 3 numbers, nine of them base and tool.
    assert len(geometric) == 4 * 6 + 6 - 3 - 9
    assert "base_z" in seen.reasons["d1"]
    assert "base_rz" in seen.reasons["offset1"]
    rough = observed(model, x, measured, prior_sigma(model), (0.1, 0.0)).reasons  # people read mm and degrees
    best = float(rough["alpha2"].split(" to ")[1].split(" deg at best")[0])
    assert best > np.degrees(prior_sigma(model)[model.names.index("alpha2")])


def test_the_fit_is_least_squares(scene):
    from scipy.optimize import least_squares

    w, _, _, rng = scene
    measured = replace(w.seen(*poses(w.nominal, 40, rng), rng), cov=None)
    model, x = with_placement(Model.of(w.nominal, measured, backlash=False).with_features(()), measured)
    prior = prior_sigma(model)
    free = np.array([p.kind in PLACEMENT or p.name in ("a2", "a3", "offset2", "alpha3") for p in model.parameters])
    s = fit(model, x, measured, free, prior, used=np.ones(len(measured), bool))
    phi, nominal = model.feature_values(measured.q, None), model.nominal()
    scale = np.repeat([1 / s.noise[0], 1 / s.noise[1]], 3)

    def cost(v):
        y = s.x.copy()
        y[free] = v
        pull = ((y - nominal) / prior)[free & np.isfinite(prior)]
        return np.concatenate([(model.residuals(y, measured, phi) * scale).ravel(), pull])

    best = least_squares(cost, s.x[free], x_scale=np.diag(s.cov)[free] ** 0.5, xtol=1e-12, ftol=1e-12)
    assert np.abs((best.x - s.x[free]) / np.sqrt(np.diag(s.cov)[free])).max() < 0.01
    assert np.mean((cost(s.x[free])[: 6 * len(measured)]) ** 2) == pytest.approx(1 - free.sum() / (6 * 40), rel=0.1)


def test_several_points_do_as_poses_do(scene):
    w, measured, _, _ = scene
    body = np.array([[0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05], [-0.05, 0.02, 0.0]])
    seen = points_of(measured, w, body)
    found = identify(w.nominal, seen)
    assert re.fullmatch(
        rf"Identified\({w.nominal.name}, \d+ of \d+ numbers fitted, \d+ of {len(seen)} poses used; .*\)", repr(found)
    )
    rng = np.random.default_rng(3)
    q, approach = poses(w.nominal, 100, rng)
    v = validate(found, points_of(Measured(q, np.zeros((100, 1, 3)), None, None, approach), w, body))
    assert not v.placement_refitted
    assert v.identified.summary()["mean_m"] < v.nominal.summary()["mean_m"] / 8
    assert 0.7 < v.residual_over_predicted < 1.5


def test_base_and_tool_are_refitted_for_another_set_up(scene):
    w, _, found, rng = scene
    q, approach = poses(w.nominal, 40, rng)
    moved = replace(w, T_rig_base=w.T_rig_base @ inverse(w.T_flange_body))
    v = validate(found, moved.seen(q, approach, rng))
    assert v.placement_refitted
    assert v.identified.summary()["mean_m"] < 0.3e-3


def test_a_perfect_arm_is_left_as_it_is():
    arm, rng = open_arm("six_r"), np.random.default_rng(4)
    none = np.zeros(6)
    w = replace(worn(0), true=arm, backlash=none, compliance=none, gain=none, waves=np.zeros((6, 0, 2)))
    measured = w.seen(*poses(arm, 60, rng), rng)
    found = identify(arm, measured)
    kept = [n for n, f in zip(found.model.names, found.solution.free, strict=True) if f]
    beyond = [n for n in kept if not n.startswith(("base", "tool"))]
    assert len(beyond) <= 12  # what chance selects
    assert sum(contributions(found, measured).values()) < 2e-4
    q, approach = poses(arm, 100, rng)
    assert distance_m(found.model, found.solution.x, w.T_rig_body(q, approach), q, approach).mean() < 1e-4


def test_readings_bring_the_tool_there(scene):
    w, _, found, rng = scene
    corrected = Corrected.of(found)
    q, approach = poses(w.nominal, 5, rng)
    for T, angles, side in zip(corrected.forward(q, approach), q, approach, strict=True):
        back = corrected.readings(T, angles + 0.05, side)
        assert np.abs(log_se3(inverse(T) @ corrected.forward(back[None], side[None])[0])).max() < 1e-8
    assert corrected.readings(np.diag([1, 1, 1, 1.0]) + 5 * np.eye(4, k=3), q[0]) is None


def test_what_is_written_is_read_as_the_same_arm(scene, tmp_path):
    _, _, found, rng = scene
    x, q = found.solution.x.copy(), rng.uniform(-1, 1, (20, 6))
    x[found.model.names.index("beta2")] = 1e-3  # axes a little off parallel
    found = replace(found, solution=replace(found.solution, x=x.copy()))
    (tmp_path / "corrected.toml").write_text(table_text(Corrected.of(found)))
    (tmp_path / "corrected.urdf").write_text(Corrected.of(found).urdf())
    x[found.model.sources_at :] = 0.0
    for name in ("corrected.toml", "corrected.urdf"):
        arm = open_arm(str(tmp_path / name))
        np.testing.assert_allclose(arm.forward(q), found.model.tool_in_base(x, q, None), atol=1e-9)
        assert arm.inverse(arm.forward(arm.home + 0.1), near=arm.home).best is not None


def test_a_sensors_curve_with_fast_swings_is_followed():
    """Ten oscillations a revolution, three over the range measured; less than half of its effect on the tool is left."""
    w, rng = worn(4, backlash=False, compliance=False), np.random.default_rng(8)
    q, approach = poses(w.nominal, 260, rng)

    def off(q):
        return np.deg2rad(0.04) * np.sin(10 * q[:, 1] + 1)[:, None] * np.eye(6)[1]

    measured = replace(w.seen(q[:60] + off(q[:60]), approach[:60], rng), q=q[:60])
    found = identify(w.nominal, measured)
    q, approach = q[60:], approach[60:]
    truth = w.T_rig_body(q + off(q), approach)
    moved = np.linalg.norm((truth - w.T_rig_body(q, approach))[:, :3, 3], axis=1)
    assert distance_m(found.model, found.solution.x, truth, q, approach).mean() < 0.5 * moved.mean()


def test_with_plenty_of_numbers_the_fastest_harmonics_are_left_out():
    arm, rng = open_arm("six_r"), np.random.default_rng(2)
    names = {}
    for n in (10, 60, 400):
        q = rng.uniform(-1, 1, (n, 6))
        T = arm.forward(q)
        names[n] = Model.of(arm, Measured(q, T[:, None, :3, 3], T[:, :3, :3]), backlash=True).names
    assert [("ripple1_sin3" in names[n], "ripple1_sin12" in names[n]) for n in names] == [
        (False, False),
        (True, True),
        (True, False),
    ]


def test_one_pose_that_nothing_explains_does_not_rule_which_sources_are_selected():
    folds = Folds(*(np.zeros(0) for _ in range(3)), np.full(20, 18.0), *(np.zeros(0) for _ in range(2)))
    without, with_it = np.full(20, 4.0), np.ones(20)
    with_it[3] = 100.0  # by the mean of squares it would cost more than it brings
    assert with_it.mean() > without.mean()
    assert folds.improves(without, with_it)
    assert not folds.improves(without, without * (1 + 1e-12))


def lever_of_rods(arm, q, joint):
    """The torque (N,), m per unit of weight, of the links beyond a joint about its axis: straight rods, alike per metre."""
    out = np.empty(len(q))
    for n, angles in enumerate(q):
        T = arm.links(angles)[joint:]
        ends = T[:, :3, 3]
        mass, middles = np.linalg.norm(np.diff(ends, axis=0), axis=1), (ends[1:] + ends[:-1]) / 2
        out[n] = mass @ np.cross(middles - ends[0], [0, 0, -1.0]) @ T[0, :3, 2] / mass.sum()
    return out


def test_near_the_balance_of_gravity_and_friction_the_side_is_uncertain():
    """Against draws: gravity pulls a link to one stop of its backlash, friction drags it along, how much is uncertain."""
    w, rng, joint, half, draws = worn(1), np.random.default_rng(6), 4, 2e-3, 4000
    q, approach = poses(w.nominal, 300, rng)
    uncertain = rng.logistic(0, FRICTION_M / 4, (draws, len(q)))
    pull = lever_of_rods(w.nominal, q, joint) - FRICTION_M * approach[:, joint]
    stood = half * np.sign(pull + uncertain)
    m = Measured(q, np.zeros((len(q), 1, 3)), np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 6, 6)), approach)
    model = Model.of(w.nominal, m, backlash=True)
    x = model.nominal()
    T = model.tool_in_base(x, q, approach)
    x[model.names.index("gravity_backlash5")] = 2 * half
    axes = np.array([w.nominal.links(angles)[joint, :3, 2] for angles in q])
    rotated = Rotation.from_matrix(model.tool_in_base(x, q, approach)[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2))
    np.testing.assert_allclose(
        np.einsum("ni,ni->n", rotated.as_rotvec(), axes), stood.mean(axis=0), atol=5 * half / np.sqrt(draws)
    )
    _, J = model.linearised(x, m, model.feature_values(q, approach))
    b = J[:, :, model.names.index("offset5")]
    along = np.einsum("ni,nij,nj->n", b, with_joint_noise(model, x, m, np.zeros(6)).cov, b) / np.sum(b**2, axis=1) ** 2
    np.testing.assert_allclose(along, stood.var(axis=0), atol=10 * half**2 / np.sqrt(draws))
    assert (along > 0.5 * half**2).any()
    assert np.median(along) < 1e-6 * half**2


def test_the_backlash_of_each_joint_is_reported_or_why_it_is_not(scene):
    w, measured, found, _ = scene
    for backlash in joint_backlashes(found, measured):  # here friction holds every joint on the side it came from
        assert backlash.value_rad == pytest.approx(w.backlash[backlash.joint], abs=np.deg2rad(0.02))
        assert abs(backlash.value_rad - w.backlash[backlash.joint]) < 4 * backlash.sigma_rad


def test_a_joint_that_lies_anywhere_in_its_backlash_spoils_only_its_own_direction():
    w, rng = worn(2), np.random.default_rng(7)
    q, approach = poses(w.nominal, 60, rng)
    w = replace(w, backlash=w.backlash * [0, 1, 1, 1, 1, 1])
    half = np.deg2rad(0.1)
    stood = np.clip(rng.uniform(-1.5, 1.5, 60), -1, 1) * half  # at a stop or between
    seen = w.seen(q + stood[:, None] * np.eye(6)[0], approach, rng)
    measured = replace(seen, q=q)
    found = identify(w.nominal, measured)
    assert found.joint_sigma_rad[0] == pytest.approx(stood.std(), rel=0.3)  # of 60 samples: 10 %
    assert found.joint_sigma_rad[1:].max() < 0.3 * stood.std()
    backlash = joint_backlashes(found, measured)[0]
    assert abs(backlash.value_rad - 2 * half) < 4 * backlash.sigma_rad < np.deg2rad(0.2)
    assert "how far apart" in backlash.how
    q, approach = poses(w.nominal, 200, rng)
    assert distance_m(found.model, found.solution.x, w.T_rig_body(q, approach), q, approach).mean() < 0.2e-3


def test_planned_poses_inform_more_than_random_ones(scene):
    w, measured, _, _ = scene
    few = measured.rows(np.arange(15))
    plan = plan_joints(w.nominal, few, None, 12, 0)
    assert (np.diff(plan.sigma_m) < 0).all()
    assert plan.sigma_m[12] < plan.random_sigma_m[12]
    assert plan.random_for(12) >= 15
    assert w.nominal.within_limits(plan.q).all()
    assert free_of_collision(Model.of(w.nominal, few, backlash=True), plan.q).all()


def test_poses_all_alike_are_rejected(scene):
    w, _, _, rng = scene
    q = np.repeat(w.nominal.home[None], 30, axis=0)
    with pytest.raises(CalibrationError, match="too alike"):
        identify(w.nominal, w.seen(q, np.ones((30, 6)), rng))


def test_too_few_poses_are_rejected_and_few_are_enough_for_little(scene):
    w, measured, _, _ = scene
    with pytest.raises(InputError, match="fewer than 6"):
        identify(w.nominal, measured.rows(np.arange(3)))
    found = identify(w.nominal, measured.rows(np.arange(10)))
    frozen = [name for name, free in zip(found.model.names, found.solution.free, strict=True) if not free]
    assert frozen
    assert all(name in found.reasons for name in frozen)
    q, approach = poses(w.nominal, 100, np.random.default_rng(5))
    truth = w.T_rig_body(q, approach)
    before, after = (distance_m(found.model, x, truth, q, approach).mean() for x in (found.nominal, found.solution.x))
    assert after < before  # what is free beyond 60 numbers does no harm: its prior holds it


def test_where_no_pose_can_be_left_out_the_fit_stands_and_says_so(scene, monkeypatch):
    monkeypatch.setattr("armsight.loop.identify.validate.MANY", 0)  # one part is enough
    w, measured, _, _ = scene
    few = measured.rows(np.arange(7))
    found = armsight.identify(w.nominal, few)
    assert found.held_out is None
    np.testing.assert_array_equal(found.cov, identify(w.nominal, few).cov)
    assert "no pose was left out, and the sigmas are the fit's own, not scaled: 5 poses are fewer than 6" in repr(found)
    more = armsight.identify(w.nominal, measured.rows(np.arange(12)))
    assert more.held_out is not None
    assert more.notes == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: replace(m, p_rig=m.p_rig / 1e3), "are they in m, not mm"),
        (lambda m: replace(m, p_rig=m.p_rig * 1e3), "are they in mm, not m"),
        (lambda m: replace(m, q=np.degrees(m.q) / 10), "not of this arm|fit"),
        (lambda m: replace(m, q=np.radians(m.q)), "radians; name the columns q1_rad"),
        (lambda m: replace(m, q=m.q * [1, 1, -1, 1, -1, 1]), "sign is wrong of joint 3, 5"),
    ],
)
def test_wrong_units_order_and_signs_are_reported(scene, change, said):
    w, measured, _, _ = scene
    with pytest.raises(InputError, match=said):
        identify(w.nominal, change(replace(measured, cov=None)))


def test_another_arm_is_reported(scene):
    _, measured, _, _ = scene
    with pytest.raises(InputError, match="not of this arm"):
        identify(open_arm("ur10"), measured)


def test_wrong_arguments_are_named_and_what_was_read_is_taken(scene):
    w, measured, found, _ = scene
    for call, words in (
        (lambda: armsight.identify("ur10", measured), r'arm is a str; expected open_arm\("ur10"\)'),
        (lambda: armsight.identify(w.nominal, "poses.csv"), r'measured is a str; expected read_poses\("poses.csv"\)'),
        (lambda: armsight.identify(w.nominal, measured, other=1), "other is a int"),
        (lambda: validate(w.nominal, measured), "found is a Arm"),
    ):
        with pytest.raises(InputError, match=words):
            call()
    read = Read(measured, np.arange(len(measured)), ())
    assert repr(read) == f"Read({len(measured)} full poses of 6 joints; notes=())"
    assert repr(validate(found, read)) == repr(validate(found, measured))
    assert repr(validate(found, read)).startswith(f"Validation({len(measured)} poses: 0.")


def test_a_prior_of_zero_keeps_a_parameter_and_an_unknown_name_is_rejected(scene):
    w, measured, _, _ = scene
    found = identify(w.nominal, measured, priors={"a2": 0.0, "wave": 0.0})
    assert found.value("a2") == (w.nominal.a[1], pytest.approx(np.nan, nan_ok=True))
    table = found.columns()
    assert np.isnan(table["sigma"]).tolist() == (~found.solution.free).tolist()
    drawn = {ax.get_ylabel(): ax.lines[0] for ax in found.plot().axes}
    rows = [k for k in np.flatnonzero(found.solution.free) if found.model.parameters[k].unit == "m"]
    rows = [k for k in rows if found.model.parameters[k].kind not in ("base", "tool")]
    off = 1e3 * (table["value"] - table["nominal"])[rows]
    np.testing.assert_allclose(drawn["off nominal, mm"].get_ydata(), off, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="has no parameter alpha9; it has "):
        found.value("alpha9")
    assert "prior of zero" in found.reasons["wave1_sin1"]
    with pytest.raises(InputError, match="'a9'"):
        identify(w.nominal, measured, priors={"a9": 1.0})


@pytest.mark.parametrize(("n", "seed"), [(30, 1), (60, 1)])
def test_poses_without_noise_give_the_zeros_and_little_else(n, seed):
    arm, rng = open_arm("six_r"), np.random.default_rng(seed)
    q = rng.uniform(-1, 1, (n, 6))
    T = arm.forward(q + 1e-3 * np.array([0, 1, -1, 0, 1, 0]))
    found = identify(arm, Measured(q, T[:, None, :3, 3], T[:, :3, :3]))
    assert found.solution.free.sum() < 30
    off = [found.value(f"offset{k}")[0] - arm.offset[k - 1] for k in (2, 3, 5)]
    np.testing.assert_allclose(off, [1e-3, -1e-3, 1e-3], rtol=0, atol=1e-9)


def test_rotations_of_base_and_body_are_those_of_their_transforms(scene):
    """Values are whole rotation vectors, and their sigmas those of random draws of the small rotations."""
    _, _, found, rng = scene
    x, model = found.solution.x, found.model
    draws = rng.multivariate_normal(x, found.cov, 4000)
    for names, T_of in (
        ("base", model.T_rig_base),
        (model.names[model.table_at - 1].removesuffix("_rz"), model.T_6_body),
    ):
        vectors = Rotation.from_matrix([T_of(each)[:3, :3] for each in draws]).as_rotvec()
        values, sigmas = np.array([found.value(f"{names}_r{axis}") for axis in "xyz"]).T
        np.testing.assert_allclose(values, Rotation.from_matrix(T_of(x)[:3, :3]).as_rotvec(), atol=1e-12)
        free = np.isfinite(sigmas)
        assert free.any()
        np.testing.assert_allclose(vectors.std(axis=0)[free], sigmas[free], rtol=0.1)
