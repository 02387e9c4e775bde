"""What only a process that has compiled nothing yet can show: whether a warm-up compiles all that is called afterwards."""

import os
import subprocess
import sys

from numba.core.dispatcher import Dispatcher


def compiled():
    """How many kinds of arguments each of the project's compiled functions has been compiled or loaded for."""
    return {
        (name, key): len(value.signatures)
        for name, module in list(sys.modules.items())
        if name.startswith("armsight.")
        for key, value in vars(module).items()
        if isinstance(value, Dispatcher)
    }


def run_fresh(module, function):
    """Call a function of a test module in a new process, which must end well; returns what it printed."""
    done = subprocess.run(
        [sys.executable, "-c", f"import {module}; {module}.{function}()"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
