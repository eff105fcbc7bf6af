"""What the console remembers for its user between two starts: one small JSON file; a damaged one is left aside."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processing.outputs import write_durably

if TYPE_CHECKING:
    from display.console.journal import Level

NAME = "console.json"


def settings_folder() -> Path:
    """Return the folder for this user's settings."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "stereotome"


@dataclass
class Settings:
    """Remembered per user."""

    jog: int = 2
    gamma: float = 1.0
    table: str = "gray"
    paint: bool = True
    ignored_percent: float = 0.1
    crosshair: bool = False
    scale_bar: bool = True
    log_level: Level = "info"
    folder: str = "data/{date}/{name}-{run:03d}"
    operator: str = ""
    notify: str = ""
    snapshots: str = "snapshots"
    sound: bool = True
    stick_um_s: float = 100.0
    pads: dict[str, list[int]] = field(default_factory=dict)
    recent: list[str] = field(default_factory=list)


def load(folder: Path) -> Settings:
    """Return what was remembered; what cannot be read, or is of another kind, is as at the first start."""
    try:
        told = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return Settings()
    plain = Settings()
    known = {each.name: getattr(plain, each.name) for each in fields(Settings)}
    kept = {
        name: value for name, value in (told.items() if isinstance(told, dict) else ()) if _fits(known, name, value)
    }
    return Settings(**kept)


def save(folder: Path, settings: Settings) -> None:
    """Remember."""
    folder.mkdir(parents=True, exist_ok=True)
    write_durably(folder / NAME, json.dumps(asdict(settings), indent=1, ensure_ascii=False).encode())


def _fits(known: dict[str, Any], name: str, value: Any) -> bool:
    wanted = known.get(name)
    return name in known and (type(value) is type(wanted) or (isinstance(wanted, float) and isinstance(value, int)))
