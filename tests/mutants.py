"""Forty mutants, small errors made by hand, and whether the tests see each: ``python tests/mutants.py [NAME ...]``.

A mutant is one change of one file: a sign flipped, a matrix transposed, an index off by one, a unit wrong. The
checkout is copied to a temporary folder and never changed. The tests named for a mutant must pass without it and fail
with it. Not part of ``make test``: all forty take about twenty minutes on one core.

    --list           show the table and run nothing
    --json FILE      write one record per mutant

The exit code is 1 where a mutant survives, and 2 where one is invalid: its text does not stand in the file exactly once,
or its tests fail without it.
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
GEOMETRY, VISION, KINEMATICS = "src/armsight/geometry", "src/armsight/vision", "src/armsight/robot/kinematics"
LOOP, HANDEYE, IDENTIFY = "src/armsight/loop", "src/armsight/loop/handeye", "src/armsight/loop/identify"
ESTIMATORS, CORE = "src/armsight/loop/estimators", "firmware/core"


class Mutant(NamedTuple):
    """One change of one file.

    Attributes:
        name: what it is called here.
        kind: "sign", "transposed", "off by one" or "unit".
        file: path from the root of the checkout.
        text: what stands in the file, once.
        becomes: what the mutant has instead.
        test: name of the test file that must fail, looked up under tests/.
        choose: pytest's ``-k`` expression; empty for all tests of the file.
    """

    name: str
    kind: str
    file: str
    text: str
    becomes: str
    test: str
    choose: str = ""


class Outcome(NamedTuple):
    """What became of a mutant.

    Attributes:
        name: of the mutant.
        state: "killed", "survived" or "invalid".
        by: the first test that failed or could not be set up, or why it is invalid.
        seconds: how long its tests ran.
    """

    name: str
    state: str
    by: str
    seconds: float


class Invalid(Exception):
    """The mutant or its tests are not what the table says."""


# fmt: off
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
           "[b, j] - t[b]", "[b, j] + t[b]", "test_match.py"),
    Mutant("match-line", "transposed", f"{VISION}/match.py",
           "line[1, j] += a[i] * E[i, j]", "line[1, j] += a[i] * E[j, i]", "test_match.py"),
    Mutant("match-gate", "unit", f"{VISION}/match.py",
           "np.sqrt(2 * variance)", "(2 * variance)", "test_match.py"),
    Mutant("match-focal", "off by one", f"{VISION}/match.py",
           "intrinsics[:2]", "intrinsics[1:3]", "test_match.py"),
    Mutant("triangulate-midpoint", "sign", f"{VISION}/triangulate.py",
           "(ab * at - bt)", "(ab * at + bt)", "test_triangulate.py", "none or rigs_noise"),
    Mutant("triangulate-weight", "transposed", f"{VISION}/triangulate.py",
           "= C[1, 1] / det, C[0, 0] / det", "= C[0, 0] / det, C[1, 1] / det", "test_triangulate.py", "none or rigs_noise"),
    Mutant("triangulate-by-rig", "off by one", f"{VISION}/triangulate.py",
           "start += 4 + counts[c]", "start += 3 + counts[c]", "test_triangulate.py", "none or rigs_noise"),
    Mutant("triangulate-noise", "unit", f"{VISION}/triangulate.py",
           "1e-6) ** 2 * np.eye(2)", "1e-6) * np.eye(2)", "test_triangulate.py", "none or rigs_noise"),
    Mutant("locate-jacobian", "sign", f"{VISION}/posefit.py",
           "J[i, 3] = J[i, 2] * p[n, 1] - ", "J[i, 3] = J[i, 2] * p[n, 1] + ", "test_posefit.py"),
    Mutant("locate-by-rig", "sign", f"{VISION}/posefit.py",
           "= J_p[i, 1] * q[2] - ", "= J_p[i, 1] * q[2] + ", "test_locate.py", "covers_noise"),
    Mutant("locate-misfit", "unit", f"{VISION}/locate.py",
           "float(np.sqrt(misfit))", "float(misfit)", "test_locate.py", "bad_print"),
    Mutant("pnp-rotation", "transposed", f"{VISION}/pnp.py",
           "(rotation, np.float64).ravel())", "(rotation, np.float64).ravel()).T", "test_pnp.py"),
    Mutant("handeye-adjoint", "transposed", f"{GEOMETRY}/pose.py",
           "skew(T[..., :3, 3]) @ R", "R @ skew(T[..., :3, 3])", "test_handeye.py"),
    Mutant("handeye-derivative", "sign", f"{HANDEYE}/handeye.py",
           "np.eye(6) + 0.5 *", "np.eye(6) - 0.5 *", "test_handeye.py"),
    Mutant("handeye-start", "transposed", f"{HANDEYE}/handeye.py",
           "nij,nkl->ikjl", "nji,nkl->ikjl", "test_handeye.py"),
    Mutant("handeye-offset", "unit", f"{HANDEYE}/streams.py",
           "@ late[good]) / SPEED_S", "@ late[good])", "test_handeye_streams.py"),
    Mutant("identify-chain", "sign", f"{IDENTIFY}/model.py",
           "c * v - s * u", "c * v + s * u", "test_identify_model.py"),
    Mutant("identify-residual", "transposed", f"{IDENTIFY}/model.py",
           "back = measured.R_rig_body.swapaxes(1, 2)", "back = measured.R_rig_body", "test_identify_model.py"),
    Mutant("identify-joints", "off by one", f"{IDENTIFY}/joint_noise.py",
           ".OFFSET :", ".OFFSET + 1 :", "test_identify_arm.py", "spoils_only"),
    Mutant("identify-prior", "sign", f"{IDENTIFY}/fit.py",
           "J.T @ e + pull *", "J.T @ e - pull *", "test_identify_arm.py", "perfect"),
    Mutant("identify-noise", "unit", f"{IDENTIFY}/joint_noise.py",
           "= sigma_rad**2 +", "= sigma_rad +", "test_identify_arm.py", "spoils_only"),
    Mutant("kinematics-jacobian", "sign", f"{KINEMATICS}/chain.py",
           "= zy * rz - zz * ry,", "= zy * rz + zz * ry,", "test_forward.py"),
    Mutant("kinematics-tool-axes", "transposed", f"{KINEMATICS}/chain.py",
           "= F[0] * x + F[1] * y + F[2] * z", "= F[0] * x + F[3] * y + F[6] * z", "test_forward.py"),
    Mutant("kinematics-elbow", "sign", f"{KINEMATICS}/closed.py",
           "- upper * upper - fore * fore)", "- upper * upper + fore * fore)", "test_inverse.py", "known_one"),
    Mutant("kinematics-whole-turn", "off by one", f"{KINEMATICS}/inverse.py",
           "np.floor((goal - q)", "1.0 + np.floor((goal - q)", "test_inverse.py", "near_sorts"),
    Mutant("kinematics-reach", "unit", f"{KINEMATICS}/closed.py",
           "= math.sqrt(far2),", "= far2,", "test_inverse.py", "known_one"),
    Mutant("servo-gain", "off by one", f"{LOOP}/servo.py",
           "d**d / (d + 1) ** (d + 1)", "d**d / (d + 1) ** d", "test_servo.py", "gain_rule"),
    Mutant("servo-correction", "sign", f"{LOOP}/servo.py",
           "= q_ref - ahead.q", "= ahead.q - q_ref", "test_servo.py", "a_tenth and 30"),
    Mutant("servo-rate", "unit", f"{LOOP}/servo.py",
           "qd_max * period_s, np.maximum(", "qd_max, np.maximum(", "test_servo.py", "within_every_limit"),
    Mutant("estimators-backlash", "sign", f"{ESTIMATORS}/armerror.py",
           "= -0.5 * unseen[0, i]", "= 0.5 * unseen[0, i]", "test_arm_error.py"),
    Mutant("estimators-adjoint", "transposed", f"{ESTIMATORS}/armerror.py",
           "out[row, col] = out[3 + row, 3 + col] =", "out[col, row] = out[3 + col, 3 + row] =", "test_arm_error.py"),
    Mutant("estimators-window", "off by one", f"{ESTIMATORS}/parabola.py",
           'side="right") - 1', 'side="right") - 2', "test_readings.py"),
    Mutant("estimators-jitter", "unit", f"{ESTIMATORS}/kalman.py",
           "jitter_s**2 *", "jitter_s *", "test_kalman.py", "consistent"),
    Mutant("firmware-derivative", "sign", f"{CORE}/pid.c",
           "- gains->kd_s_per_rad *", "+ gains->kd_s_per_rad *", "test_firmware_pid.py"),
    Mutant("firmware-glitch", "off by one", f"{CORE}/pot.c",
           "bad_ticks < confirm_ticks", "bad_ticks <= confirm_ticks", "test_firmware_pot.py"),
    Mutant("firmware-current", "unit", f"{CORE}/core.c",
           "* 0.001f;", "* 0.000001f;", "test_firmware_commands.py", "current"),
)
# fmt: on


def copy_checkout(root: Path, folder: Path) -> None:
    """Copy what the tests need, without compiled code."""
    ignored = shutil.ignore_patterns("__pycache__", "_build", ".*")
    for part in PARTS:
        if (root / part).is_dir():
            shutil.copytree(root / part, folder / part, ignore=ignored, dirs_exist_ok=True)
        elif (root / part).is_file():
            shutil.copy2(root / part, folder / part)


def find_test(folder: Path, name: str) -> str:
    """Return the path of a test file, wherever it stands under tests/."""
    found = sorted((folder / "tests").rglob(name))
    if len(found) != 1:
        raise Invalid(f"{len(found)} files under tests/ are called {name}")
    return str(found[0].relative_to(folder))


def environment(folder: Path) -> dict[str, str]:
    """Return the environment in which the copy is what is imported."""
    return os.environ | {"PYTHONPATH": str(folder / "src")}


def require_copy(folder: Path) -> None:
    """Make sure that Python imports the copy, not the installed package."""
    command = [sys.executable, "-c", "import armsight.errors as e; print(e.__file__)"]
    path = subprocess.run(command, cwd=folder, env=environment(folder), capture_output=True, text=True, check=True)
    if not Path(path.stdout.strip()).resolve().is_relative_to(folder.resolve()):
        raise Invalid(f"Python imports {path.stdout.strip()}, not the copy")


def run_tests(folder: Path, mutant: Mutant) -> tuple[int, str, float]:
    """Run a mutant's tests in a copy; return pytest's exit code, its first failure or its last line, and the time, s."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", find_test(folder, mutant.test)]
    command += ["-k", mutant.choose] if mutant.choose else []
    start = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment(folder), capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"no end after {LONGEST_S:.0f} s", time.monotonic() - start
    failed = re.search(r"^(?:FAILED|ERROR) (?:\S*/)?(\S+?::[^\n]*?)(?: - |$)", done.stdout, re.MULTILINE)
    lines = (done.stdout + done.stderr).strip().splitlines()
    if failed:
        return done.returncode, failed.group(1), time.monotonic() - start
    # A test that failed, or could not be set up, stands in the summary; what broke before did not kill the mutant.
    return done.returncode and 2, lines[-1] if lines else "pytest said nothing", time.monotonic() - start


def mutated(folder: Path, mutant: Mutant) -> str:
    """Return what the file contains with the mutant."""
    path = folder / mutant.file
    if not path.is_file():
        raise Invalid(f"there is no file {mutant.file}")
    text = path.read_text()
    if text.count(mutant.text) != 1:
        raise Invalid(f"{mutant.text!r} stands {text.count(mutant.text)} times in {mutant.file}")
    return text.replace(mutant.text, mutant.becomes)


def apply(folder: Path, mutant: Mutant) -> None:
    """Change the file in a copy."""
    path = folder / mutant.file
    path.write_text(mutated(folder, mutant))
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


def evaluate(clean: Path, work: Path, mutant: Mutant) -> Outcome:
    """Run one mutant's tests on a copy of the clean tree, which has the compiled kernels."""
    if work.exists():
        shutil.rmtree(work)
    shutil.copytree(clean, work)
    try:
        apply(work, mutant)
        require_copy(work)
        code, by, seconds = run_tests(work, mutant)
    except Invalid as error:
        return Outcome(mutant.name, "invalid", str(error), 0.0)
    state = {0: "survived", 1: "killed"}.get(code, "invalid")
    return Outcome(mutant.name, state, "" if code == 0 else by, seconds)


def run(mutants: tuple[Mutant, ...], root: Path, folder: Path) -> list[Outcome]:
    """Evaluate mutants of a checkout one after the other, working in a folder."""
    clean, work = folder / "clean", folder / "mutant"
    if not clean.exists():
        copy_checkout(root, clean)
    require_copy(clean)
    passed: dict[tuple[str, str], str] = {}  # why the unmutated tests do not pass, empty where they do
    outcomes = []
    for mutant in mutants:
        selection = (mutant.test, mutant.choose)
        if selection not in passed:
            try:
                code, by, _ = run_tests(clean, mutant)
                passed[selection] = f"its tests do not pass without it: {by}" if code else ""
            except Invalid as error:
                passed[selection] = str(error)
        reason = passed[selection]
        outcome = Outcome(mutant.name, "invalid", reason, 0.0) if reason else evaluate(clean, work, mutant)
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
        outcomes = run(chosen, root, Path(temporary))
    states = [outcome.state for outcome in outcomes]
    print(f"{states.count('killed')} of {len(states)} killed, {states.count('survived')} survived")
    if asked.json:
        records = [known[outcome.name]._asdict() | outcome._asdict() for outcome in outcomes]
        asked.json.write_text(json.dumps(records, indent=2) + "\n")
    return 2 if "invalid" in states else int("survived" in states)


if __name__ == "__main__":
    sys.exit(main())
