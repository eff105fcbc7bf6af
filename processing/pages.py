"""Reports as a page of HTML that needs no other file: pictures inside, words escaped."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1000px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: .6em 0; font-variant-numeric: tabular-nums; }
td, th { padding: .2em .7em; text-align: left; border-bottom: 1px solid #e4e4e4; vertical-align: top; }
td.number, th.number { text-align: right; white-space: nowrap; } th { background: #f4f4f4; }
.wide { overflow-x: auto; font-size: 13px; } .note { background: #fff6da; padding: .4em .8em; margin: .4em 0; }
figure { display: inline-block; margin: .5em 1em .5em 0; } figcaption { font-size: 13px; color: #555; max-width: 60em; }
img { max-width: 100%; } @media print { h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


def page(title: str, parts: Iterable[str]) -> bytes:
    """Put parts together to a page."""
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    body = "\n".join(parts)
    shown = f"<body><h1>{escape(title)}</h1>\n{body}\n</body>"
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n{shown}</html>\n'.encode()


def heading(words: str) -> str:
    """Return a heading."""
    return f"<h2>{escape(words)}</h2>"


def paragraph(words: str) -> str:
    """Return a paragraph."""
    return f"<p>{escape(words)}</p>"


def notes(said: Iterable[str]) -> str:
    """Return what must be said, one line each, so that it is seen."""
    return "\n".join(f'<p class="note">{escape(words)}</p>' for words in said)


def picture(png: bytes, caption: str) -> str:
    """Return a picture, within the page, with words below."""
    data = b64encode(png).decode()
    words = escape(caption)
    return f'<figure><img alt="{words}" src="data:image/png;base64,{data}"><figcaption>{words}</figcaption></figure>'


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table; numbers stand to the right, with four figures."""
    lines = [[_cell(item) for item in row] for row in rows]
    numeric = [bool(lines) and all(row[k][1] for row in lines) for k in range(len(columns))]
    head = "".join(f"<th{_kind(n)}>{escape(name)}</th>" for name, n in zip(columns, numeric, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{_kind(n)}>{escape(words)}</td>" for words, n in row) + "</tr>" for row in lines
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def facts(given: Mapping[str, object]) -> str:
    """Return a table of two columns."""
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(_cell(value)[0])}</td></tr>" for name, value in given.items()
    )
    return f"<table>{rows}</table>"


def _kind(number: bool) -> str:  # noqa: FBT001
    return ' class="number"' if number else ""


def _cell(item: object) -> tuple[str, bool]:
    """Return how a value is written, and whether it is a number."""
    if isinstance(item, bool):
        return ("yes" if item else "no"), False
    if isinstance(item, float):
        return f"{item:.4g}", True
    if item is None:
        return "–", True
    return str(item), isinstance(item, int)
