"""Opens the Z axis of an ASI Tiger, whose cards have addresses of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from devices.drivers.asi import greeted, opened_link
from devices.drivers.asi_triggered import AsiTriggeredStage, slots_of
from devices.errors import DeviceError, Refused
from devices.wire import asi
from devices.wire.asi_identity import tiger_card

if TYPE_CHECKING:
    from devices.link import Link
    from devices.registry import DeviceContext
    from devices.rig import AxisSpec
    from devices.wire.asi_identity import Card

DECIMALS = 2


def open_stage(table: AxisSpec, context: DeviceContext) -> AsiTriggeredStage:
    """Open the port, ask the Tiger which card drives Z, and set the speed if the file gives one.

    Raises
    ------
    DeviceError
        As `devices.drivers.asi.open_stage`; device-unknown when what answers is no Tiger or has no Z.
    """
    with opened_link(table, context) as link:
        card = _card(link)
        _tell_decimals(link, card)
        return greeted(AsiTriggeredStage(link, table, context.clock, card, slots=slots_of(link, card)), table)


def _card(link: Link) -> Card:
    build = link.ask(asi.build("0 "))
    card = tiger_card(build)
    if card is None:
        raise DeviceError(
            "z stage: what answers is no Tiger with a Z axis.",
            why=f"It calls itself: {build[0]}.",
            fix='an MS-2000 has a driver of its own: set stage.z.driver = "asi-ms2000"',
            code="device-unknown",
        )
    return card


def _tell_decimals(link: Link, card: Card) -> None:
    """Ask for finer positions than tenths of a µm; older firmware cannot, and need not."""
    try:
        link.ask(asi.set_decimals(DECIMALS, card.address))
    except Refused:
        return
