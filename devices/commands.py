"""``stereotome devices list`` and ``stereotome devices probe``."""

from __future__ import annotations

import getpass
import json as json_text
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from devices.clock import SystemClock
from devices.holders import holders_of
from devices.probe import BAUDS, probe_port, words
from devices.registry import KINDS, drivers
from devices.transport.ports import group_members, port_group, ports_present

if TYPE_CHECKING:
    from devices.transport.ports import Port

NOBODY = 4


def list_devices(*, json: Annotated[bool, Parameter(negative="")] = False) -> None:
    """List the serial ports present now, who holds them, and the installed drivers.

    Parameters
    ----------
    json
        One JSON object instead of words.
    """
    ports = described_ports()
    installed = {kind: sorted(drivers(kind)) for kind in KINDS}
    if json:
        _print(json_text.dumps({"ports": ports, "drivers": installed}))
        return
    _print("Serial ports:" if ports else "Serial ports: none")
    for port in ports:
        _print(f"  {port['name']}  ({port['device']}, {port['description']})")
        for remark in (*(f"in use by {holder}" for holder in port["held_by"]), port["hint"]):
            if remark:
                _print(f"      {remark}")
    for kind, names in installed.items():
        _print(f"{kind.capitalize()} drivers: {', '.join(names)}")


def described_ports() -> list[dict[str, Any]]:
    """Return the serial ports present now: name, device, description, who holds each, what keeps this user out."""
    return [_described(port) for port in ports_present()]


def _described(port: Port) -> dict[str, Any]:
    return {
        "name": port.name,
        "device": port.device,
        "description": port.description,
        "held_by": [str(holder) for holder in holders_of(port.device)],
        "hint": _permission_hint(port.device),
    }


def _permission_hint(device: str) -> str:
    """Return what keeps this user from opening a port that is there, and the way out; nothing if nothing does."""
    if os.access(device, os.R_OK | os.W_OK) or not Path(device).exists():
        return ""
    group, user = port_group(device), getpass.getuser()
    if user in group_members(group):
        return f"no permission yet: user '{user}' is in group '{group}' from the next login on"
    return f"no permission: sudo usermod -aG {group} {user}   then log out and in again"


def probe(port: str, /, *, baud: tuple[int, ...] = BAUDS, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Ask who is at a serial port, by questions that change nothing, and show every byte that came back.

    Parameters
    ----------
    port
        The port, as `stereotome devices list` names it.
    baud
        Try this speed only; may be given more than once. Never 1200.
    json
        One JSON object instead of words.
    """
    report = probe_port(port, baud, SystemClock())
    if json:
        seen = [{"baud": one.baud, "sent": one.sent.hex(), "received": one.received.hex()} for one in report.exchanges]
        _print(json_text.dumps({"found": report.found and asdict(report.found), "exchanges": seen}))
    else:
        for line in words(report, port):
            _print(line)
    return 0 if report.found else NOBODY


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")
