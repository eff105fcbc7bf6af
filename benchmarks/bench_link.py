"""What the link costs above the bare pseudo-terminal, and what it costs to poll.

Run: ``python benchmarks/bench_link.py``. The same peer, a process that answers each line at once with the number of the
line, is asked in turns with bare system calls and through the link, in one run; every answer is checked to be that of
its question. Prints a table and a line of JSON; ends with 1 when a limit is missed.
"""

from __future__ import annotations

import json
import os
import platform
import pty
import select
import statistics
import subprocess
import sys
import time
import tty
from contextlib import closing

from devices.clock import SystemClock
from devices.link import Link
from devices.transport.serial_port import SerialPort
from devices.wire import asi

ROUNDS, PER_ROUND = 40, 50
POLLS_PER_S, POLLING_S = 16, 5
OVERHEAD_MS, CORE_PERCENT = 0.15, 1.0


def main() -> int:
    """Measure, print, and say whether the limits are kept."""
    master, slave = pty.openpty()
    for end in (master, slave):
        tty.setraw(end)
    with subprocess.Popen([sys.executable, __file__, "peer", str(master)], pass_fds=[master]) as peer:
        try:
            bare_ms, link_ms, core_percent = measure(slave, os.ttyname(slave))
        finally:
            peer.kill()
    overhead_ms = link_ms - bare_ms
    rows = [
        ("bare request and reply, p50 ms", bare_ms, None),
        ("through the link, p50 ms", link_ms, None),
        ("overhead of the link, p50 ms", overhead_ms, OVERHEAD_MS),
        (f"{POLLS_PER_S} polls a second, % of a core", core_percent, CORE_PERCENT),
    ]
    for name, value, limit in rows:
        print(f"{name:<40} {value:>8.4f}  {'' if limit is None else f'<= {limit:g}'}")
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    print(json.dumps({"benchmark": "link", **machine, **{name: value for name, value, _ in rows}}))
    return int(any(limit is not None and value > limit for _, value, limit in rows))


def measure(slave: int, path: str) -> tuple[float, float, float]:
    """Return the medians of both ways in ms, measured in turns, and the share of a core that polling takes in %."""
    bare, linked = [], []
    with closing(Link(SerialPort(path, 115200, device="peer"), SystemClock(), terminator=asi.TERMINATOR)) as link:
        for _ in range(ROUNDS):
            for times_s, ask in ((bare, lambda: ask_bare(slave)), (linked, lambda: link.ask(asi.where()))):
                times_s += [timed(ask, len(bare) + len(linked) + turn + 1) for turn in range(PER_ROUND)]
        core_percent = polling(link)
    return statistics.median(bare) * 1e3, statistics.median(linked) * 1e3, core_percent


def ask_bare(slave: int) -> int:
    """Ask with nothing but system calls; return the number of the answer."""
    os.write(slave, b"W Z\r")
    received = b""
    while not received.endswith(b"\r\n"):
        select.select([slave], [], [])
        received += os.read(slave, 64)
    return int(received[3:])


def polling(link: Link) -> float:
    """Return the share of a core that polling takes, without waiting in between counted."""
    started_s, cpu_s = time.perf_counter(), time.process_time()
    for poll in range(POLLS_PER_S * POLLING_S):
        link.ask(asi.where())
        time.sleep(max(0.0, started_s + (poll + 1) / POLLS_PER_S - time.perf_counter()))
    return (time.process_time() - cpu_s) / (time.perf_counter() - started_s) * 100


def timed(ask, number: int) -> float:
    """Return how long it takes in seconds to get the answer with this number."""
    start = time.perf_counter()
    answer_number = ask()
    took_s = time.perf_counter() - start
    assert answer_number == number, f"answer {answer_number} to question {number}"
    return took_s


def answer(master: int) -> None:
    """Answer each line at once with its number, for ever."""
    number = 0
    while True:
        for _ in range(os.read(master, 64).count(b"\r")):
            number += 1
            os.write(master, b":A %d \r\n" % number)


if __name__ == "__main__":
    if sys.argv[1:2] == ["peer"]:
        answer(int(sys.argv[2]))
    sys.exit(main())
