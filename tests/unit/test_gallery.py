"""The gallery shows every technique it is meant to show, and has every picture it names."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
SHOWN = {f"{letter}{k}" for letter, last in (("E", 11), ("F", 12), ("G", 8)) for k in range(1, last + 1)}
SHOWN |= {"H4", "H5", "H6", "H7", "H8", "H9", "I4", "I5"}


def test_every_row_has_its_pictures():
    page = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\*\*([A-I]\d+)\*\*", page)) == SHOWN
    named = {DOCS / place for place in re.findall(r"\]\((gallery/[^)]+)\)", page)}
    assert named == set((DOCS / "gallery").iterdir())
