"""Some forty mutants, small errors made by hand, and whether the tests see each: ``python tests/mutants.py [NAME ...]``.

A mutant is one change of one file: a sign flipped, a matrix transposed, an index off by one, a unit wrong. The
checkout is copied to a temporary folder and never changed. The tests named for a mutant must pass without it and fail
with it. Not part of ``make test``: all take some minutes on one core.

    --list           show the table and run nothing
    --json FILE      write one record per mutant

The exit code is 1 where a mutant survives, and 2 where one is invalid: its text does not stand in the file exactly once,
or its tests fail without it.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
#: Imported once, before any test: each run is a fork of this process and does not pay for them again.
SHARED = ("cv2", "hypothesis", "numpy", "scipy.linalg", "scipy.optimize", "scipy.spatial.transform", "scipy.stats")
#: What the tests need of the checkout.
PARTS = ("src", "tests", "firmware", "docs", "pyproject.toml", "setup.py", "README.md", "CHANGELOG.md")
#: Tests that run longer than this, s, never end because of the mutant: that is seen, too.
LONGEST_S = 900.0
GEOMETRY, VISION, KINEMATICS = "src/armsight/geometry", "src/armsight/vision", "src/armsight/robot/kinematics"
LOOP, HANDEYE, IDENTIFY = "src/armsight/loop", "src/armsight/loop/handeye", "src/armsight/loop/identify"
ESTIMATORS, CORE = "src/armsight/loop/estimators", "firmware/core"


class Mutant(NamedTuple):
    """One change of one file."""

    name: str  #: what it is called here
    kind: str  #: "sign", "transposed", "off by one" or "unit"
    file: str  #: path from the root of the checkout
    text: str  #: what stands in the file, once
    becomes: str  #: what the mutant has instead
    test: str  #: name of the test file that must fail, looked up under tests/
    choose: str = ""  #: pytest's ``-k`` expression; empty for all tests of the file
    #: whether kernels are compiled, for tests that simulate. Elsewhere they run as plain Python: a kernel's compiled
    #: code would have to be made anew for every mutant, and takes longer than most tests
    compiled: bool = False


class Outcome(NamedTuple):
    """What became of a mutant."""

    name: str  #: of the mutant
    state: str  #: "killed", "survived" or "invalid"
    by: str  #: the first test that failed or could not be set up, or why it is invalid
    seconds: float  #: how long its tests ran


class Invalid(Exception):
    """The mutant or its tests are not what the table says."""


TRIANGULATED = "none and (truth or minimiser or calibration) or rigs_noise"
IDENTIFIED = "derivative_is or torque"

# fmt: off
#: Texts are short and mostly numbers and operators, so that they outlast a change of names.
MUTANTS = (
    Mutant("geometry-inverse", "sign", f"{GEOMETRY}/pose.py",
           "= -(Rt @ T", "= (Rt @ T", "test_pose.py"),
    Mutant("geometry-exp", "sign", f"{GEOMETRY}/pose.py",
           "(angle - s) / (safe", "(angle + s) / (safe", "test_pose.py"),
    Mutant("geometry-fit", "transposed", f"{GEOMETRY}/rigid.py",
           "mean_a - R @ mean_b", "mean_a - R.T @ mean_b", "test_rigid.py"),
    Mutant("geometry-quaternion", "off by one", f"{GEOMETRY}/rotation.py",
           "np.roll(q, -1)", "np.roll(q, 0)", "test_rotation.py"),
    Mutant("match-essential", "sign", f"{VISION}/match.py",
           "[b, j] - t[b]", "[b, j] + t[b]", "test_match.py", "none or gate_is_wide"),
    Mutant("match-line", "transposed", f"{VISION}/match.py",
           "line[1, j] += a[i] * E[i, j]", "line[1, j] += a[i] * E[j, i]", "test_match.py", "none or gate_is_wide"),
    Mutant("match-gate", "unit", f"{VISION}/match.py",
           "np.sqrt(2 * variance)", "(2 * variance)", "test_match.py", "none or gate_is_wide"),
    Mutant("match-focal", "off by one", f"{VISION}/match.py",
           "intrinsics[:2]", "intrinsics[1:3]", "test_match.py", "none or gate_is_wide"),
    Mutant("triangulate-midpoint", "sign", f"{VISION}/triangulate.py",
           "(ab * at - bt)", "(ab * at + bt)", "test_triangulate.py", TRIANGULATED),
    Mutant("triangulate-weight", "transposed", f"{VISION}/triangulate.py",
           "= C[1, 1] / det, C[0, 0] / det", "= C[0, 0] / det, C[1, 1] / det", "test_triangulate.py", TRIANGULATED),
    Mutant("triangulate-by-rig", "off by one", f"{VISION}/triangulate.py",
           "start += 4 + counts[c]", "start += 3 + counts[c]", "test_triangulate.py", TRIANGULATED),
    Mutant("triangulate-noise", "unit", f"{VISION}/triangulate.py",
           "1e-6) ** 2 * np.eye(2)", "1e-6) * np.eye(2)", "test_triangulate.py", TRIANGULATED),
    Mutant("locate-jacobian", "sign", f"{VISION}/posefit.py",
           "J[3] = J[2] * p[1] - ", "J[3] = J[2] * p[1] + ", "test_posefit.py", "scipy and brown4"),
    Mutant("locate-covariance", "sign", f"{VISION}/locate.py",
           "noise * misfit + gain", "noise * misfit - gain", "test_locate.py", "other_bodies and 1.0", compiled=True),
    Mutant("locate-misfit", "unit", f"{VISION}/locate.py",
           "float(np.sqrt(misfit))", "float(misfit)", "test_locate.py", "bad_print"),
    Mutant("pnp-rotation", "transposed", f"{VISION}/pnp.py",
           "(rotation, np.float64).ravel())", "(rotation, np.float64).ravel()).T", "test_pnp.py", "truth and none"),
    Mutant("handeye-adjoint", "transposed", f"{GEOMETRY}/pose.py",
           "skew(T[..., :3, 3]) @ R", "R @ skew(T[..., :3, 3])", "test_laws.py", "derivative"),
    Mutant("handeye-derivative", "sign", f"{HANDEYE}/poses.py",
           "np.eye(6) + 0.5 *", "np.eye(6) - 0.5 *", "test_laws.py", "derivative"),
    Mutant("handeye-pivot", "sign", f"{HANDEYE}/pivot.py",
           "-np.eye(3), (len", "np.eye(3), (len", "test_handeye_streams.py", "pivot_is_found"),
    Mutant("handeye-offset", "unit", f"{HANDEYE}/streams.py",
           "@ late[good]) / SPEED_S", "@ late[good])", "test_handeye_streams.py", "found_within and to_hand"),
    Mutant("identify-chain", "sign", f"{IDENTIFY}/model.py",
           "c * v - s * u", "c * v + s * u", "test_identify_model.py", IDENTIFIED),
    Mutant("identify-residual", "transposed", f"{IDENTIFY}/model.py",
           "back = measured.R_rig_body.swapaxes(1, 2)", "back = measured.R_rig_body", "test_identify_model.py", IDENTIFIED),
    Mutant("identify-body", "off by one", f"{IDENTIFY}/model.py",
           "J[:, 3:, at - 3 : at] =", "J[:, 3:, at - 2 : at + 1] =", "test_identify_model.py", IDENTIFIED),
    Mutant("identify-gravity", "sign", f"{IDENTIFY}/model.py",
           "at[:-1], -up_base)", "at[:-1], up_base)", "test_identify_model.py", "torque"),
    Mutant("identify-backlash", "unit", f"{IDENTIFY}/backlash.py",
           "float(np.sqrt(max(", "float((max(", "test_identify_backlash.py"),
    Mutant("kinematics-jacobian", "sign", f"{KINEMATICS}/chain.py",
           "= zy * rz - zz * ry,", "= zy * rz + zz * ry,", "test_forward.py", "jacobian and ur5"),
    Mutant("kinematics-tool-axes", "transposed", f"{KINEMATICS}/chain.py",
           "= F[0] * x + F[1] * y + F[2] * z", "= F[0] * x + F[3] * y + F[6] * z", "test_forward.py", "jacobian and ur5"),
    Mutant("kinematics-elbow", "sign", f"{KINEMATICS}/closed.py",
           "- upper * upper - fore * fore)", "- upper * upper + fore * fore)", "test_inverse.py", "known_one and ur5"),
    Mutant("kinematics-revolution", "off by one", f"{KINEMATICS}/inverse.py",
           "np.floor((goal - q)", "1.0 + np.floor((goal - q)", "test_inverse.py", "and_takes_whole and ur5"),
    Mutant("kinematics-reach", "unit", f"{KINEMATICS}/closed.py",
           "= math.sqrt(far2),", "= far2,", "test_inverse.py", "known_one and ur5"),
    Mutant("servo-gain", "off by one", f"{LOOP}/servo.py",
           "d**d / (d + 1) ** (d + 1)", "d**d / (d + 1) ** d", "test_servo.py", "gain_rule"),
    Mutant("servo-correction", "sign", f"{LOOP}/servo.py",
           "= q_ref[i] - q[1, i]", "= q[1, i] - q_ref[i]", "test_servo.py", "brought_back"),
    Mutant("servo-rate", "unit", f"{LOOP}/servo.py",
           "= self._arm.qd_max * self.timing.period_s", "= self._arm.qd_max", "test_servo.py", "brought_back"),
    Mutant("estimators-update", "sign", f"{ESTIMATORS}/errormodel.py",
           "P[k, j] -= K[k, row]", "P[k, j] += K[k, row]", "test_arm_error.py", "textbook"),
    Mutant("estimators-backlash", "sign", f"{ESTIMATORS}/armerror.py",
           "= -0.5 * unseen[0, i]", "= 0.5 * unseen[0, i]", "test_arm_error.py", "offsets_are or slow_arm"),
    Mutant("estimators-adjoint", "transposed", f"{ESTIMATORS}/armerror.py",
           "out[row, col] = out[3 + row, 3 + col] =", "out[col, row] = out[3 + col, 3 + row] =",
           "test_arm_error.py", "derivative_is_exact and ur5"),
    Mutant("estimators-parabola", "off by one", f"{ESTIMATORS}/parabola.py",
           "n = high - low + 1\n    s1", "n = high - low\n    s1", "test_readings.py", "parabolas"),
    Mutant("estimators-gain", "unit", f"{ESTIMATORS}/armerror.py",
           "B[i, at] = q[i]", "B[i, at] = np.rad2deg(q[i])", "test_arm_error.py", "offsets_are or slow_arm"),
    Mutant("firmware-derivative", "sign", f"{CORE}/pid.c",
           "- gains->kd_s_per_rad *", "+ gains->kd_s_per_rad *", "test_firmware_pid.py", "derivative"),
    Mutant("firmware-glitch", "off by one", f"{CORE}/pot.c",
           "bad_ticks < confirm_ticks", "bad_ticks <= confirm_ticks", "test_firmware_pot.py", "once_it_lasts or glitch"),
    Mutant("firmware-current", "unit", f"{CORE}/core.c",
           "* 0.001f;", "* 0.000001f;", "test_firmware_commands.py", "current"),
)
# fmt: on


def copy_checkout(root: Path, folder: Path) -> None:
    """Copy what the tests need; kernels that are compiled already come with it."""
    for part in PARTS:
        if (root / part).is_dir():
            shutil.copytree(root / part, folder / part, ignore=shutil.ignore_patterns("_build", ".*"))
        elif (root / part).is_file():
            shutil.copy2(root / part, folder / part)


def find_test(folder: Path, name: str) -> str:
    """Return the path of a test file, wherever it stands under tests/."""
    found = sorted((folder / "tests").rglob(name))
    if len(found) != 1:
        raise Invalid(f"{len(found)} files under tests/ are called {name}")
    return str(found[0].relative_to(folder))


def in_fork(folder: Path, arguments: list[str], compiled: bool, output: str) -> None:
    """Run pytest on a copy in this process, which is a fork, with its output in a file; exit with its code."""
    with open(output, "w") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(folder / "src")
    sys.path[0] = str(folder / "src")
    if not compiled:
        os.environ["ARMSIGHT_KERNELS"] = "python"
    from armsight import errors

    if not Path(errors.__file__).is_relative_to(folder):
        print(f"Python imports {errors.__file__}, not the copy")
        sys.exit(pytest.ExitCode.USAGE_ERROR)
    quiet = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # that hypothesis is imported already
    sys.exit(pytest.main(["-x", "-q", "--tb=no", "-p", "no:cacheprovider", *quiet, *arguments]))


def run_tests(folder: Path, mutant: Mutant) -> tuple[int, str, float]:
    """Run a mutant's tests in a copy; return pytest's exit code, its first failure or its last line, and the time, s."""
    arguments = [find_test(folder, mutant.test), *(["-k", mutant.choose] if mutant.choose else [])]
    output, start = folder / "pytest.txt", time.monotonic()
    fork = multiprocessing.get_context("fork").Process(
        target=in_fork, args=(folder, arguments, mutant.compiled, str(output))
    )
    fork.start()
    fork.join(LONGEST_S)
    seconds = time.monotonic() - start
    if fork.is_alive():
        fork.kill()
        fork.join()
        return 1, f"no end after {LONGEST_S:.0f} s", seconds
    said, code = output.read_text(), fork.exitcode or 0
    failed = re.search(r"^(?:FAILED|ERROR) (?:\S*/)?(\S+?::[^\n]*?)(?: - |$)", said, re.MULTILINE)
    if failed:
        return code, failed.group(1), seconds
    # A test that failed, or could not be set up, stands in the summary; what broke before did not kill the mutant.
    return code and 2, (said.strip().splitlines() or ["pytest said nothing"])[-1], seconds


def mutated(folder: Path, mutant: Mutant) -> str:
    """Return what the file contains with the mutant."""
    path = folder / mutant.file
    if not path.is_file():
        raise Invalid(f"there is no file {mutant.file}")
    text = path.read_text()
    if text.count(mutant.text) != 1:
        raise Invalid(f"{mutant.text!r} stands {text.count(mutant.text)} times in {mutant.file}")
    return text.replace(mutant.text, mutant.becomes)


def evaluate(folder: Path, mutant: Mutant) -> Outcome:
    """Run a mutant's tests in a copy with the mutant in it; the file is then as it was, its time too."""
    path, changed = folder / mutant.file, mutated(folder, mutant)
    if mutant.compiled and "armsight.kernels" in changed:
        raise Invalid(f"{mutant.file} has kernels, and those that call them would run the code as it was")
    kept = path.with_suffix(".kept")
    shutil.copy2(path, kept)
    path.write_text(changed)
    try:
        code, by, seconds = run_tests(folder, mutant)
    finally:
        kept.replace(path)
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()
    return Outcome(mutant.name, {0: "survived", 1: "killed"}.get(code, "invalid"), "" if code == 0 else by, seconds)


def require_passing(folder: Path, mutant: Mutant, passing: set[tuple[str, str]]) -> None:
    """Make sure, once for every choice of tests, that they pass without the mutant."""
    if (mutant.test, mutant.choose) in passing:
        return
    code, by, _ = run_tests(folder, mutant)
    if code:
        raise Invalid(f"its tests do not pass without it: {by}")
    passing.add((mutant.test, mutant.choose))


def run(mutants: tuple[Mutant, ...], root: Path, folder: Path) -> list[Outcome]:
    """Evaluate mutants of a checkout one after the other, in a copy in a folder."""
    if not (folder / "src").exists():
        copy_checkout(root, folder)
    for name in SHARED:
        importlib.import_module(name)
    passing: set[tuple[str, str]] = set()
    outcomes = []
    for mutant in mutants:
        try:
            require_passing(folder, mutant, passing)
            outcome = evaluate(folder, mutant)
        except Invalid as error:
            outcome = Outcome(mutant.name, "invalid", str(error), 0.0)
        print(f"{outcome.name:24} {outcome.state:9} {outcome.seconds:5.0f} s  {outcome.by}", flush=True)
        outcomes.append(outcome)
    return outcomes


def show(mutants: tuple[Mutant, ...], root: Path) -> bool:
    """Print the table; return whether every text stands in its file exactly once and every test file is there."""
    good = True
    for m in mutants:
        tests = m.test + (f" -k '{m.choose}'" if m.choose else "")
        print(f"{m.name:24} {m.kind:12} {m.file}\n    - {m.text}\n    + {m.becomes}\n    {tests}")
        try:
            mutated(root, m)
            find_test(root, m.test)
        except Invalid as error:
            print(f"    INVALID: {error}")
            good = False
    return good


def main(mutants: tuple[Mutant, ...] = MUTANTS, root: Path = ROOT) -> int:
    """Evaluate the mutants that the command line names, or all."""
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
        return 0 if show(chosen, root) else 2
    with tempfile.TemporaryDirectory() as temporary:
        outcomes = run(chosen, root, Path(temporary).resolve())
    states = [outcome.state for outcome in outcomes]
    print(f"{states.count('killed')} of {len(states)} killed, {states.count('survived')} survived")
    if asked.json:
        records = [known[outcome.name]._asdict() | outcome._asdict() for outcome in outcomes]
        asked.json.write_text(json.dumps(records, indent=2) + "\n")
    return 2 if "invalid" in states else int("survived" in states)


if __name__ == "__main__":
    sys.exit(main())
