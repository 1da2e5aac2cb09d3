"""The memory there is, and what does not fit into it: refused before it is taken.

Takes: how many bytes something needs. Gives: `refuse_beyond`, `free_memory`, `size_text`; what keeps a
command within it, `hold_to_memory`, `is_lack`, `lacking`.
Guarantees: what is refused says what it needs, what there is, and what to write instead.
Does not: measure what is taken.

What commands take beside the 60 to 120 MB of the program, at most and within a factor of two:

| what | bytes | told by |
|---|---|---|
| `analyze`: systems of n states, their margins | 500 n² at work, 200 n² kept of each | `analysis.plan` |
| `analyze`: k unlike peers, a determinant of s rows and r heard | (200 k + 6,000) s r | `analysis.plan` |
| `analyze`: k different peers of n states | 100 n² k | `large.populations` |
| `feel`: n states together, frequencies in blocks | 30 MB, or 150 n² if that is more | `hands.response` |
| `simulate`: numbers of a frame of all peers | 64 each | `simulation.simulation` |
| the same: a way of an unreliable link; a packet on it | 200; 100 | `network.timetable` |
| `simulate` in Python, `--plot`: rows × signals | 16 each | `simulation.trajectory` |
| `simulate --out`: a signal; a number of a block | 2,000 (Parquet 24,000); 150 | `present.recording` |
| the same: a number of all rows | MAT 32; Parquet 500 a signal and block | `present.recording` |
| `simulate --runs`: a run | 300 each | `simulation.ensemble` |
| `export`: a state space of n states and inputs | 40 n² | `exports.lifted` |
| `sweep`: points × columns, of a file's two blocks of rows at most | 32 each | `sweeps.resumable_sweep` |

Other things have bounds of their own: states of a matrix, packets, ticks of a frame, points of a sweep.
What can't be known beforehand, as what a sparse factorization fills in, ends at a limit of the process.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

SMALL = 2**26  # bytes: as much as the program takes by itself; whoever has no more can't run it

CGROUPS = Path("/sys/fs/cgroup")
PROCESS = Path("/proc/self")
MACHINE = Path("/proc/meminfo")


def refuse_beyond(needed: float, code: str, place: SourceLocation, what: str, hint: str) -> None:
    """Refuse what needs more memory than there is.

    Parameters
    ----------
    needed
        Bytes.
    code, place, hint
        Of the message.
    what
        What needs it, in the plural.

    Raises
    ------
    ApcError
        The code given.
    """
    if needed > SMALL and needed > (free := free_memory()):
        text = f"{what} take about {size_text(needed)} of memory, and {size_text(free)} are free"
        raise ApcError(Diagnostic(code, place, text, hint=hint))


def size_text(size: float) -> str:
    """Return bytes for a person: "12 MB"."""
    unit = max(0, min(4, int(math.log10(max(size, 1.0)) / 3)))
    return f"{size / 1000**unit:,.3g} {('B', 'kB', 'MB', 'GB', 'TB')[unit]}"


def free_memory() -> float:
    """Return how many bytes this process may still take: of the machine, its control groups, its limits.

    Infinite where nothing tells.
    """
    return max(0.0, min([_of_machine(), *_of_groups(), *_of_limits()]))


def hold_to_memory() -> None:
    """Limit this process to the memory there is: one that takes more is told so instead of being killed."""
    if sys.platform != "linux":  # elsewhere the limit holds for nothing, or for too much
        return
    import resource

    free, limit = free_memory(), resource.RLIMIT_DATA
    if math.isfinite(free):
        with suppress(OSError, ValueError):
            most = resource.getrlimit(limit)[1]
            resource.setrlimit(limit, (_number(PROCESS / "status", "VmData") + int(free), most))


def lacking(command: str) -> Diagnostic:
    """Return the message of a command that ran out of memory."""
    what = "ran out of memory"
    return Diagnostic(
        "E820", SourceLocation(command), what, hint="fewer peers that differ, fewer states, or a shorter time"
    )


def is_lack(error: BaseException) -> bool:
    """Say whether an error is that there was no memory left."""
    return isinstance(error, MemoryError) or "bad_alloc" in str(error)


def _of_machine() -> float:
    with suppress(OSError, StopIteration):
        return _number(MACHINE, "MemAvailable") + _number(MACHINE, "SwapFree")
    with suppress(OSError, ValueError, AttributeError):
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return math.inf


def _of_groups() -> Iterator[float]:
    """Yield what the control groups of this process leave it, those of version 2 and of version 1."""
    try:
        listed = (PROCESS / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in listed:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        top = CGROUPS / controllers
        names = ("memory.max", "memory.current") if not controllers else _FIRST
        for folder in (top / path.lstrip("/"), *(top / path.lstrip("/")).parents):
            with suppress(OSError, ValueError):  # "max" is no number, the root has none
                most, taken = (int((folder / name).read_text(encoding="utf-8")) for name in names)
                # Of what files take there, the part not in use is given back when it is asked for.
                with suppress(OSError, StopIteration):
                    taken -= _number(folder / "memory.stat", "inactive_file", unit=1)
                yield most - taken
            if folder == top:
                break


_FIRST = "memory.limit_in_bytes", "memory.usage_in_bytes"


def _of_limits() -> Iterator[float]:
    """Yield what the limits of this process leave it."""
    with suppress(ImportError, OSError, StopIteration):
        import resource

        for limit, name in ((resource.RLIMIT_DATA, "VmData"), (resource.RLIMIT_AS, "VmSize")):
            most = resource.getrlimit(limit)[0]
            if most != resource.RLIM_INFINITY:
                yield most - _number(PROCESS / "status", name)


def _number(file: Path, name: str, unit: int = 1024) -> int:
    """Return the number of a line of a file `name: number`, in bytes."""
    lines = (line.replace(":", " ").split() for line in file.read_text(encoding="utf-8").splitlines())
    return next(int(words[1]) for words in lines if words and words[0] == name) * unit
