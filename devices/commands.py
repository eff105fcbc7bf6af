"""``stereotome devices list`` and ``stereotome config check``."""

from __future__ import annotations

import json as json_text
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from devices.errors import RigError
from devices.registry import drivers
from devices.transport.ports import ports_present

if TYPE_CHECKING:
    from pydantic import BaseModel

MODELS = "stereotome.models"


def list_devices(*, json: Annotated[bool, Parameter(negative="")] = False) -> None:
    """List the serial ports present now and the installed drivers.

    Parameters
    ----------
    json
        One JSON object instead of words.
    """
    ports = [{"name": port.name, "device": port.device, "description": port.description} for port in ports_present()]
    installed = {"stage": sorted(drivers("stage")), "camera": sorted(drivers("camera"))}
    if json:
        _print(json_text.dumps({"ports": ports, "drivers": installed}))
        return
    _print("Serial ports:" if ports else "Serial ports: none")
    for port in ports:
        _print(f"  {port['name']}  ({port['device']}, {port['description']})")
    for kind, names in installed.items():
        _print(f"{kind.capitalize()} drivers: {', '.join(names)}")


def check_config(files: list[Path], /) -> int:
    """Check instrument and recipe files; which of the two a file is, its tables tell.

    Parameters
    ----------
    files
        Instrument or recipe files.
    """
    worst = 0
    for path in files:
        try:
            kind = _check(path)
            _print(f"{path}: a good {kind} file.")
        except RigError as error:
            sys.stderr.write(f"{error.message()}\n")
            worst = error.exit_code
    return worst


def _check(path: Path) -> str:
    from devices.toml_model import load_model  # noqa: PLC0415  `devices list` does without the file reader

    kind = _kind_of(path)
    load_model(path, _models()[kind], RigError)
    return kind


def _kind_of(path: Path) -> str:
    """Return the kind of file whose tables ``path`` has; one that cannot be read counts as an instrument file."""
    try:
        keys = tomllib.loads(path.read_text(encoding="utf-8")).keys()
    except (OSError, ValueError):
        return "instrument"
    return max(_models(), key=lambda kind: len(keys & _tables(kind)))


def _tables(kind: str) -> set[str]:
    """Return the tables that only this kind of file has."""
    models = _models()
    others = {name for other, model in models.items() if other != kind for name in model.model_fields}
    return set(models[kind].model_fields) - others


def _models() -> dict[str, type[BaseModel]]:
    return {point.name: point.load() for point in entry_points(group=MODELS)}


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")
