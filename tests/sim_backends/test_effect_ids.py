"""Test that effect ids occur as strings in the effect classes only."""

import ast
import re
from pathlib import Path

from sim_backends.effects import EFFECTS

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("carlab", "drivers", "learning", "mocap", "sim_backends")
OWN_GENERATOR = ROOT / "carlab" / "benchmark"
"""The simulator of the proof is independent and has its own catalogue."""
EFFECT_CLASSES = ROOT / "sim_backends" / "effects"
DOTTED = re.compile(rf"\beffects\.({'|'.join(EFFECTS)})\b")


def ids_in(source: str) -> list[tuple[int, str]]:
    """Return lines and texts of string constants that are an effect id or a dotted name with one."""
    tree = ast.parse(source)
    # One id of the recording audit equals an effect id.
    findings = {
        id(node.args[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and node.args and ast.unparse(node.func).rpartition(".")[2] == "Finding"
    }
    return [
        (node.lineno, node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in findings
        if node.value in EFFECTS or (DOTTED.search(node.value) and " " not in node.value)
    ]


def test_effect_ids_in_source_are_found() -> None:
    assert ids_in('if name == "steering_lag": pass') == [(1, "steering_lag")]
    assert ids_in('LATENCY = "effects.mocap_latency.latency"') == [(1, "effects.mocap_latency.latency")]
    assert ids_in('f"effects.wind.{name}"') == [(1, "effects.wind.")]
    assert ids_in('"""A steady wind."""\nname = "timing.command_delay"') == []


def test_no_effect_id_is_a_string_outside_the_effect_classes() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if not path.is_relative_to(OWN_GENERATOR) and not path.is_relative_to(EFFECT_CLASSES)
        for line, text in ids_in(path.read_text(encoding="utf-8"))
    }
    assert found == set()
