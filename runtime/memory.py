"""The available memory; allocations that exceed it are refused in advance.

Takes: a number of bytes. Gives: `refuse_beyond`, `free_memory`, `size_text`; the process limit,
`hold_to_memory`, `is_lack`, `lacking`.
Guarantees: a refusal states required and available memory, and a remedy.
Does not: measure the memory in use.

Memory of commands in addition to the 60 to 120 MB of the program, at most and within a factor of two:

| what | bytes | defined in |
|---|---|---|
| `analyze`: systems of n states, their margins | 500 n² at work, 200 n² kept of each |
`analysis.method_selection` | | `analyze`: k unlike peers, a determinant of s sent and r received values |
(200 k + 6,000) s r | `analysis.method_selection` | | `analyze`: k different peers of n states | 100 n² k |
`large_scale.heterogeneous_peers` | | `transparency`: n states together, frequencies in blocks | 30 MB, or 150
n² if that is more | `haptics.modal_response` | | `simulate`: numbers of a frame of all peers | 64 each |
`simulation.simulation` | | the same: a directed link of an unreliable link; a packet on it | 200; 100 |
`network.packet_schedule` | | `simulate` in Python, `--plot`: rows × signals | 16 each |
`simulation.trajectory` | | `simulate --out`: a signal; a number of a block | 2,000 (Parquet 24,000); 150 |
`output.recording` | | the same: a number of all rows | MAT 32; Parquet 500 a signal and block |
`output.recording` | | `simulate --runs`: a run | 300 each | `simulation.monte_carlo` | | `export`: a state
space of n states and inputs | 40 n² | `exports.lifted` | | `sweep`: points × columns, of a file's two blocks
of rows at most | 32 each | `sweeps.resumable_sweep` |

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

SMALL = 2**26  # bytes: the program itself needs as much

CGROUPS = Path("/sys/fs/cgroup")
PROCESS = Path("/proc/self")
MACHINE = Path("/proc/meminfo")


def refuse_beyond(needed: float, code: str, location: SourceLocation, subject: str, hint: str) -> None:
    """Refuse a computation that needs more memory than there is.

    Parameters
    ----------
    needed
        Bytes.
    code, location, hint
        Of the message.
    subject
        The objects that need it, in the plural.

    Raises
    ------
    ApcError
        The code given.
    """
    if needed > SMALL and needed > (free := free_memory()):
        text = f"{subject} take about {size_text(needed)} of memory, and {size_text(free)} are free"
        raise ApcError(Diagnostic(code, location, text, hint=hint))


def size_text(size: float) -> str:
    """Return bytes for a person: "12 MB"."""
    unit = max(0, min(4, int(math.log10(max(size, 1.0)) / 3)))
    return f"{size / 1000**unit:,.3g} {('B', 'kB', 'MB', 'GB', 'TB')[unit]}"


def free_memory() -> float:
    """Return the number of bytes still available to this process: machine, control groups, limits.

    Infinite if unknown.
    """
    return max(0.0, min([_of_machine(), *_of_groups(), *_of_limits()]))


def hold_to_memory() -> None:
    """Limit this process to the available memory, so that excess raises an error instead of a kill."""
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
    message = "ran out of memory"
    return Diagnostic(
        "E820",
        SourceLocation(command),
        message,
        hint="fewer peers that differ, fewer states, or a shorter time",
    )


def is_lack(error: BaseException) -> bool:
    """Return whether an error is a lack of memory."""
    return isinstance(error, MemoryError) or "bad_alloc" in str(error)


def _of_machine() -> float:
    with suppress(OSError, StopIteration):
        return _number(MACHINE, "MemAvailable") + _number(MACHINE, "SwapFree")
    with suppress(OSError, ValueError, AttributeError):
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return math.inf


def _of_groups() -> Iterator[float]:
    """Yield the memory available in the control groups of this process, of version 2 and of version 1."""
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
                most, used = (int((folder / name).read_text(encoding="utf-8")) for name in names)
                # Of what files take there, the part not in use is given back when it is asked for.
                with suppress(OSError, StopIteration):
                    used -= _number(folder / "memory.stat", "inactive_file", unit=1)
                yield most - used
            if folder == top:
                break


_FIRST = "memory.limit_in_bytes", "memory.usage_in_bytes"


def _of_limits() -> Iterator[float]:
    """Yield the memory available within the limits of this process."""
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
