"""Run the commands of the tutorials in order, and keep the pictures that their pages show.

    python docs/run_tutorials.py docs/_made

Every line of a ``console`` block that begins with ``$`` is a command; it ends where the next such line or the block ends. A
comment before a block says how it runs:

- ``<!-- run: no -->``: needs a device or is the user's own; not run.
- ``<!-- run: shared -->``: expensive, and the same on several pages: run once in a folder of its own, whose contents are
  then linked into the folder of every page that has it.

All other blocks run in the page's own folder. A picture ``_made/PAGE/FILE`` of a page is FILE in that folder after its
commands have run. A page whose commands, and the program behind them, have not changed is not run again.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
#: Pages whose commands are run: the first steps, then the tutorials in their order, then the pages of arms.
PAGES = (
    "start",
    "tutorials/calibrate_two_webcams",
    "tutorials/measure_a_tag_plate",
    "tutorials/close_the_loop",
    "tutorials/identify_an_arm",
    "tutorials/iso9283_test",
    "arms/so101",
    "arms/ur",
    "arms/xarm",
    "arms/franka",
    "arms/another_arm",
)
_BLOCK = re.compile(r"(?:<!-- run: (?P<how>\w+) -->\n)?^```console\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
_PICTURE = re.compile(r"\((?:\.\./)?_made/(?P<page>\w+)/(?P<file>[^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A console block: its commands, and how they run (``here``, ``shared`` or ``no``)."""

    commands: tuple[str, ...]
    how: str


def text_of(page: str) -> str:
    """Return the text of a page."""
    return (DOCS / f"{page}.md").read_text(encoding="utf-8")


def blocks(page: str) -> list[Block]:
    """Return the console blocks of a page, in order."""
    found = []
    for match in _BLOCK.finditer(text_of(page)):
        parts = re.split(r"^\$ ", match["text"], flags=re.MULTILINE)[1:]
        found.append(Block(tuple(part.rstrip("\n") for part in parts), match["how"] or "here"))
    return found


def pictures(page: str) -> list[tuple[str, str]]:
    """Return the pictures that a page shows from its run: page's short name, and file in its folder."""
    return [(match["page"], match["file"]) for match in _PICTURE.finditer(text_of(page))]


def execute(command: str, folder: Path) -> str:
    """Run a command in a folder with this Python's programs first on the path; return what it printed.

    Raises:
        RuntimeError: its exit code is not 0; the message has what it printed.
    """
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", command],
        cwd=folder,
        env={**os.environ, "PATH": path, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"$ {command}\nexit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


class Runner:
    """Runs pages below a folder; shared blocks once for all of them.

    Args:
        folder: an existing folder; each page gets one of its short name, shared blocks get ``shared``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._shared = folder, folder / "shared"
        self._done: set[tuple[str, ...]] = set()

    def run(self, page: str) -> Path:
        """Run a page's commands in order and return the folder they ran in."""
        here = self._begin(self.folder / page.rpartition("/")[2])
        for block in blocks(page):
            if block.how == "shared":
                self._run_shared(block)
                for made in self._shared.iterdir():
                    if not (here / made.name).exists():
                        (here / made.name).symlink_to(made)
            elif block.how == "here":
                for command in block.commands:
                    execute(command, here)
        return here

    def take(self, commands: tuple[str, ...], made: Path) -> None:
        """Take what a shared block's commands have made in another folder, instead of running them."""
        self._begin(self._shared)
        for each in made.iterdir():
            (self._shared / each.name).symlink_to(each)
        self._done.add(commands)

    def _run_shared(self, block: Block) -> None:
        if block.commands not in self._done:
            self._begin(self._shared)
            for command in block.commands:
                execute(command, self._shared)
            self._done.add(block.commands)

    def _begin(self, folder: Path) -> Path:
        """Make a folder in which commands run as in a clone: the examples are there."""
        folder.mkdir(exist_ok=True)
        if not (folder / "examples").exists():
            (folder / "examples").symlink_to(ROOT / "examples")
        return folder


def state_of(page: str) -> str:
    """Return a hash of what a page's run depends on: its commands and pictures, and the program's sources."""
    total = hashlib.sha256(repr((blocks(page), pictures(page))).encode())
    for folder in ("src", "firmware", "examples"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".c", ".h", ".toml", ".xml") and "built" not in path.parts:
                total.update(path.read_bytes())
    return total.hexdigest()


def main(made: Path) -> None:
    """Run the pages that changed, and keep their pictures in a folder."""
    made.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        runner = Runner(Path(name))
        for page in PAGES:
            mark, state = made / page.rpartition("/")[2] / "run.sha256", state_of(page)
            if mark.exists() and mark.read_text(encoding="utf-8") == state:
                continue
            print(f"running {page}", flush=True)
            folder = runner.run(page)
            for short, file in pictures(page):
                kept = made / short / file
                kept.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile((folder if short == mark.parent.name else runner.folder / short) / file, kept)
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.write_text(state, encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python docs/run_tutorials.py FOLDER")
    main(Path(sys.argv[1]).resolve())
