"""What the pages name exists: files, modules, functions, commands, options, pages."""

import importlib
import re
import shlex
from pathlib import Path

import click

from armsight.app.main import COMMANDS, group

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
PAGES = [page for page in PAGES if not {"_build", "_made", "gallery"} & set(page.relative_to(ROOT).parts)]
#: A file of the repository; brackets and ellipses stand for names that a reader chooses.
FILE = re.compile(r"\b((?:src|tests|benchmarks|docs|examples|firmware)/[\w./-]*\w/?)")
#: Folders that appear when something is built, and names that a reader chooses.
LATER = re.compile(r"docs/_build|NAME")
MODULE = re.compile(r"\barmsight(?:\.\w+)+")
IMPORT = re.compile(r"from (armsight[\w.]*) import ([\w, ]+)")
LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)]*)?\)")


def missing_files(text: str) -> list[str]:
    """Return the files of the repository that a text names and that are not there."""
    names = {match[1] for match in FILE.finditer(text) if not LATER.search(match[0])}
    return sorted(name for name in names if not (ROOT / name).exists())


def missing_names(text: str) -> list[str]:
    """Return the dotted names below ``armsight`` that a text has and that cannot be imported."""
    missing = []
    for name in sorted(set(MODULE.findall(text))):
        parts = name.split(".")
        if parts[-1] in ("xml", "toml", "json", "fish", "log"):  # a file's name
            continue
        if not _imports(name):
            missing.append(name)
    for module, names in IMPORT.findall(text):
        named = [f"{module}.{name.strip()}" for name in names.split(",")]
        missing += [name for name in named if not _imports(name)]
    return missing


def _imports(name: str) -> bool:
    """Say whether a dotted name can be imported."""
    parts = name.split(".")
    return any(_found(parts, cut) for cut in range(len(parts), 0, -1))


def _found(parts: list[str], cut: int) -> bool:
    """Say whether the first ``cut`` parts are a module and the others attributes in it."""
    try:
        found: object = importlib.import_module(".".join(parts[:cut]))
    except ImportError:
        return False
    for part in parts[cut:]:
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


def calls(text: str) -> list[list[str]]:
    """Return the ``armsight`` command lines of a text: lines of blocks, and code in a sentence."""
    found = []
    for line in re.findall(r"^(?: {4}|\$ )(?:\$ )?(armsight [^\n]*)$|`(armsight [^`\n]+)`", text, re.MULTILINE):
        words = re.split(r"\s#|\s{3,}", line[0] or line[1])[0]
        try:
            found.append(shlex.split(words))
        except ValueError:
            continue
    return found


def unknown_parts(words: list[str]) -> list[str]:
    """Return the commands and options of a command line that do not exist."""
    command, rest = group, words[1:]
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        context = click.Context(command)
        below = command.get_command(context, rest[0])
        if below is None:
            if command is group:
                return [] if not re.fullmatch(r"[a-z]+", rest[0]) else [rest[0]]
            break  # what is no subcommand is data
        command, rest = below, rest[1:]
    members = command.commands.values() if isinstance(command, click.Group) and command is not group else ()
    return _unknown_options([command, *members], rest)


def _unknown_options(commands: list[click.Command], rest: list[str]) -> list[str]:
    parameters = [parameter for command in commands for parameter in command.params]
    known = {option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts)}
    known |= {"-h", "--help", "--version"}
    words = [word.strip("[],").split("=")[0] for word in rest]
    return [word for word in words if re.fullmatch(r"--?[a-z][a-z-]*", word) and word not in known]


def test_what_pages_name_exists():
    missing = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        unknown = [(" ".join(words), parts) for words in calls(text) if (parts := unknown_parts(words))]
        far = [each for each in LINK.findall(text) if not re.search("://|_made/|gallery/", each)]
        broken = [target for target in far if not (page.parent / target).exists()]
        missing[page.relative_to(ROOT).as_posix()] = [*missing_files(text), *missing_names(text), *unknown, *broken]
    assert {page: found for page, found in missing.items() if found} == {}


def texts_of_code() -> dict[str, str]:
    """Return every file of code that people read, by its path: the package's, without what is built, and the firmware's."""
    kinds = {".py", ".toml", ".c", ".h", ".ld", ".S", ".xml"}
    found = [
        path for folder in ("src", "firmware") for path in sorted((ROOT / folder).rglob("*")) if path.suffix in kinds
    ]
    names = {
        path.relative_to(ROOT).as_posix(): path for path in found if not {"built", "__pycache__"} & set(path.parts)
    }
    return {name: path.read_text(encoding="utf-8") for name, path in names.items()}


def test_the_files_that_code_names_exist():
    missing = {name: found for name, text in texts_of_code().items() if (found := missing_files(text))}
    assert missing == {}


def test_the_checks_find_what_is_planted():
    assert missing_files("see `src/armsight/nothing.py` and docs/index.md") == ["src/armsight/nothing.py"]
    assert "src/armsight/files.py" in texts_of_code()
    assert any(name.startswith("firmware/") for name in texts_of_code())
    assert missing_names("armsight.vision.nothing and armsight.vision.rig.StereoRig") == ["armsight.vision.nothing"]
    assert missing_names("from armsight.data import Shot, Nothing") == ["armsight.data.Nothing"]
    planted = calls(
        "    armsight measure rig.json --nothing 3\n`armsight calibrate --alone a,b`\n$ armsight nowhere x\n"
    )
    assert [unknown_parts(words) for words in planted] == [["--nothing"], [], ["nowhere"]]
    assert set(COMMANDS) >= {"measure", "calibrate"}
