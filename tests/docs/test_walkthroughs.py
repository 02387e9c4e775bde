"""The walkthroughs' lines give what their pages show; numbers may differ by two units of their last digit.

The lines of one measured shot need a rendered recording and a calibration: they are not run here.
"""

import doctest
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


class Near(doctest.OutputChecker):
    """Compares numbers by value: other processors and other versions of OpenCV differ in the last digits."""

    def check_output(self, want, got, optionflags):
        """Say whether two outputs are the same, spaces and last digits aside."""
        if super().check_output(want, got, optionflags):
            return True
        texts = [re.sub(r"\s+", "", _NUMBER.sub("#", text)) for text in (want, got)]
        pairs = zip(_NUMBER.findall(want), _NUMBER.findall(got), strict=False)
        return texts[0] == texts[1] and all(near(first, second) for first, second in pairs)


def near(first: str, second: str) -> bool:
    """Say whether two numbers differ by at most two units of the last digit shown; whole numbers must be equal."""
    digits = len(first.partition(".")[2]) if "e" not in first else 0
    return first == second or (digits > 0 and abs(float(first) - float(second)) <= 2.001 * 10.0**-digits)


def run_page(name: str) -> doctest.TestResults:
    """Run the lines of a page in the present folder."""
    text = (DOCS / "walkthroughs" / f"{name}.md").read_text(encoding="utf-8")
    test = doctest.DocTestParser().get_doctest(text, {}, name, name, 0)
    runner = doctest.DocTestRunner(Near(), optionflags=doctest.NORMALIZE_WHITESPACE)
    said = []
    runner.run(test, out=said.append)
    assert runner.tries > 20
    assert runner.failures == 0, "".join(said)
    return doctest.TestResults(runner.failures, runner.tries)


@pytest.mark.parametrize("name", ["command", "identify_row"])
def test_the_lines_give_what_the_page_shows(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(name)


def test_a_wrong_number_is_found():
    checker = Near()
    assert checker.check_output("array([ 1.0051, 2. ])\n", "array([1.005, 2.])\n", 0)
    assert not checker.check_output("array([ 1.0051, 2. ])\n", "array([1.004, 2.])\n", 0)
    assert not checker.check_output("(16, 16)\n", "(16, 17)\n", 0)
    assert not checker.check_output("1.0 mm\n", "1.0 px\n", 0)
