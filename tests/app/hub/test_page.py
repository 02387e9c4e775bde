"""The commands of docs/howto/cells.md as they stand there, for one cell in place of twelve."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[3] / "docs/howto/cells.md"


@pytest.fixture
def shell(tmp_path, quick_demo, port):
    """Return what runs lines in a fresh folder with the run of ``armsight demo --quick``, and the page's address.

    The ports are free ones and the replay is as fast as it can be; what the lines started ends with the test.
    """
    (tmp_path / "demo").mkdir()
    for name in ("run.mcap", "summary.json"):
        shutil.copy(quick_demo / "demo" / name, tmp_path / "demo")
    with socket.create_server(("127.0.0.1", 0)) as found:
        http = f"127.0.0.1:{found.getsockname()[1]}"
    changes = {
        "    armsight demo --quick\n": "",
        "{1..12}": "{1..1}",
        "--rate 0.2 ": "",
        ":7447 --keys site-keys": f":{port} --keys site-keys --http {http}",
        "hub keys lab": f"hub keys lab --hub 127.0.0.1:{port}",
    }
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    began = []

    def lines(text):
        """Return what the lines print until the shell ends; those in its background go on."""
        for old, new in changes.items():
            text = text.replace(old, new)
        with (tmp_path / "said").open("w+") as said:
            began.append(
                subprocess.Popen(
                    ["bash", "-ec", text], cwd=tmp_path, env={**os.environ, "PATH": path}, stdout=said, stderr=said,
                    start_new_session=True,
                )
            )  # fmt: skip
            began[-1].wait(100)
            said.seek(0)
            return said.read()

    yield lines, http
    for each in began:
        try:
            os.killpg(each.pid, signal.SIGTERM)
        except ProcessLookupError:
            continue


def test_the_page_s_commands_make_a_cell_an_archive_and_a_report(shell, wait):
    begin, end = re.findall(r"(?:^    \S.*\n)+", PAGE.read_text().partition("## Try it")[2], re.MULTILINE)[:2]
    lines, http = shell
    lines(begin)

    def levels():
        try:
            with urllib.request.urlopen(f"http://{http}/state", timeout=5) as answer:
                return {cell["name"]: cell["level"] for cell in json.load(answer)["cells"]}
        except urllib.error.URLError:
            return {}

    wait(lambda: levels() == {"table-1": -1}, 100)
    said = lines(end)
    assert "1 runs are in archive now" in said, said
    assert "1 cells, up to 1 runs each" in said
