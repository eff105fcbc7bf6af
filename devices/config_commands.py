"""``stereotome config check``, ``show`` and ``schema``: instrument and recipe files."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path  # noqa: TC003  the command line reads the annotations
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from devices.errors import RigError
from devices.installed import installed
from devices.toml_lines import key_lines
from devices.toml_model import load_model, load_text
from devices.toml_write import toml_key, toml_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import BaseModel


MODELS = "stereotome.models"
Kind = Literal["instrument", "recipe"]


def check_config(files: list[Path], /) -> int:
    """Check instrument and recipe files; which of the two a file is, its tables tell.

    Parameters
    ----------
    files
        Instrument or recipe files.
    """
    worst = 0
    for path in files:
        try:
            kind = _check(path)
            sys.stdout.write(f"{path}: a good {kind} file.\n")
        except RigError as error:
            sys.stderr.write(f"{error.message()}\n")
            worst = error.exit_code
    return worst


def show(
    file: Path,
    /,
    *,
    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    all_: Annotated[bool, Parameter(name="--all", negative="")] = False,
) -> None:
    """Show each value of an instrument or recipe file, and where it comes from. What is printed is TOML again.

    Parameters
    ----------
    file
        An instrument or recipe file.
    set_
        Replace a value, as the same option of run and serve does: --set stack.step=0.5
    all_
        Also what the file leaves out: the values that hold then.
    """
    kind = _check(file)
    lines = key_lines(file.read_text(encoding="utf-8"))
    given = {given.partition("=")[0].replace(" ", "") for given in set_}
    held = load_model(file, _models()[kind], RigError, overrides=set_).model_dump(mode="json", by_alias=True)
    for path, value in _values(held, ()):
        dotted = ".".join(map(toml_key, path))
        origin = "--set" if dotted in given else f"line {lines[path]}" if path in lines else "default"
        if value is None and all_:
            sys.stdout.write(f"# {dotted} is not set\n")
        elif value is not None and (all_ or origin != "default"):
            sys.stdout.write(f"{dotted} = {toml_value(value)}  # {origin}\n")


def schema(kind: Kind, /) -> None:
    """Print the JSON schema of instrument or recipe files: editors check and complete what is typed by it.

    Parameters
    ----------
    kind
        Of which files.
    """
    sys.stdout.write(json.dumps(_models()[kind].model_json_schema(by_alias=True), indent=1, ensure_ascii=False) + "\n")


def _values(table: dict[str, Any], within: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], object]]:
    """Yield every value that is no table, with its path."""
    for key, value in table.items():
        if isinstance(value, dict) and value:
            yield from _values(value, (*within, key))
        else:
            yield (*within, key), value


def _check(path: Path) -> str:
    try:
        kind = kind_of(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        kind = "instrument"
    load_model(path, _models()[kind], RigError)
    return kind


def check_text(text: str, name: str) -> str:
    """Return the kind of file a text is, instrument or recipe; raises `RigError` with everything wrong in it."""
    kind = kind_of(text)
    load_text(text, name, _models()[kind], RigError)
    return kind


def kind_of(text: str) -> str:
    """Return the kind of file whose tables a text has; one that cannot be read counts as an instrument file."""
    try:
        keys = tomllib.loads(text).keys()
    except ValueError:
        return "instrument"
    return max(_models(), key=lambda kind: len(keys & _tables(kind)))


def _tables(kind: str) -> set[str]:
    """Return the tables that only this kind of file has."""
    models = _models()
    others = {name for other, model in models.items() if other != kind for name in model.model_fields}
    return set(models[kind].model_fields) - others


def _models() -> dict[str, type[BaseModel]]:
    return {point.name: point.load() for point in installed(MODELS)}
