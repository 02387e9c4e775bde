"""The body on the tool: its file says what its patterns show."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import transform
from armsight.sim.workcell.body import body_patterns, body_target, body_text, patterns_of
from armsight.vision.markers.targets import open_target
from cli_runs import run

EXAMPLES = Path(__file__).parents[3] / "examples"


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


def test_any_body_of_discs_is_painted_as_its_file_has_it(tmp_path):
    leaning = 'name = "two"\n' + "".join(
        f'[[markers]]\nname = "{n}"\nposition_mm = {p}\nnormal = {v}\ndisc = {{ radius_mm = 6.0, bright = true }}\n'
        for n, p, v in (
            ("A", [0, 0, 0], [0, 0, -1]),
            ("B", [20, 0, 0], [0, 0, -1]),
            ("C", [50, 0, 9], [0.6, 0.0, -0.8]),
        )
    )
    (tmp_path / "two.toml").write_text(leaning)
    for path in (tmp_path / "two.toml", EXAMPLES / "arm_plate.toml"):
        target = open_target(str(path))
        shown = [(p.T_body_pattern, disc) for p in patterns_of(target) for disc in p.discs]
        at = [transform(T, np.array([*disc[:2], 0.0])) for T, disc in shown]
        order = [int(np.argmin(np.linalg.norm(np.array(at) - point, axis=1))) for point in target.body.points]
        assert sorted(order) == list(range(len(at)))
        np.testing.assert_allclose(np.array(at)[order], target.body.points, atol=1e-9)
        normals = [-shown[k][0][:3, 2] for k in order]
        np.testing.assert_allclose(normals, target.discs.normals, atol=1e-6)
    assert len(patterns_of(target)) == 1  # a plate is one face
    with pytest.raises(InputError, match="simulated cameras show discs with normals"):
        patterns_of(open_target("chessboard:9x6:20mm"))


def test_a_body_like_the_default_in_its_points_alone_is_painted_as_itself():
    own = body_target()
    assert [len(p.discs) for p in patterns_of(own)] == [5, 1, 1, 1, 1]  # the plate, then the wings: the default's
    for changed in (
        replace(own.discs, radii_m=own.discs.radii_m * 0.8),
        replace(own.discs, bright=~own.discs.bright),
        replace(own.discs, normals=np.tile([0.0, 0.0, -1.0], (9, 1))),
    ):
        painted = patterns_of(replace(own, discs=changed))
        shown = {(round(float(r), 6), value > 0.5) for p in painted for *_, r, value in p.discs}
        assert shown == {(round(float(r), 6), bool(b)) for r, b in zip(changed.radii_m, changed.bright, strict=True)}
        plates = np.unique(
            np.column_stack([changed.normals, np.sum(changed.normals * own.body.points, axis=1)]).round(5), axis=0
        )
        assert len(painted) == len(plates)
    mixed = replace(own.discs, bright=np.arange(9) != 1)
    with pytest.raises(InputError, match="tool_body: A and B are on one face, and one of them is bright, one dark"):
        patterns_of(replace(own, discs=mixed))
