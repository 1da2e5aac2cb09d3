"""Peers in real time on loopback: how late their ticks are, and what `simulate` says of what they did.

Run it from the project's folder: `python -m tests.bench.play`. The paper's topology, three processes, packets
held back and lost at the sender. Then the processor time of one tick of a peer, of several topologies,
without waiting: what is left of 1 ms is how late a tick may begin.
"""

from __future__ import annotations

import socket
from fractions import Fraction
from time import process_time

import apc
from apc.compiler.compiled import Model
from apc.output.realtime_output import ticks_text
from apc.parameter_values.parameters import resolve
from apc.realtime.peer import PeerLoop
from apc.realtime.peer_run import RealtimeRun
from apc.realtime.run_comparison import compare_run
from apc.realtime.start import LocalRun, run_all
from apc.simulation.output_blocks import forces_in_time
from apc.timing.communication_graph import build_comm_graph
from tests.bench.judge import decided, parser_of
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced

MOVED = replaced(
    AVERAGE,
    ("{count: 3}", "{count: 3, set: {device.x: [3 mm, -2 mm, 1 mm]}}"),
    ("delay: 8 ms}", "delay: 8 ms, jitter: 4 ms, loss: 5 %}"),
)
NAMES = ("three-users-average", "experiment-average", "planar-users", "lifted-box", "ring-of-eight")
FRAMES = 200
MOST_APART = 1e-9  # of forces in N, and of the rest in its own unit
TICK = 1e-3  # seconds of a haptic loop's period


def work_of_a_tick(model: Model) -> tuple[float, int]:
    """Return the processor time of one instant of the first peer, in s, and how many states it has."""
    comm_graph = build_comm_graph(model, resolve(model).timings)
    names = [comm_graph.peer_name(one) for one in range(comm_graph.peers)]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        addresses = {name: ("127.0.0.1", at + 1) for at, name in enumerate(names[1:])}
        loop = PeerLoop(model, names[0], listening, addresses, digest=bytes(8), duration=Fraction(1))
        given = forces_in_time(loop.simulation, 0)
        loop.player.warm_up()
        used = []
        for first in range(0, FRAMES, loop.simulation.length):
            count = min(loop.simulation.length, FRAMES - first)
            before, begin = len(loop.player.log), process_time()
            loop.player.advance(first, count, given)
            used.append((process_time() - begin) / (len(loop.player.log) - before))
    return min(used), len(model.peer_types[model.groups[0].peer_type].states)


def main() -> None:
    """Print how late ticks are, what is lost, how far from `simulate`, and the work of a tick."""
    parser = parser_of("play", __doc__)
    parser.add_argument("--seconds", type=int, default=60)
    with decided(parser) as (judge, given):
        seconds, model = 3 if given.quick else given.seconds, compiled(MOVED)
        how = LocalRun(duration=Fraction(seconds), secret=bytes(16), emulate=True, seed=None, patience=60.0)
        peers = [part.run for part in run_all(model, how) if part.run is not None]
        run = RealtimeRun("", model, tuple(sorted(peers, key=lambda one: one.number)))
        alongside = compare_run(run)
        print(f"three peers, {seconds} s, lan: 8 ms, jitter 4 ms, loss 5 %, in the sender; sealed packets")
        print("\n".join(ticks_text(alongside.ticks)))
        judge.right("a run that can be played again", not alongside.why_not)
        for unit, (far, large) in alongside.differences.items():
            print(
                f"  apart from simulate, fed with what each tick had: {far:.0e} {unit} of {large:.3g} {unit}"
            )
            judge.within(f"apart from simulate, {unit}", far, MOST_APART)
        print("\nwork of one tick of a peer       states   processor")
        for name in NAMES:
            work, states = work_of_a_tick(apc.compile(TOPOLOGIES / f"{name}.yaml"))
            stored = judge.in_time(f"{name}, a tick in s", work, TICK)
            print(f"  {name:<30} {states:6} {work * 1e6:8.0f} µs   {stored}")


if __name__ == "__main__":
    main()
