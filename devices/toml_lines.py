"""Where in a TOML text every key stands: `tomllib` reads values but forgets their lines."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field

KeyPath = tuple[str | int, ...]

_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"{3,5}'
    r"|'''.*?'{3,5}"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'"
    r"|\#[^\n]*|\n|[\[\]{}=,.]|[^\s\[\]{}=,.\"'\#]+|[^\S\n]+",
    re.DOTALL,
)
_END_OF_VALUE = frozenset(",]}\n")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, counted from 1, of every key, table and array element of a valid TOML text.

    Parameters
    ----------
    text : str
        A text that `tomllib.loads` accepts; anything else gives a meaningless answer.

    Returns
    -------
    dict
        Paths such as ``("stage", "z", "limits", "min_um")`` or ``("sim", "faults", 0)``. A table opened more than once
        (``[a.b]`` then ``[a.c]``) stands where it was opened first.
    """
    scanner = _Scanner(_tokens(text))
    scanner.document()
    return scanner.lines


def _tokens(text: str) -> list[tuple[str, int]]:
    tokens, line = [], 1
    for match in _TOKEN.finditer(text):
        word = match.group()
        if not word.startswith("#") and (word == "\n" or word.strip()):
            tokens.append((word, line))
        line += word.count("\n")
    return [*tokens, ("\n", line)]


@dataclass
class _Scanner:
    """Walks the tokens once; `lines` grows as keys are met."""

    tokens: list[tuple[str, int]]
    at: int = 0
    lines: dict[KeyPath, int] = field(default_factory=dict)
    elements: dict[KeyPath, int] = field(default_factory=dict)

    def document(self) -> None:
        table: KeyPath = ()
        while self.at < len(self.tokens):
            if self.peek() == "\n":
                self.take()
            elif self.peek() == "[":
                table = self.header()
            else:
                self.pair(table)

    def header(self) -> KeyPath:
        self.take()
        is_array = self.peek() == "["
        if is_array:
            self.take()
        path = self.key(())
        while self.peek() == "]":
            self.take()
        return self.next_element(path) if is_array else path

    def next_element(self, path: KeyPath) -> KeyPath:
        array = path[:-1] if isinstance(path[-1], int) else path
        self.elements[array] = self.elements.get(array, -1) + 1
        return self.note((*array, self.elements[array]), self.tokens[self.at - 1][1])

    def pair(self, table: KeyPath) -> None:
        path = self.key(table)
        self.take()  # the equals sign
        self.value(path)

    def key(self, path: KeyPath) -> KeyPath:
        """Take a dotted key; a part that names an array of tables means its newest element."""
        while True:
            part, line = self.take()
            path = self.note((*path, _plain(part)), line)
            if path in self.elements:
                path = (*path, self.elements[path])
            if self.peek() != ".":
                return path
            self.take()

    def value(self, path: KeyPath) -> None:
        if self.peek() == "[":
            self.array(path)
        elif self.peek() == "{":
            self.inline_table(path)
        else:
            while self.peek() not in _END_OF_VALUE:
                self.take()

    def array(self, path: KeyPath) -> None:
        self.take()
        index = 0
        while self.peek() != "]":
            if self.peek() in ",\n":
                self.take()
                continue
            self.note((*path, index), self.tokens[self.at][1])
            self.value((*path, index))
            index += 1
        self.take()

    def inline_table(self, path: KeyPath) -> None:
        self.take()
        while self.peek() != "}":
            if self.peek() in ",\n":
                self.take()
            else:
                self.pair(path)
        self.take()

    def note(self, path: KeyPath, line: int) -> KeyPath:
        self.lines.setdefault(path, line)
        return path

    def peek(self) -> str:
        return self.tokens[self.at][0]

    def take(self) -> tuple[str, int]:
        self.at += 1
        return self.tokens[self.at - 1]


def _plain(key: str) -> str:
    """Return a bare or quoted key without its quotes and escapes."""
    if key[0] in "\"'":
        return str(tomllib.loads(f"key = {key}")["key"])
    return key
