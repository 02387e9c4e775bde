"""Files that armsight wrote before its keys were renamed: they are read as they were."""

from pathlib import Path

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.vision.markers.body_file import RENAMED, VERSION
from armsight.vision.markers.targets import open_target, read_layout
from armsight.vision.rig import StereoRig

FILES = Path(__file__).parent / "written_by_version_1"


def test_a_rig_file_of_version_1(tmp_path):
    rig = StereoRig.load(FILES / "rig.json")
    assert rig.left.model == "brown5"
    assert rig.left.image_size_px == (1280, 720)
    assert rig.baseline_m == pytest.approx(0.2, rel=0.02)  # the workcell's cameras stand 0.2 m apart
    assert (np.diag(rig.cov) > 0).all()
    rig.save(tmp_path / "again.json")
    again = StereoRig.load(tmp_path / "again.json")
    np.testing.assert_array_equal(again.cov, rig.cov)
    np.testing.assert_array_equal(again.T_left_right, rig.T_left_right)
    assert again.provenance == rig.provenance


def test_a_body_file_of_version_1():
    target = open_target(str(FILES / "body.toml"))
    assert target.body.point_names[-1] == "A"  # discs come last
    about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    tag = read_layout(FILES / "body.toml").tags.tags[0]
    np.testing.assert_allclose(tag.T_body_tag[:3, :3], about_z, atol=1e-15)


def test_old_keys_and_new_ones_mean_the_same(tmp_path):
    text = (FILES / "body.toml").read_text()
    for old, new in RENAMED.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "body.toml").write_text(f"version = {VERSION}\n{text}")
    old, new = read_layout(FILES / "body.toml"), read_layout(tmp_path / "body.toml")
    np.testing.assert_array_equal(new.body.points, old.body.points)
    np.testing.assert_array_equal(new.normals, old.normals)


@pytest.mark.parametrize("version", ["0", "3", "true", '"2"'])
def test_a_version_that_is_not_known_is_named(tmp_path, version):
    (tmp_path / "body.toml").write_text(f"version = {version}\n{(FILES / 'body.toml').read_text()}")
    with pytest.raises(InputError, match="reads body files of version 1 to 2"):
        open_target(str(tmp_path / "body.toml"))
