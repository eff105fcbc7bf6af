"""The story of a run, told from its journal: ``report.json`` for programs, ``report.md`` for people.

Everything in it is derived, so it can be written anew from the run's folder at any time.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from acquire.ome_zarr import replace_json, replace_text
from acquire.words import ranges, took

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from acquire.journal import Record
    from acquire.store import StoredRun

NS_PER_S = 1e9
MOST_SECTIONS, MOST_EVENTS = 500, 500  # in report.md; report.json has all


@dataclass
class SectionStory:
    """What became of one section.

    Attributes
    ----------
    depth_um, removed_nm : float or None
        Where the feed read back for it, and how much further that is than for the section before.
    cuts : int or None
        What the knife's counter said after its cut.
    cut_s : float or None
        How long the cut took.
    findings : list of str
        What each look at it found.
    sweeps, retaken : int
        How often it was wiped, and planes taken again.
    waived : list of int
        Planes left out.
    committed_s : float or None
        When it was complete, in seconds from the start.
    """

    section: int
    depth_um: float | None = None
    removed_nm: float | None = None
    cuts: int | None = None
    cut_s: float | None = None
    recovered: bool = False
    findings: list[str] = field(default_factory=list)
    sweeps: int = 0
    retaken: int = 0
    waived: list[int] = field(default_factory=list)
    committed_s: float | None = None


@dataclass(frozen=True)
class Event:
    """One thing worth telling: when, in seconds from the start and by the wall clock, and what."""

    at_s: float
    utc: str
    what: str


@dataclass
class Story:
    """A run, told."""

    state: str
    reason: str
    planned: int
    durable: int
    missing: list[int]
    missed: dict[int, str]
    seconds: float
    sections: list[SectionStory]
    events: list[Event]


class Teller:
    """Goes through the records of a journal in order."""

    def __init__(self, run: StoredRun) -> None:
        self._began = _utc(run.manifest.get("created_utc"))
        self._anchor_s: float | None = None
        self._anchor_at_s = 0.0
        self._now_s = 0.0
        self._depth_nm: float | None = None
        self.sections: dict[int, SectionStory] = {}
        self.events: list[Event] = []
        self._hears: dict[str, Callable[[Record], str | None]] = {
            "origin": self._stood,
            "feed_done": self._fed,
            "cut_done": self._cut,
            "feed_not_done": lambda r: f"section {r['section']}: a look at the feed shows that it was not fed",
            "cut_not_done": lambda r: f"section {r['section']}: {_by(r)} that it was not cut",
            "verdict": self._judged,
            "sweep_intent": self._swept,
            "reject": self._retaken,
            "accepted": lambda r: f"section {r['section']}: accepted although {r['finding']}",
            "commit": self._committed,
            "hold": lambda r: f"HOLD [{r['code']}]: {r['question']}",
            "answer": lambda r: f"answered: {r['choice']}",
            "fault": lambda r: f"fault [{r['code']}]: {r['message']}",
            "missed": lambda r: f"plane {r['plane']} of section {r.get('section', 0)} left out: {r['reason']}",
            "resumed": lambda r: f"the run went on, with {r['durable']} durable planes",
            "compared": _compared,
            "focus": lambda r: f"section {r['section']}: {r['words']}" if "moved" in r["words"] else None,
            "cut_doubtful": lambda r: f"section {r['section']}: the stroke failed on its way [{r['code']}]",
            "tilt": lambda r: f"view {r['section']}: tilted to {r['angle_deg']:+g}°",
            "note": lambda r: f"note: {r['text']}",
            "end": lambda r: f"end: {r['state']}{': ' if r['reason'] else ''}{r['reason']}",
        }

    def hear(self, record: Record) -> None:
        """Take one record into account."""
        self._set_time(record)
        hears = self._hears.get(record["e"])
        said = hears(record) if hears else None
        if said:
            utc = (self._began + timedelta(seconds=self._now_s)).isoformat(timespec="seconds") if self._began else ""
            self.events.append(Event(round(self._now_s, 3), utc, said))

    @property
    def seconds(self) -> float:
        """Time from the first record to the last, the time between two parts of the run included if it is known."""
        return self._now_s

    def _set_time(self, record: Record) -> None:
        """Keep up with the journal's clock, which begins anew with the computer; each start tells the wall clock."""
        t_s = record["t"] / NS_PER_S
        anew = record["e"] in {"run_created", "resumed"}
        if anew or self._anchor_s is None:
            self._anchor_s = t_s
            utc = _utc(record.get("utc"))
            self._anchor_at_s = (utc - self._began).total_seconds() if utc and self._began else self._now_s
        self._now_s = max(self._now_s, self._anchor_at_s + t_s - self._anchor_s)

    def _section(self, record: Record) -> SectionStory:
        number = record["section"]
        return self.sections.setdefault(number, SectionStory(number))

    def _stood(self, record: Record) -> str:
        self._depth_nm = record["depth_nm"]
        return f"the feed stands at {record['depth_nm'] / 1000:.3f} µm, the knife counted {record['cuts']} cuts"

    def _fed(self, record: Record) -> str | None:
        section, depth_nm = self._section(record), record["readback_nm"]
        section.depth_um = depth_nm / 1000
        if self._depth_nm is not None:
            section.removed_nm = round(depth_nm - self._depth_nm, 1)
        self._depth_nm = depth_nm
        return self._recovered(record, "was fed")

    def _cut(self, record: Record) -> str | None:
        section = self._section(record)
        section.cuts, section.cut_s = record.get("cuts_after", section.cuts), record.get("duration_s")
        return self._recovered(record, "was cut")

    def _recovered(self, record: Record, what: str) -> str | None:
        if not (record.get("recovered") or record.get("by")):
            return None
        self._section(record).recovered = True
        return f"section {record['section']}: {_by(record)} that it {what}"

    def _judged(self, record: Record) -> str | None:
        self._section(record).findings.append(record["finding"])
        if record["finding"] == "good":
            return None
        return f"section {record['section']}: {record['finding']}: {record['words']}"

    def _swept(self, record: Record) -> str:
        self._section(record).sweeps += 1
        return f"section {record['section']}: the knife wipes the face"

    def _retaken(self, record: Record) -> str:
        if "section" in record:
            self._section(record).retaken += len(record["slots"])
        return f"{len(record['slots'])} planes are taken again: {record['reason']}"

    def _committed(self, record: Record) -> None:
        section = self._section(record)
        section.committed_s, section.waived = round(self._now_s, 3), record["waived"]


def tell_story(run: StoredRun) -> Story:
    """Return the story of a run as its folder has it."""
    teller = Teller(run)
    end: Record = {"state": str(run.state), "reason": ""}
    for record in run.records:
        teller.hear(record)
        end = record if record["e"] == "end" else end
    return Story(
        state=str(run.state),
        reason=end["reason"] if run.state == end["state"] else "",
        planned=run.layout.planned,
        durable=len(run.planes),
        missing=run.missing,
        missed=run.missed,
        seconds=round(teller.seconds, 3),
        sections=[teller.sections[number] for number in sorted(teller.sections)],
        events=teller.events,
    )


def write_report(run: StoredRun) -> Path:
    """Write ``report.json`` and ``report.md`` into a run's folder and return the latter.

    Raises
    ------
    OSError
        The disk refused it.
    """
    story = tell_story(run)
    facts = {key: run.manifest.get(key) for key in ("name", "created_utc", "software")}
    recipe = run.manifest.get("recipe", {})
    facts |= {key: recipe.get(key, "") for key in ("operator", "notes")}
    facts["instrument"] = run.manifest.get("instrument", {}).get("name", "")
    replace_json(run.folder / "report.json", {**facts, **asdict(story)})
    path = run.folder / "report.md"
    replace_text(path, "\n".join(_lines(facts, story, run)) + "\n")
    return path


def _lines(facts: dict[str, Any], story: Story, run: StoredRun) -> Iterator[str]:
    yield f"# {facts['name']}: {story.state}"
    yield ""
    if story.reason:
        yield f"**{story.reason}**\n"
    yield f"{story.durable} of {story.planned} planes are durable and verified. It took {took(story.seconds)}."
    if story.missing:
        yield f"Missing: {ranges(story.missing)}."
    yield ""
    told = {"operator": "operator", "instrument": "instrument", "created_utc": "began (UTC)", "software": "software"}
    for key, word in told.items():
        if facts.get(key):
            yield f"- {word}: {facts[key]}"
    yield f"- plan: {run.manifest.get('plan_id', '')[:12]}"
    if facts.get("notes"):
        yield f"- notes: {facts['notes']}"
    yield from _section_table(story.sections)
    yield from _event_table(story.events)


def _section_table(sections: Sequence[SectionStory]) -> Iterator[str]:
    if not sections:
        return
    yield "\n## Sections\n"
    yield "| section | depth µm | removed nm | cuts | cut s | found | wiped | retaken | left out | complete at |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for s in sections[:MOST_SECTIONS]:
        done = "**no**" if s.committed_s is None else took(s.committed_s)
        cells = [s.section, _number(s.depth_um, 3), _number(s.removed_nm, 0), _text(s.cuts), _number(s.cut_s, 2)]
        cells += [", ".join(s.findings) or "–", s.sweeps or "", s.retaken or "", ranges(s.waived), done]
        yield f"| {' | '.join(map(str, cells))} |"
    if len(sections) > MOST_SECTIONS:
        yield f"\n… and {len(sections) - MOST_SECTIONS} more in report.json."


def _event_table(events: Sequence[Event]) -> Iterator[str]:
    yield "\n## What happened\n"
    yield "| at | UTC | |"
    yield "|---|---|---|"
    for event in events[:MOST_EVENTS]:
        yield f"| {took(event.at_s)} | {event.utc[11:19]} | {_cell(event.what)} |"
    if len(events) > MOST_EVENTS:
        yield f"\n… and {len(events) - MOST_EVENTS} more in report.json."


def _compared(record: Record) -> str:
    if record["apart_um"] is None:
        return "nothing tells whether z reads as it did before"
    return f"plane {record['plane']} is where it was, within {record['apart_um'] / 2:.2g} µm along z"


def _by(record: Record) -> str:
    return "the operator said" if record.get("by") == "operator" else "a look at the device shows"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _text(value: object | None) -> str:
    return "" if value is None else str(value)


def _utc(text: str | None) -> datetime | None:
    return None if text is None else datetime.fromisoformat(text).astimezone(UTC)
