"""The page of what to buy is what benchmarks/budget.py makes of the catalogue."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import budget


def test_the_page_is_what_is_generated():
    page = budget.PAGE.read_text(encoding="utf-8")
    assert page == budget.buying_page(), "python benchmarks/budget.py page"
    assert all(f"## {title}" in page for title in budget.KITS)
