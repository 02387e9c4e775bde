"""A plan of a rig: what it says, the noise of its markers, its budget, and what cannot be built."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import armsight
from armsight.errors import InputError
from armsight.sim.budget import result
from armsight.sim.budget.chart import marker_noise
from armsight.sim.budget.plan import RigPlan, catalogue, planned
from armsight.sim.camera.stages import CameraPipeline
from armsight.vision.rig import Shutters, StereoRig

#: Of two cameras that lose shots in motion.
_LATE = {"skew_ms": 10.0, "start_ms": 5.0, "exposure_ms": 1.0}


def test_a_file_says_the_same_as_options(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text('volume = "100x100x100mm"\ndistance = "70cm"\ncamera = "global-shutter-1mp"\npairs = 12\n')
    by_file, by_option = (
        RigPlan.read(str(path)),
        RigPlan(volume="0.1x0.1x0.1m", distance="0.7m", camera="global-shutter-1mp", pairs=12),
    )
    np.testing.assert_allclose(planned(by_file).cov(), planned(by_option).cov())
    path.write_text("pair = 12\n")
    with pytest.raises(InputError, match="did you mean pairs"):
        RigPlan.read(str(path))


@pytest.mark.parametrize("key", ["rig", "body", "preset"])
def test_a_file_whose_paths_are_no_texts(tmp_path, key):
    (path := tmp_path / "plan.toml").write_text(f"{key} = 0.5\n")
    with pytest.raises(InputError, match=rf"plan.toml: {key} must be a text, got 0\.5"):
        RigPlan.read(str(path))


def test_any_path_is_a_text():
    class Own:
        def __fspath__(self):
            return "rig.json"

    assert RigPlan.read("", rig=Own()).rig == RigPlan.read("", rig=Path("rig.json")).rig == "rig.json"


@pytest.mark.parametrize("want", ["600 \u00b5m, 0.2\N{DEGREE SIGN}", "600\u03bcm,12 arcmin", "0.6mm,0.003490658504rad"])
def test_units_of_what_is_requested(want):
    np.testing.assert_allclose(RigPlan(want=want).requested, [6e-4, np.radians(0.2)], rtol=1e-9)


def test_amounts_in_any_order_and_with_blanks():
    plan = RigPlan(volume="400 mm x 0.4 X 0.3 m", want="0.2 deg, 600um", speed="20deg/s,0.3m/s")
    np.testing.assert_allclose(plan.size_m, (0.4, 0.4, 0.3))
    assert plan.requested == pytest.approx((6e-4, np.radians(0.2)))
    assert plan.speeds == pytest.approx((0.3, np.radians(20.0)))


def test_a_temporal_filter_helps_at_rest_alone():
    still, slow = (RigPlan(camera="webcam-720p-evening", speed=speed)._noise_px() for speed in ("0m/s", "0.001m/s"))
    assert slow["pixel noise"] == still["pixel noise"]
    assert still["exposure blur"] == 0.0 < slow["exposure blur"]


def test_noise_is_what_the_detector_shows():
    # White noise alone: the fit's sigma falls as the rim grows, with the root of the diameter.
    clean = CameraPipeline.load("clean")
    small, large = marker_noise(clean, "disc", 16.0), marker_noise(clean, "disc", 36.0)
    assert small / large == pytest.approx(1.5, rel=0.25)
    assert large < marker_noise(clean, "disc", 25.0) < small  # between two charts
    assert marker_noise(clean, "disc", 200.0) == marker_noise(clean, "disc", 64.0) < large
    assert marker_noise(CameraPipeline.load("cheap-webcam"), "disc", 16.0) > 5 * marker_noise(clean, "disc", 16.0)


def test_between_a_chart_that_is_found_and_one_that_is_not_it_is_that_of_the_size_itself():
    webcam = CameraPipeline.load("cheap-webcam")
    assert marker_noise(webcam, "tag", 28.0) == pytest.approx(marker_noise(webcam, "tag", 32.0), rel=0.3)
    assert marker_noise(webcam, "disc", 24.0, 16.0) < 2 * marker_noise(
        webcam, "disc", 24.0
    )  # one of 32 px is not found
    with pytest.raises(InputError, match=r"a disc of 24\.0 px, blurred over 30\.0 px: \d+ of \d+ are found"):
        marker_noise(webcam, "disc", 24.0, 30.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"volume": "400x400x300m"}, "is it in mm"),
        ({"volume": "0.4x0.4"}, "width x height x depth"),
        ({"volume": "0.4x0.4x0.3"}, "^volume '0.4x0.4x0.3': side '0.4': expected a length with its unit"),
        ({"volume": "0.2x0.2x0.8m", "distance": "0.3m"}, "behind the cameras; a distance above 0.4 m"),
        ({"volume": "0x0x0m"}, "each side must be above zero"),
        ({"volume": "0.1x0.1x0.1m", "baseline": "1mm"}, "two cameras cannot stand 1 mm apart"),
        ({"distance": "800"}, "with its unit"),
        ({"body": "chessboard:9x6:5mm"}, "^a square is "),
        ({"speed": "300m/s"}, "is it in mm/s"),
        ({"want": "0.1"}, "expected 0.1mm or 0.1mm,0.05deg"),
        ({"want": "0.1mm,0.2mm"}, "expected 0.1mm or 0.1mm,0.05deg"),
        ({"want": "12arcmin"}, "expected 0.1mm or 0.1mm,0.05deg; an angle alone"),
        ({"want": "0,6mm"}, "expected 0.1mm or 0.1mm,0.05deg; decimals have a point"),
        ({"want": "0mm"}, "no rig measures without error"),
        ({"want": "1mm,0deg"}, "no rig measures without error"),
        ({"speed": "nanm/s"}, "speed 'nanm/s': expected 0.3m/s"),
        ({"volume": "0.1x0.1x0.1m", "handeye": "1"}, "expected 0.1mm,0.02deg"),
        ({"volume": "0.1x0.1x0.1m", "board_bent": "1m"}, "no print is off by more than 10 mm"),
        ({"volume": "0.1x0.1x0.1m", "body": "other.toml", "body_scale": 2.0}, "of the default body"),
        ({"camera": "webcam-720"}, "did you mean webcam-720p"),
        (
            {"volume": "0.01x0.01x0.01m", "distance": "0.2m"},
            "does not focus nearer than 0.3 m.*a distance of 0.31 m can be had",
        ),
        ({"volume": "1x1x0.1m"}, "the field of view is"),
        ({"distance": "0.6m"}, "volume and body are .* or a volume 0.26 m high"),
        ({"volume": "0.1x0.1x0.1m", "verging_deg": 90.0}, "look past each other"),
        ({"volume": "0.1x0.1x0.1m", "baseline": "3m"}, "the arm would cross it; at most 1.6 m"),
        ({"volume": "0.1x0.1x0.1m", "distance": "3m"}, "at least 8 are needed"),
        ({"exposure_ms": 50.0}, "longer than a frame at 30 Hz"),
        ({"camera": "machine-vision-5mp", "rate_hz": 60.0}, "one USB controller carries .* at 34.7 Hz at most"),
        ({"objective": "median"}, "objective 'median': expected worst or mean"),
        ({"distances": "1m"}, "distances '1m': expected the least and the largest, such as 0.5m,1.2m"),
        ({"distances": "2m,1m"}, "expected the least and the largest"),
        (
            {"distances": "1m,2m", "named": ("distance", "distances")},
            "^distance 0.8m: the distances that may be are 1 to 2 m",
        ),
        ({"volume": "0.1x0.1x0.1m", "pairs": 2}, "pairs is 2: expected 3 to 1000"),
    ],
)
def test_what_cannot_be_built_is_rejected_with_the_nearest(given, message):
    with pytest.raises(InputError, match=message) as said:
        RigPlan(**given).check()
    assert "\n" not in str(said.value)


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_class_can_be_built(name):
    RigPlan(volume="0.05x0.05x0.05m", distance="0.8m", camera=name).check()


def test_python_takes_the_keys_of_a_plan_file():
    found = armsight.budget(volume="0.1x0.1x0.1m", distance="0.7m", camera="machine-vision-2mp", speed="0.2m/s")
    assert found.mm > found.at_rest.mm > 0
    assert found.deg > 0
    assert repr(found).startswith(f"RigBudget({found.mm:.2g} mm, ")
    assert found.to_dict()["results"]["moving"]["level_m"] == pytest.approx(1e-3 * found.mm)
    assert [cause.share for cause in found.causes] == sorted((cause.share for cause in found.causes), reverse=True)
    for change in found.changes:
        assert change.level_m < found.moving.level_m
    with pytest.raises(InputError, match="did you mean speed"):
        armsight.budget(sped="0.2m/s")
    with pytest.raises(InputError, match="pairs must be a whole number, got '20'"):
        armsight.budget(pairs="20")
    with pytest.raises(InputError, match=r"pairs must be a whole number, got 20\.5"):
        armsight.budget(pairs=20.5)


def test_python_takes_paths_whole_floats_and_numbers_of_numpy():
    given = {"rig": Path("a/rig.json"), "pairs": 20.0, "rate_hz": np.int64(30), "skew_ms": np.float32(2)}
    found = RigPlan.read("", **given)
    assert (found.rig, found.pairs, found.rate_hz, found.skew_ms) == (str(Path("a/rig.json")), 20, 30, 2.0)
    assert isinstance(found.pairs, int)
    assert RigPlan.read("", pairs=np.int32(12)).pairs == 12


def test_the_best_is_at_a_minimum_and_alternatives_are_grouped(monkeypatch):
    two = ("global-shutter-1mp", "machine-vision-2mp")
    monkeypatch.setattr(result, "catalogue", lambda: {name: catalogue()[name] for name in two})
    found = result.best(RigPlan.read("", volume="0.1x0.1x0.1m", distances="0.5m,0.6m", speed="0m/s", body_scale=1.0))
    assert [one.plan.camera for one in found] == list(two)
    near = max(one.mm for one in found) < result.PREDICTED * min(one.mm for one in found)
    assert (found[0].group == found[1].group) == near
    best = found[0]
    assert 0.5 <= best.plan.distance_m <= 0.6
    twice = replace(best.plan, pairs=4 * RigPlan.pairs)
    assert best.plan.pairs < twice.pairs  # as few as differ by less than predictions are off
    assert result.loss(best.plan) < result.PREDICTED * result.loss(twice)
    for factor in (0.8, 1.25):  # beside the minimum of a search that ends where a step gains less than 1 %
        other = replace(best.plan, baseline=f"{factor * best.plan.baseline_m}m")
        assert result.RigBudget(other, planned(other)).mm > 0.98 * best.mm
    with pytest.raises(InputError, match="is it in mm"):
        result.best(RigPlan.read("", volume="400x400x300m"))


def test_a_rig_that_there_is_has_its_own_calibration(tmp_path):
    plan = RigPlan(volume="0.1x0.1x0.1m", speed="0m/s")
    cov = plan.conditions.cov_calibration
    StereoRig(*plan.stereo_rig.cameras, plan.stereo_rig.T_left_right, 4 * cov, 0.0).save(tmp_path / "rig.json")
    (tmp_path / "plan.toml").write_text('volume = "0.1x0.1x0.1m"\nspeed = "0m/s"\nrig = "rig.json"\n')
    twice, once = armsight.budget(str(tmp_path / "plan.toml")), planned(plan)
    ratio = twice.found.rms(twice.found.cov(of="calibration"))[0] / once.rms(once.cov(of="calibration"))[0]
    assert ratio == pytest.approx(2.0, rel=1e-6)
    np.testing.assert_allclose(twice.found.cov(of="pixel noise"), once.cov(of="pixel noise"), rtol=1e-6)


def test_what_a_rig_says_itself_cannot_be_given_beside_it(tmp_path):
    plan = RigPlan(volume="0.1x0.1x0.1m")
    plan.stereo_rig.save(path := tmp_path / "rig.json")
    given = {"volume": "0.1x0.1x0.1m", "rig": path}
    values = {"baseline": "500mm", "verging_deg": 5.0, "focal_widths": 1.0, "board": "chessboard:8x5:20mm"}
    for key, value in (values | {"pairs": 9, "board_bent": "1mm"}).items():
        with pytest.raises(InputError, match=rf"rig.json has its own {key}"):
            RigPlan.read("", **given, **{key: value}).check()
    late = RigPlan.read("", **given, skew_ms=4.0, start_ms=1.0)
    late.check()
    assert late.timing["skew"] == pytest.approx(0.004)
    replace(plan.stereo_rig, shutters=Shutters(0.004, 0.0, np.zeros((2, 2)))).save(path)
    for key in ("skew_ms", "start_ms"):
        with pytest.raises(InputError, match=rf"rig.json has its own {key}"):
            RigPlan.read("", **given, **{key: 1.0}).check()


def test_other_cameras_keep_what_is_named(monkeypatch):
    named = {"skew_ms": 100.0, "start_ms": 0.0, "exposure_ms": 1.0}
    plan = RigPlan.read("", volume="0.1x0.1x0.1m", camera="webcam-720p", **named)
    two = ("webcam-720p", "global-shutter-1mp")
    monkeypatch.setattr(result, "catalogue", lambda: {name: catalogue()[name] for name in two})
    monkeypatch.setattr(result, "CHANGES", {})
    assert not result.RigBudget(plan, planned(plan)).changes  # the skew that is named costs most, and stays


def test_a_body_of_tags_or_a_board_has_a_budget(tmp_path):
    given = {"volume": "0.05x0.05x0.05m", "distance": "0.6m", "camera": "global-shutter-1mp", "speed": "0m/s"}
    board = RigPlan(**given, body="chessboard:9x6:10mm")
    assert board.marker(0.6) == ("square", pytest.approx(0.01 * board.focal_px / 0.6))
    tags = "".join(
        f'[[markers]]\nname = "t{k}"\nposition_mm = [{x}, 0, 0]\neuler_zyx_deg = [0, 0, 0]\n'
        f'tag = {{ family = "tag36h11", id = {k}, size_mm = 30 }}\n'
        for k, x in enumerate((-40, 40))
    )
    (tmp_path / "tags.toml").write_text(f'version = 2\nname = "tags"\n{tags}')
    two = RigPlan(**given, body=str(tmp_path / "tags.toml"))
    assert two.marker(0.6)[0] == "tag"
    assert two.marker_of.tolist() == [0] * 4 + [1] * 4
    for plan in (board, two):
        assert 0 < planned(plan).rms(planned(plan).cov())[0] < 1e-3
    with pytest.raises(InputError, match="boards of discs none"):
        planned(RigPlan(**given, body="circles:7x6:10mm:radius=3mm"))


def test_a_camera_of_its_own_has_its_preset_aperture_and_readout(tmp_path):
    (tmp_path / "mine.toml").write_text('preset = "webcam-good-light"\n[timing]\nreadout_ms = 9.0\n')
    (tmp_path / "plan.toml").write_text('preset = "mine.toml"\nf_number = 8.0\n')  # beside the plan
    own, usual = RigPlan.read(str(tmp_path / "plan.toml")), RigPlan()
    assert own.timing["readout"] == pytest.approx(0.009)
    assert RigPlan(readout_ms=5.0).timing["readout"] == pytest.approx(0.005)
    assert own.defocus_px(0.5) == pytest.approx(usual.defocus_px(0.5) / 4)  # f/2
    with pytest.raises(InputError, match="camera 'raw' is unknown; known are clean"):
        RigPlan(preset="raw").check()
    with pytest.raises(InputError, match=r"f_number is 0\.1: expected 0\.5 to 64"):
        RigPlan(f_number=0.1).check()


def test_an_autofocus_costs_what_its_class_says_until_it_is_switched_off(monkeypatch):
    plan = RigPlan(volume="0.2x0.2x0.2m", camera="webcam-1080p-autofocus", speed="0m/s")
    found = planned(plan)
    costs, warming = (found.rms(found.cov(of=cause))[0] for cause in ("autofocus", "warming of the lenses"))
    assert costs / warming == pytest.approx(plan.cameras.refocus_ppm / (plan.lens_ppm_per_k * plan.warming_k))
    off = "switch the autofocus off"
    monkeypatch.setattr(result, "CHANGES", {off: result.CHANGES[off]})
    monkeypatch.setattr(result, "catalogue", dict)
    (change,) = result.RigBudget(plan, found).changes
    fixed = planned(replace(plan, refocus_ppm=0.0))
    assert "autofocus" not in fixed.factors
    assert change.level_m == pytest.approx(result.RigBudget(plan, fixed).moving.level_m)


def test_the_objective_is_the_worst_or_the_mean_position():
    given = {"volume": "0.2x0.2x0.2m", "speed": "0.2m/s", "distance": "0.6m"} | _LATE
    worst, mean = (armsight.budget(**given, objective=each) for each in ("worst", "mean"))
    every = mean.found.at_level(mean.found.cov())[0]
    assert (worst.mm, mean.mm) == pytest.approx((1e3 * every.max(), 1e3 * every.mean()))
    assert "95 % at the mean position" in repr(mean)
    # Lost shots count where most are, whichever it is.
    assert worst.moving.lost_share == mean.moving.lost_share == mean.found.lost.max() > mean.found.lost.mean()


@pytest.mark.parametrize(
    "given",
    [
        {"camera": "machine-vision-2mp"},
        {"camera": "webcam-720p-cheap", "distance": "0.6m", "speed": "0m/s"},
        {"camera": "webcam-720p", "speed": "0.5m/s", **_LATE},
        {"camera": "webcam-720p", "speed": "1m/s", "objective": "mean"} | _LATE,
        # Few are lost, the fastest: what is left moves less than all.
        {"camera": "webcam-720p", "speed": "0.2m/s", "distance": "0.6m"}
        | _LATE
        | {"start_ms": 1.0, "exposure_ms": 0.5},
    ],
)
def test_what_takes_long_is_left_out_of_a_bound_below_the_loss(given):
    plan = RigPlan.read("", volume="0.2x0.2x0.2m", **given)
    assert 0 < result.loss(plan, known=True) <= result.loss(plan)
    assert not result.below(plan, result.loss(plan))
    assert result.below(plan, 1.01 * result.loss(plan))


def test_the_lens_of_a_webcam_is_not_exchanged_for_a_better_rig():
    with pytest.raises(InputError, match=r"the field of view is .* a distance of 1 m"):
        result.best(RigPlan.read("", camera="webcam-1080p-autofocus", distance="0.8m"))


def test_a_small_aperture_is_dark_and_soft():
    plan = RigPlan(camera="machine-vision-2mp", f_number=16.0)
    usual, dark = RigPlan(camera="machine-vision-2mp").pipeline, plan.pipeline
    assert dark.sensor.white_e == pytest.approx(usual.sensor.white_e / 16)
    airy_px = 1.029 / 2.355 * 550e-6 * 16.0 * plan.focal_px / plan.focal_mm  # as wide at half its height
    assert np.hypot(usual.psf_sigma_px, airy_px) == pytest.approx(dark.psf_sigma_px, rel=0.1)


def test_a_board_of_metres_is_named():
    with pytest.raises(InputError, match=r"chessboard:9x6:2m fills the images at \d+ m: .* is the unit right"):
        planned(RigPlan(board="chessboard:9x6:2m"))


def test_a_distance_that_is_left_out_is_one_that_may_be():
    assert [RigPlan.read("", distances=each).distance for each in ("1m,2m", "0.3m,50cm", "0.5m,1m")] == [
        "1m",
        "0.5m",
        "0.8m",
    ]


@pytest.mark.parametrize(("most_mm", "speed", "late"), [(0.6, "0.3m/s", {}), (2.0, "0.4m/s,9deg/s", _LATE)])
def test_what_is_not_reached_in_motion_is_reached_when_slower(most_mm, speed, late):
    given = {"volume": "0.1x0.1x0.1m", "distance": "0.7m", "want": f"{most_mm}mm"} | late
    found = armsight.budget(**given, speed=speed)
    assert (found.moving.lost_share > 0.2) == bool(late)  # those that are lost move most
    slower = armsight.budget(**given, speed=f"{found.slower_m_s}m/s")
    assert 0.9 * most_mm < slower.mm <= most_mm
    assert slower.slower_m_s == armsight.budget(**given, speed="0m/s").slower_m_s == 0.0


def test_the_image_has_the_size_that_is_given():
    small = RigPlan(volume="0.05x0.05x0.05m", image="640x480", distance="0.5m")
    assert small.stereo_rig.left.image_size_px == (640, 480)
    with pytest.raises(InputError, match="expected width x height in pixels"):
        RigPlan(volume="0.05x0.05x0.05m", image="640").check()


@pytest.mark.parametrize("board", ["chessboard:60x40:2mm", "charuco:40x40:3mm:2mm:DICT_5X5_1000"])
def test_squares_of_a_board_that_are_too_small_are_squares(board):
    with pytest.raises(InputError, match=rf"^a square of {board} is \d\.\d px, at least 8 are needed"):
        planned(RigPlan(volume="0.1x0.1x0.1m", distance="0.7m", camera="webcam-720p", board=board))


def test_a_smaller_aperture_costs_light():
    def noise_px(**plan):
        return RigPlan.read("", volume="0.2x0.2x0.1m", distance="0.8m", **plan)._noise_px()["pixel noise"]

    assert noise_px(f_number=2.0) == noise_px()  # the class's
    assert noise_px(f_number=8.0) > 1.5 * noise_px()
