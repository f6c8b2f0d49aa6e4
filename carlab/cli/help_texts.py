"""Help texts of options without the line breaks of the source code."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import is_dataclass

MARK = "\n\nArgs:\n"


def join_help_lines(option_classes: Iterable[type]) -> None:
    """Join the lines of each option's help text, so that tyro wraps the text at the width of the terminal.

    tyro keeps the line breaks of attribute docstrings, but not those of an ``Args`` section in the docstring of a
    class. Therefore this function copies the attribute docstrings into such a section.

    Args:
        option_classes: dataclasses with options; their base classes are included.
    """
    from docstring_parser.attrdoc import AttributeDocstrings

    for option_class in dict.fromkeys(c for given in option_classes for c in given.__mro__ if is_dataclass(c)):
        summary = inspect.getdoc(option_class) or ""
        texts = AttributeDocstrings().get_attr_docs(option_class)
        rows = [f"    {name}: {' '.join(text.split())}" for name, (text, *_) in texts.items() if text]
        if rows and MARK not in summary:
            option_class.__doc__ = summary + MARK + "\n".join(rows)


__all__ = ["join_help_lines"]
