"""Images that are delivered twice: found and counted; not found where each is new."""

import pytest
from faults import watched_body

from armsight.loop.health.host import HostWatch


@pytest.mark.parametrize("every", [0, 4])
def test_shots_that_repeat_the_one_before_are_counted(every):
    watch, last = HostWatch(), None
    for n, (_, t_s, _, estimate, _) in enumerate(watched_body(8, seconds=2.0)):
        repeats = every and n % every == every - 1
        watch.take(last if repeats else estimate, t_s)
        last = estimate
    findings = watch.findings()
    if not every:
        assert findings == ()
        return
    (found,) = findings
    assert (found.cause, found.unit) == ("host", "%")
    assert found.size == pytest.approx(25.0)
    assert "15 of 60 shots" in found.what
