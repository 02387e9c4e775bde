"""Images that are delivered twice, and a computer that stalls: found and counted; not found where all is well."""

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


@pytest.mark.parametrize(
    ("late_s", "every", "said"), [(0.03, 50, True), (0.03, 400, False), (0.15, 900, True), (0.01, 1, False)]
)
def test_a_computer_that_stalls_is_named(late_s, every, said):
    watch = HostWatch()
    for n in range(1000):
        watch.began(0.004 * n, late_s if n % every == every - 1 else 0.001)
    found = watch.findings()
    assert bool(found) is said
    if said:
        assert found[0].cause == "host"
        assert found[0].size == pytest.approx(1e3 * late_s)
        assert found[0].since_s == pytest.approx(0.004 * (every - 1))
