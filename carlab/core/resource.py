"""Objects that a with block opens and closes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Resource(ABC):
    """Something to open and close. A with block does both, and also closes it if ``open`` fails."""

    @abstractmethod
    def open(self) -> None:
        """Acquire what the object needs; idempotent."""

    @abstractmethod
    def close(self) -> None:
        """Release it; idempotent, and safe after a failed ``open``."""

    def __enter__(self) -> Self:
        try:
            self.open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()
