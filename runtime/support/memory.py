"""The available memory; computations that require more raise an error in advance.

Takes: a number of bytes. Gives: `refuse_beyond`, `free_memory`, `size_text`; the process limit,
`hold_to_memory`, `is_lack`, `lacking`.
Guarantees: the error has the required and the available memory, and a fix.
Does not: measure the memory in use.

Memory of commands in addition to the 60 to 120 MB of the program, at most and within a factor of two:

| what | bytes | defined in |
|---|---|---|
| `analyze`: systems of n states, their margins | 500 n² at work, 200 n² kept of each |
`analysis.method_selection` | | `analyze`: k unlike peers, a determinant of s sent and r received values |
(200 k + 6,000) s r | `analysis.method_selection` | | `analyze`: k different peers of n states | 100 n² k |
`spectrum.heterogeneous_peers` | | `transparency`: n states together, frequencies in blocks | 30 MB, or 150
n² if that is more | `haptics.modal_response` | | `simulate`: numbers of a frame of all peers | 64 each |
`simulation.simulation` | | the same: a directed link of an unreliable link; a packet on it | 200; 100 |
`network.packet_schedule` | | `simulate` in Python, `--plot`: rows × signals | 16 each |
`simulation.trajectory` | | `simulate --out`: a signal; a number of a block | 2,000 (Parquet 24,000); 150 |
`output.recording` | | the same: a number of all rows | MAT 32; Parquet 500 a signal and block |
`output.recording` | | `simulate --runs`: a run | 300 each | `simulation.monte_carlo` | | `export`: a state
space of n states and inputs | 40 n² | `exports.lifted` | | `sweep`: points × columns, of a file's two blocks
of rows at most | 32 each | `studies.resumable_sweep` |

Separate limits exist for: states of a matrix, packets, ticks of a frame, points of a sweep. Unpredictable
needs, such as the fill-in of a sparse factorization, are stopped by a limit of the process.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

SMALL = 2**26  # bytes, about the memory of the program itself; smaller computations are not checked

CGROUPS = Path("/sys/fs/cgroup")
PROCESS = Path("/proc/self")
MACHINE = Path("/proc/meminfo")


def refuse_beyond(needed: float, code: str, location: SourceLocation, subject: str, advice: str) -> None:
    """Raise ApcError for a computation that requires more memory than available.

    Parameters
    ----------
    needed
        The required memory in bytes.
    code, location, advice
        The code, location and advice of the error.
    subject
        The noun for the objects that require the memory, in the plural.

    Raises
    ------
    ApcError
        The error with this code.
    """
    if needed > SMALL and needed > (free := free_memory()):
        text = f"{subject} need about {size_text(needed)} of memory, but {size_text(free)} are free"
        raise ApcError(Diagnostic(code, location, text, advice=advice))


def size_text(size: float) -> str:
    """Return the text of a number of bytes, such as "12 MB"."""
    unit = max(0, min(4, int(math.log10(max(size, 1.0)) / 3)))
    return f"{size / 1000**unit:,.3g} {('B', 'kB', 'MB', 'GB', 'TB')[unit]}"


def free_memory() -> float:
    """Return the bytes available to this process within machine, control groups and limits.

    The result is infinite if unknown.
    """
    return max(0.0, min([_machine_memory(), *_control_group_memory(), *_process_limit_memory()]))


def hold_to_memory() -> None:
    """Limit this process to the available memory, so that exceeding it raises an error."""
    if sys.platform != "linux":  # on other systems the limit has no effect, or includes other memory
        return
    import resource

    free, limit = free_memory(), resource.RLIMIT_DATA
    if math.isfinite(free):
        with suppress(OSError, ValueError):
            most = resource.getrlimit(limit)[1]
            resource.setrlimit(limit, (_number(PROCESS / "status", "VmData") + int(free), most))


def lacking(command: str) -> Diagnostic:
    """Return the error of a command that ran out of memory."""
    message = "out of memory"
    return Diagnostic(
        "E820",
        SourceLocation(command),
        message,
        advice="reduce the number of different peers or states, or shorten the time",
    )


def is_lack(error: BaseException) -> bool:
    """Return whether an error is a lack of memory."""
    return isinstance(error, MemoryError) or "bad_alloc" in str(error)


def _machine_memory() -> float:
    """Return the bytes available on the machine, infinite if unknown."""
    with suppress(OSError, StopIteration):
        return _number(MACHINE, "MemAvailable") + _number(MACHINE, "SwapFree")
    with suppress(OSError, ValueError, AttributeError):
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return math.inf


def _control_group_memory() -> Iterator[float]:
    """Yield the bytes available in each control group of this process, of version 1 or 2."""
    try:
        lines = (PROCESS / "cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        top = CGROUPS / controllers
        names = ("memory.max", "memory.current") if not controllers else _FIRST
        for folder in (top / path.lstrip("/"), *(top / path.lstrip("/")).parents):
            with suppress(OSError, ValueError):  # "max" is no number, the root has no such file
                most, usage = (int((folder / name).read_text(encoding="utf-8")) for name in names)
                # The inactive part of the file cache is released on demand.
                with suppress(OSError, StopIteration):
                    usage -= _number(folder / "memory.stat", "inactive_file", unit=1)
                yield most - usage
            if folder == top:
                break


_FIRST = "memory.limit_in_bytes", "memory.usage_in_bytes"


def _process_limit_memory() -> Iterator[float]:
    """Yield the bytes available within each limit of this process."""
    with suppress(ImportError, OSError, StopIteration):
        import resource

        for limit, name in ((resource.RLIMIT_DATA, "VmData"), (resource.RLIMIT_AS, "VmSize")):
            most = resource.getrlimit(limit)[0]
            if most != resource.RLIM_INFINITY:
                yield most - _number(PROCESS / "status", name)


def _number(file: Path, name: str, unit: int = 1024) -> int:
    """Return the number in the line `name: number` of a file, in bytes; `unit` is its unit in bytes."""
    lines = (line.replace(":", " ").split() for line in file.read_text(encoding="utf-8").splitlines())
    return next(int(words[1]) for words in lines if words and words[0] == name) * unit
