"""Waiting for what another thread does."""

import time


def until(true, patience_s=120.0, why=lambda: ""):
    """Wait until a function returns something true, and return that; fail where it never does."""
    end = time.monotonic() + patience_s
    while not (found := true()):
        assert time.monotonic() < end, f"did not happen in time {why()}"
        time.sleep(0.01)
    return found
