"""A method is compiled by another process, and this one only reads what that left."""

import os
import subprocess
import sys


def test_the_second_process_compiles_nothing(tmp_path):
    code = (
        "from numba.core import event\n"
        "from armsight.app.dense.run import compile_apart, compile_method\n"
        "compile_apart('block')\n"
        "with event.install_recorder('numba:compile') as seen:\n"
        "    compile_method('block')\n"
        "print(len(seen.buffer))\n"
    )
    settings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"
