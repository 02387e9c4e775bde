"""The tree and its names hold what docs/concepts/conventions.md promises; the checkers are tested on planted violations.

Retired words are those that the field does not use: each has a standard term. They are looked for as whole words and as
parts of identifiers (``q_wanted``, ``SlackModel``) in code, comments, messages and pages.
"""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SRC = ROOT / "src" / "armsight"
#: Files of Python in the package, at most: a newcomer's first look.
MOST_FILES = 490

#: Retired word -> the field's.
RETIRED = {
    word: term
    for term, words in {
        "backlash; gravity-side backlash": "play plays slack",
        "compliance": "sag sags",
        "rotation, orientation, reversal": "turn turns turned turning",
        "position": "place places",
        "reported, unknown, observable": "told untold tell tells telling",
        "evaluate; assess": "judge judges judged judging",
        "assessment; outcome": "verdict verdicts",
        "outlier": "stray strays",
        "segment, interval": "stretch stretches stretched stretching",
        "reference; requested": "wanted",
        "pose measurement; observation": "sighting sightings",
        "predicted, prediction": "foresight foretold outlook outlooks",
        "plausibility; rejected": "likeness unbelievable believed",
        "warm_up": "rehearse rehearsed rehearsal",
        "symmetry, ambiguity": "relabel relabeling relabelling relabelled",
        "forward selection": "growth grown",
        "acknowledged": "obey obeys obeyed",
        "rejected": "refused refusal refusals",
        "setup": "station stations",
        "test rig": "bench",
    }.items()
    for word in words.split()
}
#: Retired phrases -> what to write.
PHRASES = {
    "standard form": "rectified",
    "the chapter": "the method's name; its source is cited in docs/concepts/method.md",
}
#: Where a retired word is right: (files, text around the word, why).
LEGITIMATE = (
    (
        r"benchmarks/|Makefile|README\.md|CONTRIBUTING\.md|docs/|pyproject",
        r"make bench|\[bench\]|^bench\b|\bbench\b(?=:| clean)",
        "a make target",
    ),
    (r"tests/vision/sources/", r"\bPLAY\b|Connection refused", "the words of RTSP and of the operating system"),
    (r"tests/app/run/test_run_folder\.py", r"wanted\.(csv|parquet)", "what version 1 wrote is read"),
    (
        r"src/armsight/app/run/motion_file\.py|tests/app/run/test_motion_file\.py",
        r"\bturn_deg\b",
        "what version 1 wrote is read",
    ),
    (
        r"src/armsight/loop/identify/corrected\.py|tests/loop/identify/test_identify_corrected\.py",
        r"\bslack\d?\b|\bsag\d?(_\d)?\b",
        "what version 1 wrote is read",
    ),
    (r"", r"\bin[- ]place\b|\bin turn\b", "plain English"),
    (r"src/armsight/robot/kinematics/", r"\bstandard form\b", "of Denavit-Hartenberg parameters"),
    (
        r"src/armsight/app/(check/run_folder|run/folder|run/summary)\.py|src/armsight/sim/workcell/arm\.py",
        r"\bwanted\b|q\{joint\}_wanted_rad|\bq1_wanted_rad\b|\bwanted\.csv\b|\bsag_deg\b",
        "what version 1 wrote is read",
    ),
)
#: Files in which no word is looked for: what they hold is older words, or other people's.
SPARED = (
    r"CHANGELOG\.md", r"docs/reference/old_names\.md", r"tests/test_words\.py", r".*/firmware/built/.*", r"docs/_.*",
    r"docs/gallery/.*", r".*written_by_version_\d.*",
)  # fmt: skip
WHERE = (
    "src/armsight", "firmware", "docs", "examples", "benchmarks", "tests", "README.md", "CONTRIBUTING.md",
    "Makefile",
)  # fmt: skip
KINDS = {".py", ".md", ".toml", ".c", ".h", ".xml", ".rst", ".css", ""}


def parts(line: str) -> set[str]:
    """Return the words of a line; identifiers come apart at ``_`` and at capitals."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", line)}


def retired_words(text: str, name: str) -> list[str]:
    """Return every (file:line: word -> standard term) of a text."""
    legitimate = [re.compile(around) for files, around, _ in LEGITIMATE if re.match(files, name)]
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        rest = line
        for pattern in legitimate:
            rest = pattern.sub(" ", rest)
        hits = {word: RETIRED[word] for word in parts(rest) & RETIRED.keys()}
        hits |= {phrase: term for phrase, term in PHRASES.items() if phrase in rest.lower().replace("_", " ")}
        found += [f"{name}:{number}: {word} -> {term}: {line.strip()[:100]}" for word, term in sorted(hits.items())]
    return found


def files_to_read() -> list[Path]:
    """Return every file of ours that people read."""
    found = []
    for where in WHERE:
        path = ROOT / where
        found += [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file())
    names = ((path, path.relative_to(ROOT).as_posix()) for path in found if path.suffix in KINDS)
    return [
        path
        for path, name in names
        if not any(re.fullmatch(spared, name) for spared in SPARED) and "__pycache__" not in name
    ]


def test_no_retired_word_comes_back():
    found = []
    for path in files_to_read():
        name = path.relative_to(ROOT).as_posix()
        found += retired_words(path.read_text(encoding="utf-8"), name) + retired_words(path.stem, f"{name} (its name)")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("q_wanted = 1", "wanted"),
        ("class SlackModel:", "slack"),
        ("# the joint's play", "play"),
        ('"turn_deg": 3', "turn"),
        ("as The Chapter says", "the chapter"),
        ("MOST_TOLD = 2", "told"),
        ("def in_standard_form(", "standard form"),
    ],
)
def test_a_planted_word_is_found(line, word):
    (found,) = retired_words(line, "src/armsight/a.py")
    assert found.startswith(f"src/armsight/a.py:1: {word} -> ")


@pytest.mark.parametrize(
    "line", ["display", "displacement", "return placement", "make bench", "benchmarks/kinematics.py", "replaced"]
)
def test_words_that_only_look_like_one_pass(line):
    assert retired_words(line, "docs/a.md") == []


def class_names(root: Path) -> Counter[str]:
    """Count the names of all classes under a folder, nested ones included."""
    names: Counter[str] = Counter()
    for path in root.rglob("*.py"):
        if "built" not in path.parts:
            names.update(
                node.name
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.ClassDef)
            )
    return names


def test_no_class_name_stands_twice():
    assert sorted(name for name, count in class_names(SRC).items() if count > 1) == []


def test_a_class_name_that_stands_twice_is_found(tmp_path):
    (tmp_path / "a.py").write_text("class A:\n    class B: ...\n")
    (tmp_path / "b.py").write_text("class B: ...\n")
    assert class_names(tmp_path) == {"A": 1, "B": 2}


def families(names: list[str]) -> list[str]:
    """Return the prefixes before ``_`` that three files of a folder share."""
    counts = Counter(name.split("_")[0] for name in names)
    shared = {name for name in counts if any(other.startswith(f"{name}_") for other in names)}
    return sorted(name for name, count in counts.items() if count >= 3 and name in shared and name)


def test_no_folder_has_a_family_by_prefix():
    assert families(["run", "run_a", "run_b", "c_1"]) == ["run"]
    assert families(["a", "b", "a_b", "__init__"]) == []
    for folder in [SRC, *(path for path in SRC.rglob("*") if path.is_dir() and "built" not in path.parts)]:
        found = families([path.stem for path in folder.glob("*.py")])
        assert found == [], f"{folder.relative_to(SRC)}: a prefix is a folder that was not made: {found}"


def test_the_tree_is_small_enough_to_look_through():
    files = [path for path in SRC.rglob("*.py") if "built" not in path.parts]
    assert 200 < len(files) <= MOST_FILES
