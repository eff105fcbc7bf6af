"""TOML files as pydantic models: every problem found at once, each with its line and, for a misspelt key, a guess."""

from __future__ import annotations

import math
import re
import tomllib
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from devices.errors import did_you_mean
from devices.toml_lines import KeyPath, key_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails

    from devices.errors import StereotomeError

M = TypeVar("M", bound=BaseModel)
Problems = dict[KeyPath, list[str]]
Place = tuple[int, str]


class Table(BaseModel):
    """Base of everything written in a file: frozen, typed as written, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def load_model(path: Path, model: type[M], error: type[StereotomeError], *, overrides: Sequence[str] = ()) -> M:
    """Read a TOML file into ``model``.

    Parameters
    ----------
    path : Path
        The file.
    model : type
        The pydantic model of the whole file.
    error : type
        Class of the error to raise.
    overrides : sequence of str
        ``"stack.step=2.5"``: values that replace or add to the file's, written as TOML; other words are text.

    Raises
    ------
    StereotomeError
        Of the class ``error``: the file cannot be read, is no TOML, or does not fit; all problems are listed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise error(f"{path}: no such file.", fix="check the name, or give another file.") from None
    except (OSError, UnicodeDecodeError) as cause:
        raise error(f"{path}: cannot be read as text: {cause}") from cause
    return load_text(text, str(path), model, error, overrides=overrides)


def load_text(
    text: str, name: str, model: type[M], error: type[StereotomeError], *, overrides: Sequence[str] = ()
) -> M:
    """Read a TOML text into ``model``; ``name`` stands for the file in messages. Raises as `load_model` does."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as cause:
        raise error(_listed(name, [_syntax_problem(str(cause), text, name)])) from None
    overridden = {_override(data, given, error): (0, f"--set {given}") for given in overrides}
    problems: Problems = {path: ["must be a finite number"] for path in _not_finite(data, ())}
    try:
        instance = model.model_validate(data)
    except ValidationError as cause:
        _add_model_problems(problems, cause, data, model)
    else:
        if not problems:
            return instance
    places = {path: (line, f"{name}:{line}") for path, line in key_lines(text).items()}
    raise error(_listed(name, _with_places(problems, places | overridden, name)))


def _override(data: dict[str, Any], given: str, error: type[StereotomeError]) -> KeyPath:
    """Put one ``key.path=value`` into ``data`` and return its path."""
    dotted, equals, value = given.partition("=")
    path = tuple(part.strip() for part in dotted.split("."))
    if not equals or not all(path):
        raise error(f"--set {given}: is not of the form key=value", fix="write for example --set stack.step=2.5")
    for part in path[:-1]:
        data = data.setdefault(part, {})
        if not isinstance(data, dict):
            raise error(f"--set {given}: '{part}' is a value, not a table.")
    data[path[-1]] = _toml_value(value.strip())
    return path


def _toml_value(text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _syntax_problem(said: str, text: str, name: str) -> str:
    found = re.search(r" \(at line (\d+), column \d+\)", said)
    line = int(found.group(1)) if found else len(text.splitlines())
    return f"{name}:{line}: no valid TOML: {re.sub(r' *[(]at .*[)]', '', said)}"


def _listed(name: str, problems: list[str]) -> str:
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    return "\n    ".join([f"{name} has {count}:", *problems])


def _with_places(problems: Problems, places: dict[KeyPath, Place], name: str) -> list[str]:
    placed = [
        (_place_of(path, places, name), f"{_dotted(path)}{' or '.join(dict.fromkeys(words))}")
        for path, words in problems.items()
    ]
    return [f"{place}: {words}" for (_, place), words in sorted(placed)]


def _place_of(path: KeyPath, places: dict[KeyPath, Place], name: str) -> Place:
    """Return the place of the key, or of the nearest table around it that is written down."""
    while path and path not in places:
        path = path[:-1]
    return places.get(path, (1, f"{name}:1"))


def _dotted(path: KeyPath) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".") + ": " * bool(
        path
    )


def _not_finite(value: object, path: KeyPath) -> Iterator[KeyPath]:
    if isinstance(value, float) and not math.isfinite(value):
        yield path
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _not_finite(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _not_finite(inner, (*path, index))


def _add_model_problems(problems: Problems, cause: ValidationError, data: object, model: type[BaseModel]) -> None:
    already = set(problems)
    for detail in cause.errors(include_url=False):
        path = _written_path(detail, data)
        if path not in already:
            problems.setdefault(path, []).append(_words(detail, path, model))


def _written_path(detail: ErrorDetails, data: Any) -> KeyPath:
    """Return the error's place without the names pydantic gives to the members of a union."""
    path: KeyPath = ()
    for part in detail["loc"]:
        if isinstance(data, list):
            data = dict(enumerate(data))
        if isinstance(data, dict) and part in data:
            path, data = (*path, part), data[part]
    return (*path, detail["loc"][-1]) if detail["type"] == "missing" else path


def _words(detail: ErrorDetails, path: KeyPath, model: type[BaseModel]) -> str:
    if detail["type"] == "missing":
        return "missing"
    if detail["type"] == "extra_forbidden":
        return "unknown key" + did_you_mean(str(path[-1]), _keys_at(path[:-1], model))
    if detail["type"] == "value_error":
        return detail["msg"].removeprefix("Value error, ")
    said = detail["msg"][0].lower() + detail["msg"][1:]
    return said.replace("input should be", "should be") + f", not {detail['input']!r}"


def _keys_at(path: KeyPath, model: type[BaseModel]) -> list[str]:
    """Return the keys a file may have in the table at ``path``."""
    models = [model]
    for part in path:
        if isinstance(part, str):
            models = [inner for outer in models for inner in _models_of_key(outer, part)]
    return [field.alias or name for outer in models for name, field in outer.model_fields.items()]


def _models_of_key(model: type[BaseModel], key: str) -> list[type[BaseModel]]:
    for name, field in model.model_fields.items():
        if key == (field.alias or name):
            return list(_models_in(field.annotation))
    return []


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
