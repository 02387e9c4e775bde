"""The body on the tool: its file says what its patterns show."""

import json

import numpy as np

from armsight.geometry.pose import transform
from armsight.sim.workcell.body import body_patterns, body_target, body_text
from armsight.vision.markers.targets import open_target
from cli_runs import run


def test_the_file_is_the_target(tmp_path):
    path = tmp_path / "body.toml"
    path.write_text(body_text())
    read, made = open_target(path).discs, body_target().discs
    assert read.body.point_names == made.body.point_names
    assert np.abs(read.body.points - made.body.points).max() < 1e-12
    assert np.abs(read.normals - made.normals).max() < 1e-8
    assert np.abs(read.radii_m - made.radii_m).max() < 1e-15
    assert read.bright.all()
    assert made.bright.all()


def test_the_patterns_show_the_target():
    discs = body_target().discs
    shown = [(p.T_body_pattern, disc) for p in body_patterns() for disc in p.discs]
    for (T, disc), at, normal, radius in zip(shown, discs.body.points, discs.normals, discs.radii_m, strict=True):
        assert np.abs(transform(T, np.array([disc[0], disc[1], 0.0])) - at).max() < 1e-15
        assert np.abs(T[:3, 2] + normal).max() < 1e-15
        assert disc[2] == radius


def test_the_check_calls_it_usable(tmp_path, capsys):
    path = tmp_path / "body.toml"
    path.write_text(body_text())
    assert run("body", "check", path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["assessment"] == "usable"
