"""How much stack the firmware needs: what gcc reports for each function, summed along the deepest chain of calls.

gcc's ``-fcallgraph-info=su`` gives each function's frame and whom it calls once everything is inlined. A call through a
pointer may reach any function of the board's struct literal. Recursion would have no bound and is rejected.
"""

from __future__ import annotations

import functools
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from armsight.errors import InputError
from armsight.firmware import build

#: What the processor pushes for an interrupt: 8 words, 17 of the floating-point unit, 1 to align (ARMv7-M, B1.5.7).
INTERRUPT_BYTES = 26 * 4
#: The board's functions with which the main loop and the tick begin, and its other interrupts, each of which may come at
#: the deepest point of what is running: a board's handlers are called *_interrupt.
MAIN, TICK, HANDLER = "loop_poll", "loop_tick", "_interrupt"
_INDIRECT = "__indirect_call"
_HOOKS = "sense|drive|feed_watchdog|reset_cause|crash|receive|send|read_copy|write_copy|restart"
_HOOK = re.compile(rf"\.(?:{_HOOKS}) = (\w+)")
_NODE = re.compile(r'node: \{ title: "([^"]+)" label: "[^"]*?(?:\\n(\d+) bytes \((\w+)[^"]*)?"')
_EDGE = re.compile(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"')


@dataclass(frozen=True)
class Chain:
    """The deepest chain of calls from a function on."""

    functions: tuple[str, ...]  #: the first calls the second, and so on
    stack_bytes: int  #: of all their frames


@dataclass(frozen=True)
class StackUse:
    """The stack a board needs."""

    main: Chain  #: of the main loop
    tick: Chain  #: of the tick's interrupt, from its handler on, which comes on top of it
    nested: tuple[Chain, ...]  #: of each interrupt that may come on top of that

    @property
    def total_bytes(self) -> int:
        """The tick at the main loop's deepest point, and all other interrupts at the tick's."""
        return self.main.stack_bytes + sum(INTERRUPT_BYTES + each.stack_bytes for each in (self.tick, *self.nested))


@functools.cache
def stack_use(board: str) -> StackUse:
    """Return the stack a board needs; :class:`~armsight.errors.InputError` without gcc for ARM, or without a bound."""
    compiler = build.open_compiler("gcc")
    frames: dict[str, int] = {}
    calls: dict[str, set[str]] = {}
    with tempfile.TemporaryDirectory() as folder, build.headers() as mavlink:
        flags = (*build.board_flags(board, mavlink), "-c", "-fcallgraph-info=su")
        for number, source in enumerate(build.board_sources(board)):
            build.compile_c(compiler.arm, Path(folder) / f"{number}.o", [source], *flags)
            _read((Path(folder) / f"{number}.ci").read_text(encoding="utf-8"), frames, calls)
    hooks = {name for name in frames if name.split(":")[-1] in _hooks(board)}
    for called in calls.values():
        if _INDIRECT in called:
            called |= hooks
    main, ticked = _deepest(MAIN, frames, calls, ()), _deepest(TICK, frames, calls, ())
    handlers = [_deepest(name, frames, calls, ()) for name in frames if name.endswith(HANDLER)]
    ticks = [chain for chain in handlers if TICK in chain.functions]
    others = [chain for chain in handlers if TICK not in chain.functions and "fault" not in chain.functions[0]]
    return StackUse(main, max([ticked, *ticks], key=lambda chain: chain.stack_bytes), tuple(others))


def _hooks(board: str) -> set[str]:
    """Return the functions the board's struct literal names."""
    sources = [
        build.source_folder() / source for source in build.board_sources(board) if f"/{build.drivers(board)}/" in source
    ]
    return {name for source in sources for name in _HOOK.findall(source.read_text(encoding="utf-8"))}


def _read(graph: str, frames: dict[str, int], calls: dict[str, set[str]]) -> None:
    for name, size, kind in _NODE.findall(graph):
        if size:
            if kind != "static":
                raise InputError(f"{name}: takes stack by what it computes; there is no bound")
            frames[name] = int(size)
    for caller, called in _EDGE.findall(graph):
        calls.setdefault(caller, set()).add(called)


def _deepest(name: str, frames: Mapping[str, int], calls: Mapping[str, set[str]], above: tuple[str, ...]) -> Chain:
    if name in above:
        raise InputError(f"{' -> '.join((*above, name))}: recursion; there is no bound for the stack")
    known = [called for called in calls.get(name, ()) if called in frames]
    below = max(
        (_deepest(called, frames, calls, (*above, name)) for called in known),
        key=lambda chain: chain.stack_bytes,
        default=Chain((), 0),
    )
    return Chain((name.split(":")[-1], *below.functions), frames[name] + below.stack_bytes)
