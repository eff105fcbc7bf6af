"""Opens the Z axis of an ASI MS-2000; `devices.drivers.asi_tiger` does the same for a Tiger."""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.drivers.asi_axis import AsiStage
from devices.drivers.asi_triggered import AsiTriggeredStage
from devices.drivers.polled import open_polled
from devices.wire import asi

if TYPE_CHECKING:
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec

__all__ = ["AsiStage", "open_stage"]
BAUDS = "set baud as on the controller: an MS-2000 is delivered with 9600, a Tiger with 115200."


def open_stage(table: AxisSpec, context: DeviceContext) -> AsiTriggeredStage:
    """Open the port, make sure that an MS-2000 answers, and set the speed if the file gives one.

    Raises
    ------
    DeviceError
        As of `open_polled`.
    """
    return open_polled(
        table,
        context,
        lambda link: AsiTriggeredStage(link, table, context.clock),
        terminator=asi.TERMINATOR,
        fix=BAUDS,
    )
