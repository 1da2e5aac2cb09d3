"""Peers in C, compiled with all warnings and sanitizers, each a process that is fed row by row."""

from __future__ import annotations

import itertools
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.exports.c_text import driver, header, source
from apc.exports.peer_step import ExportedPeer, peer_of
from apc.network.channel import PacketSource, channel_law
from apc.simulation.settings import DEFAULT, parse_method
from apc.simulation.simulation import SimulationPlan, plan_of
from tests.lossy import effective

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
# Of a way, looked at packet by packet: more than a run sends.
MOST_PACKETS = 100
SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def compiler() -> str:
    """Return the C compiler of the machine; without one the test is skipped."""
    found = shutil.which("gcc") or shutil.which("cc")
    return found or pytest.skip("there is no C compiler")


def build(peer: ExportedPeer, folder: Path, options: Sequence[str] = SANITIZED) -> Path:
    """Return the driver of a peer, compiled."""
    texts = {
        f"{peer.identifier}.h": header(peer),
        f"{peer.identifier}.c": source(peer, f"{peer.identifier}.h"),
        f"{peer.identifier}_test.c": driver(peer, f"{peer.identifier}.h"),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii")
    listed = [name for name in texts if name.endswith(".c")]
    command = [compiler(), *STRICT, *options, *listed, "-o", peer.identifier, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / peer.identifier


@dataclass
class Running:
    """A peer's process; what it said last, by name."""

    peer: ExportedPeer
    process: subprocess.Popen[str]
    names: tuple[str, ...]
    at: int = 0
    turns: itertools.cycle[int] | None = None

    @classmethod
    def started(cls, peer: ExportedPeer, folder: Path) -> Running:
        names = ["time", *(one.name for one in peer.forces.values())]
        for line in peer.lines:
            if line.sending >= 0:
                names += [f"{line.link} sent", *(f"{line.link} {one}" for one in line.channels)]
        ticking = {p for one in peer.instants for p in one.ticks}
        names += [name for p in sorted(ticking) for name in peer.peer_type.clocks[p].outputs]
        process = subprocess.Popen(
            [build(peer, folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        turns = itertools.cycle(peer.moves[one.move].quanta for one in peer.instants)
        return cls(peer, process, tuple(names), 0, turns)

    def done(self, row: Sequence[float]) -> dict[str, float]:
        """Return what it does with a row, and go to its next instant."""
        assert self.process.stdin is not None and self.process.stdout is not None and self.turns is not None
        self.process.stdin.write((" ".join(map(repr, row)) or ".") + "\n")
        self.process.stdin.flush()
        printed = [float(one) for one in self.process.stdout.readline().split()]
        assert len(printed) == len(self.names), f"{self.peer.name} ended"
        self.at += next(self.turns)
        return dict(zip(self.names, printed, strict=True))

    def end(self) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        rest = self.process.stdout.read()
        assert self.process.wait(30) == 0 and not rest
        self.process.stdout.close()


def differences(
    model: apc.Model, folder: Path, *, duration: str, method: str = "", device: str | None = None
) -> dict[str, tuple[float, float]]:
    """Play a topology, and its peers in C with the devices' motion and the packets' arrivals of that run.

    Packets go from peer to peer as they come out of C, late by what the topology says, or as the links' luck
    has it. Returns by signal the largest difference and the largest value.
    """
    how = parse_method(method) if method else DEFAULT
    plan = plan_of(model, how)
    course = apc.simulate(model, duration=duration, method=method or None, jit=False)
    column = {one.name: course.values[:, place] for place, one in enumerate(course.signals)}
    quantum = plan.schedules[0].quantum
    marks = [round(float(Fraction(float(t)) / quantum)) for t in course.time]
    running = [
        Running.started(peer_of(plan, k, how, device=device), folder) for k in range(plan.comm_graph.peers)
    ]
    network = _Network(plan)
    off: dict[str, tuple[float, float]] = {}
    while (at := min(one.at for one in running)) < marks[-1]:
        row = int(np.searchsorted(marks, at, side="right")) - 1
        for one in [one for one in running if one.at == at]:
            peer = one.peer
            given = [
                float(column[f"{peer.name}.{peer.peer_type.states[i].name}"][row]) for i in peer.measured
            ]
            received = network.received(peer, at)
            printed = one.done([*given, *received])
            network.send(peer, at, printed)
            assert printed["time"] == float(at * quantum)
            if at == marks[row] and one.at <= marks[row + 1]:
                for name in one.names:
                    key = f"{peer.name}.{name}"
                    if key in column:
                        his = float(column[key][row + 1])
                        before = off.get(key, (0.0, 0.0))
                        gap = 0.0 if printed[name] == his else abs(printed[name] - his)
                        off[key] = max(before[0], gap), max(before[1], abs(his))
    for one in running:
        one.end()
    return off


class _Network:
    """All packets that were sent, and which of them each peer hears."""

    def __init__(self, plan: SimulationPlan) -> None:
        self.plan, self.sent = plan, dict[tuple[str, int, int], Mapping[str, float]]()
        self.quantum = plan.schedules[0].quantum
        timings = plan.numbers.timings
        clocks = {one.name: one for one in plan.model.clocks}
        self.grid = {
            link: (int(timings[own.period] / self.quantum), int(timings[own.phase] / self.quantum))
            for link, one in plan.comm_graph.links.items()
            for own in (clocks[one.clock],)
        }
        self.late: dict[tuple[str, int, int], list[float]] = {}
        self.links = {one.name: one for one in plan.model.links}
        for name, link in self.links.items():
            if link.channel is None:
                continue
            law = channel_law(plan.model, link, link.delay)
            for arc in itertools.permutations(range(plan.comm_graph.peers), 2):
                used = PacketSource(law, name, [arc], seed=plan.model.experiment.seed).take(MOST_PACKETS)
                self.late[(name, *arc)] = used[0].tolist()

    def send(self, peer: ExportedPeer, at: int, printed: Mapping[str, float]) -> None:
        for line in peer.lines:
            if line.sending >= 0 and printed[f"{line.link} sent"]:
                period, phase = self.grid[line.link]
                packet = {one: printed[f"{line.link} {one}"] for one in line.channels}
                self.sent[line.link, peer.number, (at - phase) // period] = packet

    def received(self, peer: ExportedPeer, at: int) -> list[float]:
        """Return the numbers that are heard at an instant, in the driver's order."""
        found: list[float] = []
        comm_graph, timings = self.plan.comm_graph, self.plan.numbers.timings
        groups = np.searchsorted(comm_graph.starts, np.arange(comm_graph.peers), side="right") - 1
        for line in peer.lines:
            period, phase = self.grid[line.link]
            for sender in line.senders:
                late = comm_graph.delay(line.link, int(groups[sender.peer]), int(groups[peer.number]))
                number, gone = (at - int(timings[late] / self.quantum) - phase) // period, False
                if (arc := (line.link, sender.peer, peer.number)) in self.late:
                    newest = self.links[line.link].channel.reorder != "all"
                    tick = int(at * self.quantum * 1000)  # ticks every millisecond, packets every eight
                    number, gone = effective(self.late[arc], tick, newest=newest)
                if number < 0:
                    found += sender.start
                else:
                    packet = self.sent[line.link, sender.peer, number]
                    found += [packet[one] for one in line.channels]
                found += [int(gone)] if line.missing else []
        return found


def worst(off: Mapping[str, tuple[float, float]]) -> float:
    """Return the largest difference, as a part of the largest value of its signal."""
    assert off and any(size for _, size in off.values()), "something is compared"
    return max(gap / size if size else gap for gap, size in off.values())
