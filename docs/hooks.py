"""MkDocs hooks: fill generated sections (command line help, effects, decisions) when the site is built."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import json
import os
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
INCOMPLETE_PAGE = "In the repository this page is incomplete: `make docs` writes the complete page to `build/site`.\n\n"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace each ``<!-- generated: NAME -->`` by its text; hide markers of tests and the note for the repository."""
    markdown = markdown.replace(INCOMPLETE_PAGE, "")
    for name, section in SECTIONS.items():
        marker = f"<!-- generated: {name} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, section())
    return re.sub(r"<!-- test: [^>]*-->\n", "", markdown)


def _command_line() -> str:
    return "\n".join(f"## carlab {verb}\n\n```text\n{_help(verb)}\n```\n" for verb in _verbs())


def _verbs() -> list[str]:
    from carlab.cli import _verbs

    return list(_verbs())


def _help(verb: str) -> str:
    from carlab.cli import run

    os.environ["COLUMNS"] = "110"
    captured = io.StringIO()
    with contextlib.redirect_stdout(captured), contextlib.suppress(SystemExit):
        run([verb, "--help"])
    return re.sub(r"\x1b\[[0-9;]*m", "", captured.getvalue()).strip()


def _decisions() -> str:
    records = sorted(path for path in (DOCS / "decisions").glob("[0-9]*.md"))
    titles = [path.read_text(encoding="utf-8").split("\n", 1)[0].lstrip("# ") for path in records]
    return "\n".join(f"* [{title}]({path.name})" for path, title in zip(records, titles, strict=True))


def _effects() -> str:
    from sim_backends.effects import CATALOGUE, EFFECTS

    return "\n".join(_effect(EFFECTS[name]) for name in CATALOGUE)


def _curves() -> str:
    from sim_backends.effects import CURVES

    return "\n".join(_curve(curve) for curve in CURVES)


def _curve(curve: Any) -> str:
    axes = "\n".join(
        f"| {axis.name} | {axis.unit} | {', '.join(f'{knot:g}' for knot in axis.knots)} | "
        f"{'' if axis.anchor is None else f'{axis.anchor:g}'} |"
        for axis in curve.axes
    )
    equation = (type(curve).__doc__ or "").split("\n\n")[0]
    unit = "The curve has no unit." if curve.unit == "1" else f"Unit: {curve.unit}."
    return (
        f"### {curve.id}\n\n{curve.summary} {equation} {unit}\n\n"
        f"| over | unit | knots | deviation is 0 at |\n| --- | --- | --- | --- |\n{axes}\n"
    )


def _parameter(p: Any) -> str:
    """A row of the table of an effect's parameters; car files have the words of a choice."""
    if p.choices:
        words = [f"`{word}`" for word in p.choices]
        return f"| `{p.name}` | {p.unit} | {words[0]} | {' or '.join(words)} | {words[0]} |"
    return f"| `{p.name}` | {p.unit} | {p.same_as or p.identity} | {p.low:g} to {p.high:g} | {p.typical:g} |"


def _effect(effect: Any) -> str:
    from sim_backends.effects import confusable_effects, separation

    rows = "\n".join(_parameter(p) for p in effect.parameters)
    picture = DOCS / "images" / "effects" / f"{effect.id}.png"
    shown = (
        f"![{effect.id}: drive with and without the effect](../images/effects/{effect.id}.png)\n"
        if picture.is_file()
        else ""
    )
    links = []
    for name in confusable_effects()[effect.id]:
        found = separation(effect.id, name)
        drive = f" (`{found.drive}`)" if found is not None and found.drive else " (no drive separates them)"
        links.append(f"[`{name}`](#{name}){drive}")
    return (
        f"## `{effect.id}` {{ #{effect.id} }}\n\n{effect.summary} In reports: {effect.name}.\n\n"
        f"{inspect.getdoc(type(effect))}\n\n"
        f"| parameter | unit | identity | range | typical |\n| --- | --- | --- | --- | --- |\n{rows}\n\n"
        f"Kind: {effect.kind}. Confusable with: {', '.join(links) or 'none'}.\n\n{shown}"
    )


def _tables_of_hardware() -> str:
    from carlab.core.safety import SafetyEnvelope
    from drivers.calibration import ActuatorCalibration
    from drivers.config import ActuatorConfig
    from mocap.config import MocapConfig

    tables = {"actuator": ActuatorConfig, "calibration": ActuatorCalibration, "mocap": MocapConfig}
    return "\n".join(_table_of_hardware(name, cls) for name, cls in (tables | {"limits": SafetyEnvelope}).items())


def _table_of_hardware(name: str, cls: type) -> str:
    """Text of a table of ``[hardware]``, and its keys with their default values."""
    from carlab.cli.help_texts import attribute_texts

    text = (inspect.getdoc(cls) or "").split("\n\nRaises:")[0]
    meanings = attribute_texts(cls)
    rows = [
        f"| `{field.name}` | `{_toml(field.default)}` |" + (f" {meanings.get(field.name, '')} |" if meanings else "")
        for field in dataclasses.fields(cls)
        if field.name != "arena_m"  # the corners of [hardware.arena]
    ]
    head = "| key | default |\n| --- | --- |"
    if meanings:
        head = "| key | default | meaning |\n| --- | --- | --- |"
    return "\n".join([f"### `[hardware.{name}]`\n\n{text}\n\n{head}", *rows, ""])


def _toml(value: Any) -> str:
    """A default value as a car file states it."""
    return "none" if value is None else json.dumps(value)


SECTIONS = {
    "cli": _command_line,
    "effects": _effects,
    "curves": _curves,
    "hardware": _tables_of_hardware,
    "decisions": _decisions,
}
