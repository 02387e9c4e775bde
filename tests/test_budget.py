"""How much there is of armsight, held against ``budget.toml``, whose values may only fall.

``python tests/test_budget.py`` prints what is measured beside the budget, ``--lower`` writes what fell into the file.
"""

import ast
import re
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SRC = ROOT / "src" / "armsight"
BUDGET = Path(__file__).with_name("budget.toml")
#: What the one solver does, by the names it is called in numpy and scipy.
SOLVERS = {"solve", "lstsq", "cho_solve", "least_squares"}


def is_number(node: ast.AST) -> bool:
    """Whether an expression is numbers alone: -3, 2 * 60, 1 / 3."""
    match node:
        case ast.Constant(value=value):
            return type(value) in (int, float)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) and is_number(right)
    return False


def held(value: ast.expr, names: int) -> int:
    """Numbers that a value assigned to so many names holds; unpacked from a range, or numbers one by one, one a name."""
    match value:
        case ast.Tuple(elts=elements):
            return sum(held(element, 1) for element in elements if not isinstance(element, ast.Tuple))  # rows are data
        case ast.Call(func=ast.Name(id="range"), args=ends):
            return names if names > 1 else sum(map(is_number, ends))
        case ast.GeneratorExp(generators=[each]) if any(map(is_number, ast.walk(each.iter))):
            return names
    return is_number(value)


def numbers(tree: ast.Module) -> int:
    """Numeric constants at module level, those of enumerations and other classes included (fields' defaults are none)."""
    bodies = [tree.body, *(n.body for n in tree.body if isinstance(n, ast.ClassDef))]
    given = [n for n in tree.body if isinstance(n, ast.AnnAssign) and n.value is not None]
    given += [n for body in bodies for n in body if isinstance(n, ast.Assign)]
    return sum(held(n.value, len(getattr(getattr(n, "targets", [n])[0], "elts", [n]))) for n in given)


def docstring_lines(tree: ast.Module) -> int:
    """Lines of all docstrings of a module."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    firsts = [n.body[0] for n in ast.walk(tree) if isinstance(n, kinds) and ast.get_docstring(n)]
    return sum((n.end_lineno or n.lineno) - n.lineno + 1 for n in firsts)


def calls_solver(tree: ast.Module) -> bool:
    """Whether a module calls one of SOLVERS."""
    called = {n.func for n in ast.walk(tree) if isinstance(n, ast.Call)}
    return any(getattr(f, "attr", getattr(f, "id", None)) in SOLVERS for f in called)


def imported_folders(tree: ast.Module, folders: set[str]) -> set[str]:
    """The folders of armsight that a module imports from, when it is imported."""
    lazy = {id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef) for n in ast.walk(f)}
    names: list[str] = []
    for node in ast.walk(tree):
        if id(node) in lazy:
            continue
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    parts = [name.split(".")[1:] for name in names if name.startswith("armsight.")]
    return {next((f for i in range(len(p), 0, -1) if (f := "/".join(p[:i])) in folders), "") for p in parts} - {""}


def circles(graph: dict[str, set[str]]) -> int:
    """Folders that import one another, by whatever way: the number of knots of more than one folder."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        todo = [start]
        while todo:
            todo += (new := graph.get(todo.pop(), set()) - seen)
            seen |= new
        return seen

    reach = {folder: reached(folder) - {folder} for folder in graph}
    return len(
        {frozenset({a} | {b for b in reach[a] if a in reach.get(b, ())}) for a in graph}
        - {frozenset({a}) for a in graph}
    )


def options() -> int:
    """Options of all commands as they are declared: a declaration that several commands share counts once."""
    import click

    from armsight.app.main import group

    def of(command: click.Command) -> set[int]:
        own = {id(getattr(p, "declaration", p)) for p in command.params if isinstance(p, click.Option)}
        if isinstance(command, click.Group):
            context = click.Context(command)
            for name in command.list_commands(context):
                if (below := command.get_command(context, name)) is not None:
                    own |= of(below)
        return own

    return len(of(group))


def complexity(function: ast.AST) -> int:
    """Cyclomatic complexity of a function: one, and one for each way that it may fork, functions within it included."""
    forks = 1
    for node in ast.walk(function):
        match node:
            case ast.BoolOp(values=values):
                forks += len(values) - 1
            case ast.comprehension(ifs=ifs):
                forks += 1 + len(ifs)
            case (
                ast.If() | ast.IfExp() | ast.For() | ast.While() | ast.ExceptHandler() | ast.match_case() | ast.Assert()
            ):
                forks += 1
    return forks


def measured() -> dict[str, dict[str, float]]:
    """All that is counted, by the table and key of ``budget.toml``."""
    lines: Counter[str] = Counter()
    total: Counter[str] = Counter()
    files = [p for p in sorted(SRC.rglob("*.py")) if "built" not in p.parts]  # generated when the firmware is built
    folders = {p.parent.relative_to(SRC).as_posix() for p in files} - {"."}
    graph: dict[str, set[str]] = {folder: set() for folder in folders}
    for path in files:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        parts = path.relative_to(SRC).parts[:-1]
        room = "/".join(parts[: 1 if parts[:1] != ("app",) else 2]) or "top"
        lines[room] += len(text.splitlines())
        total["docstrings"] += docstring_lines(tree)
        total["numbers"] += numbers(tree)
        functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
        total["complex"] += sum(complexity(function) > 20 for function in functions)
        total["solvers"] += calls_solver(tree)
        total["solvers_app"] += calls_solver(tree) and parts[:1] == ("app",)
        if parts:
            graph["/".join(parts)] |= imported_folders(tree, folders)
    code = sum(lines.values())
    tests = sum(len(p.read_text(encoding="utf-8").splitlines()) for p in (ROOT / "tests").rglob("*.py"))
    made = {"_build", "_made"}
    pages = [p for p in (ROOT / "docs").rglob("*.md") if not made & set(p.parts)]
    return {
        "whole": {
            "src_lines": code,
            "docstrings_percent": round(100 * total["docstrings"] / code, 1),
            "tests_lines": tests,
            "module_numbers": total["numbers"],
            "files_that_solve": total["solvers"],
            "files_that_solve_in_app": total["solvers_app"],
            "folder_circles": circles(graph),
            "functions_over_complexity_20": total["complex"],
            "options": options(),
            "docs_words": sum(len(p.read_text(encoding="utf-8").split()) for p in pages),
            "limits_bytes": (ROOT / "docs" / "limits.md").stat().st_size,
            "changelog_bytes": (ROOT / "CHANGELOG.md").stat().st_size,
        },
        "rooms": dict(sorted(lines.items())),
    }


@pytest.fixture(scope="module")
def found():
    return measured()


def test_nothing_exceeds_its_budget(found):
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8"))
    assert {table: set(rows) for table, rows in budget.items()} == {table: set(rows) for table, rows in found.items()}
    over = {k: (v, budget[t][k]) for t, rows in found.items() for k, v in rows.items() if v > budget[t][k]}
    assert over == {}, "more than budget.toml allows: shorten, it is not to be raised"


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("A, B, C = range(3)", 3),
        ("A, B = range(FIRST, FIRST + 2)", 2),
        ("MEMORY, OTHER = range(0x100), range(0x200, 0x300)", 3),
        ("A, B = (1 << bit for bit in range(2))", 2),
        ("A, B = (number(name) for name in ('a', 'b'))", 0),
        ("class Code(enum.IntEnum):\n    A = 1\n    B = 2", 2),
        ("class Row:\n    a: float = 1.0", 0),
    ],
)
def test_numbers_in_other_clothes_are_counted(text, count):
    assert numbers(ast.parse(text)) == count


def test_what_is_counted():
    tree = ast.parse(
        '"""One.\n\nTwo."""\nA = -3\nB = (1, 2 * 60, "x")\nC: float = 1 / 3\nD = f(2)\nx = np.linalg.solve(a, b)'
    )
    assert (docstring_lines(tree), numbers(tree), calls_solver(tree)) == (3, 4, True)
    folders = {"loop", "loop/health", "vision"}
    tree = ast.parse(
        "from armsight.loop.health import rig\nimport armsight.vision.rig\ndef f():\n    import armsight.loop.servo"
    )
    assert imported_folders(tree, folders) == {"loop/health", "vision"}
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == 1


if __name__ == "__main__":
    now, held = measured(), tomllib.loads(BUDGET.read_text(encoding="utf-8")) if BUDGET.exists() else {}
    for table, rows in now.items():
        for key, value in rows.items():
            print(f"{table:6} {key:32} {value:>9} {held.get(table, {}).get(key, '-'):>9}")
    if "--lower" in sys.argv:
        text = BUDGET.read_text(encoding="utf-8")
        for table, rows in now.items():
            for key, value in rows.items():
                if value < held[table][key]:
                    text = re.sub(rf'(?m)^("?{re.escape(key)}"?) = .*$', rf"\1 = {value}", text)
        BUDGET.write_text(text, encoding="utf-8")
