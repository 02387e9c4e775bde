"""Every command with ``--json``, with good and with wrong input: one JSON document (or one a line) or one line and 2.

    python benchmarks/json_commands.py [COMMAND ...]     # those whose names begin so

The commands are those of the command line's own tree. Wrong input stands where a command requires a name of a file: one
that is not there, an empty one, a folder, a device, bytes, a table of something else, JSON of something else; and an option
that is unknown. Each case is a process of its own, forked after the imports.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import click

from armsight.app.main import group, main
from armsight.sim.example_rig import example_rig

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
MOST_S = 60  # a wrong input is answered within; half: the same on an idle computer
#: What is given where nothing is required; X is the wrong input. A command by itself does no harm: it opens no device.
OPTIONAL = {
    "board bringup": ("--board", "X"), "board clear": ("--board", "X"), "board config diff": ("--board", "X"),
    "board config get": ("--board", "X"), "board config set": ("--board", "X"), "board config store": ("--board", "X"),
    "board build": ("--board", "X"), "board flash": ("--board", "X"), "board gains": ("--board", "X"),
    "board home": ("--board", "X"), "board monitor": ("--board", "X"), "board offsets": ("--board", "X"),
    "board release": ("--board", "X"), "board selftest": ("--board", "X"), "calibrate": ("--source", "pairs:X,X"),
    "demo": ("--arm", "X", "-o", "OUT"), "identify": ("--data", "X"), "live": ("--source", "X", "--no-browser"),
    "measure": ("--source", "pairs:X,X"), "dense match": ("X", "X", "X"), "cameras": ("X",), "arm list": ("X",),
}  # fmt: skip
#: Commands with good input.
GOOD = (
    ("arm", "list"), ("arm", "show", "six_r"), ("arm", "fk", "six_r", "0", "10", "20", "0", "30", "0"),
    ("arm", "ik", "six_r", "400", "0", "500", "0", "90", "0"), ("arm", "jacobian", "so101", "0", "10", "20", "0", "30"),
    ("arm", "urdf", "six_r", "-o", "OUT.urdf"),
    ("body", "draw", "chessboard:7x5:25mm", "-o", "OUT.pdf"), ("cameras",), ("check", "plan", "--arm", "six_r"),
    ("check", "evaluate", "rows.csv"), ("check", "rows.csv"), ("identify", "plan", "--arm", "six_r"),
    ("rig", "show", "rig.json"), ("body", "check", "body.toml"),
)  # fmt: skip


def leaves(command: click.Command, name: tuple[str, ...]):
    """Yield every command that does something, and its name."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for each in command.list_commands(context):
            found = command.get_command(context, each)
            if found is not None:
                yield from leaves(found, (*name, each))
    if not isinstance(command, click.Group) or command.invoke_without_command:
        yield name, command


def wrong(command: click.Command, name: str, bad: str, out: str) -> list[str]:
    """Return arguments of a command with one wrong input wherever it requires something."""
    given = [part.replace("X", bad) if part == "X" else part.replace("OUT", out) for part in OPTIONAL.get(name, ())]
    for parameter in command.params:
        if isinstance(parameter, click.Argument) and parameter.required:
            given.append(bad)
        elif isinstance(parameter, click.Option) and parameter.required and parameter.opts[0] not in given:
            value = parameter.type.choices[0] if isinstance(parameter.type, click.Choice) else bad
            count = max(parameter.nargs, 1)
            given += [parameter.opts[0], *([out] if "-o" in parameter.opts else [value] * count)]
    return given


def ran(arguments: list[str]) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command; -1 where it did not end, -2 where it ended by a signal."""
    files = [tempfile.TemporaryFile() for _ in range(2)]  # noqa: SIM115 - the child writes to them
    child = os.fork()
    if child == 0:
        os.setsid()
        for number, file in enumerate(files, 1):
            os.dup2(file.fileno(), number)
        sys.argv = ["armsight", *arguments]
        try:
            main()
        except SystemExit as end:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(end.code if isinstance(end.code, int) else 1)
        finally:
            os._exit(9)
    end, status = time.monotonic() + MOST_S, (0, 0)
    while status[0] == 0 and time.monotonic() < end:
        status = os.waitpid(child, os.WNOHANG)
        time.sleep(0.005)
    if status[0] == 0:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
    texts = []
    for file in files:
        file.seek(0)
        texts.append(file.read().decode(errors="replace"))
    code = -1 if status[0] == 0 else os.waitstatus_to_exitcode(status[1])
    return code, texts[0], texts[1]


def is_json(text: str) -> bool:
    """Return whether a text is a JSON document, or one a line, without NaN."""

    def reject(word: str) -> None:
        raise ValueError(word)

    try:
        json.loads(text, parse_constant=reject)
    except ValueError:
        try:
            return bool([json.loads(line, parse_constant=reject) for line in text.splitlines()])
        except ValueError:
            return False
    return True


def run_all(only: list[str]) -> int:
    """Run all cases, and print those that are not as they should be."""
    count, bad = 0, 0

    def evaluate(good: bool, arguments: list[str], code: int, out: str, err: str) -> None:
        nonlocal count, bad
        count, bad = count + 1, bad + (not good)
        if not good:
            print(
                f"MISSED {' '.join(arguments)}\n  code {code}; stdout {out[:200]!r}; stderr {err[-300:]!r}", flush=True
            )

    (Path("file.bin")).write_bytes(bytes(range(256)) * 40)
    Path("empty").write_text("")
    Path("folder").mkdir()
    Path("table.csv").write_text("a,b\n1,2\n3,4\n")
    Path("other.json").write_text('{"a": [1, 2, {"b": null}]}')
    example_rig().save("rig.json")
    Path("body.toml").write_text((EXAMPLES / "plate.toml").read_text())
    names = "pose,cycle,x_m,y_m,z_m,command_x_m,command_y_m,command_z_m"
    rows = [
        f"P{p},{c},{0.3 + 0.1 * p + 1e-4 * c},0.{p},0.5,{0.3 + 0.1 * p},0.{p},0.5"
        for p in range(1, 6)
        for c in range(1, 31)
    ]
    Path("rows.csv").write_text("\n".join([names, *rows]) + "\n")
    for name, command in leaves(group, ()):
        label = " ".join(name)
        if only and not label.startswith(tuple(only)):
            continue
        for k, value in enumerate(("none.toml", "empty", "folder", "/dev/zero", "file.bin", "table.csv", "other.json")):
            arguments = [*name, *wrong(command, label, value, f"out{k}"), "--json"]
            code, out, err = ran(arguments)
            evaluate(code == 2 and not out and len(err.splitlines()) == 1, arguments, code, out, err)
        arguments = [*name, "--no-such-option", "--json"]
        code, out, err = ran(arguments)
        evaluate(code == 2 and not out and len(err.splitlines()) == 1, arguments, code, out, err)
    for good in GOOD:
        if only and not " ".join(good).startswith(tuple(only)):
            continue
        arguments = [part.replace("OUT", "good") for part in good]
        code, out, err = ran([*arguments, "--json"])
        evaluate(code in (0, 3) and is_json(out), [*arguments, "--json"], code, out, err)
    print(f"{count - bad} of {count}")
    return 1 if bad else 0


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        sys.exit(run_all(sys.argv[1:]))
