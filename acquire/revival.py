"""A camera that went away is opened anew: to take a picture again harms nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from devices.errors import CameraGone, DeviceError

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.control import Control
    from devices.protocols import Camera, Clock

REOPEN_AFTER_S = (1.0, 2.0, 5.0)


def revived(
    reopen: Callable[[], Camera],
    gone: CameraGone,
    clock: Clock,
    control: Control,
    tell: Callable[[dict[str, Any]], None],
) -> Camera:
    """Return the camera, opened anew, after waiting longer each time.

    Raises
    ------
    CameraGone
        It stays away; what the last attempt met is its reason.
    Cancelled
        The run was cancelled meanwhile.
    """
    why = gone.why
    for wait_s in REOPEN_AFTER_S:
        tell({"event": "warn", "code": gone.code, "message": f"{gone.what} It is opened anew in {wait_s:g} s."})
        control.checkpoint()
        clock.sleep(wait_s)
        try:
            return reopen()
        except DeviceError as error:
            why = error.what
    raise CameraGone(gone.what, why=why, fix=("check its cable and power", *gone.fix)) from gone
