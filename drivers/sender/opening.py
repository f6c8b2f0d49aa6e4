"""Opening of a device in a separate thread, since a port or an adapter may take seconds to open."""

from __future__ import annotations

import threading

from drivers.device import Device


class Opening:
    """One attempt to open a device; it starts on construction. Nothing else may use the device until it is over."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._open, name="open-device", daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether the attempt has succeeded or failed."""
        return not self._thread.is_alive()

    def require_success(self) -> None:
        """Raise the error of an attempt that has failed."""
        if self._error is not None:
            raise self._error

    def _open(self) -> None:
        try:
            self._device.open()
        except Exception as error:
            self._error = error
