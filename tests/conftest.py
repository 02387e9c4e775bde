"""What every test shares: one fixed hypothesis profile and the place of the real recordings."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

# The same examples on every machine and in every run; no database, no clock.
settings.register_profile("ci", derandomize=True, max_examples=60, deadline=None, database=None)
settings.load_profile("ci")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings, or a skip that says where it was looked for."""
    path = Path(os.environ.get("ARMSIGHT_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no real recordings at {path}; set ARMSIGHT_DATA to their folder")
    return path
