"""The house stands: imports point only down, and nothing heavy is imported before it is needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import margcal

HOUSE = Path(margcal.__file__).parent
BELOW = {
    "core": {"core"},
    "methods": {"core", "methods"},
    "files": {"core", "files"},
    "workflow": {"core", "methods", "files", "workflow"},
    "apps": {"core", "methods", "files", "workflow", "apps"},
}
HEAVY = {"scipy", "pyarrow", "click", "rich", "msgspec", "pygeomag", "matplotlib", "pandas"}
FILES = sorted(p for room in BELOW for p in (HOUSE / room).rglob("*.py"))


def imported(node: ast.AST, *, at_start: bool) -> Iterator[str]:
    """Names of the modules imported in `node`; `at_start`: only those that importing the file itself imports."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "relative import"
            yield f"{child.module}"
            yield from (f"{child.module}.{alias.name}" for alias in child.names if child.module == "margcal")
        elif not (at_start and runs_later(child)):
            yield from imported(child, at_start=at_start)


def runs_later(node: ast.AST) -> bool:
    """Bodies of functions, and what only type checkers read."""
    for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    return for_types or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(HOUSE)))
def test_imports_point_down_and_start_light(path):
    tree, room = ast.parse(path.read_text(encoding="utf-8")), path.relative_to(HOUSE).parts[0]
    for name in imported(tree, at_start=False):
        if name == "margcal":
            continue  # its parts follow: `from margcal import core`
        if name.startswith("margcal."):
            assert name.split(".")[1] in BELOW[room], f"{room} imports {name}"
    heavy = {name.split(".")[0] for name in imported(tree, at_start=True)} & HEAVY
    allowed = {"click"} if path == HOUSE / "apps" / "cli.py" else set()
    assert heavy <= allowed, f"imported at the start: {heavy}"


def test_rooms_are_those_that_are_known_and_their_init_files_are_empty():
    rooms = {p.name for p in HOUSE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert rooms == set(BELOW)
    assert all((HOUSE / room / "__init__.py").read_text() == "" for room in BELOW)


@pytest.mark.parametrize(
    ("code", "unwanted"),
    [
        ("import margcal", "numpy"),
        ("import margcal.apps.cli", "numpy rich"),
        ("import margcal.core.types, margcal.files.tables", "scipy pyarrow"),
        ("import margcal.workflow.calibrate", "scipy pyarrow msgspec pygeomag"),
    ],
)
def test_what_an_import_does_not_bring_in(code, unwanted):
    script = f"{code}; import sys; print([n for n in {unwanted.split()} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_are_there_and_documented():
    for name in margcal.__all__:
        thing = getattr(margcal, name)
        assert name == "__version__" or thing.__doc__
    assert set(margcal.__all__) <= set(dir(margcal))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = margcal.nonsense
