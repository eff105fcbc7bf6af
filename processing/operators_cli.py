"""The command ``stereotome process operators``."""

from __future__ import annotations

import inspect
import json as notation
import sys
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from processing.operators import families, operators

if TYPE_CHECKING:
    from processing.operators import Operator


def list_operators(family: str | None = None, /, *, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """List the operators that steps of a pipeline may name, with their parameters.

    Parameters
    ----------
    family
        One family alone: the word before the dot.
    json
        Write a JSON list to standard output.
    """
    chosen = [o for o in operators() if family in {None, o.name.partition(".")[0]}]
    if not chosen:
        sys.stderr.write(f"no family is called {family!r}; there are {', '.join(families())}.\n")
        return 2
    if json:
        sys.stdout.write(notation.dumps([described(o) for o in chosen]) + "\n")
    else:
        sys.stdout.write("\n".join(paragraph(o) for o in chosen) + "\n")
    return 0


def described(operator: Operator) -> dict[str, Any]:
    """Return an operator as a JSON table."""
    return {
        "name": operator.name,
        "summary": operator.summary,
        "takes": [name if needed else f"{name}?" for name, needed in operator.takes.items()],
        "gives": [layer.name for layer in operator.gives],
        "parameters": {name: written(operator, name) for name in operator.defaults},
    }


def written(operator: Operator, name: str) -> str:
    """Return a parameter's type and default as its function writes them."""
    parameter = next(p for p in inspect.signature(operator.function).parameters.values() if p.name == name)
    default = "" if parameter.default is parameter.empty else f" = {parameter.default!r}"
    return f"{parameter.annotation}{default}"


def paragraph(operator: Operator) -> str:
    """Return an operator in words: what it does, takes and gives, and its parameters."""
    told = described(operator)
    lines = [f"{told['name']}  {told['summary']}", f"    {', '.join(told['takes'])} → {', '.join(told['gives'])}"]
    lines += [f"    {name}: {words}" for name, words in told["parameters"].items()]
    return "\n".join(lines)
