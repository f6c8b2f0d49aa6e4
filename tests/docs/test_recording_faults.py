"""The page of recording faults has every id that the code can report, and no other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CHECKS = ("carlab/recording/faults", "carlab/recording/audit", "carlab/diagnosis/recording_faults", "carlab/api")
ID_POSITION = {"Fault": 0, "Finding": 0, "DataFault": 0, "report": 0, "at": 1}
"""Position of the id among the arguments, by the name of the called function."""


def test_page_lists_every_id_of_a_fault() -> None:
    """Ids in the first column of the page's tables are those of the calls that make faults and findings."""
    page = (ROOT / "docs/reference/recording-faults.md").read_text(encoding="utf-8")
    first_cells = re.findall(r"^\|([^|]*)\|", page, flags=re.MULTILINE)
    listed = {name for cell in first_cells for name in re.findall(r"`(\w+)`", cell.split(" of ")[0])}
    assert listed == set(_reported_ids())


def _reported_ids() -> Iterator[str]:
    for folder in CHECKS:
        for path in sorted((ROOT / folder).glob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            constants = _strings_by_name(tree)
            for call in ast.walk(tree):
                if isinstance(call, ast.Call) and (position := ID_POSITION.get(_called(call))) is not None:
                    for argument in call.args[position : position + 1]:
                        yield from _strings(argument, constants)


def _called(call: ast.Call) -> str:
    function = call.func
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def _strings_by_name(tree: ast.AST) -> dict[str, list[str]]:
    """Strings that a name may have, by assignments ``name = "a"`` and ``name = "a" if condition else "b"``."""
    return {
        target.id: list(_strings(node.value, {}))
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def _strings(node: ast.expr, names: dict[str, list[str]]) -> Iterator[str]:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.IfExp):
        yield from _strings(node.body, names)
        yield from _strings(node.orelse, names)
    elif isinstance(node, ast.Name):
        yield from names.get(node.id, [])
