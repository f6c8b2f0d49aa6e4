"""Common options of several verbs, and checks of output files."""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from carlab.api.cars import car_options_text
from carlab.api.driving import drive
from carlab.core.errors import ConfigError, DataError

ARGUMENT_DEFAULT: Any = object()
"""Stands for the default of the argument with the name of the option (``options_of``)."""
T = TypeVar("T")


def options_of(*calls: Callable[..., Any]) -> Callable[[type[T]], type[T]]:
    """Class decorator below ``@dataclass``: options are arguments of functions of the Python API, or of dataclasses.

    An option whose value is ``ARGUMENT_DEFAULT`` has the default of the argument of its name. An option without a help
    text has the text of that argument (``carlab.cli.help_texts``). The first call with that argument counts.
    """

    def with_defaults(option_class: type[T]) -> type[T]:
        arguments = {name: p for call in reversed(calls) for name, p in inspect.signature(call).parameters.items()}
        for name in [name for name, value in vars(option_class).items() if value is ARGUMENT_DEFAULT]:
            setattr(option_class, name, arguments[name].default)
        option_class.calls = calls  # type: ignore[attr-defined]
        return option_class

    return with_defaults


@dataclass
@options_of(drive)
class CarOptions:
    """Options that select the car."""

    car: str = ARGUMENT_DEFAULT
    vehicle: Path | None = ARGUMENT_DEFAULT
    dry_run: bool = ARGUMENT_DEFAULT
    reality: Path | None = ARGUMENT_DEFAULT

    def to_text(self) -> str:
        """These options as command-line text, each with a leading space; default values are omitted."""
        return car_options_text(**vars(self))


@dataclass
@options_of(drive)
class TaskOptions:
    """Options that select the task."""

    task: str | None = ARGUMENT_DEFAULT
    """parking, obstacles (parking behind four discs), path (figure eight), laps, or FILE.py:CLASS: a class in your own
    file, derived from carlab.core.task.Task. By default parking, or the task of a run that is resumed or driven again.
    A run folder contains no code, so a run with your own task needs FILE.py:CLASS again."""

    track: Path | None = ARGUMENT_DEFAULT

    def to_text(self) -> str:
        """These options as command-line text, each with a leading space; default values are omitted."""
        given = {"--task": self.task, "--track": self.track}
        return "".join(f" {option} {shlex.quote(str(value))}" for option, value in given.items() if value is not None)


def arguments_of(verb: Any, call: Callable[..., Any]) -> dict[str, Any]:
    """The options of a verb that are arguments of a function or class, by name."""
    values = dict(vars(verb))
    for group in ("car", "task"):
        if is_dataclass(values.get(group)):
            values |= vars(values.pop(group))
    return {name: values[name] for name in inspect.signature(call).parameters if name in values}


def registry_without_none() -> ConstructorRegistry:
    """Rules of tyro in which ``None`` is no value of an option: an option is ``None`` only if it is not given."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        types = get_args(info.type)
        if len(types) != 2 or NoneType not in types:
            return None
        (value_type,) = (each for each in types if each is not NoneType)
        values = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(value_type, info.markers))
        assert isinstance(values, PrimitiveConstructorSpec)
        return replace(
            values,
            is_instance=lambda value: value is None or values.is_instance(value),
            str_from_instance=lambda value: [str(value)] if value is None else values.str_from_instance(value),
        )

    return registry


def new_file(path: Path, option: str, suffix: str) -> None:
    """Check the path of a new file before the work begins; its folder may be missing.

    Raises:
        ConfigError: the name has another suffix.
        DataError: the file exists, or cannot be created.
    """
    if path.suffix != suffix:
        raise ConfigError(f"{option} {path}: name a file that ends in {suffix}.")
    if path.exists():
        raise DataError(f"{path} exists already; remove it or choose another {option}.")
    check_folder(path.parent, f"{option} {path}")


def check_folder(folder: Path, where: str) -> None:
    """Check that files can be written into a folder, which may be missing. Raises DataError that begins ``where``."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise DataError(f"{where}: {existing} is a file; choose another folder.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise DataError(f"{where}: {existing} is not writable; choose another folder or change its permissions.")


def json_file(path: Path, option: str) -> None:
    """Check the path of a JSON file. Raises ConfigError for another suffix or a missing folder."""
    if path.suffix != ".json" or path.is_dir():
        raise ConfigError(f"{option} {path}: name a file that ends in .json.")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; create it first.")


def log_file(path: Path, option: str) -> None:
    """Check the path of a file to which lines will be appended; it may exist already.

    Raises:
        ConfigError: the path is a folder, or its folder is missing.
        DataError: the file or its folder is not writable.
    """
    if path.is_dir():
        raise ConfigError(f"{option} {path}: it is a folder; name a file in it, such as {path / 'commands.jsonl'}.")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; create it first.")
    if not path.exists():
        check_folder(path.parent, f"{option} {path}")
    elif not os.access(path, os.W_OK):
        raise DataError(f"{option} {path}: it is not writable; choose another file or change its permissions.")
