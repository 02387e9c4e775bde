"""Functions in a child process: arrays and errors come back, and its end is an error that says so."""

import operator
import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from armsight.errors import ArmsightError, InputError
from armsight.files import read_text
from armsight.processes import Process, caller


@pytest.fixture(scope="module")
def call():
    process = Process(caller)
    yield process
    process.close()


@pytest.mark.parametrize("count", [3, 1_000_000])  # within the pickle, and beside it
def test_arrays_go_there_and_come_back(call, count):
    numbers = np.arange(count, dtype=float)
    doubled = call(operator.mul, numbers, 2.0)
    assert doubled.tobytes() == (2.0 * numbers).tobytes()
    doubled[0] = 1.0  # it is the caller's own


def test_what_the_function_raises_is_raised_here_and_the_next_call_is_answered(call, tmp_path):
    with pytest.raises(InputError, match=r"missing\.json: no such file"):
        call(read_text, tmp_path / "missing.json")
    assert call(operator.add, 1, 2) == 3
    assert call(os.getpid) != os.getpid()


def test_what_making_the_function_raises_answers_every_call():
    process = Process(caller, "armsight.nowhere")
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="nowhere"):
            process(abs, -1)
    process.close()
    process.close()


def test_a_child_that_ended_is_an_error():
    process = Process(caller)
    with pytest.raises(ArmsightError, match="has ended"):
        process(os._exit, 3)
    with pytest.raises(ArmsightError, match="has ended"):
        process(abs, -1)
    process.close()


def test_a_call_that_nobody_waits_for_any_more_is_ended():
    process = Process(caller)
    assert process(abs, -1) == 1
    with ThreadPoolExecutor(1) as beside:
        called = beside.submit(process, time.sleep, 600.0)
        process.kill()
        with pytest.raises(ArmsightError, match="has ended"):
            called.result()
    process.close()
