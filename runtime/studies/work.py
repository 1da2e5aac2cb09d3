"""The computation of parts of a sweep in one process: the model is opened once.

Takes: `Work`, plain data that can be sent to another process or machine.
Gives: `Work`, `Computed`, `compute_part`, `program_versions`.
Guarantees: a part's rows depend on the work and the part only, not on the process or the order; one BLAS
thread; one part at a time in a process, as numerical libraries have global settings.
Does not: start processes, or store results.
"""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

from apc.compiler.cache import program_digest
from apc.studies.grid import Grid
from apc.studies.quantities import Cells, SweepQuantity, find_quantity
from apc.support.distribution import versions
from apc.support.processes import model_of_bytes
from apc.support.threads import single_threaded

# The numerical libraries: with another version of one of them, last digits may differ.
LIBRARIES = ("casadi", "numpy", "python-flint", "scipy")

_SEQUENTIAL = threading.Lock()


@dataclass(frozen=True, slots=True)
class Work:
    """The data of a sweep: the compiled model as bytes (see `processes`), the name of the quantity, the grid.

    Part i contains the points from i·`part_points` on, `part_points` of them or the remaining ones.
    """

    model: bytes
    of: str
    grid: Grid
    part_points: int

    @property
    def parts(self) -> int:
        """The number of parts."""
        return -(-self.grid.points // self.part_points)

    def points_of(self, part: int) -> range:
        """Return the indices of a part's points."""
        first = part * self.part_points
        return range(first, min(first + self.part_points, self.grid.points))


@dataclass(frozen=True, slots=True, eq=False)
class Computed:
    """The computed cells of a part (see `quantities.SweepQuantity`), and the versions of the
    libraries used.
    """

    part: int
    cells: Cells
    versions: tuple[tuple[str, str], ...]


def compute_part(work: Work, part: int) -> Computed:
    """Return the cells of one part of a sweep; a point with an error is a row with its message."""
    with _SEQUENTIAL, single_threaded():
        cells = _load(work.model, work.of).cells(work.grid, work.points_of(part))
    return Computed(part, cells, program_versions())


@cache
def program_versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the libraries in use, and a digest of the program's source text."""
    digest = hashlib.sha256(program_digest().encode())
    runtime = Path(__file__).resolve().parents[1]
    for path in sorted(runtime.rglob("*.py")):
        digest.update(f"\0{path.relative_to(runtime)}\0".encode())
        digest.update(path.read_bytes())
    return (*versions(*LIBRARIES), ("program", digest.hexdigest()[:16]))


@lru_cache(maxsize=1)
def _load(model: bytes, of: str) -> SweepQuantity:
    """Return the quantity of a serialized model, cached in the process."""
    return find_quantity(model_of_bytes(model), of)
