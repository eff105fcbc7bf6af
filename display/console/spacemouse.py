"""3-D mice by 3Dconnexion on Linux, read from their hidraw device; pushing up or pulling moves the stage.

Report 1 carries three 16-bit numbers, x, y, z, little-endian, about ±350 at the end of the way, z positive downwards;
report 3 the buttons, a bit each. As in spacenavd's and pyspacemouse's tables; not tried with a real device here. While
the cap is displaced reports come every few ms, so silence means that it rests, or is gone.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

from devices.errors import DeviceError
from display.console.sticks import Reading

CLASS = Path("/sys/class/hidraw")
VENDORS = {0x256F: None, 0x046D: range(0xC603, 0xC630)}  # 3Dconnexion; Logitech, who sold them before
FULL = 350.0
TRANSLATION, BUTTONS = 1, 3
LONGEST, SHORTEST, Z_AT = 64, 7, 5


def found(folder: Path = CLASS) -> list[Path]:
    """Return the devices of 3-D mice that are plugged in."""
    if not folder.is_dir():
        return []
    return [Path("/dev") / each.name for each in sorted(folder.iterdir()) if _is_one(each / "device" / "uevent")]


def _is_one(uevent: Path) -> bool:
    try:
        lines = dict(line.split("=", 1) for line in uevent.read_text().splitlines() if "=" in line)
        _, vendor, product = (int(part, 16) for part in lines["HID_ID"].split(":"))
    except (OSError, KeyError, ValueError):
        return False
    return vendor in VENDORS and (VENDORS[vendor] is None or product in (VENDORS[vendor] or ()))


class SpaceMouse:
    """One 3-D mouse; its first button is the dead man's.

    Raises
    ------
    DeviceError
        ``device-permission`` and ``device-missing``: it cannot be opened.
    """

    def __init__(self, path: Path, name: str = "3-D mouse") -> None:
        self.name = name
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except PermissionError:
            raise DeviceError(
                f"no permission to read {path}.",
                fix='a udev rule: KERNEL=="hidraw*", ATTRS{idVendor}=="256f", TAG+="uaccess"',
                code="device-permission",
            ) from None
        except OSError as cause:
            raise DeviceError(f"{path} cannot be opened: {cause.strerror}.", code="device-missing") from None
        self._rate = 0.0
        self._held = False
        self._told_s = 0.0

    def read(self, now_s: float) -> Reading | None:
        """Return where the cap is; a displaced cap that tells nothing is old, one at rest is not. None: unplugged."""
        while True:
            try:
                report = os.read(self._file, LONGEST)
            except BlockingIOError:
                return Reading(self._rate, self._held, self._told_s if self._rate else now_s)
            except OSError:
                return None
            if not report:
                return None
            self._take(report, now_s)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)

    def _take(self, report: bytes, now_s: float) -> None:
        if report[0] == TRANSLATION and len(report) >= SHORTEST:
            (down,) = struct.unpack_from("<h", report, Z_AT)
            self._rate, self._told_s = max(-1.0, min(-down / FULL, 1.0)), now_s
        if report[0] == BUTTONS and len(report) > 1:
            self._held = bool(report[1] & 1)
