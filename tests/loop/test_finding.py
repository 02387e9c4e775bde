"""The table of causes: every row becomes a finding, of evidence of either sign, in its unit."""

import json
from string import Formatter

import numpy as np
import pytest

from armsight.loop.finding import CAUSES, make_finding


@pytest.mark.parametrize("sign", [1, -1])
def test_every_cause_is_said_in_its_unit(sign):
    for name, row in CAUSES.items():
        words = {word: 2.0 if spec else "them" for _, word, spec, _ in Formatter().parse(row.what) if word}
        words = {word: value for word, value in words.items() if word not in ("size", "signed", "way")}
        found = make_finding(name, (np.float64(sign * 0.5), np.float64(0.25)), 1.0, cost_m=2e-3, words=words)
        by = {"deg": np.degrees(1.0), "mm": 1e3, "ms": 1e3, "%": 100.0}.get(row.unit, 1.0)
        assert (found.size, found.sigma) == pytest.approx((sign * 0.5 * by, 0.25 * by)), name
        assert (found.cause, found.unit, found.advice, found.cost_mm) == (row.cause, row.unit, row.advice, 2.0)
        assert row.ways[sign < 0] in found.what
        assert "{" not in found.what
        assert json.loads(json.dumps(found.to_json()))["size"] == found.size


def test_what_cannot_be_excluded_and_what_explains_it_as_well_stand_beside_it():
    found = make_finding("swings", (0.01, 0.001), unsure="a rotation of one camera", also=("time",))
    assert found.what.endswith("; a rotation of one camera cannot be excluded")
    assert (found.alternatives, found.forbids) == (("rig", "time"), True)
