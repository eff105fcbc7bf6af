"""Values and registers: 32-bit numbers over two words, actions of a profile as ordered writes. Pure."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Kind = Literal["u16", "i16", "u32", "i32", "f32", "block"]
WordOrder = Literal["big", "little"]
Number = int | float

FORMATS = {"u16": ">H", "i16": ">h", "u32": ">I", "i32": ">i", "f32": ">f"}
_HALF = re.compile(r"(hi|lo)\((\w+)\)")


@dataclass(frozen=True)
class RegisterWrite:
    """Values for consecutive holding registers, to be sent once and never again.

    Attributes
    ----------
    address : int
        Of the first register, counted from 0 as on the wire.
    values : tuple of int
        16-bit words.
    single : bool
        One word by function 6; all else goes by function 16.
    """

    address: int
    values: tuple[int, ...]
    single: bool = False


@dataclass(frozen=True)
class RegisterRead:
    """Consecutive holding registers to be read by function 3; may be asked again."""

    address: int
    count: int


def width(kind: Kind, words: int = 1) -> int:
    """Return how many registers a value of this kind takes."""
    return words if kind == "block" else struct.calcsize(FORMATS[kind]) // 2


def encode(value: Number, kind: Kind, order: WordOrder) -> tuple[int, ...]:
    """Return the words of one number.

    Raises
    ------
    ValueError
        It does not fit; nothing is ever wrapped round.
    """
    if kind == "block":
        raise ValueError("a block is written word by word")
    try:
        words = struct.unpack(f">{width(kind)}H", struct.pack(FORMATS[kind], value))
    except (struct.error, OverflowError) as cause:
        raise ValueError(f"{value} does not fit into {kind}") from cause
    return words if order == "big" else words[::-1]


def decode(words: Sequence[int], kind: Kind, order: WordOrder) -> Number:
    """Return the number that these words mean.

    Raises
    ------
    ValueError
        Not as many words as the kind has, or values that are no 16-bit words.
    """
    if kind == "block" or len(words) != width(kind):
        raise ValueError(f"{len(words)} words are no {kind}")
    ordered = words if order == "big" else words[::-1]
    try:
        number: Number = struct.unpack(FORMATS[kind], struct.pack(f">{len(words)}H", *ordered))[0]
    except struct.error as cause:
        raise ValueError(f"{list(words)} are no 16-bit words") from cause
    return number


def name_in(term: str) -> str:
    """Return the supplied name in ``"pos"``, ``"hi(pos)"`` or ``"lo(pos)"``."""
    half = _HALF.fullmatch(term)
    return half.group(2) if half else term


def is_half(term: int | str) -> bool:
    """Tell whether a term is ``hi(…)`` or ``lo(…)``, which always fits into one word."""
    return isinstance(term, str) and _HALF.fullmatch(term) is not None


def evaluate(term: int | str, supplied: Mapping[str, int]) -> int:
    """Return an integer as it is, a supplied name's value, or the high or low word of one.

    Raises
    ------
    ValueError
        A value to be halved is no signed 32-bit number.
    """
    if isinstance(term, int):
        return term
    half = _HALF.fullmatch(term)
    if half is None:
        return supplied[term]
    high, low = encode(supplied[half.group(2)], "i32", "big")
    return high if half.group(1) == "hi" else low
