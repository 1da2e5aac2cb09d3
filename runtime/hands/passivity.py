"""Is a scene stable with every passive hand at every device?

Takes: a `Model`.
Gives: `AbsoluteStability`, `PassiveMode`, `passive_hands`; `passive_growth`, `loop_growths`; `circulates`,
`frequency_of`.
Guarantees: no grid of frequencies decides anything; a verdict is proved, or it is undecided. Hands may be
anything that gives back no more energy than it was given, each by itself, or, where devices feel each other
alike, joined to each other too.
Does not: say with which hand it shakes: which motion of the devices takes energy out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, lifted_groups, near_start
from apc.analysis.contact_modes import contact_modes
from apc.analysis.elements import is_linear
from apc.analysis.sides import Side, severity, sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.dissipation import least_real, proves_positive
from apc.eigen.modes import split
from apc.frame.devices import clamped, directions_of, replaced_hands, without_hands
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.radius import RADII, UNIT, radius_of, solve, value_of, with_radius
from apc.hands.port import PortLoop, port_loops
from apc.hands.published_limits import published_limits
from apc.moments.network_verdict import StabilityMeasure
from apc.network.nominal import left_out
from apc.result import Result
from apc.threads import load_pool, single_threaded
from apc.unserved import NotSupportedError
from apc.verdict import NO_PROOF, ProofMethod, ProofScope, StabilityProof, Term

Complexes = NDArray[np.complex128]

OPTION = "--hands passive"

CIRCULATES = (
    "What devices feel of one another at rest is not what springs give: moved slowly round, they give back "
    "more energy than they got, whatever their damping"
)

# How far below the least that is found, relatively, what is proved may lie, the first that can be proved; and
# what part of that a proof may leave over for rounding.
WIDTHS, SPARED = (1e-9, 3e-9, 1e-8, 1e-7, 1e-5), (1e-2, 1e-3)

# Widths that a verdict asks for at first: more digits than are shown, at a third of the time.
SHOWN = (1e-7, 1e-5)

# Two frequencies fit a motion alike, relatively.
ALIKE = 1e-6


class PassivityVerdict(Term):
    """The verdict with all passive hands; `NEVER` where no damping makes it stable."""

    STABLE = "stable with any passive hands"
    UNSTABLE = "unstable with some passive hands"
    UNDECIDED = "undecided"
    NEVER = "unstable with some passive hands, however much damping there is"


@dataclass(frozen=True, slots=True)
class PassiveMode:
    """A mode of devices that hands move: common, or apart.

    `damping` is what its devices have in N·s/m, None where they differ; `more` what each of them needs beside
    it, negative if some could be spared, ± `error`; None where none suffices, as the scene is unstable with
    its devices clamped, or what devices feel at rest is not what springs give. `frequency_hz` is where most
    energy can be taken out. `stiffness` is what its devices feel at rest, N/m, None where several groups move
    in it.
    """

    name: str
    multiplicity: int
    passive: bool | None
    damping: float | None
    more: float | None
    error: float | None
    frequency_hz: float | None
    stiffness: float | None

    @property
    def needed(self) -> float | None:
        """The least damping of each device, N·s/m."""
        return None if self.damping is None or self.more is None else self.damping + self.more


@dataclass(frozen=True, slots=True)
class AbsoluteStability(Result):
    """Whether a scene is stable whatever passive hands hold its devices.

    `clamped_radius` ± `clamped_error` is the spectral radius with all devices held fast, the hardest of
    hands. `joined` says that hands may be joined to each other, too; where some devices feel others more than
    those feel them, what is said is of hands each by itself. `why` says why no damping suffices, where that
    follows from the equations alone.
    """

    shown_by = "hands_output:passive"

    topology: str
    verdict: PassivityVerdict
    stable: bool | None
    clamped_stable: bool | None
    clamped_radius: float
    clamped_error: float
    modes: tuple[PassiveMode, ...]
    joined: bool
    why: str
    proof: StabilityProof
    linearized: bool
    left_out: tuple[str, ...]

    @property
    def worst(self) -> PassiveMode | None:
        """The mode that needs most damping."""
        passive_modes = [mode for mode in self.modes if mode.more is not None]
        lost = [mode for mode in self.modes if mode.more is None]
        return (
            lost[0]
            if lost
            else max(passive_modes, key=lambda passive_mode: passive_mode.more or 0.0)
            if passive_modes
            else None
        )


@part("passive hands")
def passive_hands(
    system: Model, prepared: Prepared | None = None, *, certify: bool = False
) -> AbsoluteStability:
    """Say whether a scene is stable with every passive hand at every device.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    certify
        Whether what is said of clamped devices is to be proved in ball arithmetic, where they decide.

    Raises
    ------
    ApcError
        E931 a peer without a device; E932 hands in the scene; E933 a device that is touched otherwise than by
        samples and held forces, or too many intervals; and those of `analysis.analyze`.

    Notes
    -----
    After Colgate and Schenkel, J. Robotic Systems 14 (1997) 37, for any number of devices, delays and clocks:
    see `port`.
    """
    of_scene, system = system, without_hands(system, OPTION)
    if prepared is None or system is not of_scene:
        prepared = prepare(system)
    if along := _directions(system, prepared):
        parts = {
            axis: passive_hands(compiled_system, certify=certify) for axis, compiled_system in along.items()
        }
        return _together(parts, replaced_hands(of_scene))
    fixed = analyze(clamped(system, option=OPTION), certify=certify)
    each = [
        _one_sided_hands(side.system, side.prepared, fixed, certify=certify)
        for side in sides(system, prepared)
    ]
    worst = max(each, key=lambda hands: severity(hands.stable, _missing(hands)))
    return replace(worst, left_out=(*replaced_hands(of_scene), *_limitations(system, prepared)))


def _missing(hands: AbsoluteStability) -> float:
    """Return the damping that the worst mode lacks."""
    worst = hands.worst
    return -math.inf if worst is None else math.inf if worst.more is None else worst.more


def _limitations(system: Model, prepared: Prepared) -> tuple[str, ...]:
    linear = all(prepared.jacobians[group.kind].affine for group in system.groups)
    return (
        *near_start(system, prepared),
        *published_limits(system),
        *left_out(system),
        *_as_at_start(system, prepared, linear=linear),
    )


def _one_sided_hands(
    system: Model,
    prepared: Prepared,
    fixed: Analysis,
    *,
    certify: bool,
) -> AbsoluteStability:
    """Return the verdict of a topology without kinks, in which devices move along a line.

    `fixed` is the analysis with its devices clamped.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        loops: tuple[PortLoop, ...] = ()
        unserved = ""
        try:
            loops = port_loops(system, prepared, option=OPTION)
        except NotSupportedError as why:
            unserved = str(why)
        modes = tuple(_judge(loop) for loop in loops)
        never = unserved or (CIRCULATES if any(map(circulates, loops)) else "")
    linear = is_linear(system, prepared)
    stable: bool | None = None
    joined = not unserved and all(loop.joined for loop in loops)
    drawn = [mode.passive is False and (joined or mode.more is None) for mode in modes]
    if unserved or fixed.stable is False or any(drawn):
        stable = False
    elif all(mode.passive for mode in modes) and fixed.stable:
        stable = True
    verdict = {
        True: PassivityVerdict.STABLE,
        False: PassivityVerdict.UNSTABLE,
        None: PassivityVerdict.UNDECIDED,
    }[stable]
    bounded = StabilityProof(ProofMethod.ROUNDED, scope=(ProofScope.LINEARIZATION,) * (not linear))
    proof = NO_PROOF if stable is None else bounded
    if certify and fixed.stable is False and not never:
        proof = fixed.proof or bounded
        proof = replace(proof, scope=(*proof.scope, ProofScope.CLAMPED_DEVICES))
    return AbsoluteStability(
        topology=system.name,
        verdict=PassivityVerdict.NEVER if never else verdict,
        stable=stable,
        clamped_stable=fixed.stable,
        clamped_radius=fixed.spectral_radius,
        clamped_error=fixed.spectral_radius_error,
        modes=modes,
        joined=joined,
        why=never,
        proof=proof,
        linearized=not linear,
        left_out=(),
    )


def _directions(system: Model, prepared: Prepared) -> dict[str, Model]:
    """Return the scene along each direction of its devices, none where they move along a line.

    Raises
    ------
    ApcError
        E933 where what moves along one direction acts on what moves along another.
    """
    along = directions_of(system)
    side = sides(system, prepared)[0] if along else Side("", system, prepared)
    for loop in split(*lifted_groups(side.system, prepared=side.prepared)) if along else ():
        parts = load_pool("scipy.sparse.csgraph").connected_components(loop.matrix != 0, connection="weak")[1]
        of: dict[str, set[str]] = {}
        for name, part_ in zip(loop.layout.names, parts.tolist(), strict=True):
            if (axis := f"x{name[name.rindex('[') :]}" if "[" in name else "") in along:
                of.setdefault(str(part_), set()).add(axis)
        if any(len(axes) > 1 for axes in of.values()):
            what = f"{OPTION}: devices move along {', '.join(along)}, which act on one another"
            raise ApcError(Diagnostic("E933", SourceLocation(system.origin.topology), what))
    return along


def _together(parts: Mapping[str, AbsoluteStability], replaced: tuple[str, ...]) -> AbsoluteStability:
    """Return what is said of all directions together, which don't act on one another."""
    verdicts = [part.stable for part in parts.values()]
    stable = False if False in verdicts else None if None in verdicts else True
    deciding = next(part for part in parts.values() if part.stable is stable)
    modes = tuple(
        replace(mode, name=f"{mode.name}, {axis}") for axis, part in parts.items() for mode in part.modes
    )
    joined = all(part.joined for part in parts.values())
    return replace(deciding, modes=modes, joined=joined, left_out=(*replaced, *deciding.left_out))


def _as_at_start(system: Model, prepared: Prepared, *, linear: bool) -> tuple[str, ...]:
    """Say which contacts the answer takes as they are at the start, though hands may open and close them."""
    if linear:
        return ()
    try:
        parts = contact_modes(system, prepared=prepared).parts
    except ApcError:  # too many to look at: that the scene isn't linear is said
        return ()
    if not parts:
        return ()
    text = (
        f"left out: {', '.join(parts)} as at the start, whether they touch then or not; hands may change that"
    )
    return (text,)


def passive_growth(system: Model, prepared: Prepared, *, bounded: bool = True) -> StabilityMeasure:
    """Return a number below 1 where a scene is stable with every passive hand, and above it elsewhere.

    With n the damping needed at each device and b the largest there is, it is e^{2 (n − b)/(n + b)}. n grows
    without end where the scene becomes unstable with devices clamped, and as 1/n this goes there evenly;
    beyond it is e².

    Parameters
    ----------
    system, prepared
        As for `passive_hands`.
    bounded
        Whether bounds are asked for.
    """
    each = loop_growths(system, prepared, bounded=bounded)
    radius, low, high = (max(getattr(growth, name) for growth in each) for name in ("radius", "low", "high"))
    return StabilityMeasure(radius, low, high, exact=True, proved=True)


def loop_growths(system: Model, prepared: Prepared, *, bounded: bool = True) -> list[StabilityMeasure]:
    """Return the same of each closed loop by itself: the largest is that of the scene.

    Parameters
    ----------
    system, prepared, bounded
        As for `passive_growth`.
    """
    of_scene, system = system, without_hands(system, OPTION)
    prepared = prepared if system is of_scene else prepare(system)
    if along := _directions(system, prepared):
        parts = (
            loop_growths(compiled_system, prepare(compiled_system), bounded=bounded)
            for compiled_system in along.values()
        )
        return [growth for part in parts for growth in part]
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        result, scale = [(-np.inf, -np.inf, -np.inf)], 1.0
        with suppress(NotSupportedError):
            loops = [
                loop
                for side in sides(system, prepared)
                for loop in port_loops(side.system, side.prepared, option=OPTION)
            ]
            result = [
                _bounds(loop)[:3] if bounded else (-np.inf if circulates(loop) else _least(loop)[0],) * 3
                for loop in loops
            ]
            scale = max(float(damping) for loop in loops for damping in loop.dampings) or 1.0
    worst = min(result)
    if (
        bounded
        and np.isneginf(worst[0])
        and not np.isneginf(min(most for *_, most in result))
        and analyze(clamped(system, option=OPTION)).stable is False
    ):
        result.append((-np.inf, -np.inf, -np.inf))  # floats alone said so
    return [_growth(scale, *item) for item in result]


def _growth(scale: float, *spare: float) -> StabilityMeasure:
    """Return e^{2 (n − b)/(n + b)}, b the largest damping and b − n what is spare, at least, at most."""
    needed = [scale - value for value in spare]
    logs = [np.sign(value) if np.isinf(value) else (value - scale) / (abs(value) + scale) for value in needed]
    radius, high, low = (float(np.exp(2 * log)) for log in logs)
    if spare[1] >= 0:  # passive, if only just
        high = min(high, float(np.nextafter(1.0, 0.0)))
    return StabilityMeasure(radius, low, high, exact=True, proved=True)


def _judge(loop: PortLoop) -> PassiveMode:
    """Say whether hands can draw energy from a mode."""
    least, low, high, angle = _bounds(loop, SHOWN)
    if low < 0 <= high:
        least, low, high, angle = _bounds(loop)
    dampings = set(loop.dampings)
    known = bool(np.isfinite(least))
    return PassiveMode(
        name=loop.name,
        multiplicity=loop.multiplicity,
        passive=True if low >= 0 else False if high < 0 else None,
        damping=float(dampings.pop()) if len(dampings) == 1 else None,
        more=-least if known else None,
        error=max(high - least, least - low) if known else None,
        frequency_hz=frequency_of(loop, angle) if known else None,
        stiffness=float(loop.static[0, 0, 0]) if loop.static.shape[-1] == 1 else None,
    )


def _bounds(loop: PortLoop, widths: Sequence[float] = WIDTHS) -> tuple[float, float, float, float]:
    """Return the least eigenvalue of He H + diag(b/τ), what is proved below and above it, and its angle.

    What is proved below is as near as the first of some relative widths that serves.

    −∞ where the scene is unstable with its devices clamped, of which this is no proof, and where slow motions
    draw energy, of which it is one.
    """
    if circulates(loop):
        return -np.inf, -np.inf, -np.inf, 0.0
    matrices = loop.a, loop.b, loop.c, loop.d
    least, angle = _least(loop)
    if not np.isfinite(least):
        return least, -np.inf, np.inf, angle
    scale = max(abs(least), float(np.abs(value_of(loop.weight)).max()))
    low = -np.inf
    for width in widths:
        shift = least - width * scale
        less = RADII.subtract(loop.weight, RADII.exact(shift * np.eye(len(loop.weight[0]))))
        if proves_positive(*matrices, less, spared=[share * width for share in SPARED]):
            low = shift
            break
    else:
        if least > 0 and proves_positive(*matrices, loop.weight):
            low = 0.0
    return least, low, _draws(loop, angle), angle


def _least(loop: PortLoop) -> tuple[float, float]:
    """Return the least eigenvalue of He H + diag(b/τ) over all angles, and its angle, in floats."""
    return least_real(*map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight)))


def circulates(loop: PortLoop) -> bool:
    """Say whether the stiffness at rest is not that of any spring.

    Parameters
    ----------
    loop
        A mode.

    Notes
    -----
    The residue at z = 1 has to be symmetric and not negative, or hands that move devices slowly round draw
    energy from it. What rounding leaves of one that vanishes counts as none.
    """
    value, off = value_of(loop.static), radius_of(loop.static)
    turned = np.abs(value - value.T) > off + off.T
    least = float(np.linalg.eigvalsh((value + value.T) / 2).min())
    return bool(turned.any()) or least < -2 * float((off + off.T).sum())


def _draws(loop: PortLoop, angle: float) -> float:
    """Return what at most the Hermitian part is in the worst direction at an angle, a bound for its least.

    Notes
    -----
    e^{jθ} is a rational point of the circle.
    """
    tangent = float(np.tan(angle / 2))
    z = complex(1 - tangent**2, 2 * tangent) / (1 + tangent**2)
    direction = _worst(loop, z)[:, None]
    # Both parts are quotients of sums about 1: off by roundings of 1, however small they are themselves.
    unit, v = np.eye(loop.a.shape[-1]), RADII.exact(direction)
    states = solve(RADII.subtract(with_radius(z * unit, 16 * UNIT * unit), loop.a), RADII.multiply(loop.b, v))
    if states is None:
        return np.inf
    through = RADII.multiply(RADII.add(loop.d, loop.weight), v)
    drawn = RADII.multiply(
        RADII.exact(direction.conj().T), RADII.add(RADII.multiply(loop.c, states), through)
    )
    size = float(np.vdot(direction, direction).real)
    top = float(drawn[0, 0, 0].real + drawn[1, 0, 0].real)
    return top / size + 8 * UNIT * abs(top)


def _worst(loop: PortLoop, z: complex) -> Complexes:
    """Return the vector of the least eigenvalue of He H + diag(b/τ) at a point of the circle."""
    a, b, c, d, weight = map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight))
    response = c @ np.linalg.solve(z * np.eye(len(a)) - a, b + 0j) + d
    return np.asarray(np.linalg.eigh((response + response.conj().T) / 2 + weight)[1][:, 0])


def frequency_of(loop: PortLoop, angle: float) -> float:
    """Return the frequency of the motion that takes most energy out at an angle, in Hz.

    Parameters
    ----------
    loop
        A mode.
    angle
        By how much it turns in a frame, as far as frames see.

    Notes
    -----
    Frequencies that differ by a multiple of the frame rate have one angle: which of them it is, its course
    within a frame says: the one that most of it is at.
    """
    moved = _worst(loop, complex(np.exp(1j * angle))) * np.sqrt(loop.seconds)
    most = round(loop.frame_s / float(loop.seconds.min()) / 2) + 1
    values = sorted(angle + 2 * np.pi * turn for turn in range(-most, most + 1))
    values.sort(key=abs)  # of two that can't be told apart, the slower
    # A device moves evenly through each interval: how much of that is at a frequency, over all devices.
    middles, device = loop.starts + loop.seconds / 2, np.cumsum(loop.starts == 0) - 1
    each = device == np.arange(device[-1] + 1)[:, None]
    turned = np.outer(values, middles) / loop.frame_s
    shares = np.sinc(np.outer(values, loop.seconds) / (2 * np.pi * loop.frame_s))
    fits = np.linalg.norm((np.exp(-1j * turned) * shares * moved) @ each.T, axis=1)
    best = next(value for value, fit in zip(values, fits, strict=True) if fit >= max(fits) * (1 - ALIKE))
    return abs(best) / (2 * np.pi * loop.frame_s)
