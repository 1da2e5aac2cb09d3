"""Topologies as text, and each stage's value of a text: no file, no command line."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from apc.compiler.cache import Origin, program_digest
from apc.compiler.compiled import Model
from apc.compiler.components.component_library import Library
from apc.compiler.equations.causalization import SortedSystem, sort
from apc.compiler.equations.clocks import ClockedSystem, partition
from apc.compiler.equations.flatten import FlatSystem, flatten
from apc.compiler.errors import ApcError
from apc.compiler.functions.functions import build_functions
from apc.compiler.pipeline import linear_system
from apc.compiler.source.source import Source, parse_source
from apc.compiler.topology.topology import Topology, build_topology

ROOT = Path(__file__).resolve().parents[1]
TOPOLOGIES = ROOT / "models" / "topologies"


def _topology(name: str) -> str:
    """Return a topology's text without its first line, which is for editors."""
    return (TOPOLOGIES / name).read_text(encoding="utf-8").partition("\n")[2]


AVERAGE = _topology("three-users-average.yaml")
MESH = _topology("three-users-mesh.yaml")

# One part alone at one peer: what it does is all that happens.
ONE_MASS = """\
topology: one-mass
peers: {user: {count: 1}}
masses:
  device: {mass: 2 kg, damping: 3 N*s/m}
"""

# Textbook: m x″ + d x′ + k x = 0.
OSCILLATOR = """\
topology: oscillator
peers: {{user: {{count: 1}}}}
masses:
  device: {{mass: 1 kg}}
couplers:
  s: {{type: SpringDamper, a: device, b: ground, stiffness: {stiffness} N/m, damping: {damping} N*s/m}}
"""


def source(text: str) -> Source:
    return parse_source(text.encode(), file="topology.yaml")


@functools.cache
def built_in() -> Library:
    """Return the library that comes with apc, read once."""
    return Library()


def topology(text: str, library: Library | None = None) -> Topology:
    return build_topology(source(text), library or built_in())


def flat(text: str, library: Library | None = None) -> FlatSystem:
    return flatten(topology(text, library))


def clocked(text: str, library: Library | None = None) -> ClockedSystem:
    return partition(flat(text, library))


def ordered(text: str, library: Library | None = None) -> SortedSystem:
    return sort(clocked(text, library))


@functools.lru_cache(maxsize=32)
def compiled(text: str, library: Library | None = None) -> Model:
    """Compile a text; the same text gives the same model, with all that it keeps."""
    system = ordered(text, library)
    origin = Origin("topology.yaml", (("topology.yaml", text.encode()),), program_digest())
    return build_functions(system, origin, linear=linear_system(system.topology))


def wall(mass: float, damping: float, delay: float, stiffness: float, virtual: float = 0.0) -> Model:
    """Return a device pressed against a sampled wall, the velocity by backward difference, T = 1 ms."""
    return compiled(
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: {mass} kg, damping: {damping} N*s/m, x: 1 mm}}}}\n"
        f"couplers: {{it: {{type: VirtualWall, flange: device, stiffness: {stiffness!r} N/m, clock: tick,"
        f" damping: {virtual!r} N*s/m, delay: {delay} s, x: 1 mm}}}}\n"
    )


def library(folder: Path, *texts: str) -> Library:
    """Return the built-in library and components of our own, written to a folder."""
    for number, text in enumerate(texts):
        (folder / f"part{number}.yaml").write_text(text, encoding="utf-8")
    return Library((folder,))


def messages_of(function: Callable[..., object], *arguments: object) -> list[str]:
    """Return the first line of every mistake that a call raises: place, code and sentence."""
    try:
        function(*arguments)
    except ApcError as error:
        return [str(mistake).splitlines()[0] for mistake in error.mistakes]
    return []


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    """Return the text with each (old, new) pair replaced; every old one must be there."""
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text
