"""The rig and its file: exact round trips, every damage reported, and no file lost to a full disk."""

import contextlib
import functools
import json
import os
import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armsight.errors import InputError
from armsight.geometry.pose import log_se3
from armsight.vision.rig import VERSION, CameraNoise, Shutters, StereoRig
from asserts import assert_jacobian, one_line
from strategies import CAMERAS, ordinary_rig


def saved(tmp_path, **changes):
    """A rig file with some entries changed; a value of ... removes one."""
    path = tmp_path / "rig.json"
    ordinary_rig().save(path)
    document = json.loads(path.read_text())
    for key, value in changes.items():
        *way, last = key.split("__")
        entry = document
        for name in way:
            entry = entry[name]
        if value is ...:
            del entry[last]
        else:
            entry[last] = value
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize("model", list(CAMERAS))
def test_round_trip_is_exact(tmp_path, model):
    rig, path = ordinary_rig(model), tmp_path / "rig.json"
    rig.save(path)
    back = StereoRig.load(path)
    for mine, other in zip(rig.cameras, back.cameras, strict=True):
        assert (mine.image_size_px, mine.model) == (other.image_size_px, other.model)
        np.testing.assert_array_equal(mine.parameters, other.parameters)
    np.testing.assert_array_equal(rig.T_left_right, back.T_left_right)
    np.testing.assert_array_equal(rig.cov, back.cov)
    assert (rig.sigma_px, dict(rig.provenance)) == (back.sigma_px, dict(back.provenance))
    before = path.read_bytes()
    back.save(path)
    assert path.read_bytes() == before


def test_properties_of_the_geometry():
    rig = ordinary_rig()
    x, y, z = rig.T_left_right[:3, 3]
    assert rig.baseline_m == pytest.approx((x * x + y * y + z * z) ** 0.5, rel=1e-15)
    assert rig.convergence_deg == pytest.approx(np.degrees(np.arccos(rig.T_left_right[2, 2])))


@pytest.mark.parametrize("model", list(CAMERAS))
def test_every_parameter_has_a_name(model):
    rig = ordinary_rig(model)
    names = rig.parameter_names
    assert len(names) == len(set(names)) == rig.parameter_count == len(rig.cov)
    assert names[0] == "left.fx_px"
    assert names[-6:] == tuple(f"T_left_right.{n}" for n in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"))


def test_perturbed_moves_along_the_parameter_vector():
    rig = ordinary_rig()
    n = rig.parameter_count

    def vector(delta):
        moved = rig.perturbed(delta)
        tangent = log_se3(np.linalg.inv(rig.T_left_right) @ moved.T_left_right)
        return np.concatenate([moved.left.parameters, moved.right.parameters, tangent])

    assert_jacobian(np.eye(n), vector, np.zeros(n), 1e-3, rtol=1e-6)


def test_points_are_triangulated_where_both_cameras_see_them():
    rig, p = ordinary_rig(), np.array([[0.02, -0.03, 0.8], [-0.05, 0.04, 1.1]])
    np.testing.assert_allclose(rig.triangulate(*rig.project(p)), p, atol=1e-9)
    for wrong in (([521, 281], [459, 291]), (np.zeros((2, 2)), np.zeros((3, 2)))):
        with pytest.raises(InputError, match=r"\(N, 2\) pixels each are needed"):
            rig.triangulate(*wrong)


def test_a_newer_version_asks_for_an_update(tmp_path):
    path = saved(tmp_path, version=VERSION + 1)
    with pytest.raises(InputError, match=rf"rig\.json: .*version {VERSION + 1}.*update armsight"):
        StereoRig.load(path)


KEYS = ("left", "right", "T_left_right_m", "covariance", "sigma_px")
CAMERA_KEYS = ("image_size_px", "distortion_model", "intrinsics_px", "distortion")


@pytest.mark.parametrize(
    ("key", "said"),
    [(key, key) for key in KEYS]
    + [(f"left__{key}", key) for key in CAMERA_KEYS]
    + [(f"right__intrinsics_px__{key}", key) for key in ("fx", "fy", "cx", "cy")],
)
def test_a_missing_entry_is_named(tmp_path, key, said):
    path = saved(tmp_path, **{key: ...})
    with pytest.raises(InputError, match=f"rig.json: the rig file has no '{said}'"):
        StereoRig.load(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "other"}, "not a rig file"),
        ({"format": ...}, "not a rig file"),
        ({"version": ...}, "version must be a positive whole number, got null"),
        ({"version": "1"}, 'version must be a number, got the text "1"'),
        ({"version": 0}, "version must be a positive whole number, got 0"),
        ({"version": -1}, "version must be a positive whole number, got -1"),
        ({"version": 1.0}, "version must be a positive whole number, got 1.0"),
        ({"version": True}, "version must be a positive whole number, got true"),
        ({"left": 3}, "damaged"),
        ({"left__image_size_px": [640]}, r"image_size_px has shape \(1,\), must be \(2\)"),
        ({"left__image_size_px": ["a", "b"]}, "image_size_px must be numbers"),
        ({"left__image_size_px": [float("inf"), 480]}, "image_size_px contains NaN or infinity"),
        ({"left__image_size_px": [640, -480]}, "image_size_px must be two positive whole numbers.*got 640 -480"),
        ({"right__image_size_px": [0, 480]}, "image_size_px must be two positive whole numbers.*got 0 480"),
        ({"right__image_size_px": [640.5, 480]}, "image_size_px must be two positive whole numbers.*got 640.5 480"),
        ({"right__image_size_px": [10**400, 480]}, "damaged"),
        ({"left__distortion_model": "brown6"}, "unknown distortion model 'brown6'"),
        ({"left__distortion": [0.1, 0.2]}, "distortion has shape"),
        ({"left__distortion": [0.1, 0.2, 0.3, 0.4, "x"]}, "distortion must be numbers"),
        ({"left__intrinsics_px__fx": -900.0}, "focal lengths must be positive"),
        ({"left__intrinsics_px__fx": float("nan")}, "finite"),
        ({"left__intrinsics_px__fx": "wide"}, "damaged"),
        ({"left__intrinsics_px": [1, 2, 3, 4]}, "damaged"),
        ({"T_left_right_m": [[1, 0], [0, 1]]}, "T_left_right_m has shape"),
        ({"T_left_right_m": (2 * np.eye(4)).tolist()}, "rotation"),
        ({"T_left_right_m": np.diag([1.0, 1, -1, 1]).tolist()}, "rotation"),
        ({"T_left_right_m": np.full((4, 4), np.nan).tolist()}, "NaN"),
        (
            {"T_left_right_m": [*np.eye(4)[:3].tolist(), [0, 0, 0, 2]]},
            "last row of T_left_right must be 0 0 0 1, got 0 0 0 2",
        ),
        ({"T_left_right_m": [*np.eye(4)[:3].tolist(), [0.1, 0, 0, 1]]}, "last row of T_left_right .* got 0.1 0 0 1"),
        ({"covariance": [[1.0]]}, "covariance has shape"),
        ({"covariance": "none"}, "covariance"),
        ({"sigma_px": -0.1}, "sigma_px"),
        ({"sigma_px": float("nan")}, "sigma_px must be a finite number not below zero, got nan"),
        ({"sigma_px": float("inf")}, "sigma_px must be a finite number not below zero, got inf"),
        ({"sigma_px": 10**400}, "damaged"),
        ({"provenance": None}, "provenance must be an object of names and values, got null"),
        ({"provenance": [["a", 1]]}, r'provenance must be an object of names and values, got \[\["a", 1\]\]'),
        (
            {"covariance": np.diag([*np.ones(20), -1e-9, *np.ones(3)]).tolist()},
            "variance of T_left_right.z_m is negative",
        ),
        (
            {"covariance": (np.eye(24) + np.eye(24, k=1)).tolist()},
            "not symmetric: left.fx_px with left.fy_px is 1 and 0",
        ),
        ({"sigma_px": None}, "damaged"),
    ],
)
def test_a_damaged_entry_is_reported(tmp_path, changes, said):
    path = saved(tmp_path, **changes)
    with one_line(match=said, begins=path):
        StereoRig.load(path)


def test_the_symmetry_asked_of_a_covariance_is_relative():
    rig = ordinary_rig()
    sigma = np.logspace(-12, 3, rig.parameter_count)  # from radians of a good rig to pixels of a bad one
    C = np.outer(sigma, sigma) * (0.5 + 0.5 * np.eye(len(sigma)))
    for off, rejected in ((1e-6, False), (1e-4, True)):
        for i, j in ((0, 1), (0, len(C) - 1), (len(C) - 2, len(C) - 1)):
            cov = C.copy()
            cov[i, j] *= 1 + off
            with pytest.raises(InputError, match="not symmetric") if rejected else contextlib.nullcontext():
                replace(rig, cov=cov)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 3) | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)
POSITIONS = st.sampled_from(
    [
        *(["version"], ["left"], ["T_left_right_m"], ["T_left_right_m", 3], ["T_left_right_m", 1, 2], ["sigma_px"]),
        *(["covariance"], ["covariance", 2], ["covariance", 2, 2], ["covariance", 2, 3], ["provenance"], ["format"]),
        *(["right", key] for key in CAMERA_KEYS),
        *(["right", "image_size_px", 0], ["right", "intrinsics_px", "fx"], ["right", "distortion", 1]),
    ]
)


@settings(max_examples=300)
@given(POSITIONS, JSON)
def test_whatever_stands_in_a_rig_file_is_a_rig_or_one_clear_line(tmp_path_factory, position, value):
    path = tmp_path_factory.getbasetemp() / "any_rig.json"
    document = entry = json.loads(rig_text("brown4"))
    *way, last = position
    for key in way:
        entry = entry[key]
    entry[last] = value
    path.write_text(json.dumps(document))
    try:
        rig = StereoRig.load(path)
    except InputError as error:
        said = str(error)
    else:
        said = f"{path}: read"
        rig.save(path)
        assert StereoRig.load(path).parameter_names == rig.parameter_names
    assert said.startswith(f"{path}: ")
    assert len(said.splitlines()) == 1


@functools.cache
def rig_text(model):
    with tempfile.TemporaryDirectory() as folder:
        ordinary_rig(model).save(f"{folder}/rig.json")
        return Path(f"{folder}/rig.json").read_text()


def test_what_is_no_rig_file_or_cut_short_is_reported(tmp_path):
    path = tmp_path / "rig.json"
    ordinary_rig("none").save(path)
    whole = path.read_bytes()
    others = [b"[]", b"3", b"\xff\xfe\x00rig", b"left: 1\n", b"[" * 100_000, b'{"format": ' + b"9" * 5000 + b"}"]
    for content in (*others, *(whole[:length] for length in range(0, len(whole.rstrip()) - 1, 97))):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"rig\.json"):
            StereoRig.load(path)


def test_the_noise_of_discs_is_stored_and_files_without_it_are_read(tmp_path):
    path, noise = tmp_path / "rig.json", (CameraNoise(1.4, 700.0), CameraNoise(0.8, 650.0))
    replace(ordinary_rig(), disc_noise=noise).save(path)
    found = StereoRig.load(path)
    assert found.disc_variance_factors == (1.4, 1.0)
    assert (found.disc_noise[1].variance_factor, found.disc_noise[1].freedom) == (0.8, 650.0)
    assert found.perturbed(np.zeros(found.parameter_count)).disc_variance_factors == (1.4, 1.0)
    assert StereoRig.load(saved(tmp_path)).disc_variance_factors == (1.0, 1.0)
    for wrong in (3, {"left": {}}, {side: {"variance_factor": -1, "freedom": 9} for side in ("left", "right")}):
        with pytest.raises(InputError, match=r"rig\.json: "):
            StereoRig.load(saved(tmp_path, disc_noise=wrong))
    for wrong in (True, [1], {side: {"variance_factor": True, "freedom": 9} for side in ("left", "right")}):
        with pytest.raises(InputError, match="disc_noise: expected left and right"):
            StereoRig.load(saved(tmp_path, disc_noise=wrong))


def test_shutters_are_stored_and_files_without_them_are_read(tmp_path):
    path, shutters = tmp_path / "rig.json", Shutters(-5e-3, 0.014, np.array([[1e-10, 2e-11], [2e-11, 4e-10]]))
    replace(ordinary_rig(), shutters=shutters).save(path)
    found = StereoRig.load(path).shutters
    assert (found.skew_s, found.readout_s) == (-5e-3, 0.014)
    assert np.array_equal(found.cov, shutters.cov)
    assert str(found) == "skew 5.00 ± 0.01 ms (left later), readout 14.00 ± 0.02 ms"
    assert StereoRig.load(saved(tmp_path)).shutters is None
    for wrong in ({"skew_s": 1.0}, {"skew_s": 0.0, "readout_s": -1.0, "covariance_s2": [[0, 0], [0, 0]]}, "late"):
        with pytest.raises(InputError, match=r"rig\.json"):
            StereoRig.load(saved(tmp_path, shutters=wrong))


def test_missing_files_and_folders_are_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        StereoRig.load(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        StereoRig.load(tmp_path)
    with pytest.raises(InputError, match="cannot be written"):
        ordinary_rig().save(tmp_path / "nowhere" / "rig.json")


def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "rig.json"
    ordinary_rig(seed=1).save(path)
    before, limit = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    try:
        with pytest.raises(InputError, match=r"rig\.json: cannot be written: File too large"):
            ordinary_rig(seed=2).save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["rig.json"]
