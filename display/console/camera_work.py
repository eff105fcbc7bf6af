"""What is done with the camera: live frames, pictures and clips that are kept, exposure, the part of the frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from acquire import replies, requests
from acquire.snapshots import frame_of, write_clip, write_snapshot
from devices.errors import StereotomeError
from display.console.placing import Placing, inside

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.snapshots import Taken
    from display.console.model import Console

LIVE_HZ = 30.0
Roi = tuple[int, int, int, int]


class CameraWork:
    """The camera of a console's instrument.

    Attributes
    ----------
    exposure_ms : float or None
        Exposure, as typed; None before the camera's is known.
    typed : (x, y, width, height)
        A part of the frame, as typed.
    roi : (x, y, width, height) or None
        The part of the frame this console had delivered last, in pixels of the whole; None for all of it.
    """

    def __init__(self, console: Console) -> None:
        self.roi: Roi | None = None
        self.exposure_ms: float | None = None
        self.typed: Roi = (0, 0, 0, 0)
        self._console = console
        self._largest: tuple[int, int] | None = None

    def live(self) -> None:
        """Show frames as they come, or no more."""
        shown = self._console.state is not None and self._console.state.live
        self._console.bench.ask(requests.StopLive() if shown else requests.StartLive(frames_per_s=LIVE_HZ), "camera")

    def snap(self) -> None:
        """Take one frame and keep it; while frames come anyway, keep the newest."""
        coming = self._console.running or (self._console.state is not None and self._console.state.live)
        if coming and self._console.eyes.seen is not None and not self._console.eyes.afar:
            self._keep(self._console.eyes.seen)
        else:
            self._console.bench.ask(requests.Snap(), "camera", self._snapped)

    def set_exposure(self, exposure_ms: float) -> None:
        """Expose for so long from now on."""
        self._console.bench.ask(requests.SetCamera(exposure_ms=exposure_ms), "camera")

    def set_roi(self, roi: Roi | None) -> None:
        """Deliver this part of the frame, x, y, width, height in pixels of the whole; None for all of it."""
        state, whole = self._console.state, self._whole
        if words := self._console.why_no_motion():
            self._console.refuse(f"{words}. The frame is as it was.")
        elif state is not None and whole is not None:
            self.roi, self._console.placing = roi, Placing()
            self._console.bench.ask(
                requests.SetCamera(exposure_ms=state.exposure_ms, roi=roi or (0, 0, *whole)), "camera"
            )

    def choose_part(self, corner: tuple[int, int], other: tuple[int, int]) -> None:
        """Deliver the part between two pixels (column, row) of the frame that is shown, both included."""
        seen, whole = self._console.eyes.seen, self._whole
        if seen is None or whole is None:
            return
        shown = seen.pixels.shape[1::-1]
        known = (0, 0, *whole) if shown == whole else self.roi
        if known is None or known[2:] != shown:
            self._console.refuse("this is a part of the frame chosen elsewhere: W shows the whole, then choose.")
        elif part := inside(known, corner, other):
            self.set_roi(part)

    @property
    def _whole(self) -> tuple[int, int] | None:
        """Width and height of the whole frame: as in the instrument file, or else the largest that was seen."""
        rig, seen = self._console.bench.rig, self._console.eyes.seen
        if rig is not None and rig.camera.size_px is not None:
            return rig.camera.size_px
        if seen is not None and (self._largest is None or seen.pixels.size > self._largest[0] * self._largest[1]):
            self._largest = seen.pixels.shape[1::-1]
        return self._largest

    def record(self) -> None:
        """Begin to keep frames as they come, or end and write them as a clip."""
        if self._console.eyes.kept is None:
            if self._console.eyes.afar:
                self._console.journal.add("error", "camera", "no clip from afar: only previews come over the network.")
            else:
                self._console.eyes.keep()
            return
        kept = self._console.eyes.keep_no_more()
        if kept:
            self._written(lambda: write_clip(Path(self._console.settings.snapshots), kept, self._about()))

    def _snapped(self, answer: replies.AnyReply | StereotomeError) -> None:
        if isinstance(answer, replies.Picture):
            self._keep(frame_of(answer))

    def _keep(self, taken: Taken) -> None:
        self._written(lambda: write_snapshot(Path(self._console.settings.snapshots), taken, self._about()))

    def _written(self, write: Callable[[], Path]) -> None:
        try:
            self._console.journal.add("info", "camera", f"saved {write()}")
        except (OSError, StereotomeError) as error:
            self._console.journal.add("error", "camera", f"not saved: {error}")

    def _about(self) -> dict[str, object]:
        """Return what a picture is kept with."""
        rig = self._console.bench.rig
        return {
            "instrument": "" if rig is None else rig.name,
            "pixel_um": None if rig is None else rig.object_pixel_um,
            "operator": self._console.form.operator or self._console.bench.actor,
            "notes": self._console.form.notes,
        }
