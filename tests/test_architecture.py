"""Test the architecture beyond `lint-imports`: import cycles, prints, wall-clock reads, package roots, sizes."""

import ast
import functools
import graphlib
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("carlab", "drivers", "mocap", "learning", "sim_backends")
SOURCES = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    """Return all nodes of the syntax tree of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Return the modules that each module imports, including imports in functions and for type checking."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_modules_do_not_import_each_other_in_a_cycle(imports: dict[str, set[str]]) -> None:
    assert len(imports) > 300
    assert _cycle(imports) == []


def test_packages_do_not_import_each_other_in_a_cycle(imports: dict[str, set[str]]) -> None:
    """In each package the import graph of its direct members has no cycle."""
    packages = {module.rpartition(".")[0] for module in imports} - {""}
    assert {"carlab", "carlab.diagnosis", "learning"} <= packages
    assert {package: cycle for package in packages if (cycle := _cycle(_members(imports, package)))} == {}


def _members(imports: dict[str, set[str]], package: str) -> dict[str, set[str]]:
    """Return the imports among the direct members of ``package``, without its ``__init__``."""
    depth = package.count(".") + 2

    def member(module: str) -> str:
        return ".".join(module.split(".")[:depth])

    within = [module for module in imports if module.startswith(f"{package}.")]
    return {
        name: {
            member(imported)
            for module in within
            if member(module) == name
            for imported in imports[module]
            if imported.startswith(f"{package}.")
        }
        - {name}
        for name in {member(module) for module in within}
    }


def _cycle(imports: dict[str, set[str]]) -> list[str]:
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_cycle_check_finds_a_cycle() -> None:
    imports = {"p.a.x": {"p.b.x"}, "p.b.x": set(), "p.b.y": {"p.a.y"}, "p.a.y": set(), "p.a": set(), "p.b": set()}
    assert _cycle(imports) == []
    assert set(_cycle(_members(imports, "p"))) == {"p.a", "p.b"}


def test_each_package_has_a_layer(imports: dict[str, set[str]]) -> None:
    """An exhaustive contract fails if a member of its package has no layer."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    covered = {
        container for contract in contracts if contract.get("exhaustive") for container in contract["containers"]
    }
    packages = {module.rpartition(".")[0] for module in imports} - {""}
    assert {parent for package in packages if (parent := package.rpartition(".")[0])} - covered == set()
    assert set(PACKAGES) <= covered


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_imports_no_heavy_dependency(package: str) -> None:
    heavy = (
        "torch",
        "serial",
        "can",
        "rerun",
        "mcap",
        "gymnasium",
        "scipy",
        "stable_baselines3",
        "pygame",
        "matplotlib",
    )
    code = f"import sys, {package}; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_importing_carlab_loads_fewer_than_40_modules() -> None:
    """The bound is on modules, because import seconds depend on machine load; 400 modules take about 0.2 s."""
    code = "import sys; before = set(sys.modules); import carlab; print(len(set(sys.modules) - before), *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    count, *loaded = done.stdout.split()
    assert int(count) < 40
    assert "numpy" not in loaded


def test_core_imports_numpy_array_api_compat_and_the_standard_library_only() -> None:
    imported = {
        name.split(".")[0]
        for path in (ROOT / "carlab" / "core").glob("*.py")
        for node in nodes(path)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names])
    }
    assert imported - sys.stdlib_module_names == {"carlab", "numpy", "array_api_compat"}


def test_only_the_command_line_prints() -> None:
    printing = {
        str(path.relative_to(ROOT))
        for path in SOURCES
        for node in nodes(path)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert {p for p in printing if not p.startswith("carlab/cli/")} == set()


def test_wall_clock_is_read_in_one_module() -> None:
    reading = {
        str(path.relative_to(ROOT))
        for path in SOURCES
        for node in nodes(path)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and (node.value.id, node.attr) in {("time", "time"), ("time", "time_ns"), ("datetime", "now")}
    }
    assert reading == {"carlab/core/clock.py"}


def test_each_package_is_typed() -> None:
    assert all((ROOT / package / "py.typed").is_file() for package in PACKAGES)


def test_files_have_at_most_400_lines() -> None:
    long = {str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text().splitlines())) > 400}
    assert long == {}


def test_functions_have_at_most_60_lines() -> None:
    """``reference_rates`` is excepted, because it is one table of equations."""
    sources = [*SOURCES, *(p for folder in ("tests", "docs", "examples") for p in (ROOT / folder).rglob("*.py"))]
    long = {
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in sources
        for node in nodes(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno is not None
        and node.end_lineno - node.lineno >= 60
    }
    assert long == {"tests/helpers/reference_dynamics.py: reference_rates"}
