"""The rooms of the house: an import never points up."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxsat"
ORDER = (
    "errors",
    "signals",
    "inertial",
    "saturation",
    "config",
    "preparation",
    "claims",
    "pipeline",
    "attitude",
    "periodic",
    "studies",
    "present",
    "demo",
    "cli",
)
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE) != Path("__init__.py"))


def room(module: str) -> str:
    """The room of a module of the package, 'jaxsat.signals.rails' → 'signals'."""
    return module.split(".")[1]


def imported(tree: ast.AST) -> list[str]:
    """Every module of the package that is imported anywhere, inside functions too."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module == "jaxsat":
            names += [f"jaxsat.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the package in full"
            names.append(node.module)
    return [name for name in names if name.startswith("jaxsat.")]


def upward(path: Path, text: str) -> list[str]:
    """Imports of a file that point up."""
    own = ORDER.index(path.relative_to(PACKAGE).parts[0].removesuffix(".py"))
    return [name for name in imported(ast.parse(text)) if ORDER.index(room(name)) > own]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_import_points_up(path):
    assert upward(path, path.read_text()) == []


def test_an_upward_import_is_seen():
    text = "def f():\n    from jaxsat.pipeline import estimate\n    import numpy, jaxsat.present.tables\n"
    assert upward(PACKAGE / "signals" / "rails.py", text) == ["jaxsat.pipeline", "jaxsat.present.tables"]
    assert upward(PACKAGE / "cli.py", text) == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_stay_short(path):
    assert len(path.read_text().splitlines()) <= 400


def test_only_the_solvers_import_jaxopt():
    users = [path.name for path in FILES if "import jaxopt" in path.read_text()]
    assert users == ["solvers.py"]
