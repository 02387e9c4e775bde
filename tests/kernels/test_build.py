"""Kernels as they come compiled: what a call may hand over, results against the same functions as plain Python, memory."""

import contextlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from armsight import open_arm
from armsight.errors import ArmsightError
from armsight.geometry import matrix
from armsight.geometry.pose import exp_se3
from armsight.kernels import decorator
from armsight.loop.estimators import ArmEstimate, Innovation, Mounting, Outcome, Prior
from armsight.loop.estimators.armerror import layout
from armsight.loop.estimators.clock import ClockFollower
from armsight.loop.estimators.errormodel import ErrorModel, ErrorState, smoothed_anew
from armsight.loop.estimators.readings import Smoothed
from armsight.loop.servo import LoopTiming, PoseServo
from armsight.robot.kinematics import chain, structure
from armsight.robot.trajectories import Tabled, point_to_point
from armsight.vision import camera, match, normal
from armsight.vision.dense import cost, scanline, semiglobal

compiled = pytest.mark.skipif(decorator.in_python(), reason="kernels run as plain Python")
GREY = np.zeros((16, 64), np.uint8)
TABLE, Q, T = open_arm("ur5").table, np.zeros(6), np.zeros((4, 4))


def locked(array):
    array = array.copy()
    array.flags.writeable = False
    return array


REJECTED = {  # (kernel, arguments, number of the first that does not fit)
    "numbers of another size": (chain.forward, (TABLE, Q.astype(np.float32), T), 2),
    "integers for floats": (chain.forward, (TABLE, Q.astype(np.int64), T), 2),
    "signed for unsigned": (cost.census, (np.zeros((9, 9), np.int8), 1, np.zeros((3, 3, 3), np.uint8)), 1),
    "another byte order": (chain.forward, (TABLE, Q.astype(">f8"), T), 2),
    "complex numbers": (chain.forward, (TABLE, Q.astype(complex), T), 2),
    "too few dimensions": (chain.forward, (TABLE, Q, T[0]), 3),
    "too many dimensions": (chain.forward, (TABLE, Q[None], T), 2),
    "a column": (chain.forward, (TABLE, np.zeros((6, 2))[:, 0], T), 2),
    "columns in place of rows": (chain.forward, (TABLE, Q, T.T), 3),
    "reversed": (chain.forward, (TABLE, Q[::-1], T), 2),
    "only read where the kernel writes": (chain.forward, (TABLE, Q, locked(T)), 3),
    "a list": (chain.forward, (TABLE, [0.0] * 6, T), 2),
    "None": (chain.forward, (TABLE, None, T), 2),
    "a float for an integer": (chain.forward_batch, (TABLE, Q[None], T[None], np.zeros(chain.BATCH_WORK), 8.0), 5),
    "an integer beyond 64 bits": (chain.forward_batch, (TABLE, Q[None], T[None], np.zeros(chain.BATCH_WORK), 2**63), 5),
    "an integer beyond its byte": (
        semiglobal._strip,
        (cost.prepare(GREY, GREY, 32), 0, 1, 0, 16, 5, 64, 300, np.zeros(256, np.uint8), None),
        8,
    ),
    "text for a float": (chain.angle_of, (1.0, "1"), 2),
    "too few arguments": (chain.forward, (TABLE, Q), 3),
    "too many arguments": (chain.forward, (TABLE, Q, T, T), 4),
    "none at all": (chain.forward, (), 1),
}


@compiled
@pytest.mark.parametrize(("kernel", "arguments", "number"), REJECTED.values(), ids=REJECTED)
def test_what_does_not_fit_the_signature_is_rejected_by_kernel_and_argument(kernel, arguments, number):
    name = re.escape(f"{kernel.__module__}.{kernel.__name__}: argument {number} ")
    with pytest.raises(TypeError, match=name):
        kernel(*arguments)


@compiled
def test_named_arguments_are_rejected():
    with pytest.raises(TypeError, match=r"chain\.angle_of: a kernel takes no named arguments"):
        chain.angle_of(y=1.0, x=1.0)


@compiled
def test_what_fits_is_taken():
    assert chain.angle_of(1, np.float32(0)) == chain.angle_of(1.0, 0.0)
    assert chain.forward(locked(TABLE), Q, T) == chain.GOOD
    assert chain.jacobian(TABLE, Q, np.True_, np.zeros((6, 6))) == chain.GOOD
    batch = TABLE, np.zeros((0, 6)), np.zeros((0, 4, 4)), np.zeros(chain.BATCH_WORK)
    assert chain.forward_batch(*batch, np.int32(8)) == chain.GOOD


@compiled
def test_a_call_holds_none_of_its_arguments():
    q, number = np.zeros(6), 2**40
    for arguments in ((TABLE, q, T), (TABLE, q, None)):  # the second is rejected when q was already looked at
        before = sys.getrefcount(q)
        with contextlib.suppress(TypeError):
            chain.forward(*arguments)
        assert sys.getrefcount(q) == before
    before = sys.getrefcount(number)
    scanline.seen(np.zeros((1, 1), np.int16), number)
    assert sys.getrefcount(number) == before


@compiled
def test_a_kernel_without_a_signature_refuses_a_call_from_python():
    with pytest.raises(TypeError, match=r"chain\.store has no signature: only kernels call it"):
        chain.store((), T)


@compiled
def test_kernels_keep_name_and_text_of_their_function():
    assert chain.sincos.__name__ == repr(chain.sincos) == "sincos"
    assert chain.sincos.__doc__.startswith("Return sin(x), cos(x)")
    assert chain.sincos.__wrapped__(0.0) == (0.0, 1.0)


@compiled
def test_a_module_that_was_edited_since_is_rejected_with_the_command_to_run():
    """All that the compiled code holds: a module whose kernels only kernels call, and one that constants come from."""
    sources = dict(decorator._library().sources())
    decorator._check_not_stale(sources.items())
    for module in (chain, matrix, structure):
        with pytest.raises(ArmsightError, match=rf"{module.__name__.split('.')[-1]}\.py has changed .*kernels\.build"):
            decorator._check_not_stale((sources | {module.__name__: "0:0"}).items())
        with pytest.raises(ArmsightError, match="has changed"):  # as a build of before has it
            decorator._check_not_stale([(module.__name__, "0" * 8)])
    _, code = sources[chain.__name__].split(":")
    decorator._check_not_stale([(chain.__name__, f"0:{code}")])  # only comments or docstrings differ


def test_comments_docstrings_and_layout_leave_a_files_code_as_it_is(tmp_path):
    before, same, other = (tmp_path / name for name in ("before.py", "same.py", "other.py"))
    before.write_text('"""A module."""\ndef double(x):\n    """Return 2 x."""\n    return 2 * x\n')
    same.write_text("def double(x):  # twice\n    return (\n        2 * x)\n")
    other.write_text("def double(x):\n    return 3 * x\n")
    assert decorator.code_digest(before) == decorator.code_digest(same) != decorator.code_digest(other)


@compiled
def test_kernels_are_built_where_none_of_the_requirements_is_installed():
    program = """
import importlib.abc, sys
import llvmlite, numba, numpy
from armsight.kernels import build

class Bare(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in ("armsight", "llvmlite", "numba", "numpy", *sys.stdlib_module_names):
            stand_in = sys.meta_path[-1]
            if not isinstance(stand_in, build._Absent):
                raise ModuleNotFoundError(name)
            return stand_in.find_spec(name)

sys.meta_path.insert(0, Bare())
for path in build.kernel_modules():
    build.import_alone(build.module_name(path))
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert not ran.returncode, ran.stderr


def test_a_function_that_was_not_compiled_is_rejected_with_the_command_to_run():
    with pytest.raises(
        ArmsightError, match=r"test_build\.locked is not compiled; .* python -m armsight\.kernels\.build"
    ):
        decorator.kernel("f8")(locked)


def results():
    """Call some kernels: scalars, tuples, batches, bytes, an array that is made; return what they give and write."""
    rng = np.random.default_rng(1)
    done = {"sincos": [chain.sincos(x) for x in rng.uniform(-9, 9, 50)]}
    done["angle_of"] = [chain.angle_of(y, x) for y, x in rng.normal(size=(50, 2))]
    done["edge"] = [normal.edge(u, s, 1.1) for u, s in rng.uniform(0.3, 2, (50, 2))]
    poses = np.empty((11, 4, 4))
    done["valid"] = chain.forward_batch(TABLE, rng.uniform(-3, 3, (11, 6)), poses, np.empty(chain.BATCH_WORK), 8)
    rays = [np.append(rng.normal(size=(9, 2)), np.ones((9, 1)), axis=1) for _ in "lr"]
    gaps = np.empty((9, 2))
    match._gaps(*rays, poses[0], np.full((2, 2), 700.0), gaps)
    k, d = np.array([700.0, 710.0, 320.0, 240.0]), np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0])
    unprojected = np.empty((9, 3))
    camera._unproject(False, k, d, rng.uniform(0, 480, (9, 2)), unprojected)
    image = rng.integers(0, 255, (12, 16), dtype=np.uint8)
    words, low, high = np.zeros((3, 8, 12), np.uint8), *np.zeros((2, 8, 12), np.uint8)
    cost.census(image, 1, words)
    cost._half_way(image, low, high)
    done |= {"poses": poses, "gaps": gaps, "unprojected": unprojected, "words": words, "low": low, "high": high}
    done["seen"] = scanline.seen(rng.integers(-1, 6, (8, 12), dtype=np.int16), 1)
    done |= from_image_to_command(rng)
    return {name: np.asarray(value) for name, value in done.items()}


class Imagined:
    """An estimator for a servo."""

    def __init__(self, model, state, step, joints):
        self.parts = model, state, step, joints
        T, cov, own = (each[0] for each in model.tracked(state, step, joints))
        self.now = ArmEstimate(0.0, T, cov, own * 1e-6, joints.q[0], 0.0 * joints.qd[0], 0.01)
        self.cov, self.own = cov, own

    def estimate(self):
        return self.now

    def tool(self, q, qd, *, pressed=False):
        model, state, step, joints = self.parts
        return model.imagined(state, step, joints, q, qd, np.arange(6) < 3 * pressed)


def from_image_to_command(rng):
    """Carry a pose to the tool, update a filter by it, follow the clock, make a command; return what came of each."""
    arm = open_arm("ur5")
    n, model = layout(6).size, ErrorModel(arm, Prior(), 2e-4)
    joints = Smoothed(*(rng.uniform(0.1, 0.3, (1, *shape)) for shape in ((6,),) * 4 + ((3, 6), (6,), (2, 6))))
    root = rng.normal(size=(n, n))
    state = ErrorState(0.0, 1e-3 * rng.normal(size=n), 1e-4 * (np.eye(n) + root @ root.T / n), joints, None)
    state = smoothed_anew(state, joints._replace(unseen=0.5 * joints.unseen))
    step = model.moved(state, joints._replace(travel=joints.travel + 0.01), np.array([0.1]))
    T, cov = arm.forward(joints.q[0]) @ exp_se3(0.01 * rng.normal(size=6)), 1e-2 * np.eye(6)
    seen = SimpleNamespace(T_left_body=T, cov_noise=cov, cov=cov + 1e-3 * np.eye(6))
    seen = Mounting(exp_se3(1e-3 * np.ones(6)), np.eye(4), 1e-3 * np.eye(12)).pose_measurement(seen, 0.02)
    at, chi_square = model.predicted(state, step, joints, seen, 1e-2)
    done = {f"predicted {name}": value.copy() for name, value in at._asdict().items()} | {"chi_square": chi_square}
    gain, _, _ = model.updated(at, joints, seen, 1e-2, learns_delay=False)
    clock = ClockFollower(n, n - 1, 1e-3)
    for t_s in (0.0, 0.1):
        clock.take(Innovation(t_s, T, at.z, at.S, at.H, step.kept[0], gain, Outcome.USED))
    done |= {"gain": gain, "x": at.x, "P": at.P, "clock": [*clock._b, *clock._M.ravel(), *clock._V.ravel()]}
    servo = PoseServo(arm, LoopTiming(0.004, 1 / 60, 0.02))
    estimator = Imagined(model, state._replace(pose_measurement=seen), step, joints)
    path = Tabled(point_to_point(arm, joints.q[0], joints.q[0] + 0.1))
    for k in range(3):
        aim = servo.aim(path, 0.004 * k)
        command = servo.step(aim, estimator)
    moved = 0.004 * command.command.qd_ref  # in a period: a speed has the roundings of angles over so short a time
    done |= {"tool": estimator.now.T_base_tool, "cov": estimator.cov, "own": estimator.own}
    return done | {"q_ref": command.command.q_ref, "moved": moved, "error": command.error}


@compiled
def test_compiled_kernels_give_what_python_gives(tmp_path):
    script = f"import numpy, test_build; numpy.savez({str(tmp_path / 'python.npz')!r}, **test_build.results())"
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "ARMSIGHT_KERNELS": "python", "PYTHONPATH": path}, check=True
    )
    slow, fast = np.load(tmp_path / "python.npz"), results()
    assert set(slow.files) == set(fast)
    for name, value in fast.items():
        assert value.dtype == slow[name].dtype
        # Some hundred roundings of numbers below 10, and a difference over some milliseconds; integers are equal.
        np.testing.assert_allclose(
            value, slow[name], rtol=2e-14, atol=1e-12 if name == "qd_ref" else 2e-14, err_msg=name
        )


def resident():
    """Bytes of memory that this process has now; its maximum, which getrusage has, is that of the tests before."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("this system does not say how much memory a process has now")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@compiled
def test_an_array_that_a_kernel_makes_is_python_s_own_and_is_freed():
    d = np.zeros((32, 32), np.int16)
    made = scanline.seen(d, 0)
    assert made.flags.writeable
    assert made.flags.c_contiguous
    made[:] = False
    assert scanline.seen(d, 0).all()
    for _ in range(1000):
        scanline.seen(d, 0)
    before = resident()
    for _ in range(100_000):
        scanline.seen(d, 0)
    # Were one of the call's objects kept, the array (1 kB), its bytes or its shape, it would be 5 MB at the least.
    assert resident() - before < 3e6


@compiled
def test_a_rejected_call_keeps_nothing():
    before = resident()
    for _ in range(100_000):
        with pytest.raises(TypeError):
            chain.forward(TABLE, Q, None)
    assert resident() - before < 3e6
