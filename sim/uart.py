"""Bytes on a serial wire: when each one is there, and what is heard at the wrong baud. Pure functions."""

from __future__ import annotations

BITS_PER_BYTE = 10  # start, eight data, stop


def byte_times_s(count: int, baud: int, start_s: float) -> list[float]:
    """Return when each of ``count`` bytes has arrived that are sent without gaps from ``start_s`` on."""
    return [start_s + (index + 1) * BITS_PER_BYTE / baud for index in range(count)]


def as_heard(data: bytes, sent_baud: int, heard_baud: int) -> bytes:
    """Return the bytes a receiver at ``heard_baud`` makes of ``data`` sent at ``sent_baud``.

    It waits for the line to fall, then samples eight bits in their middles, as a UART does; framing errors go unseen.
    """
    line = _levels(data)
    heard, at = [], 0.0
    per_bit = sent_baud / heard_baud  # in bits as sent
    while (start := _falls(line, at)) is not None:
        bits = [_level(line, start + (1.5 + bit) * per_bit) for bit in range(8)]
        heard.append(sum(level << bit for bit, level in enumerate(bits)))
        at = start + 9.5 * per_bit
    return bytes(heard)


def _levels(data: bytes) -> list[int]:
    return [level for byte in data for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)]


def _level(line: list[int], at: float) -> int:
    return line[int(at)] if 0 <= at < len(line) else 1


def _falls(line: list[int], at: float) -> float | None:
    """Return the next time from ``at`` on at which the line falls to 0."""
    edges = range(int(at), len(line))
    return next((float(i) for i in edges if i >= at and line[i] == 0 and _level(line, i - 1) == 1), None)
