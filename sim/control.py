"""The bench from outside: faults, plugs, power, pulses and the truth, asked for over TCP, one JSON object a line.

========================================  ==============================================================
``{"do": "fault", "set": "z.late@3"}``     switches a fault on; ``"clear"`` switches it off
``{"do": "faults"}``                       names those that are on
``{"do": "unplug", "device": "z"}``        the port vanishes; ``"replug"`` brings it back under its name
``{"do": "power", "device": "z", "on": …}``  off and on again: what was not saved is lost
``{"do": "power-cycle", "device": "z"}``   both, one after the other
``{"do": "ttl", "device": "z", "count": 1}``  pulses at the device's TTL input
``{"do": "reset"}``                        all as it was at the start: faults off, plugs in, power cycled, the axis back
``{"do": "truth"}``                        where the axis truly is, and what every device counted
========================================  ==============================================================

Every answer has ``"ok"``; a no has ``"error"``. An ``"id"`` comes back with the answer.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from typing import TYPE_CHECKING, Any

from devices.errors import InputError, StereotomeError
from sim.faults import parse_fault
from sim.rack import device_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.faults import Faults
    from sim.motion import Axis
    from sim.rack import Rack

Answer = dict[str, Any]
MOST_PULSES = 100_000


class Control:
    """What may be done to a bench. It is a server of its own: `serve` answers until `close`."""

    def __init__(self, rack: Rack, axis: Axis, faults: Faults) -> None:
        self._rack = rack
        self._axis = axis
        self._faults = faults
        self._start_um, self._start_um_s = axis.encoder_um(), axis.speed_um_s
        self._one_at_a_time = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._actions: dict[str, Callable[[Answer], Answer]] = {
            "fault": self._fault,
            "faults": lambda _: {"faults": [str(fault) for fault in self._faults.active]},
            "unplug": self._unplug,
            "replug": self._replug,
            "power": self._power,
            "power-cycle": self._power_cycle,
            "ttl": self._ttl,
            "reset": self._reset,
            "truth": self._truth,
        }

    def serve(self) -> None:
        """Accept clients until closed."""
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._attend, args=[connection], daemon=True).start()

    def close(self) -> None:
        """Stop accepting."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def answer(self, line: bytes) -> Answer:
        """Return the answer to one line, whatever it is."""
        try:
            asked = json.loads(line)
            with self._one_at_a_time:
                done = self._actions[asked["do"]](asked)
        except StereotomeError as error:
            return {"ok": False, "error": error.message()}
        except (ValueError, TypeError, KeyError) as error:
            return {"ok": False, "error": f"not understood: {line[:80]!r} ({type(error).__name__})"}
        return {"id": asked.get("id"), "ok": True, **done}

    def _attend(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection, connection.makefile("rb") as lines:
            for line in lines:
                connection.sendall(json.dumps(self.answer(line)).encode() + b"\n")

    def _fault(self, asked: Answer) -> Answer:
        if "set" in asked:
            self._faults.switch_on(parse_fault(str(asked["set"])))
        elif not self._faults.switch_off(parse_fault_kind(str(asked["clear"]))):
            raise InputError(f"the fault '{asked['clear']}' is not on.")
        return {}

    def _unplug(self, asked: Answer) -> Answer:
        device_of(self._rack, asked["device"]).line.unplug()
        return {}

    def _replug(self, asked: Answer) -> Answer:
        device_of(self._rack, asked["device"]).line.plug()
        return {}

    def _power(self, asked: Answer) -> Answer:
        device_of(self._rack, asked["device"]).power.switch(on=bool(asked["on"]))
        return {}

    def _power_cycle(self, asked: Answer) -> Answer:
        power = device_of(self._rack, asked["device"]).power
        power.switch(on=False)
        power.switch(on=True)
        return {}

    def _ttl(self, asked: Answer) -> Answer:
        pulse, count = device_of(self._rack, asked["device"]).pulse, int(asked.get("count", 1))
        if pulse is None:
            raise InputError(f"the device '{asked['device']}' has no TTL input.")
        if not 0 < count <= MOST_PULSES:
            raise InputError(f"{count} pulses: ask for 1 to {MOST_PULSES}.")
        for _ in range(count):
            pulse()
        return {}

    def _reset(self, _asked: Answer) -> Answer:
        for fault in self._faults.active:
            self._faults.switch_off(fault.kind)
        for device in self._rack.values():
            device.line.plug()
            device.power.switch(on=False)
        self._put_axis_back()
        for device in self._rack.values():
            device.power.switch(on=True)
        return {}

    def _put_axis_back(self) -> None:
        """Bring the axis to where it was at the start, past its controller, which is off."""
        self._axis.set_speed(self._axis.top_speed_um_s)
        self._axis.move_to(self._start_um)
        self._axis.clock.sleep(max(self._axis.rests_at_s - self._axis.clock.now(), 0.0))
        self._axis.set_speed(self._start_um_s)

    def _truth(self, _asked: Answer) -> Answer:
        now_s = self._axis.clock.now()
        here = {"z_um": self._axis.load_um(now_s), "encoder_um": self._axis.encoder_um(), "moving": self._axis.moving()}
        return {**here, "counters": {name: device.counters() for name, device in self._rack.items()}}


def parse_fault_kind(text: str) -> str:
    """Return the kind of a fault given with or without its number."""
    return text.partition("@")[0]
