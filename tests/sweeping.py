"""A topology whose points are cheap, sweeps of it in processes of their own, and how to kill them."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

# A device pressed against a sampled wall: three states, a tick a frame.
CHEAP = """\
topology: wall
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}}
couplers:
  it: {type: VirtualWall, flange: device, stiffness: 900 N/m, clock: tick, x: 1 mm}
"""


# However long it takes, it says nothing of how far it is.
SILENT = "from apc.__main__ import main; from apc.cli import progress; progress.QUIET = float('inf'); main()"


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Start `apc sweep` in a folder."""
    command = [sys.executable, "-c", SILENT, "sweep", *words]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


# Waits once it has kept so many parts: however late it is stopped from outside, it has done no more.
_WAITING = """\
import signal, sys, time
from apc.__main__ import run
from apc.cli import progress
from apc.studies.finished_parts import SweepParts
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by what a shell starts in the background
progress.QUIET = float('inf')
kept, write = [], SweepParts.write

def write_and_wait(*arguments):
    write(*arguments)
    kept.append(arguments)
    while len(kept) == int(sys.argv[1]):  # signal.pause() would miss a signal that comes just before it
        time.sleep(0.01)

SweepParts.write = write_and_wait
sys.exit(run(["sweep", *sys.argv[2:]]))
"""


def start_waiting(folder: Path, count: int, *words: str) -> subprocess.Popen[str]:
    """Start `apc sweep` in a folder; it waits for ever when it has kept `count` more parts."""
    command = [sys.executable, "-c", _WAITING, str(count), *words]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def parts(target: Path) -> dict[str, tuple[int, int]]:
    """Return the finished parts of a sweep: by name, what changes when a file is written anew."""
    folder = target.with_name(f"{target.name}.parts")
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("part-*")}


def wait_for_parts(running: subprocess.Popen[str], target: Path, count: int) -> None:
    """Wait until so many parts of a sweep are finished."""
    while len(parts(target)) < count:
        assert running.poll() is None, f"it ended before: {running.communicate()}"
        time.sleep(0.005)


def children(pid: int) -> list[int]:
    """Return the processes that a process started, where the system tells (Linux)."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


def alive(pid: int) -> bool:
    """Return whether a process runs (one that ended and waits to be collected does not)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"
