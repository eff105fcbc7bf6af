"""Instrument and recipe files as text, checked as the command line checks them before anything is written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from devices.config_commands import check_text
from devices.errors import StereotomeError
from processing.outputs import write_durably


@dataclass
class FileEditor:
    """One file and what is being made of it.

    Attributes
    ----------
    path : str
        Where it is, or is to be.
    text : str
        As edited.
    kind : str
        ``instrument`` or ``recipe``, once it was found good.
    words : str
        What is wrong, each with its line, or that it is good.
    good : bool
        Whether `words` are those of a good file.
    """

    path: str = ""
    text: str = ""
    kind: str = ""
    words: str = ""
    good: bool = False
    stored: str | None = None

    @property
    def changed(self) -> bool:
        """Whether what is edited is not what is stored."""
        return self.text != (self.stored or "")

    def begin(self, path: str, text: str) -> None:
        """Edit a text that is no file yet."""
        self.path, self.text, self.stored = path, text, None
        self.check()

    def open(self) -> None:
        """Read the file."""
        try:
            self.text = self.stored = Path(self.path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as cause:
            self._bad(f"{self.path}: cannot be read as text: {cause}")
        else:
            self.check()

    def check(self) -> None:
        """Say what is wrong with the text, or that nothing is."""
        try:
            self.kind = check_text(self.text, Path(self.path).name or "the text")
        except StereotomeError as error:
            self._bad(error.message())
        else:
            self.good, self.words = True, f"a good {self.kind} file"

    def save(self) -> None:
        """Write the text, if it is good and the file is still as it was read."""
        self.check()
        if not self.good:
            return
        path = Path(self.path)
        try:
            there = path.read_text(encoding="utf-8") if path.exists() else None
            if there not in {self.stored, self.text}:
                self._bad(f"{path} was changed meanwhile, by another program. Nothing was written: open it again.")
                return
            write_durably(path, self.text.encode())
        except (OSError, UnicodeDecodeError) as cause:
            self._bad(f"{path}: not written: {cause}")
            return
        self.stored = self.text
        self.words = f"a good {self.kind} file, saved" + (
            ": it holds from the next start of the instrument's process on" if self.kind == "instrument" else ""
        )

    def _bad(self, words: str) -> None:
        self.good, self.words = False, words
