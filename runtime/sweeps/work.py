"""The part of a sweep that one process does: open the model once, compute the points it is handed.

Takes: `Work`, plain data that can be sent to another process or machine.
Gives: `Work`, `Computed`, `compute_part`, `program_versions`.
Guarantees: a part's rows depend on the work and the part alone, not on who computes it or in what order; one
BLAS thread; one part at a time in a process, as the libraries of numbers keep global settings.
Does not: start processes, or keep results.
"""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

from apc.compiler.cache import program_digest
from apc.distribution import versions
from apc.processes import model_of_bytes
from apc.sweeps.grid import Grid
from apc.sweeps.quantities import Cells, SweepQuantity, find_quantity
from apc.threads import single_threaded

# The libraries that compute the numbers: with another version of one of them, the last digits may be others.
LIBRARIES = ("casadi", "numpy", "python-flint", "scipy")

_SEQUENTIAL = threading.Lock()


@dataclass(frozen=True, slots=True)
class Work:
    """A whole sweep: the compiled model as bytes (see `processes`), the quantity, and the points.

    Part i holds the points from i·`part_points` on, `part_points` of them or the remaining ones.
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
        """Return the numbers of a part's points."""
        first = part * self.part_points
        return range(first, min(first + self.part_points, self.grid.points))


@dataclass(frozen=True, slots=True, eq=False)
class Computed:
    """The cells of a part (see `quantities.SweepQuantity`), and the versions of the libraries used."""

    part: int
    cells: Cells
    versions: tuple[tuple[str, str], ...]


def compute_part(work: Work, part: int) -> Computed:
    """Compute one part of a sweep. A point that can't be computed becomes a row that says why."""
    with _SEQUENTIAL, single_threaded():
        cells = _load(work.model, work.of).cells(work.grid, work.points_of(part))
    return Computed(part, cells, program_versions())


@cache
def program_versions() -> tuple[tuple[str, str], ...]:
    """Return the versions of the libraries in use, and a digest of the program's own text."""
    whole = hashlib.sha256(program_digest().encode())
    runtime = Path(__file__).resolve().parents[1]
    for path in sorted(runtime.rglob("*.py")):
        whole.update(f"\0{path.relative_to(runtime)}\0".encode())
        whole.update(path.read_bytes())
    return (*versions(*LIBRARIES), ("program", whole.hexdigest()[:16]))


@lru_cache(maxsize=1)
def _load(model: bytes, of: str) -> SweepQuantity:
    return find_quantity(model_of_bytes(model), of)
