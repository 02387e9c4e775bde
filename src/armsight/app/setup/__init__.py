"""``armsight setup``: walk through the page of an arm in the terminal.

In: an arm's name. Out: the commands of its page (``docs/arms/``), one after the other with this computer's cameras and
port, and a file that says how far it came.

- ``steps.py``: the commands of every page, which a test holds against the pages. ``finding.py``: the port by unplugging,
  the cameras by covering. ``walk.py``: one step after the other.
"""
