"""How a command is told to go block by block, and where blocks lie meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from devices.errors import InputError

WORK = ".blocks"  # the folder of blocks, in that of the results


@Parameter(name="*")
@dataclass(frozen=True)
class Blocks:
    """That work goes block by block, and how."""

    memory: str | None = None
    """Go block by block, in no more memory than this, such as 2GB; with a scheduler that of each worker."""
    scheduler: str | None = None
    """Go block by block on the workers of the Dask scheduler at this address, such as tcp://10.0.0.5:8786; they must
    see data and output under the same names."""
    resume: Annotated[bool, Parameter(negative="")] = False
    """Go on with a block by block job that was left; blocks that are done are not done again."""

    @property
    def wanted(self) -> bool:
        """True when anything of it was asked for."""
        return self.resume or self.memory is not None or self.scheduler is not None


IN_MEMORY = Blocks()


def whole_needed(what: str) -> InputError:
    """Return the error that something needs the whole volume in memory."""
    return InputError(
        f"{what} looks at the whole volume and cannot go block by block.",
        fix=("leave out --memory, --scheduler and --resume", "make the volume smaller first: process resample"),
        code="blockwise",
    )
