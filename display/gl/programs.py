"""Shader programs from the files of ``display/shaders``, with includes, and errors that name file and line."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import moderngl

from devices.errors import DisplayError

if TYPE_CHECKING:
    from collections.abc import Mapping

SHADERS = Path(__file__).resolve().parent.parent / "shaders"
VERSION = "#version 330 core\n"
INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
PLACE = re.compile(r"(?:^|\s|ERROR:\s*)(\d+)[:(](\d+)(?:\(\d+\))?\)?")  # Mesa, NVIDIA and AMD write 1:23, 1(23)
Defines = tuple[tuple[str, object], ...]


@dataclass
class Source:
    """The text of a shader put together from files; line directives carry the number of the file."""

    files: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)

    def add(self, name: str, substitutes: Mapping[str, str]) -> Source:
        """Append a file and, in their places, what it includes, each once."""
        if name in self.files:
            return self
        number = len(self.files)
        self.files.append(name)
        self.lines.append(f"#line 1 {number}")
        for k, line in enumerate(_text(name).splitlines(), start=2):
            if included := INCLUDE.match(line):
                self.add(substitutes.get(included[1], included[1]), substitutes)
                self.lines.append(f"#line {k} {number}")
            else:
                self.lines.append(line)
        return self

    def named(self, log: str) -> str:
        """Return a compiler's log with file names in the place of numbers."""

        def name(found: re.Match[str]) -> str:
            k = int(found[1])
            return f" {self.files[k]}:{found[2]}" if k < len(self.files) else found[0]

        return PLACE.sub(name, log)


def compiled(
    context: moderngl.Context,
    vertex: str,
    fragment: str,
    *,
    defines: Defines = (),
    substitutes: Mapping[str, str] | None = None,
) -> moderngl.Program:
    """Compile two shader files into a program.

    Parameters
    ----------
    vertex, fragment : str
        Names of files in ``display/shaders``.
    defines : tuple of (name, value)
        Written as ``#define`` before everything else.
    substitutes : dict, optional
        File to include in the place of another: how one loop takes the snippet of a mode.

    Raises
    ------
    DisplayError
        ``shader``: a file is missing or does not compile; the message names file and line.
    """
    head = VERSION + "".join(f"#define {name} {value}\n" for name, value in defines)
    sources = [Source().add(name, substitutes or {}) for name in (vertex, fragment)]
    texts = [head + "\n".join(source.lines) + "\n" for source in sources]
    try:
        return context.program(vertex_shader=texts[0], fragment_shader=texts[1])
    except moderngl.Error as error:
        stage = sources[0] if "vertex_shader" in str(error) else sources[1]
        raise DisplayError(
            f"a shader does not compile: {_first_error(stage.named(str(error)))}",
            why="; ".join(f"{s.files[0]}" for s in sources) + f" on {context.info['GL_RENDERER']}",
            fix="correct the line named; after an update of the driver, report it as a bug.",
            code="shader",
        ) from None


def _first_error(log: str) -> str:
    lines = [" ".join(line.split()) for line in log.splitlines() if ".glsl:" in line]
    return lines[0] if lines else " ".join(log.split())


@cache
def _text(name: str) -> str:
    path = SHADERS / name
    if not path.is_file():
        raise DisplayError(f"there is no shader file {name}.", fix=f"put it into {SHADERS}.", code="shader")
    return path.read_text(encoding="utf-8")
