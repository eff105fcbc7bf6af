"""Register maps of feed drives: one TOML file each, checked when read, so that a new drive needs no new code."""

from __future__ import annotations

from functools import cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from devices.errors import RigError, did_you_mean
from devices.toml_lines import key_lines
from devices.toml_model import Table, load_text
from devices.wire import modbus_map
from devices.wire.modbus_map import Kind, RegisterRead, RegisterWrite, WordOrder

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from devices.toml_lines import KeyPath

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
LinkKind = Literal["rtu", "tcp", "rtu_over_tcp"]
Term = int | str
READ, WRITE_ONE, WRITE_MANY = 3, 6, 16
SUPPLIED = ("pos", "speed", "acc", "dec", "seq", "beat", "min", "max", "window_start", "window_end", "cut_speed")
NEEDED_REGISTERS = ("status", "position", "alarm")
LAST_ADDRESS = 0xFFFF
WORD_RANGE = range(-0x8000, 0x10000)


class LinkTable(Table):
    """``[link]``: what an installation may override."""

    kind: LinkKind = "rtu"
    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 115200
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    unit: Annotated[int, Field(ge=1, le=247)] = 1
    timeout_s: Positive = 0.3
    gap_ms: NotNegative = 5
    max_registers: Annotated[int, Field(ge=2, le=123)] = 60
    heartbeat_s: Annotated[float, Field(gt=0, le=10)] = 10


class AddressTable(Table):
    """``[address]``: how the manual counts, and which functions the drive knows."""

    base: Annotated[int, Field(ge=0)] = 0
    word_order: WordOrder = "big"
    pair_even: bool = False
    functions: Annotated[tuple[int, ...], Field(strict=False)] = (READ, WRITE_ONE, WRITE_MANY)


class AxisTable(Table):
    """``[axis]``: lengths and speeds; ``speed_per_um_s`` is what the speed register counts for 1 µm/s."""

    counts_per_um: Positive
    invert: bool = False
    backlash_um: NotNegative = 0.0
    min_um: float = 0.0
    max_um: float
    max_step_um: Positive
    speed_um_s: Positive
    speed_per_um_s: Positive
    acc: Annotated[int, Field(ge=0)] = 0
    dec: Annotated[int, Field(ge=0)] = 0


class Reg(Table):
    """A register by name: address as in the manual, kind, and length of a block."""

    a: Annotated[int, Field(ge=0)]
    t: Kind
    n: Annotated[int, Field(ge=1, le=123)] = 1

    @property
    def width(self) -> int:
        """Return how many registers it takes."""
        return modbus_map.width(self.t, self.n)


class Bit(Table):
    """A test: any bit of ``mask`` set in a register."""

    reg: str
    mask: Annotated[int, Field(ge=1, le=0xFFFF_FFFF)]


class StateTable(Table):
    """``[state]``: what the status means.

    Attributes
    ----------
    homed : Bit or None
        None: the drive does not tell; then only a homing of this session counts.
    start_guard_ms : float
        How long "done" still belongs to the move before, unless "moving" was seen.
    """

    fault: Bit
    moving: Bit
    enabled: Bit | None = None
    done: Bit | None = None
    homed: Bit | None = None
    estop: Bit | None = None
    start_guard_ms: NotNegative = 20


class Step(Table):
    """One write of an action: a number, a supplied name, ``hi(name)`` or ``lo(name)``; a list for a block."""

    reg: str
    v: Term | list[Term]

    @property
    def terms(self) -> list[Term]:
        """Return the value as a list."""
        return self.v if isinstance(self.v, list) else [self.v]


Action = list[Step]


class DoTable(Table):
    """``[do]``: actions as ordered writes."""

    move_abs: Action
    stop: Action
    enable: Action = Field(default_factory=list)
    home: Action = Field(default_factory=list)
    zero: Action = Field(default_factory=list)
    run: Action = Field(default_factory=list)
    reset: Action = Field(default_factory=list)
    limits: Action = Field(default_factory=list)
    heartbeat: Action = Field(default_factory=list)


class JogTable(Table):
    """``[jog]``: motion while held; a drive that wants a reminder gets it every ``repeat_ms``."""

    plus: Action
    minus: Action
    release: Action
    repeat_ms: Annotated[int, Field(ge=0, le=50)] = 0


class SeqTable(Table):
    """``[seq]``: registers of a mailbox that executes a command once, when its number is new."""

    write: str
    ack: str


class KnifeTable(Table):
    """``[knife]``: the cutting stroke and its sensors."""

    clear: Bit
    cutting: Bit
    jammed: Bit
    count: str
    window_start: str
    window_end: str
    cut_speed: str
    cut: Action
    park: Action
    stop: Action


class Identity(Table):
    """A register that has a known value: proves unit and word order before anything moves."""

    reg: str
    v: int


class Profile(Table):
    """A register map, as in the files of ``devices/profiles``."""

    schema_: Annotated[Literal[1], Field(alias="schema")]
    profile: str
    source: str
    link: LinkTable = LinkTable()
    address: AddressTable = AddressTable()
    axis: AxisTable
    reg: dict[str, Reg]
    state: StateTable
    do: DoTable
    jog: JogTable | None = None
    seq: SeqTable | None = None
    knife: KnifeTable | None = None
    identify: list[Identity] = Field(default_factory=list)
    interlocks: dict[str, Bit] = Field(default_factory=dict)
    alarms_are: Literal["codes", "bits"] = "codes"
    alarms: dict[str, str] = Field(default_factory=dict)
    exceptions: dict[str, str] = Field(default_factory=dict)

    def address_of(self, name: str) -> int:
        """Return the address on the wire of a named register."""
        return self.reg[name].a - self.address.base

    def read_of(self, name: str) -> RegisterRead:
        """Return the request that reads a named register."""
        return RegisterRead(self.address_of(name), self.reg[name].width)

    def number_in(self, name: str, words: list[int]) -> int:
        """Return the number that the words of a named register mean."""
        return int(modbus_map.decode(words, self.reg[name].t, self.address.word_order))

    def writes(self, action: Action, supplied: Mapping[str, int]) -> tuple[RegisterWrite, ...]:
        """Return an action as ordered writes; raises ValueError for a value that does not fit its register."""
        return tuple(self._write(step, supplied) for step in action)

    def write_of(self, name: str, value: int) -> RegisterWrite:
        """Return the request that sets a named register; raises ValueError as `writes` does."""
        return self._write(Step(reg=name, v=value), {})

    def alarm_words(self, code: int) -> str:
        """Return what an alarm's number means, by the manual's words."""
        known = {int(key, 0): words for key, words in self.alarms.items()}
        if self.alarms_are == "codes":
            return known.get(code, "an alarm the profile has no name for")
        return ", ".join(words for bit, words in known.items() if code & bit) or "a bit the profile has no name for"

    def exception_words(self) -> dict[int, str]:
        """Return what exception numbers mean on this device, as far as it differs from the standard."""
        return {int(key, 0): words for key, words in self.exceptions.items()}

    def _write(self, step: Step, supplied: Mapping[str, int]) -> RegisterWrite:
        reg, order = self.reg[step.reg], self.address.word_order
        kind: Kind = "u16" if reg.t == "block" else reg.t
        values = [modbus_map.evaluate(term, supplied) for term in step.terms]
        kinds: list[Kind] = ["i16" if kind == "u16" and value < 0 else kind for value in values]
        words = tuple(
            word for value, of in zip(values, kinds, strict=True) for word in modbus_map.encode(value, of, order)
        )
        return RegisterWrite(self.address_of(step.reg), words, len(words) == 1 and WRITE_ONE in self.address.functions)


@cache
def shipped_profiles() -> list[str]:
    """Return the names of the register maps that come with the program."""
    folder = resources.files("devices") / "profiles"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_profile(name: str) -> Profile:
    """Read a register map: a shipped one by its name, any other by its path.

    Raises
    ------
    RigError
        No such map, or one with problems: all of them, each with its line.
    """
    if name in shipped_profiles():
        return _shipped(name)
    path = Path(name)
    if not path.is_file():
        raise RigError(
            f"no profile '{name}'{did_you_mean(name, shipped_profiles())}",
            fix="name a shipped profile, or the path of a register map of your own.",
        )
    try:
        return parse_profile(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as cause:
        raise RigError(f"{path}: cannot be read as text: {cause}") from cause


@cache
def _shipped(name: str) -> Profile:
    """Read it once: an instrument asks for its register map several times."""
    shipped = resources.files("devices") / "profiles" / f"{name}.toml"
    return parse_profile(shipped.read_text(encoding="utf-8"), f"{name}.toml")


def parse_profile(text: str, name: str) -> Profile:
    """Read a register map from its text; ``name`` stands for the file in messages. Raises as `load_profile` does."""
    profile = load_text(text, name, Profile, RigError)
    problems = list(_problems(profile))
    if not problems:
        return profile
    lines = key_lines(text)
    placed = sorted((_line(path, lines), ".".join(map(str, path)), words) for path, words in problems)
    count = "1 problem" if len(placed) == 1 else f"{len(placed)} problems"
    listed = [f"{name}:{line}: {path}: {words}" for line, path, words in placed]
    raise RigError("\n    ".join([f"{name} has {count}:", *listed]))


def _line(path: KeyPath, lines: dict[KeyPath, int]) -> int:
    while path and path not in lines:
        path = path[:-1]
    return lines.get(path, 1)


def _problems(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    yield from _function_problems(profile)
    yield from _register_problems(profile)
    yield from _overlaps(profile)
    for path, name in _register_names(profile):
        if name not in profile.reg:
            yield path, f"no register '{name}' in [reg]{did_you_mean(name, list(profile.reg))}"
    for path, step in _steps(profile):
        yield from ((path, words) for words in _step_problems(profile, step))
    yield from _table_problems(profile)


def _function_problems(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    known = {READ, WRITE_ONE, WRITE_MANY}
    given = set(profile.address.functions)
    if given - known:
        yield ("address", "functions"), f"{sorted(given - known)} are not used here; 3, 6 and 16 are"
    if READ not in given or not given & {WRITE_ONE, WRITE_MANY}:
        yield ("address", "functions"), "the drive must know 3, and 6 or 16"
    if profile.axis.min_um >= profile.axis.max_um:
        yield ("axis", "min_um"), "must be below max_um"


def _register_problems(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    for name in NEEDED_REGISTERS:
        if name not in profile.reg:
            yield ("reg",), f"a profile needs the register '{name}'"
    for name, reg in profile.reg.items():
        first = reg.a - profile.address.base
        if first < 0 or first + reg.width - 1 > LAST_ADDRESS:
            yield ("reg", name), f"address {reg.a} with base {profile.address.base} is not between 0 and 65535"
        if reg.n > 1 and reg.t != "block":
            yield ("reg", name), "n belongs to a block"
        if reg.width > profile.link.max_registers:
            yield ("reg", name), f"{reg.width} registers are more than max_registers {profile.link.max_registers}"
        if profile.address.pair_even and reg.t in ("u32", "i32", "f32") and first % 2:
            yield ("reg", name), "a 32-bit pair starts at an even address here (pair_even)"


def _overlaps(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    ordered = sorted(profile.reg.items(), key=lambda item: item[1].a)
    for (name, reg), (later_name, later) in pairwise(ordered):
        if later.a < reg.a + reg.width:
            yield ("reg", later_name), f"overlaps '{name}', which ends at {reg.a + reg.width - 1:#06x}"


def _register_names(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    for table in ("state", "knife"):
        for key, value in getattr(profile, table) or ():
            if isinstance(value, Bit):
                yield (table, key), value.reg
            elif table == "knife" and isinstance(value, str):
                yield (table, key), value
    for key, bit in profile.interlocks.items():
        yield ("interlocks", key), bit.reg
    for index, identity in enumerate(profile.identify):
        yield ("identify", index), identity.reg
    if profile.seq:
        yield ("seq", "write"), profile.seq.write
        yield ("seq", "ack"), profile.seq.ack


def _steps(profile: Profile) -> Iterator[tuple[KeyPath, Step]]:
    for table in ("do", "jog", "knife"):
        for key, value in getattr(profile, table) or ():
            if isinstance(value, list):
                yield from (((table, key, index), step) for index, step in enumerate(value))


def _step_problems(profile: Profile, step: Step) -> Iterator[str]:
    reg = profile.reg.get(step.reg)
    if reg is None:
        yield f"no register '{step.reg}' in [reg]{did_you_mean(step.reg, list(profile.reg))}"
        return
    if reg.t == "block" and len(step.terms) != reg.n:
        yield f"'{step.reg}' has {reg.n} words, not {len(step.terms)}"
    if reg.t != "block" and isinstance(step.v, list):
        yield f"'{step.reg}' is no block: give one value"
    if reg.width > 1 and WRITE_MANY not in profile.address.functions:
        yield f"'{step.reg}' needs function 16, which [address] functions does not have"
    for term in step.terms:
        yield from _term_problems(reg, term)


def _term_problems(reg: Reg, term: Term) -> Iterator[str]:
    if isinstance(term, str) and modbus_map.name_in(term) not in SUPPLIED:
        yield f"'{term}' is no name the driver supplies{did_you_mean(modbus_map.name_in(term), list(SUPPLIED))}"
    elif reg.t in ("u16", "i16", "block") and modbus_map.name_in(str(term)) in ("pos", "min", "max"):
        if not modbus_map.is_half(term):
            yield f"'{term}' has 32 bits: write hi({term}) and lo({term}), or give it an i32 register"
    elif isinstance(term, int) and reg.width == 1 and term not in WORD_RANGE:
        yield f"{term} does not fit into 16 bits"


def _table_problems(profile: Profile) -> Iterator[tuple[KeyPath, str]]:
    for table in ("alarms", "exceptions"):
        for key in getattr(profile, table):
            try:
                int(key, 0)
            except ValueError:
                yield (table, key), "is no number: write for example 0xE0"
