"""How devices that hands move are pushed back, at many values of some parameters at once.

Takes: a `CompiledSystem` of affine equations, and the parameters that vary.
Gives: `PortEvaluator`, `port_evaluator`.
Guarantees: the maps are those of `port.port_loops`, to rounding, peers taken as alike only where they are so
everywhere; what is built once serves every value. NaN where a map is not finite.
Does not: vary a time, or ask what hands can draw (see `regions.peaks`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Feedback, Loop, StateLayout, close, feedback_of, lay_out_loop
from apc.frame.devices import refuse_hands
from apc.frame.discretize import exponential_rows, exponential_values
from apc.frame.lift import FrameMap, compose, composed_bounded
from apc.frame.linearize import linearize_rows, sites_of_rows
from apc.frame.names import Free
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of
from apc.hands.passivity import OPTION, frequency_of, worst_at
from apc.hands.port import EVEN, Cut, Maps, Opened, Openings, PortLoop, open_ports, port_loop
from apc.vary.batch import BatchEvaluator, batch_evaluator, is_beyond
from apc.vary.evaluator import Asked
from apc.vary.wiring import site_key

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Scenes prepared that are kept.
KEPT = 16

# The step of a central difference, of a direction: what it cuts off and what rounding leaves are then alike.
DIFFERENCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class _Wired:
    """A loop whose devices are moved from outside: who hears whom in it, and where it is cut."""

    loop: Loop
    feedback: tuple[Feedback, ...]
    layout: StateLayout
    cut: Cut
    port: PortLoop


@dataclass(frozen=True, slots=True, eq=False)
class PortEvaluator:
    """A `MatrixSource` of the maps G of all modes, as matrices [[A, B], [C, D + W]] (k, n + m, n + m).

    No hand draws energy from a mode if and only if G is positive real (see `port`). Where slow motions draw
    energy whatever the damping, it is that of negative dampers.
    """

    free: tuple[Free, ...]
    batch: BatchEvaluator
    openings: Openings
    inertias: Mapping[int, Callable[[Floats], Floats]]  # 1/m, by the identity of the group
    wired: tuple[_Wired, ...]

    @property
    def system(self) -> CompiledSystem:
        """The scene."""
        return self.batch.system

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """The shape of each mode's matrix."""
        rows = [one.port.maps.a.shape[-1] + ports for one, ports in zip(self.wired, self.ports, strict=True)]
        return tuple((size, size) for size in rows)

    @property
    def ports(self) -> tuple[int, ...]:
        """How many ways in, and out, each map has."""
        return tuple(len(one.port.seconds) for one in self.wired)

    @property
    def damping(self) -> float:
        """The largest damping of a device, at a point that stands for all."""
        return max(float(one) for wired in self.wired for one in wired.port.dampings)

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the map of each mode (k, n + m, n + m) at values (k, m)."""
        found = []
        for place, maps in enumerate(self._maps(values, FLOATS)):
            least = float(self.wired[place].port.seconds.min())
            packed = np.full(self.sizes[place], np.nan) if maps is None else _packed(maps, least)
            found.append(np.broadcast_to(packed, (len(values), *packed.shape[-2:])).copy())
        return tuple(found)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the same and their derivatives along directions (k, m), by differences."""
        every = self.matrices(
            np.concatenate([values + share * along for share in (0.0, -DIFFERENCE, DIFFERENCE)])
        )
        found = []
        for one in every:
            here, before, after = np.split(one, 3)
            found.append((here, (after - before) / (2 * DIFFERENCE)))
        return tuple(found)

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, n + m, n + m) on the errors of the maps at values (k, m), entry by entry."""
        rows = [self._maps(value[None], RADII) for value in values]
        return tuple(
            np.stack([_radii(one) for one in listed if one is not None] or [np.full(size, np.inf)])
            for listed, size in zip(zip(*rows, strict=True), self.sizes, strict=True)
        )

    def motion_at(self, value: Floats, angle: float) -> tuple[str, float, float]:
        """Return which mode takes most energy out at a point (m,) and an angle: its name, Hz, s a frame."""
        loops = [
            replace(one.port, maps=maps)
            for one, maps in zip(self.wired, self._maps(value[None], RADII), strict=True)
            if maps is not None
        ]
        worst = min(loops, key=lambda one: worst_at(one, angle)[0])
        return worst.name, frequency_of(worst, angle), worst.frame_s

    def _maps(self, values: Floats, numbers: Arithmetic) -> list[Maps | None]:
        """Return the maps of all modes at values (k, m); with radii, of one value alone."""
        lifted: dict[tuple[int, int], FrameMap] = {}
        dampings: dict[tuple[int, int], Floats] = {}
        for one in self.openings.groups:
            key = site_key(one.ported)
            lifted[key], dampings[key] = self._lift(one, values, numbers)
        found = []
        for wired in self.wired:
            keys = [site_key(group) for group in wired.loop.sites]
            feedback = wired.feedback if numbers is RADII else [one.plain for one in wired.feedback]
            whole = close([lifted[key] for key in keys], feedback, wired.layout, numbers=numbers).matrix
            dampers = np.stack(np.broadcast_arrays(*(dampings[key] for key in keys)), axis=-1)
            if numbers is RADII:
                whole, dampers = whole.reshape(whole.shape[-3:]), dampers[0]
            found.append(wired.cut.maps(whole, numbers.exact(dampers[..., None]), numbers))
        return found

    def _lift(self, opened: Opened, values: Floats, numbers: Arithmetic) -> tuple[FrameMap, Floats]:
        """Return a group's frame, its device moved from outside, and the device's damping (k,)."""
        built, device = opened.group.jacobians, opened.device
        vectors = self.batch.vectors(opened.group, values)
        site = sites_of_rows(built, linearize_rows(built, vectors))
        inverse = self.inertias[id(opened)](vectors)
        damping = -site.a[:, device.velocity, device.velocity] / inverse
        driven = opened.site(site, inverse)
        beyond = is_beyond(driven.a, driven.b)
        driven.a[beyond], driven.b[beyond] = 0.0, 0.0
        with np.errstate(all="ignore"):
            if numbers is RADII:
                bounded = self.batch.steps(driven, values, exponential_rows)
                frame = composed_bounded(driven, opened.ported.schedule, bounded)
            else:
                steps = self.batch.steps(driven, values, exponential_values)
                frame = compose(driven, opened.ported.schedule, steps)
        frame.p[beyond] = np.nan
        return frame, damping


def port_evaluator(system: CompiledSystem, free: Sequence[Free], prepared: Prepared) -> PortEvaluator | None:
    """Prepare a scene for hands that move its devices, at many values of some parameters.

    None where every value has to be looked at by itself: equations that are not affine, or devices that no
    damping makes passive.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    free
        What varies; none of it may reach a time.

    Raises
    ------
    ApcError
        As `passivity.passive_hands`.
    """
    refuse_hands(system, OPTION)
    return _evaluator(Asked.of(system, free, prepared))


@lru_cache(maxsize=KEPT)
def _evaluator(of: Asked) -> PortEvaluator | None:
    """Prepare a scene, see `port_evaluator`."""
    if not of.parameters_suffice:
        return None
    groups, exchange = of.lifted_anywhere()
    openings = open_ports(of.system, groups, exchange, option=OPTION)
    if isinstance(openings, str):
        return None
    wired = []
    for loop in openings.loops:
        port, cut = port_loop(openings, loop, option=OPTION)
        layout = lay_out_loop(loop)
        wired.append(_Wired(loop, tuple(feedback_of(loop, layout)), layout, cut, port))
    return PortEvaluator(
        free=of.free,
        batch=batch_evaluator(of.system, of.free, groups, exchange, matrices=False),
        openings=openings,
        inertias={id(one): _inertias(one) for one in openings.groups},
        wired=tuple(wired),
    )


def _inertias(opened: Opened) -> Callable[[Floats], Floats]:
    """Return what gives 1/m of a device (k,), or (1,), of vectors of parameters (k, n_p)."""
    function = opened.device.symbolic
    x, u, p, t = function.sx_in()
    followed = casadi.which_depends(function(x, u, p, t), p)
    zeros = [np.zeros(one.numel()) for one in (x, u, t)]

    def inertias(vectors: Floats) -> Floats:
        same = (vectors[:, followed] == vectors[:1, followed]).all()
        used = vectors[:1] if same else vectors
        every = function if len(used) == 1 else function.map(len(used))
        found = every(*zeros[:2], used.T, zeros[2])
        return np.asarray(found, dtype=np.float64).ravel()

    return inertias


def _packed(maps: Maps, seconds: float) -> Matrix:
    """Return [[A, B], [C, D + W]], or [[0, 0], [0, −1]] where slow motions draw energy."""
    whole = maps.d + maps.weight
    found = np.concatenate(
        [np.concatenate([maps.a, maps.b], axis=-1), np.concatenate([maps.c, whole], axis=-1)], axis=-2
    )
    # A stiffness that vanishes is so to the roundings of forces, which dampers over an interval compare with.
    off = EVEN * np.abs(whole).max(axis=(-2, -1)) / seconds
    turned = np.abs(maps.static - np.swapaxes(maps.static, -1, -2)).max(axis=(-2, -1)) > off
    least = np.linalg.eigvalsh((maps.static + np.swapaxes(maps.static, -1, -2)) / 2)[..., 0]
    lost = turned | (least < -off)
    if lost.any():
        found[lost] = -np.diag(np.arange(found.shape[-1]) >= maps.a.shape[-1]).astype(np.float64)
    return found


def _radii(maps: Maps) -> Floats:
    """Return what the entries of [[A, B], [C, D + W]] are off by, of maps with their radii."""
    whole = RADII.add(maps.d, maps.weight)
    a, b, c, d = map(radius_of, (maps.a, maps.b, maps.c, whole))
    return np.block([[a, b], [c, d]])
