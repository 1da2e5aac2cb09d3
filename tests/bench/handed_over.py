"""What a scene handed over as code takes: the time of one tick in C, and of one step of an FMU.

Run it from the project's folder: `python -m tests.bench.handed_over`. A tick is everything a peer computes in
one: what it heard added up, its forces, its copy's motion, its packets. Each is the least of five runs; a
step of an FMU is 1 ms of the whole scene, called from Python by `ctypes` without reading anything.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import zipfile
from pathlib import Path
from time import process_time

import apc
from apc.exports.c_names import c_peer
from apc.exports.code import scene_unit
from apc.exports.fmu import write_fmu
from apc.exports.peer import peer_of
from apc.simulation.settings import DEFAULT
from apc.simulation.simulation import plan_of
from tests.bench.judge import Judge, parser_of
from tests.hand_over.in_c import build
from tests.topologies import SCENES

NAMES = ("experiment-average", "three-users-mesh", "planar-users", "two-users-set-position", "star-lecture")
TICKS, STEPS, RUNS = 1_000_000, 20_000, 5
MOST = 1e-6  # seconds of a tick: a thousandth of a haptic loop's period


def tick_time(system: apc.CompiledSystem, folder: Path) -> float:
    """Return the time of one tick of the first peer, in s."""
    plan = plan_of(system, DEFAULT)
    program = build(c_peer(peer_of(plan, 0, DEFAULT, device=None)), folder, ("-O2",))
    said = [
        subprocess.run([program, str(TICKS)], capture_output=True, text=True, check=True).stdout
        for _ in range(RUNS)
    ]
    return min(float(one.split()[0]) for one in said)


def step_time(system: apc.CompiledSystem, folder: Path) -> float | None:
    """Return the time of one step of the whole scene's FMU, in s; None where packets get lost by chance."""
    try:
        unit = scene_unit(system)
    except apc.ApcError:
        return None
    write_fmu(path := folder / "scene.fmu", unit)
    with zipfile.ZipFile(path) as archive:
        (name,) = (one for one in archive.namelist() if one.startswith("binaries/"))
        archive.extract(name, folder)
    library = ctypes.CDLL(str(folder / name))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    guid = unit.description.partition('guid="')[2].partition('"')[0].encode()
    own = ctypes.c_void_p(library.fmi2Instantiate(b"one", 1, guid, b"", None, 0, 0))
    step = library.fmi2DoStep
    step.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int]
    library.fmi2ExitInitializationMode(own)
    taken = []
    for run in range(RUNS):
        begin = process_time()
        for k in range(run * STEPS, (run + 1) * STEPS):
            step(own, k * unit.step, unit.step, 1)
        taken.append((process_time() - begin) / STEPS)
    library.fmi2FreeInstance(own)
    return min(taken)


def main() -> None:
    arguments = parser_of("handed_over", __doc__).parse_args()
    judge = Judge(strict=arguments.strict)
    print("scene                     peers    a tick   target   a step of all")
    for name in NAMES:
        system = apc.compile(SCENES / f"{name}.yaml")
        with tempfile.TemporaryDirectory() as folder:
            tick, step = tick_time(system, Path(folder)), step_time(system, Path(folder))
        all_of_it = "lost by chance" if step is None else f"{step * 1e6:.2f} µs"
        kept = judge.in_time(f"{name}, a tick in s", tick, MOST)
        print(f"{name:<25} {system.peers:5}  {tick * 1e9:5.0f} ns   {kept:<6}  {all_of_it:>14}")
    judge.end()


if __name__ == "__main__":
    main()
