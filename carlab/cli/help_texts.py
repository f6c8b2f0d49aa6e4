"""Help texts of options: wrapped at the width of the terminal, without empty defaults."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro

MARK = "\n\nArgs:\n"
EMPTY_DEFAULTS = ("", "''", "None")
"""Empty defaults, as tyro prints them."""


def improve_help(option_classes: Iterable[type]) -> None:
    """Change option classes so that tyro prints readable help texts.

    Args:
        option_classes: dataclasses with options; their base classes are included.
    """
    for option_class in dict.fromkeys(c for given in option_classes for c in given.__mro__ if is_dataclass(c)):
        _join_lines(option_class)
        _omit_empty_defaults(option_class)


def _join_lines(option_class: type) -> None:
    """Join the lines of each option's help text, so that tyro wraps the text at the width of the terminal.

    tyro keeps the line breaks of attribute docstrings, but not those of an ``Args`` section in the docstring of a
    class. Therefore this function copies the attribute docstrings into such a section.
    """
    from docstring_parser.attrdoc import AttributeDocstrings

    summary = inspect.getdoc(option_class) or ""
    texts = AttributeDocstrings().get_attr_docs(option_class)
    rows = [f"    {name}: {' '.join(text.split())}" for name, (text, *_) in texts.items() if text]
    if rows and MARK not in summary:
        option_class.__doc__ = summary + MARK + "\n".join(rows)


def _omit_empty_defaults(option_class: type) -> None:
    """Print ``--track PATH`` instead of ``--track PATH (default: None)``."""
    own = vars(option_class).get("__annotations__", {})
    hints = get_type_hints(option_class, include_extras=True)
    for name in own:
        value_type, *markers = get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        if not is_dataclass(value_type):
            given: Any = next((each for each in markers if isinstance(each, _SETTINGS)), tyro.conf.arg())
            others = [each for each in markers if each is not given]
            own[name] = Annotated[value_type, *others, replace(given, help_behavior_hint=_default_text)]


_SETTINGS = type(tyro.conf.arg())


def _default_text(default: str) -> str:
    return "" if default in EMPTY_DEFAULTS else f"(default: {default})"
