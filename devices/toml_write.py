"""Values as TOML text: `tomllib` reads only."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(data: Mapping[str, Any]) -> str:
    """Return a TOML document of tables, arrays, texts, numbers and booleans; what is None is left out."""
    return "\n".join(_table(data, ()))


def toml_value(value: object) -> str:
    """Return one value as it stands after the equals sign."""
    if isinstance(value, dict):
        pairs = [f"{toml_key(key)} = {toml_value(inner)}" for key, inner in value.items() if inner is not None]
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_key(key: str) -> str:
    """Return a key, quoted if it has to be."""
    return key if _BARE.fullmatch(key) else toml_value(key)


def _table(data: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    inner = {key: value for key, value in data.items() if _is_table(value) or _is_tables(value)}
    for key, value in data.items():
        if key not in inner and value is not None:
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key, value in inner.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            header = ".".join(map(toml_key, (*path, key)))
            yield f"\n[[{header}]]" if one is not value else f"\n[{header}]"
            yield from _table(one, (*path, key))
    if not path:
        yield ""


def _is_table(value: object) -> bool:
    return isinstance(value, dict)


def _is_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(map(_is_table, value))
