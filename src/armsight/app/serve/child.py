"""The next process of a service: it has imported what ``armsight measure`` needs, and waits for a line with its arguments.

Imports are most of what a start takes (0.65 of 1.1 s of processor time until the first shot), and more on a busy computer.
"""

import json
import sys

from armsight import __main__
from armsight.app import main
from armsight.app.measure import run
from armsight.app.stream import streams

__all__ = ["main", "run", "streams"]  # imported before they are needed

if __name__ == "__main__" and (line := sys.stdin.readline()):  # nothing: the service has ended
    sys.argv[1:] = json.loads(line)
    __main__.main()
