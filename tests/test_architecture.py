"""Imports point one way; this reads them with ``ast`` and holds it. The checker is tested on planted violations."""

import ast
import sys
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parent.parent / "src" / "armsight"

#: Layer -> the layers it may import besides itself. Everything may import the ground beneath.
MAY_IMPORT = {
    "geometry": {"kernels"},
    "kernels": set(),
    "firmware": set(),
    "tables": {"geometry"},
    "vision": {"estimate", "geometry", "kernels", "tables"},
    "robot": {"geometry", "kernels", "firmware", "tables"},
    "sim": {"geometry", "kernels", "tables", "vision", "robot"},
    "estimate": {"geometry"},
    "loop": {"geometry", "kernels", "tables", "vision", "robot", "estimate"},
    "app": {"estimate", "geometry", "kernels", "firmware", "tables", "vision", "robot", "sim", "loop"},
}
#: The ground: what each of these modules may import of armsight.
GROUND = {
    "data": {"errors", "geometry", "plots"},
    "errors": set(),
    "files": {"errors"},
    "plots": {"errors"},
    "processes": {"errors"},
}
#: What lies outside that geometry may use.
GEOMETRY_USES = {"numpy", "scipy"}


def imported_names(tree: ast.Module, package: list[str]) -> list[tuple[int, str]]:
    """Every (line, dotted name) a module imports, relative ones resolved; ``from a import b`` counts as a.b."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found += [(node.lineno, f"{stem}.{alias.name}") for alias in node.names]
    return found


def violations(root: Path) -> list[str]:
    """Every import under ``root``, the folder of the package armsight, that points the wrong way."""
    bad = []
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        layer = parts[0]
        if layer == "__init__":  # the public names may come from anywhere but the app
            allowed = set(MAY_IMPORT) - {"app"} | set(GROUND)
        elif layer == "__main__":
            allowed = {"app"}
        elif layer in GROUND:
            allowed = GROUND[layer]
        elif layer in MAY_IMPORT:
            allowed = MAY_IMPORT[layer] | {layer} | set(GROUND)
        else:
            bad.append(f"{path.relative_to(root)}: {layer!r} is no layer of the house")
            continue
        for line, name in imported_names(ast.parse(path.read_text(encoding="utf-8")), ["armsight", *parts[:-1]]):
            top, _, rest = name.partition(".")
            where = f"{path.relative_to(root)}:{line}"
            if top == "armsight":
                target = rest.split(".")[0]
                if target in {*MAY_IMPORT, *GROUND} and target not in allowed:
                    bad.append(f"{where}: {layer} imports {target}")
            elif layer == "geometry" and top not in GEOMETRY_USES | set(sys.stdlib_module_names):
                bad.append(f"{where}: geometry imports {top}")
    return bad


def test_imports_point_one_way():
    assert violations(SRC) == []


def test_every_layer_that_stands_is_known_and_seen():
    packages = {path.name for path in SRC.iterdir() if path.is_dir() and any(path.glob("*.py"))}
    assert {"geometry", "vision", "app"} <= packages <= set(MAY_IMPORT)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("vision/a.py", "import armsight.robot.kinematics.arm", "vision imports robot"),
        ("robot/a.py", "from armsight.vision.rig import StereoRig", "robot imports vision"),
        ("loop/a.py", "from armsight import sim", "loop imports sim"),
        ("geometry/a.py", "from armsight.vision import rig", "geometry imports vision"),
        ("vision/deep/er/a.py", "from ....app import main", "vision imports app"),
        ("vision/deep/__init__.py", "from ...loop import servo", "vision imports loop"),
        ("vision/a.py", "from .. import app", "vision imports app"),
        ("sim/a.py", "def f():\n    import armsight.loop", "sim imports loop"),
        ("vision/a.py", "if TYPE_CHECKING:\n    from armsight.robot.kinematics import arm", "vision imports robot"),
        ("data.py", "from armsight.files import read_text", "data imports files"),
        ("errors.py", "import armsight.data", "errors imports data"),
        ("__init__.py", "from armsight.app.main import main", "__init__ imports app"),
        ("geometry/a.py", "import cv2", "geometry imports cv2"),
        ("utils/a.py", "", "'utils' is no layer"),
    ],
)
def test_the_checker_finds_a_planted_violation(tmp_path, file, text, said):
    path = tmp_path / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    (found,) = violations(tmp_path)
    assert said in found
    assert found.startswith(file)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("vision/markers/a.py", "from armsight.vision.rig import StereoRig\nfrom ..rig import StereoRig"),
        ("vision/a.py", "from armsight.data import Shot\nfrom armsight.geometry.pose import pose\nimport cv2"),
        ("app/check/a.py", "import armsight.sim.render.render\nfrom armsight.loop import servo"),
        ("geometry/a.py", "import numpy\nfrom scipy import linalg\nimport math"),
        ("sim/a.py", "from armsight.robot.kinematics import arm\nfrom armsight.vision import rig"),
    ],
)
def test_the_checker_lets_right_imports_pass(tmp_path, file, text):
    path = tmp_path / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    assert violations(tmp_path) == []
