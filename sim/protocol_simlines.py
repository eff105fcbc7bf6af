"""What pyserial opens for ``simlines://NAME``; it looks for a module of this name. See `sim.simlines`."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from serial import SerialException
from serial.serialutil import SerialBase

from sim.simlines import plugged

if TYPE_CHECKING:
    from sim.simlines import Circuit


class Serial(SerialBase):
    """A port with modem lines and no bytes."""

    _circuit: Circuit

    def open(self) -> None:
        """Take the circuit; like a real port, for one at a time."""
        circuit = plugged(str(self.port).partition("://")[2])
        if circuit is None:
            raise SerialException(errno.ENOENT, f"no circuit at {self.port}")
        if circuit.taken:
            raise SerialException(errno.EAGAIN, f"{self.port} is taken")
        self._circuit = circuit
        circuit.taken = self.is_open = True
        if "no-lines" not in circuit.faults:
            self._update_rts_state()

    def close(self) -> None:
        """Let go; both lines fall."""
        if self.is_open:
            self.is_open = self._circuit.taken = False
            if not self._circuit.faults & {"gone", "no-lines"}:
                self._circuit.switch(dtr=False, rts=False)

    @property
    def cts(self) -> bool:
        """State of CTS."""
        return self._circuit.clear_to_send()

    def _reconfigure_port(self) -> None:
        """Nothing to set."""

    def _update_rts_state(self) -> None:
        self._circuit.switch(dtr=bool(self.dtr), rts=bool(self.rts))

    def _update_dtr_state(self) -> None:
        self._update_rts_state()
