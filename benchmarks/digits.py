"""The figures that may not get worse: measured again by their commands, held against ``digits.json``.

    python digits.py                       all of digits.toml: what is outside its tolerance is printed, exit code 1
    python digits.py identify kinhec       the runs alone whose names contain one of these words
    python digits.py --write               take over what was measured, where it is better or new
    python digits.py page                  write docs/measured.md: measured.md of this folder, then these figures
    python digits.py --outputs FOLDER      read what the commands printed there, NAME.txt, in place of running them

``digits.toml`` has by run its command (``{data}`` is ARMSIGHT_DATA, ``{work}`` a folder that is deleted) and its figures: a
pattern whose only group is the number, its tolerance as a share of the stored value (or absolute, ``within``), and whether
``less`` is better (the default), ``more``, or ``same``. The first match counts, with ``worst`` the worst of all.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
STORED = HERE / "digits.json"
#: What people read, and its hand-written part.
PAGE = HERE.parent / "docs" / "measured.md"
WRITTEN = HERE / "measured.md"


def output(run: dict[str, Any], outputs: Path | None, work: Path) -> str:
    """Return what a run's command prints; what it needs and is missing ends with SystemExit."""
    if outputs:
        return (outputs / f"{run['name']}.txt").read_text(encoding="utf-8")
    data = os.environ.get("ARMSIGHT_DATA", str(HERE.parent.parent / "shared" / "data"))
    words = shlex.split(run["command"].format(data=data, work=work))
    start = [sys.executable, "-m", "armsight", *words[1:]] if words[0] == "armsight" else [sys.executable, *words]
    done = subprocess.run(start, cwd=HERE, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, *run.get("ends_with", ())):
        raise SystemExit(f"{run['name']}: exit code {done.returncode}")
    return done.stdout


def figures(run: dict[str, Any], text: str) -> dict[str, float]:
    """Return a run's figures by name; one that is not printed any more is NaN."""
    found = {}
    for name, each in run["figures"].items():
        values = [float(match) for match in re.findall(each["pattern"], text)]
        best_last = max if each.get("better", "less") != "more" else min
        found[f"{run['name']}: {name}"] = (
            (best_last(values) if each.get("worst") else values[0]) if values else float("nan")
        )
    return found


def is_worse(value: float, stored: float, each: dict[str, Any]) -> bool:
    """Whether a value is outside its tolerance, on the side that is worse; NaN is."""
    most = each.get("within", each.get("tolerance", 0.02) * abs(stored))
    off = {"less": value - stored, "more": stored - value, "same": abs(value - stored)}[each.get("better", "less")]
    return not off <= most


def items(run: dict[str, Any], stored: dict[str, float]) -> list[str]:
    """Return a run's figures as items of a list, metres as mm, those of one kind in one item."""
    kinds: dict[str, dict[str, str]] = {}
    for name in run["figures"]:
        value = stored.get(f"{run['name']}: {name}")
        if value is None:
            continue
        whose, _, kind = name.partition(", ")
        if (
            sum(other.endswith(f", {kind}") for other in run["figures"]) < 2 or len(kind) <= 2
        ):  # of one alone, or a unit
            whose, kind = "", name
        kind, value = (f"{kind}m", 1e3 * value) if kind.endswith(", m") else (kind, value)
        kinds.setdefault(kind, {})[whose] = f"{value:.4g}"
    texts = {
        kind: f"{alike.pop()} each"
        if len(alike := set(known.values())) == 1 < len(known)
        else "; ".join(f"{whose} {value}".strip() for whose, value in known.items())
        for kind, known in kinds.items()
    }
    return [f"- {kind}: {text}" for kind, text in texts.items()]


def page(written: str, runs: list[dict[str, Any]], stored: dict[str, float]) -> str:
    """Return docs/measured.md: the hand-written part, and a list for each run with its command."""
    lines = [
        "## Figures that are held",
        "",
        "`python benchmarks/digits.py` measures these again and ends with 1 where one is worse by more than its tolerance.",
        "`{data}` is ARMSIGHT_DATA, `{work}` a temporary folder. Tolerances: `benchmarks/digits.toml`.",
    ]
    for run in runs:
        if known := items(run, stored):
            lines += ["", f"### {run['name']}", "", f"`{run['command']}`", "", *known]
    return written.rstrip() + "\n\n" + "\n".join(lines) + "\n"


def main() -> int:
    """Measure, print, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="runs whose names contain one of these")
    parser.add_argument("--write", action="store_true", help="take over what is better or new")
    parser.add_argument("--outputs", type=Path, help="what the commands printed")
    given = parser.parse_args()
    runs = tomllib.loads((HERE / "digits.toml").read_text(encoding="utf-8"))["run"]
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {}
    if given.names == ["page"]:
        PAGE.write_text(page(WRITTEN.read_text(encoding="utf-8"), runs, stored), encoding="utf-8")
        return 0
    worse = 0
    for run in runs:
        if given.names and not any(name in run["name"] for name in given.names):
            continue
        with tempfile.TemporaryDirectory() as work:
            found = figures(run, output(run, given.outputs, Path(work)))
        for (name, value), each in zip(found.items(), run["figures"].values(), strict=True):
            was = stored.get(name)
            bad = math.isnan(value) or (was is not None and is_worse(value, was, each))
            worse += bad
            print(
                f"{'WORSE' if bad else '':5} {name:60} {value:12.5g} {'new' if was is None else f'{was:12.5g}'}",
                flush=True,
            )
            exactly = {**each, "tolerance": 0.0, "within": 0.0}
            if given.write and not bad and (was is None or is_worse(was, value, exactly)):
                stored[name] = value
    if given.write:
        STORED.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
