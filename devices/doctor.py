"""``stereotome doctor``: is this machine ready, and if not, what to do about it."""

from __future__ import annotations

import ctypes
import getpass
import json as json_text
import os
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.transport.ports import group_members, port_group, ports_present

if TYPE_CHECKING:
    from collections.abc import Iterator

OLDEST_PYTHON = (3, 11)
GRAPHICS = {"libGL.so.1": "libgl1", "libEGL.so.1": "libegl1", "libX11.so.6": "libx11-6", "libXrandr.so.2": "libxrandr2"}
LEAST_DISK_GB = 5.0
LEAST_SHM_MB = 256.0
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108  where the ring lives


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes
    ----------
    essential : bool
        Nothing works without it; the others only take something away.
    fix : str
        What to do; empty when all is well.
    """

    name: str
    ok: bool
    found: str
    fix: str = ""
    essential: bool = False

    def line(self) -> str:
        """Return the finding in words."""
        mark = "ok  " if self.ok else "FAIL" if self.essential else "note"
        return f"{mark}  {self.name}: {self.found}" + (f"\n      fix: {self.fix}" if self.fix else "")


def doctor(*, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Look at Python, packages, serial ports, graphics, display, disk and shared memory, and say how to mend them.

    Ends with exit code 0 when everything essential is there.

    Parameters
    ----------
    json
        One JSON object instead of words.
    """
    findings = list(examine())
    healthy = all(finding.ok for finding in findings if finding.essential)
    if json:
        sys.stdout.write(json_text.dumps({"ok": healthy, "findings": [asdict(one) for one in findings]}) + "\n")
    else:
        sys.stdout.writelines(f"{finding.line()}\n" for finding in findings)
    return 0 if healthy else 1


def examine() -> Iterator[Finding]:
    """Yield a finding for everything there is to look at."""
    yield python_version(sys.version_info[:3])
    yield packages(_required())
    yield serial_ports()
    yield from serial_permissions()
    yield graphics(GRAPHICS)
    yield display(os.environ, sys.platform)
    yield disk(Path.cwd())
    yield shared_memory(SHARED_MEMORY)


def python_version(present: tuple[int, ...]) -> Finding:
    """Is Python new enough."""
    words = ".".join(map(str, present))
    oldest = ".".join(map(str, OLDEST_PYTHON))
    good = present >= OLDEST_PYTHON
    return Finding("python", good, words, "" if good else f"install Python {oldest} or newer.", essential=True)


def packages(names: list[str]) -> Finding:
    """Are all packages of this program installed."""
    missing = [name for name in names if not _installed(name)]
    if missing:
        return Finding("packages", ok=False, found=f"missing: {', '.join(missing)}", fix="./run test", essential=True)
    return Finding("packages", ok=True, found=f"all {len(names)} installed", essential=True)


def serial_ports() -> Finding:
    """Name the serial ports."""
    names = [port.name for port in ports_present()]
    if names:
        return Finding("serial ports", ok=True, found=", ".join(names))
    fix = "plug in the controller; without hardware: stereotome demo"
    return Finding("serial ports", ok=False, found="none present", fix=fix)


def serial_permissions() -> Iterator[Finding]:
    """May this user open each of the ports."""
    for port in ports_present():
        if os.access(port.device, os.R_OK | os.W_OK):
            yield Finding(f"permission {port.device}", ok=True, found="may be opened")
        else:
            yield _no_permission(port.device)


def _no_permission(device: str) -> Finding:
    user, group = getpass.getuser(), port_group(device)
    if user in group_members(group):
        found, fix = f"user '{user}' joined group '{group}' after this login", "log out and in again"
    else:
        found = f"belongs to group '{group}', and user '{user}' is not in it"
        fix = f"sudo usermod -aG {group} {user}   then log out and in again"
    return Finding(f"permission {device}", ok=False, found=found, fix=fix)


def graphics(libraries: dict[str, str]) -> Finding:
    """Can the graphics libraries be loaded."""
    if not sys.platform.startswith("linux"):
        return Finding("graphics", ok=True, found="part of the system")
    missing = [name for name in libraries if not _loads(name)]
    if not missing:
        return Finding("graphics", ok=True, found=", ".join(libraries))
    fix = f"sudo apt install {' '.join(libraries[name] for name in missing)}"
    return Finding("graphics", ok=False, found=f"missing: {', '.join(missing)}", fix=fix)


def display(environment: os._Environ[str] | dict[str, str], platform: str) -> Finding:
    """Is there a screen to show a window on."""
    if not platform.startswith("linux"):
        return Finding("display", ok=True, found="the system's own")
    name = environment.get("WAYLAND_DISPLAY") or environment.get("DISPLAY")
    if name:
        return Finding("display", ok=True, found=name)
    fix = "start from a desktop session; runs, processing and pictures in files need none"
    return Finding("display", ok=False, found="neither DISPLAY nor WAYLAND_DISPLAY is set", fix=fix)


def disk(folder: Path) -> Finding:
    """Is there room for data here."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    good = free_gb >= LEAST_DISK_GB
    fix = "" if good else "free some space, or choose another folder: --out DIR"
    return Finding("disk", good, f"{free_gb:.1f} GB free in {folder}", fix)


def shared_memory(folder: Path) -> Finding:
    """Is there room for the frames on their way from process to process."""
    place = folder if folder.is_dir() else Path(tempfile.gettempdir())
    free_mb = shutil.disk_usage(place).free / 1e6
    good = free_mb >= LEAST_SHM_MB
    fix = "" if good else f"sudo mount -o remount,size=2G {folder}   (a container: --shm-size=2g)"
    return Finding("shared memory", good, f"{free_mb:.0f} MB free in {place}", fix)


def _required() -> list[str]:
    """Return the names of the packages this program depends on."""
    cut = str.maketrans(dict.fromkeys("<>=!~;[(", " "))
    return [line.translate(cut).split()[0] for line in requires("stereotome") or () if "extra ==" not in line]


def _installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
