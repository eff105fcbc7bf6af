"""A pipeline: operators in order, as data. It says what is wrong with itself before anything is computed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from devices.errors import InputError
from processing.operators import find_operator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from processing.operators import Operator


@dataclass(frozen=True)
class Step:
    """An operator by its name, and the parameters that differ from its defaults."""

    name: str
    params: Mapping[str, Any] = field(default_factory=dict)

    @property
    def operator(self) -> Operator:
        """The operator; raises `InputError` when there is none."""
        return find_operator(self.name)

    @property
    def halo(self) -> tuple[int, ...] | None:
        """How far along each axis it looks around; None for all of the input."""
        operator = self.operator
        return None if operator.halo is None else operator.halo(operator.settings(self.params))

    @classmethod
    def parse(cls, words: str) -> Step:
        """Read ``"range.median:side_px=5:other=1"``, as it is written on a command line.

        Raises
        ------
        InputError
            ``operator-params``: a part without ``=``.
        """
        name, *settings = words.split(":")
        pairs = [setting.partition("=") for setting in settings]
        if not all(sign for _, sign, _ in pairs):
            raise InputError(
                f"{words!r} is no step.", fix="write operator:parameter=value:parameter=value", code="operator-params"
            )
        return cls(name, {key: value for key, _, value in pairs})


@dataclass(frozen=True)
class Pipeline:
    """Steps to be taken one after the other on a set of named layers.

    A layer is an array, or what belongs to one, such as ``spacing_um``. A step's results replace the layers of the same
    name; all others stay.
    """

    steps: tuple[Step, ...]

    @classmethod
    def from_tables(cls, tables: Iterable[Mapping[str, Any]]) -> Pipeline:
        """Make a pipeline of tables such as a TOML file holds: ``{operator = "range.median", side_px = 5}``."""
        steps = []
        for table in tables:
            if "operator" not in table:
                raise InputError(
                    f"a step without the name of its operator: {dict(table)}.",
                    fix='write operator = "family.name"',
                    code="operator-params",
                )
            steps.append(Step(str(table["operator"]), {k: v for k, v in table.items() if k != "operator"}))
        return cls(tuple(steps))

    def tables(self) -> list[dict[str, Any]]:
        """Return the steps as tables, all parameters filled in: what a report keeps."""
        return [{"operator": step.name, **step.operator.settings(step.params)} for step in self.steps]

    def check(self, names: Iterable[str]) -> set[str]:
        """Return the layers there will be at the end, when there are ``names`` at the start.

        Raises
        ------
        InputError
            ``operator-unknown``, ``operator-params`` or ``operator-inputs``.
        """
        there = set(names)
        for number, step in enumerate(self.steps, 1):
            step.operator.settings(step.params)
            missing = [name for name, needed in step.operator.takes.items() if needed and name not in there]
            if missing:
                raise InputError(
                    f"step {number}, {step.name}, needs {', '.join(missing)}; there is {', '.join(sorted(there))}.",
                    fix="put a step before it that makes it: stereotome process operators",
                    code="operator-inputs",
                )
            there |= {layer.name for layer in step.operator.gives}
        return there

    def __call__(self, layers: Mapping[str, Any], progress: Callable[[int], None] | None = None) -> dict[str, Any]:
        """Take all steps; ``progress`` is told how many are done."""
        self.check(layers)
        there = dict(layers)
        for done, step in enumerate(self.steps, 1):
            there |= step.operator(there, **step.params)
            if progress:
                progress(done)
        return there
