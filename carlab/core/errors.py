"""All errors that carlab raises deliberately.

    CarlabError
    ├── ConfigError (ValueError)         an error in a file or option: names the key and the nearest known key
    ├── DataError (ValueError)           an error in a recording or packet: names the row, the column or the byte
    │   ├── DivergedError                learned parameters diverged to NaN or infinity
    │   └── ProtocolError                bytes that violate their protocol
    ├── NotReadyError (ConnectionError)  a car, port or camera system is missing; lists all reasons
    ├── NotOpenError (RuntimeError)      used before open() or after close()
    ├── NotArmedError (RuntimeError)     a moving command before arm()
    ├── ActionOutOfRangeError (ValueError)  a command beyond the car's limits, or not a number
    ├── PoseLostError (TimeoutError)     no pose, or too old a pose
    ├── ActuatorFaultError (OSError)     the link, the firmware or the sender process failed; latched
    └── SafetyStop                       the safety gate ended the episode (in carlab.core.safety)

Each message is one sentence with the remedy. The command line prints the message and exits with ``exit_code``.
"""

from __future__ import annotations

from collections.abc import Sequence


class CarlabError(Exception):
    """Base of all deliberate errors. ``exit_code`` is the exit code of the command line."""

    exit_code = 1


class ConfigError(CarlabError, ValueError):
    """An error in a configuration file or an option."""

    exit_code = 2


class DataError(CarlabError, ValueError):
    """An error in a recording or a packet."""


class DivergedError(DataError):
    """Training diverged to NaN or infinity; smaller steps or another seed may help."""


class ProtocolError(DataError):
    """Bytes that violate their protocol."""


class NotReadyError(CarlabError, ConnectionError):
    """A required device or service is missing; ``reasons`` holds all reasons found."""

    exit_code = 3

    def __init__(self, what: str, reasons: Sequence[str] = ()) -> None:
        self.what = what
        self.reasons = tuple(reasons)
        if len(self.reasons) == 1:
            message = f"{what}: {self.reasons[0]}"
        else:
            message = what + "".join(f"\n  - {reason}" for reason in self.reasons)
        super().__init__(message)


class NotOpenError(CarlabError, RuntimeError):
    """A car or device was used before open() or after close()."""


class NotArmedError(CarlabError, RuntimeError):
    """A command other than neutral was given to a car that is not armed."""

    exit_code = 4


class ActionOutOfRangeError(CarlabError, ValueError):
    """A command is not a number or lies beyond the car's limits."""

    exit_code = 4


class PoseLostError(CarlabError, TimeoutError):
    """Motion capture delivers no usable pose."""

    exit_code = 4


class ActuatorFaultError(CarlabError, OSError):
    """The actuator link, its firmware or the sender process failed. Latched until reset."""

    exit_code = 4


def first_line(error: BaseException) -> str:
    """First line of the text of an error, with the last one after a colon; without a text its type."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return f"{lines[0]} {lines[-1].strip()}" if lines[0].endswith(":") and len(lines) > 1 else lines[0]


def add_sentence(error: BaseException, sentence: str) -> None:
    """Append a sentence to the message of a CarlabError; another error gets it as a note, which its traceback shows."""
    if isinstance(error, CarlabError):
        message = str(error)
        separator = "\n" if "\n" in message else " "
        error.args = (f"{message}{separator}{sentence}",)
    else:
        error.add_note(sentence)
