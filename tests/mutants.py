"""Forty mutants, small errors made by hand, and whether the tests see each: ``python tests/mutants.py [NAME ...]``.

A mutant is one change of one file: a sign flipped, a matrix transposed, an index off by one, a unit wrong. The
checkout is copied to a temporary folder and never changed. The tests named for a mutant must pass without it and fail
with it. Not part of ``make test``: all forty take about twenty minutes on one core.

    --list           show the table and run nothing
    --json FILE      write one record per mutant

The exit code is 1 where a mutant survives, and 2 where one cannot be judged: its text is not in the file once, or its
tests fail without it.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
#: What the tests need of the checkout.
PARTS = ("src", "tests", "firmware", "docs", "pyproject.toml", "setup.py", "README.md", "CHANGELOG.md")
#: Tests that run longer than this, s, never end because of the mutant: that is seen, too.
LONGEST_S = 900.0
CORE = "firmware/core/"
SOURCE = "src/armsight/"


class Mutant(NamedTuple):
    """One change of one file.

    Attributes:
        name: what it is called here.
        kind: "sign", "transposed", "off by one" or "unit".
        file: path from the root of the checkout.
        text: what stands in the file, once.
        becomes: what the mutant has instead.
        tests: names of test files, looked up under tests/.
        choose: pytest's ``-k`` expression; empty for all tests of the files.
    """

    name: str
    kind: str
    file: str
    text: str
    becomes: str
    tests: tuple[str, ...]
    choose: str = ""


class Outcome(NamedTuple):
    """What became of a mutant.

    Attributes:
        name: of the mutant.
        state: "killed", "survived" or "not judged".
        by: the first test that failed, or why it was not judged.
        seconds: how long its tests ran.
    """

    name: str
    state: str
    by: str
    seconds: float


class NotJudged(Exception):
    """The mutant or its tests are not what the table says."""


MUTANTS: tuple[Mutant, ...] = ()


def copy_checkout(root: Path, folder: Path) -> None:
    """Copy what the tests need, without compiled code."""
    ignored = shutil.ignore_patterns("__pycache__", "_build", ".*")
    for part in PARTS:
        if (root / part).is_dir():
            shutil.copytree(root / part, folder / part, ignore=ignored, dirs_exist_ok=True)
        elif (root / part).is_file():
            shutil.copy2(root / part, folder / part)


def test_paths(folder: Path, names: tuple[str, ...]) -> list[str]:
    """Return the paths of test files, wherever they stand under tests/."""
    paths = []
    for name in names:
        found = sorted((folder / "tests").rglob(name))
        if len(found) != 1:
            raise NotJudged(f"{len(found)} files under tests/ are called {name}")
        paths.append(str(found[0].relative_to(folder)))
    return paths


def environment(folder: Path) -> dict[str, str]:
    """Return the environment in which the copy is what is imported."""
    return os.environ | {"PYTHONPATH": str(folder / "src")}


def require_copy(folder: Path) -> None:
    """Make sure that Python imports the copy, not the installed package."""
    command = [sys.executable, "-c", "import armsight.errors as e; print(e.__file__)"]
    path = subprocess.run(command, cwd=folder, env=environment(folder), capture_output=True, text=True, check=True)
    if not Path(path.stdout.strip()).resolve().is_relative_to(folder.resolve()):
        raise NotJudged(f"Python imports {path.stdout.strip()}, not the copy")


def run_tests(folder: Path, mutant: Mutant) -> tuple[int, str, float]:
    """Run a mutant's tests in a copy; return pytest's exit code, its first failure or its last line, and the time, s."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *test_paths(folder, mutant.tests)]
    command += ["-k", mutant.choose] if mutant.choose else []
    start = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment(folder), capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"no end after {LONGEST_S:.0f} s", time.monotonic() - start
    failed = re.search(r"^FAILED (?:\S*/)?(\S+?::[^\n]*?)(?: - |$)", done.stdout, re.MULTILINE)
    lines = (done.stdout + done.stderr).strip().splitlines()
    if failed:
        return done.returncode, failed.group(1), time.monotonic() - start
    # A test that failed has a name in the summary; what broke before a test did not kill the mutant.
    return done.returncode and 2, lines[-1] if lines else "pytest said nothing", time.monotonic() - start


def apply(folder: Path, mutant: Mutant) -> None:
    """Change the file in a copy."""
    path = folder / mutant.file
    if not path.is_file():
        raise NotJudged(f"there is no file {mutant.file}")
    text = path.read_text()
    if text.count(mutant.text) != 1:
        raise NotJudged(f"{mutant.text!r} stands {text.count(mutant.text)} times in {mutant.file}")
    path.write_text(text.replace(mutant.text, mutant.becomes))
    forget_kernels(folder, path)


def forget_kernels(folder: Path, changed: Path) -> None:
    """Delete the compiled code of a changed file, and that of every kernel it may have been compiled into.

    numba's cache looks at the age of a function's own file only, so a kernel in another file that calls a changed one
    would run old code. Callers are found by their imports, followed through files with kernels and packages.
    """
    imports = {path: imported(path) for path in (folder / "src").rglob("*.py")}
    stale, new = {changed}, {changed}
    while new:
        names = {module(folder, path) for path in new}
        new = {path for path, found in imports.items() if path not in stale and found & names and may_pass_on(path)}
        stale |= new
    for path in stale:
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            compiled.unlink()


def module(folder: Path, path: Path) -> str:
    """Return the name by which a file is imported."""
    parts = path.relative_to(folder / "src").with_suffix("").parts if path.suffix == ".py" else ()
    return ".".join(parts[:-1] if parts[-1:] == ("__init__",) else parts)


def imported(path: Path) -> set[str]:
    """Return the modules that a file imports, or may import: a name may be a module or stand in one."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def may_pass_on(path: Path) -> bool:
    """Say whether compiled code of others may stand in a file, or come through it."""
    return path.name == "__init__.py" or "numba" in path.read_text()


def judge(clean: Path, work: Path, mutant: Mutant) -> Outcome:
    """Run one mutant's tests on a copy of the clean tree, which has the compiled kernels."""
    if work.exists():
        shutil.rmtree(work)
    shutil.copytree(clean, work)
    try:
        apply(work, mutant)
        require_copy(work)
        code, by, seconds = run_tests(work, mutant)
    except NotJudged as error:
        return Outcome(mutant.name, "not judged", str(error), 0.0)
    state = {0: "survived", 1: "killed"}.get(code, "not judged")
    return Outcome(mutant.name, state, "" if code == 0 else by, seconds)


def run(mutants: tuple[Mutant, ...], root: Path, folder: Path) -> list[Outcome]:
    """Judge mutants of a checkout one after the other, working in a folder."""
    clean, work = folder / "clean", folder / "mutant"
    if not clean.exists():
        copy_checkout(root, clean)
    require_copy(clean)
    passed: dict[tuple[tuple[str, ...], str], str] = {}  # why the unmutated tests do not pass, empty where they do
    outcomes = []
    for mutant in mutants:
        selection = (mutant.tests, mutant.choose)
        if selection not in passed:
            try:
                code, by, _ = run_tests(clean, mutant)
                passed[selection] = f"its tests do not pass without it: {by}" if code else ""
            except NotJudged as error:
                passed[selection] = str(error)
        reason = passed[selection]
        outcome = Outcome(mutant.name, "not judged", reason, 0.0) if reason else judge(clean, work, mutant)
        print(f"{outcome.name:32} {outcome.state:10} {outcome.seconds:5.0f} s  {outcome.by}", flush=True)
        outcomes.append(outcome)
    return outcomes


def show(mutants: tuple[Mutant, ...]) -> None:
    """Print the table."""
    for m in mutants:
        tests = " ".join(m.tests) + (f" -k '{m.choose}'" if m.choose else "")
        print(f"{m.name:32} {m.kind:10} {m.file}\n    - {m.text}\n    + {m.becomes}\n    {tests}")


def main(mutants: tuple[Mutant, ...] = MUTANTS, root: Path = ROOT) -> int:
    """Judge the mutants that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="mutants to run; all where none is named")
    parser.add_argument("--list", action="store_true", help="show the table and run nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write one record per mutant")
    asked = parser.parse_args()
    known = {m.name: m for m in mutants}
    if unknown := [name for name in asked.names if name not in known]:
        parser.error(f"unknown: {', '.join(unknown)}; known are {', '.join(known)}")
    chosen = tuple(known[name] for name in asked.names) or mutants
    if asked.list:
        show(chosen)
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        outcomes = run(chosen, root, Path(temporary))
    states = [outcome.state for outcome in outcomes]
    print(f"{states.count('killed')} of {len(states)} killed, {states.count('survived')} survived")
    if asked.json:
        records = [known[outcome.name]._asdict() | outcome._asdict() for outcome in outcomes]
        asked.json.write_text(json.dumps(records, indent=2) + "\n")
    return 2 if "not judged" in states else int("survived" in states)


if __name__ == "__main__":
    sys.exit(main())
