"""The page of measured figures is what benchmarks/digits.py makes of its hand-written part and the stored figures."""

import json
import sys
import tomllib
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
import digits  # noqa: E402


def test_the_page_is_what_is_generated():
    runs = tomllib.loads((BENCHMARKS / "digits.toml").read_text(encoding="utf-8"))["run"]
    stored = json.loads(digits.STORED.read_text(encoding="utf-8"))
    page = digits.page(digits.WRITTEN.read_text(encoding="utf-8"), runs, stored)
    assert digits.PAGE.read_text(encoding="utf-8") == page, "python benchmarks/digits.py page"
    changed = digits.page(
        "", runs, {**stored, "identify: ur5_grid, five-fold, mm": 0.123, "cal_opencv: baseline, m": 1}
    )
    assert {line for line in changed.splitlines() if line not in page.splitlines()} == {
        "- ur5_grid, five-fold, mm: 0.123",
        "- baseline, mm: 1000",
    }
