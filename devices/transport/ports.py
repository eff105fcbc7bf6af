"""Which serial ports there are, and why one would not open: in words for the person at the bench."""

from __future__ import annotations

import errno
import getpass
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from serial.tools.list_ports import comports

from devices.errors import DeviceBusy, DeviceError

if TYPE_CHECKING:
    from collections.abc import Sequence

BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class Port:
    """A serial port of this machine: its device, the name that survives a reboot, and what it says it is."""

    device: str
    by_id: str | None
    description: str

    @property
    def name(self) -> str:
        """The name to write into an instrument file."""
        return self.by_id or self.device


def ports_present() -> list[Port]:
    """Return the serial ports that are really there; phantom ttyS ports describe themselves as ``n/a``."""
    stable = {str(link.resolve()): str(link) for link in BY_ID.glob("*")}
    found = [port for port in comports() if port.description != "n/a"]
    return [Port(port.device, stable.get(port.device), port.description) for port in sorted(found)]


def open_failure(device: str, port: str, number: int | None, cause: str) -> DeviceError:
    """Return the error for a port that did not open.

    Parameters
    ----------
    device : str
        What hangs on the port, such as ``"z stage"``.
    port : str
        The port's name.
    number : int or None
        The system's error number.
    cause : str
        The system's words.
    """
    if number == errno.EACCES:
        return _no_permission(device, port)
    if number in (errno.EAGAIN, errno.EBUSY):
        return DeviceBusy(
            f"{device}: {port} is in use by another program.",
            why="Another console, a terminal (minicom, screen, Arduino IDE) or ModemManager holds it.",
            fix=f"find it: sudo fuser -v {port}",
        )
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return _missing(device, port)
    return DeviceError(
        f"{device}: {port} cannot be opened as a serial port.",
        why=cause,
        fix="check the port's name in the instrument file; for a network port, that the other end is running.",
        code="device-missing",
    )


def _missing(device: str, port: str) -> DeviceError:
    names = [present.name for present in ports_present()]
    example = names[0] if names else "/dev/serial/by-id/..."
    return DeviceError(
        f"{device}: no serial port {port}.",
        why=f"Ports present now: {', '.join(names)}." if names else "There is no serial port on this machine now.",
        fix=(f'set port = "{example}" in the instrument file.', "work without hardware: stereotome demo"),
        code="device-missing",
    )


def _no_permission(device: str, port: str) -> DeviceError:
    user = getpass.getuser()
    group = port_group(port)
    if user in group_members(group):
        why = f"The port belongs to group '{group}'; user '{user}' is in it, but was not yet at this login."
        fix = "log out and in again"
    else:
        why = f"The port belongs to group '{group}', and user '{user}' is not in it."
        fix = f"run once: sudo usermod -aG {group} {user}   then log out and in again"
    return DeviceError(
        f"{device}: no permission to open {port}.",
        why=why,
        fix=(fix, "check afterwards: stereotome doctor"),
        code="device-permission",
    )


def port_group(port: str) -> str:
    """Return the group a port belongs to: its device says, for not every system calls it dialout."""
    try:
        return Path(port).group()
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def group_members(group: str) -> Sequence[str]:
    """Return the users of a group as the group database has them; none where there is no such database."""
    if os.name != "posix":
        return ()
    import grp  # noqa: PLC0415  exists on posix only

    try:
        return grp.getgrnam(group).gr_mem
    except KeyError:
        return ()
