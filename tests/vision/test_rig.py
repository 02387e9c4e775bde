"""The rig and its file: exact round trips, every damage told, and no file lost to a full disk."""

import errno
import json
import os

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import log_se3
from armsight.vision.rig import VERSION, StereoRig
from asserts import assert_jacobian
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


def test_facts_of_the_geometry():
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
        ({"version": ...}, "version None"),
        ({"left": 3}, "damaged"),
        ({"left__image_size_px": [640]}, "damaged"),
        ({"left__image_size_px": ["a", "b"]}, "damaged"),
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
        ({"covariance": [[1.0]]}, "covariance has shape"),
        ({"covariance": "none"}, "covariance"),
        ({"sigma_px": -0.1}, "sigma_px"),
        ({"sigma_px": float("nan")}, "sigma_px"),
        ({"sigma_px": None}, "damaged"),
    ],
)
def test_a_damaged_entry_is_told(tmp_path, changes, said):
    path = saved(tmp_path, **changes)
    with pytest.raises(InputError, match=said) as caught:
        StereoRig.load(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_every_truncation_is_told(tmp_path):
    path = tmp_path / "rig.json"
    ordinary_rig("none").save(path)
    whole = path.read_text()
    for length in range(0, len(whole.rstrip()) - 1, 97):
        path.write_text(whole[:length])
        with pytest.raises(InputError, match=r"rig\.json"):
            StereoRig.load(path)


@pytest.mark.parametrize("content", [b"", b"[]", b"3", b"\xff\xfe\x00rig", b"left: 1\n"])
def test_other_files_are_told(tmp_path, content):
    path = tmp_path / "rig.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"rig\.json"):
        StereoRig.load(path)


def test_missing_files_and_folders_are_told(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        StereoRig.load(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        StereoRig.load(tmp_path)
    with pytest.raises(InputError, match="cannot be written"):
        ordinary_rig().save(tmp_path / "nowhere" / "rig.json")


class FullDisk:
    """A file on a disk that holds a few bytes more."""

    def __init__(self, file):
        self.file = file

    def write(self, text):
        self.file.write(text[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.file.close()


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "rig.json"
    ordinary_rig(seed=1).save(path)
    before = path.read_bytes()
    real = os.fdopen
    monkeypatch.setattr("armsight.files.os.fdopen", lambda *args, **kw: FullDisk(real(*args, **kw)))
    with pytest.raises(InputError, match=r"rig\.json: cannot be written: No space left on device"):
        ordinary_rig(seed=2).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["rig.json"]
