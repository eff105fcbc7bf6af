"""Operators: pure functions on named arrays that say what they take, what they give, and what can be set.

A function becomes an operator by one line above it::

    @operator("range.median", gives=[like("range")])
    def median(range_: Array, *, side_px: int = 5) -> Array: ...

Parameters before the star are arrays (layers), taken by their names (an underscore at the end left out), None where
they may be absent; those after it are settings. What it returns, one value or a tuple, is filed under the names in
``gives``. The function itself stays what it is: call it as any other.

A family, the word before the dot, is a module named in the entry-point group ``stereotome.operators``; it is imported
when one of its operators is asked for. `processing.pipeline` runs operators in order.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from devices.errors import InputError, did_you_mean
from devices.installed import installed

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Function = TypeVar("Function", bound=Callable[..., Any])
    Layers = Mapping[str, Any]
    Halo = Callable[[Mapping[str, Any]], tuple[int, ...] | None]

GROUP = "stereotome.operators"
# What annotations name that is imported for type checkers alone.
STAND_INS = {"Array": np.ndarray, "NDArray": np.ndarray, "Spacing": tuple[float, float, float]}


@dataclass(frozen=True)
class Layer:
    """What is known of a result before it is computed.

    Attributes
    ----------
    name : str
        Under which it is filed.
    shape : str
        The input whose shape it has, one of bands without their axis; empty where it has a shape of its own.
    dtype : str
        Its numpy type, or the input whose type it has; empty where that depends on the parameters.
    """

    name: str
    shape: str = ""
    dtype: str = ""


def like(name: str, source: str = "", *, dtype: str = "") -> Layer:
    """Return the layer ``name`` of the shape and, unless ``dtype`` says another, the type of the input ``source``."""
    source = source or name
    return Layer(name, source, dtype or source)


@dataclass(frozen=True)
class Operator:
    """A registered function.

    Attributes
    ----------
    name : str
        ``family.name``.
    function : callable
        Pure: never changes what it is given.
    gives : tuple of Layer
        Its results, in order.
    halo : callable, optional
        Of the parameters: how far, in pixels along each axis, a result depends on its surroundings; a part with so
        much around it gives the same as the whole. None, itself or what it returns: on all of the input.
    """

    name: str
    function: Callable[..., Any]
    gives: tuple[Layer, ...]
    halo: Halo | None = None

    @property
    def summary(self) -> str:
        """First line of the function's docstring."""
        return (inspect.getdoc(self.function) or "").partition("\n")[0]

    @cached_property
    def _signature(self) -> list[inspect.Parameter]:
        return list(inspect.signature(self.function).parameters.values())

    @cached_property
    def takes(self) -> dict[str, bool]:
        """Layers it takes, and whether each must be there."""
        inputs = [p for p in self._signature if p.kind is not p.KEYWORD_ONLY]
        return {p.name.rstrip("_"): p.default is p.empty for p in inputs}

    @cached_property
    def defaults(self) -> dict[str, Any]:
        """Parameters with their defaults; `inspect.Parameter.empty` where one must be given."""
        return {p.name: p.default for p in self._signature if p.kind is p.KEYWORD_ONLY}

    @cached_property
    def types(self) -> dict[str, Any]:
        """Types of the parameters."""
        found = inspect.get_annotations(self.function, locals=STAND_INS, eval_str=True)
        return {name: found[name] for name in self.defaults}

    def settings(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return all parameters: those given, turned into their types, and the defaults of the others.

        Raises
        ------
        InputError
            ``operator-params``: an unknown one, one that is missing, or one of another type.
        """
        for name in given:
            if name not in self.defaults:
                raise _params(f"{self.name} has no parameter {name!r}{did_you_mean(name, list(self.defaults))}")
        settings = {**self.defaults, **{name: self._converted(name, value) for name, value in given.items()}}
        missing = [name for name, value in settings.items() if value is inspect.Parameter.empty]
        if missing:
            raise _params(f"{self.name} needs {', '.join(missing)}")
        return settings

    def _converted(self, name: str, value: object) -> Any:
        kind = self.types[name]
        if isinstance(value, str) and "tuple" in str(kind):
            value = value.split(",")
        try:
            return msgspec.convert(value, kind, strict=False)
        except msgspec.ValidationError as error:
            raise _params(f"{self.name}: {name} cannot be {value!r}: {error}") from None

    def __call__(self, layers: Layers, **given: object) -> dict[str, Any]:
        """Apply it to named layers; returns its results by name.

        Raises
        ------
        InputError
            ``operator-inputs``: a layer is missing; ``operator-params``; or what the function itself refuses.
        """
        settings = self.settings(given)
        missing = [name for name, needed in self.takes.items() if needed and name not in layers]
        if missing:
            raise InputError(
                f"{self.name} needs {', '.join(missing)}; there is {', '.join(layers) or 'nothing'}.",
                fix="give it in the input, or put a step before that makes it: stereotome process operators",
                code="operator-inputs",
            )
        made = self.function(*(layers.get(name) for name in self.takes), **settings)
        results = made if len(self.gives) > 1 else (made,)
        return {layer.name: value for layer, value in zip(self.gives, results, strict=True)}


def _params(what: str) -> InputError:
    return InputError(f"{what}.", fix="its parameters: stereotome process operators", code="operator-params")


_registered: dict[str, Operator] = {}


def operator(name: str, *, gives: Sequence[Layer], halo: Halo | None = None) -> Callable[[Function], Function]:
    """Register a function as the operator ``name``; the function stays as it is."""

    def register(function: Function) -> Function:
        _registered[name] = Operator(name, function, tuple(gives), halo)
        return function

    return register


def families() -> list[str]:
    """Return the names of all families that are installed."""
    return sorted(installed(GROUP).names)


def operators() -> list[Operator]:
    """Return every installed operator, by name; imports all families."""
    for entry in installed(GROUP):
        entry.load()
    return [_registered[name] for name in sorted(_registered)]


def find_operator(name: str) -> Operator:
    """Return the operator of that name; imports its family alone.

    Raises
    ------
    InputError
        ``operator-unknown``.
    """
    if name in _registered:
        return _registered[name]
    for entry in installed(GROUP).select(name=name.partition(".")[0]):
        entry.load()
    if name not in _registered:
        known = [o.name for o in operators()]
        raise InputError(
            f"no operator is called {name!r}{did_you_mean(name, known)}.",
            fix="all operators: stereotome process operators",
            code="operator-unknown",
        )
    return _registered[name]
