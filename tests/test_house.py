"""Structure: which package may import which, and that every package is shipped."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from .conftest import ROOT

PACKAGES = ("ingest", "recording", "algorithms", "replay", "study", "viz", "export", "cli")
MAY_IMPORT = {
    "recording": set(),
    "algorithms": set(),
    "ingest": {"recording"},
    "export": {"recording"},
    "replay": {"recording", "algorithms"},
    "study": {"recording", "algorithms", "replay", "ingest", "viz", "export"},  # export: annotations by rule
    "viz": {"recording", "replay", "export"},  # export: only for the contract that its RRD exporter fulfils
    "cli": set(PACKAGES) - {"cli"},
}
SOURCES = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, absolute dotted name below marcha or outside) of every import, lazy ones too."""
    package = path.relative_to(ROOT).parent.parts
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                found.append((node.lineno, node.module or ""))
                continue
            base = ("marcha", *package)[: len(package) + 2 - node.level]
            module = ".".join((*base, *(node.module.split(".") if node.module else ())))
            names = [f"{module}.{alias.name}" for alias in node.names] if module == "marcha" else [module]
            found += [(node.lineno, name) for name in names]
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_point_against_the_data_flow(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    for line, name in imports(path):
        parts = name.split(".")
        if parts[0] == "marcha" and len(parts) > 1 and parts[1] in PACKAGES and parts[1] != package:
            assert parts[1] in MAY_IMPORT[package], f"{path}:{line}: {package} may not import {parts[1]}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_across_packages_are_relative(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
        else:
            continue
        assert not any(n.split(".")[0] in ("marcha", *PACKAGES) for n in names), f"{path}:{node.lineno}"


def test_only_viz_imports_rerun() -> None:
    users = {
        p.relative_to(ROOT).parts[0] for p in SOURCES for _, n in imports(p) if n.split(".")[0] == "rerun"
    }
    assert users <= {"viz"}


def test_every_package_folder_is_listed() -> None:
    folders = {p.parent.relative_to(ROOT) for p in SOURCES if p.name == "__init__.py"}
    setuptools = PYPROJECT["tool"]["setuptools"]
    expected = {"marcha." + ".".join(f.parts): f.as_posix() for f in folders}
    expected["marcha.tests.contracts"] = "tests/contracts"  # shipped: plug-in authors inherit them
    assert set(setuptools["packages"]) == set(expected)
    assert setuptools["package-dir"] == expected


def test_every_module_lies_in_a_listed_package() -> None:
    listed = set(PYPROJECT["tool"]["setuptools"]["package-dir"].values())
    assert {p.parent.relative_to(ROOT).as_posix() for p in SOURCES} <= listed


ENTRY_POINTS = [
    (group, name, target)
    for group, names in PYPROJECT["project"]["entry-points"].items()
    for name, target in names.items()
]


@pytest.mark.parametrize(
    ("group", "name", "target"), ENTRY_POINTS, ids=[f"{g}:{n}" for g, n, _ in ENTRY_POINTS]
)
def test_entry_point_loads(group: str, name: str, target: str) -> None:
    import importlib

    module, _, attribute = target.partition(":")
    assert getattr(importlib.import_module(module), attribute) is not None


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, marcha.cli as c\n"
        "try: c.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'rerun', 'numba', 'polars', 'scipy', 'matplotlib', 'ezc3d', 'pyproj', 'mcap'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_nothing_names_a_machine() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    here = str(ROOT.parent)
    for name in listed.stdout.split():
        path = ROOT / name
        if path.suffix in {".py", ".md", ".toml", ".yml", ""} and path.is_file() and len(here) > 3:
            assert here + "/" not in path.read_text(encoding="utf-8", errors="ignore"), name


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_file_is_longer_than_five_hundred_lines(path: Path) -> None:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= 500, f"{path}: {lines} lines; split it by subject"


def test_one_public_name_means_one_thing() -> None:
    """No two modules give the same name to different classes, registered plug-ins and detectors' Params apart."""
    registered = {tuple(target.split(":")) for _, _, target in ENTRY_POINTS}
    places: dict[str, list[str]] = {}
    for path in SOURCES:
        module = ".".join(("marcha", *path.relative_to(ROOT).with_suffix("").parts))
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            plugin = isinstance(node, ast.ClassDef) and (module, node.name) in registered
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and not plugin:
                places.setdefault(node.name, []).append(module)
    del places["Params"]
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


VAGUE = {"found", "known", "given", "said", "at"}
"""Names that say that there is a value and not what it is."""


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_names_say_what_they_hold(path: Path) -> None:
    public = {("viz/screenshot.py", "at")}  # screenshots(…, at=0.5): where on the time line
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        named = getattr(node, "arg", None) if isinstance(node, ast.arg) else getattr(node, "id", None)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            named = (
                node.name.strip("_").lower() if node.name != "at" else ""
            )  # track.at(t_ns) says what it is
        name = named or ""
        if (path.relative_to(ROOT).as_posix(), name) not in public:
            assert name not in VAGUE, f"{path}:{getattr(node, 'lineno', 0)}: {name}"


ARRAY = re.compile(r"NDArray|FloatArray|IntArray|\bFloats\b|\bTimes\b|ndarray")
SHAPE = re.compile(r"\b[Ss]hapes?\b|\([\wµ…≤ ·+]+,( |\)|[\wµ])|vector|column|row|scalar")
COMPILED = ("compiled", "inlined", "njit")
CONTRACTS = {"draw", "flush", "step", "take"}
"""Methods whose arguments the base class describes."""


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_public_functions_tell_the_shapes_of_their_arrays(path: Path) -> None:
    """Kernels apart: they take records, whose fields have their shapes in one place."""

    def check(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                check(node.body)
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_") or node.name in CONTRACTS:
                continue
            if any(word in ast.unparse(d) for d in node.decorator_list for word in COMPILED):
                continue
            kinds = [ast.unparse(a.annotation) for a in node.args.args + node.args.kwonlyargs if a.annotation]
            if any(ARRAY.search(kind) for kind in kinds):
                assert SHAPE.search(ast.get_docstring(node) or ""), f"{path}:{node.lineno}: {node.name}"

    check(ast.parse(path.read_text(encoding="utf-8")).body)
