"""Help texts of options: wrapped at the width of the terminal, without empty defaults."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from dataclasses import MISSING, fields, is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro
from docstring_parser import parse
from docstring_parser.attrdoc import AttributeDocstrings

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

    The text is the attribute docstring, or that of the argument of the call (``carlab.cli.options.options_of``). tyro
    keeps the line breaks of attribute docstrings, but not those of an ``Args`` section in the docstring of a class.
    Therefore this function copies the texts into such a section.
    """
    summary = inspect.getdoc(option_class) or ""
    texts = _argument_texts(option_class) | attribute_texts(option_class)
    rows = [f"    {name}: {' '.join(texts[name].split())}" for name in _option_names(option_class) if name in texts]
    if rows and MARK not in summary:
        option_class.__doc__ = summary + MARK + "\n".join(rows)


def _option_names(option_class: type) -> list[str]:
    """Names of the options of a class, without those of its groups of options."""
    return [field.name for field in fields(option_class) if field.default_factory is MISSING]


def attribute_texts(option_class: type) -> dict[str, str]:
    """The text after each attribute of a class that has one."""
    return {name: text for name, (text, *_) in AttributeDocstrings().get_attr_docs(option_class).items() if text}


def _argument_texts(option_class: type) -> dict[str, str]:
    """Texts of the arguments of the class's calls, with the names of options; "as for ..." counts as no text."""
    names = _option_names(option_class)

    def as_option(match: re.Match[str]) -> str:
        return f"--{match[1].replace('_', '-')}" if match[1] in names else match[1]

    texts: dict[str, str] = {}
    for call in getattr(option_class, "calls", ()):
        arguments = {each.arg_name: each.description or "" for each in parse(call.__doc__ or "").params}
        for name, text in (arguments | (attribute_texts(call) if isinstance(call, type) else {})).items():
            if not text.startswith("as for "):
                texts.setdefault(name, re.sub("``(.*?)``", as_option, text[:1].upper() + text[1:]))
    return texts


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
