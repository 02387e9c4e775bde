"""One step after the other: what this computer calls things goes into the commands, and what is done into a file."""

from __future__ import annotations

import contextlib
import itertools
import json
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import click

from armsight.app.main import run
from armsight.app.setup import finding
from armsight.app.setup.steps import ARMS, CAMERAS, PLATE, PORT, SetupStep
from armsight.app.show.messages import UNTRUSTED
from armsight.errors import InputError
from armsight.files import as_input_error, read_json, write_text

FILE = Path("setup.json")
INTERRUPTED = 130


@dataclass
class SetupWalk:
    """An arm's steps on this computer."""

    arm: str
    words: dict[str, str] = field(default_factory=dict)  #: what the page says -> what is so here
    done: dict[str, str] = field(default_factory=dict)  #: commands of the page -> done, or left out
    simulated: str = ""  #: how the emulated board is called; empty with an arm

    @classmethod
    def open(cls, arm: str, begin: int | None, simulated: bool = False) -> SetupWalk:
        """Return the walk that the folder remembers, or a new one; ``begin``: from which step, from 1."""
        kept, was = cls(arm), simulated
        if FILE.exists():
            with as_input_error(
                f"{FILE}: not written by `armsight setup`: move it away", TypeError, KeyError, ValueError
            ):
                found = read_json(FILE)
                kept = cls(str(found["arm"]), dict(found["words"]), dict(found["done"]))
                was = bool(found.get("simulated", False))
        if kept.arm != arm:
            raise InputError(f"{FILE}: this folder is of {kept.arm}: take another folder for {arm}")
        if was != simulated:
            raise InputError(f"{FILE}: this folder is of a {'simulated' if was else 'real'} arm: take another folder")
        again = [step.command for step in ARMS[arm][begin - 1 :]] if begin is not None else []
        kept.done = {command: state for command, state in kept.done.items() if command not in again}
        return kept

    def typed(self, step: SetupStep) -> str:
        """Return the command of a step as it is typed here."""
        command = step.command
        if self.simulated:
            kind = next((each for each in finding.KINDS if f"{each}{PORT}" in command), "")
            command = command.replace(f"{kind}{PORT}", "emulated:" if command.startswith("run ") else self.simulated)
        for old, new in self.words.items():
            command = command.replace(old, new)
        return " ".join(filter(None, (command, step.simulated if self.simulated else "")))

    def find(self, step: SetupStep, say: Callable[[str], None]) -> bool:
        """Find what a step needs of this computer and its person; whether the step can be done."""
        if CAMERAS in step.command and CAMERAS not in self.words:
            self.words[CAMERAS] = finding.find_left_and_right(lambda text: _asked(f"{text}, then press Enter"))
            say(f"cameras: {self.words[CAMERAS]}")
        if PORT in step.command and PORT not in self.words and not self.simulated:
            port = finding.find_port(say)
            kind = next(each for each in finding.KINDS if f"{each}{PORT}" in step.command)
            finding.check_arm(f"{kind}{port}")
            self.words[PORT] = port
            say(f"port: {port}")
        if step.given and step.given not in self.words and not set(dict(step.without)) & set(self.words):
            file = "" if self.simulated else _asked(f"your file {step.given} (Enter: there is none)")
            path = Path(file).expanduser()
            if file and not path.exists():
                raise InputError(f"{file}: no such file")
            self.words |= {step.given: shlex.quote(str(path))} if file else dict(step.without)
        return not step.given or step.given in self.words or step.given not in self.typed(step)

    def go(self, say: Callable[[str], None], result: dict[str, Any]) -> int:
        """Do what is left; return the exit code of the step that did not go well, or 0."""
        steps = ARMS[self.arm]
        for number, step in enumerate(steps, start=1):
            state = self.done.get(step.command, "open")
            row: dict[str, Any] = {"command": f"armsight {self.typed(step)}", "state": state}
            result["steps"].append(row)
            if step.command in self.done:
                say(f"{number} of {len(steps)} {row['state']}: {row['command']}")
                continue
            say(f"\n{number} of {len(steps)}: {step.say}")
            possible = self.find(step, say)
            if PLATE in self.typed(step):
                _write_plate(say)
            row["command"] = f"armsight {self.typed(step)}"
            self.keep()
            say(f"$ {row['command']}" if possible else f"left out: there is no {step.given}")
            nobody = self.simulated and not sys.stdin.isatty()
            answer = "" if nobody or not possible else _asked("Enter runs it, s leaves it out, q ends here")
            if answer.lower().startswith("q"):
                return 0
            row["state"] = "left out"
            if possible and not answer.lower().startswith("s"):
                if step.command.startswith("run "):
                    _set_aside(Path("run"), say)
                code = run(shlex.split(self.typed(step)))
                if code and not (step.endless and code == INTERRUPTED):
                    row |= {"state": "failed", "exit_code": code}
                    if not step.needed and code != INTERRUPTED:
                        continue
                    anew = ": its result must not be used, as said above" if code == UNTRUSTED else ""
                    goes_on = "does it anew" if anew else "goes on here"
                    say(f"step {number} ended with {code}{anew}; armsight setup {self.arm} {goes_on}")
                    return code
                row["state"] = "done"
            self.done[step.command] = row["state"]
            self.keep()
        say(f"\n{_summary([row['state'] for row in result['steps']])}; --from N does them again from the N-th")
        return 0

    def keep(self) -> None:
        """Write how far it is; a simulated port is another one next time."""
        words = {} if self.simulated else self.words
        state = {"arm": self.arm, "simulated": bool(self.simulated), "words": words, "done": self.done}
        write_text(FILE, json.dumps(state, indent=1) + "\n")


def words_of(cameras: str | None, board: str | None) -> dict[str, str]:
    """Return what the pages' words are here, as given: cameras, and a board's port, with or without its kind before it."""
    kind = next((kind for kind in finding.KINDS if (board or "").startswith(kind)), "")
    given = {CAMERAS: cameras, PORT: board and board.removeprefix(kind)}
    return {word: shlex.quote(here) for word, here in given.items() if here is not None}


def _summary(states: list[str]) -> str:
    """Return how many steps are done, or failed."""
    failed = states.count("failed")
    return f"{failed} of {len(states)} steps failed" if failed else f"all {len(states)} steps are done"


def _write_plate(say: Callable[[str], None]) -> None:
    """Write the body file of the plate where there is none, as outside of a checkout."""
    if not Path(PLATE).exists():
        Path(PLATE).parent.mkdir(exist_ok=True)
        write_text(PLATE, (resources.files("armsight.app.setup") / "arm_plate.toml").read_text("utf-8"))
        say(f"written: {PLATE}")


def _set_aside(folder: Path, say: Callable[[str], None]) -> None:
    """Rename the folder of a run that did not end: `armsight run` writes over none of a real arm's."""
    if folder.exists():
        name = next(name for n in itertools.count(1) if not (name := Path(f"{folder}-{n}")).exists())
        say(f"renamed: {folder} of an earlier try is {folder.rename(name)}")


def _asked(question: str) -> str:
    return str(click.prompt(question, default="", show_default=False, err=True)).strip()


@contextlib.contextmanager
def simulated(walk: SetupWalk, cameras: str) -> Iterator[None]:
    """Let a walk go through on the emulated arm before simulated cameras, with nobody at the terminal."""
    from armsight.app.board.command import emulated_arm

    walk.words |= {CAMERAS: cameras}
    walk.words |= {old: new for step in ARMS[walk.arm] for old, new in step.without}  # nobody has files of their own
    with contextlib.ExitStack() as stack:
        own = walk.arm == "six_r"
        walk.simulated = "emulated:unicorn" if own else stack.enter_context(emulated_arm(walk.arm))
        yield
