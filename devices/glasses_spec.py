"""``[glasses]`` of the instrument file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from devices.toml_model import Table
from devices.wire.open3d import IrProtocol

Microseconds = Annotated[int, Field(ge=0, le=65535)]
Line = Literal["dtr", "rts"]
Lines = Annotated[tuple[Line, ...], Field(strict=False)]
Family = Literal["samsung07", "xpand", "nvidia-3d-vision", "sharp", "sony", "panasonic", "panasonic-custom", "dlp-link"]
ONLY_FOR = {
    "open3d": ("family", "delay_us", "open_us", "latency_ms"),
    "modem-lines": ("left", "right", "off", "idle", "max_hold_ms"),
}
NO_LINES = ("socket://", "rfc2217://")
LEAST_REFRESH_HZ, MOST_REFRESH_HZ = 30.0, 360.0


class GlassesSpec(Table):
    """``[glasses]``: shutter glasses behind an Open3DOLED emitter, or on the modem lines of a serial port.

    Attributes
    ----------
    port : str
        Device name or pyserial URL.
    drive : str
        ``free-run``: the glasses take turns by themselves, locked to the display; ``per-frame``: told at each flip.
    refresh_hz : float
        Pictures a second of the display, of both eyes together; what ``glasses test`` and ``glasses show`` use.
    swap : bool or None
        Exchange the eyes. None: as the emitter has it; not at all on modem lines.
    relock_s : float
        Free run: after how long it is started anew, because two clocks never run alike.
    family : str or None
        Emitter: whose glasses. None, here and below: as the emitter has it.
    delay_us, open_us : int or None
        Emitter: from the flip to the opening of the shutter, and for how long it is open.
    latency_ms : float or None
        Emitter: from the host's call to the emitter. None: half of an exchange, measured.
    left, right, off : tuple of str
        Modem lines: which of dtr and rts are on for the left eye, for the right one, and when nobody looks.
    idle : str
        Modem lines: ``flip`` alternates slowly while nobody calls, so that both eyes see; ``off`` takes the power away.
    max_hold_ms : float
        Modem lines: one state is never held longer. A liquid crystal under direct current dies.
    """

    driver: Literal["open3d", "modem-lines"]
    port: str
    drive: Literal["free-run", "per-frame"] = "free-run"
    refresh_hz: Annotated[float, Field(ge=LEAST_REFRESH_HZ, le=MOST_REFRESH_HZ)] = 120.0
    swap: bool | None = None
    relock_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    family: Family | None = None
    delay_us: Microseconds | None = None
    open_us: Microseconds | None = None
    latency_ms: Annotated[float, Field(ge=0, le=50)] | None = None
    left: Lines = ("dtr", "rts")
    right: Lines = ("dtr",)
    off: Lines = ()
    idle: Literal["flip", "off"] = "flip"
    max_hold_ms: Annotated[float, Field(ge=20, le=1000)] = 200.0

    @property
    def ir_protocol(self) -> int | None:
        """The emitter's number for ``family``."""
        return None if self.family is None else IrProtocol[self.family.replace("-", "_").upper()]

    @model_validator(mode="after")
    def _keys_of_its_own_driver(self) -> GlassesSpec:
        strange = [
            key
            for driver, keys in ONLY_FOR.items()
            if driver != self.driver
            for key in keys
            if key in self.model_fields_set
        ]
        if strange:
            raise ValueError(f"{' and '.join(strange)}: not for the driver '{self.driver}'")
        return self

    @model_validator(mode="after")
    def _lines_that_can_work(self) -> GlassesSpec:
        if self.driver != "modem-lines":
            return self
        if set(self.left) == set(self.right):
            raise ValueError("left and right must differ, or no shutter would ever move")
        if self.port.startswith(NO_LINES):
            raise ValueError(f"{self.port}: a network port has no modem lines that are quick enough")
        return self
