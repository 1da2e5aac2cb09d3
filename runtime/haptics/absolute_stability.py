"""Absolute stability: stability with every passive hand at every device.

Takes: a `Model`.
Gives: `AbsoluteStability`, `PassiveMode`, `absolute_stability`; `passivity_radius`, `loop_growths`;
`circulates`, `frequency_of`.
Guarantees: no grid of frequencies decides anything; a verdict is proved, or it is undecided. A hand is any
passive operator, separately at each device, or, where devices interact reciprocally, a joint one too.
Does not: construct a hand that destabilizes; it names the mode from which energy can be extracted.
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
from apc.analysis.nonlinear_elements import is_linear
from apc.analysis.one_sided_slopes import Side, severity, sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.eigen.kyp_bounds import least_real, proves_positive
from apc.eigen.modes import split
from apc.frame.devices import clamped, directions_of, replaced_hands, without_hands
from apc.frame.evaluation_errors import finite_equations
from apc.frame.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.frame.numeric_model import Prepared, prepare
from apc.haptics.displacement_port import PortLoop, port_loops
from apc.haptics.published_limits import published_limits
from apc.mean_square.mean_square_stability import StabilityMeasure
from apc.network.nominal_criterion import limitations
from apc.not_supported import NotSupportedError
from apc.result import Result
from apc.threads import load_pool, single_threaded
from apc.verdict import NO_PROOF, ProofMethod, ProofScope, StabilityProof, Term

Complexes = NDArray[np.complex128]

OPTION = "--hands passive"

CIRCULATES = (
    "What devices feel of one another at rest is not what springs give: moved slowly round, they give back "
    "more energy than they got, whatever their damping"
)

# The relative margins of a proof below the computed minimum, tried in order; and the fraction of the margin
# that a proof leaves for rounding.
WIDTHS, SPARED = (1e-9, 3e-9, 1e-8, 1e-7, 1e-5), (1e-2, 1e-3)

# Widths that a verdict requires at first: more digits than are shown, at a third of the time.
SHOWN = (1e-7, 1e-5)

# The relative difference within which two frequencies are one.
SIMILAR = 1e-6


class PassivityVerdict(Term):
    """The verdict with all passive hands; `NEVER` where no damping makes it stable."""

    STABLE = "stable with any passive hands"
    UNSTABLE = "unstable with some passive hands"
    UNDECIDED = "undecided"
    NEVER = "unstable with some passive hands, however much damping there is"


@dataclass(frozen=True, slots=True)
class PassiveMode:
    """A mode of devices with hands: the common mode, or a difference mode.

    `damping` is that of its devices in N·s/m, None where they differ; `more` is the additional damping that
    each requires, negative for a reserve, ± `error`; None where none suffices, as the model is unstable with
    its devices clamped, or the static forces at devices are not those of springs. `frequency_hz` is the
    frequency of the largest extractable energy. `stiffness` is the static stiffness at its devices, N/m, None
    where it spans several groups.
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
        """The smallest sufficient damping of each device, N·s/m."""
        return None if self.damping is None or self.more is None else self.damping + self.more


@dataclass(frozen=True, slots=True)
class AbsoluteStability(Result):
    """Whether a model is stable with every passive hand at its devices.

    `clamped_radius` ± `clamped_error` is the spectral radius with all devices clamped, the stiffest hand.
    `joined` states that the result holds for joint passive hands, too; without reciprocity it holds for
    separate hands. `why` is the reason why no damping suffices, where that follows from the equations alone.
    """

    shown_by = "haptics_output:passive"

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
    limitations: tuple[str, ...]

    @property
    def worst_mode(self) -> PassiveMode | None:
        """The mode that requires most damping."""
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
def absolute_stability(
    system: Model, prepared: Prepared | None = None, *, certify: bool = False
) -> AbsoluteStability:
    """Return whether a model is stable with every passive hand at every device.

    Parameters
    ----------
    system
        The compiled model, with the parameter values to analyse.
    prepared
        From `numeric_model.prepare`, of this model with any values.
    certify
        Whether the result for clamped devices is proved in ball arithmetic, where it decides.

    Raises
    ------
    ApcError
        E931 a peer without a device; E932 hands in the topology; E933 a device that is affected by other
        signals than samples and held forces, or too many intervals; and those of `analysis.analyze`.

    Notes
    -----
    After Colgate and Schenkel, J. Robotic Systems 14 (1997) 37, for any number of devices, delays and clocks:
    see `displacement_port`.
    """
    of_topology, system = system, without_hands(system, OPTION)
    if prepared is None or system is not of_topology:
        prepared = prepare(system)
    if along := _directions(system, prepared):
        parts = {
            axis: absolute_stability(compiled_system, certify=certify)
            for axis, compiled_system in along.items()
        }
        return _together(parts, replaced_hands(of_topology))
    fixed = analyze(clamped(system, option=OPTION), certify=certify)
    each = [
        _one_sided_hand_conditions(side.system, side.prepared, fixed, certify=certify)
        for side in sides(system, prepared)
    ]
    worst = max(each, key=lambda hands: severity(hands.stable, _missing(hands)))
    return replace(worst, limitations=(*replaced_hands(of_topology), *_limitations(system, prepared)))


def _missing(hands: AbsoluteStability) -> float:
    """Return the additional damping that the worst mode requires."""
    worst = hands.worst_mode
    return -math.inf if worst is None else math.inf if worst.more is None else worst.more


def _limitations(system: Model, prepared: Prepared) -> tuple[str, ...]:
    linear = all(prepared.jacobians[group.peer_type].affine for group in system.groups)
    return (
        *near_start(system, prepared),
        *published_limits(system),
        *limitations(system),
        *_as_at_start(system, prepared, linear=linear),
    )


def _one_sided_hand_conditions(
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
        modes = tuple(_verdict_of(loop) for loop in loops)
        never = unserved or (CIRCULATES if any(map(circulates, loops)) else "")
    linear = is_linear(system, prepared)
    stable: bool | None = None
    joined = not unserved and all(loop.joined for loop in loops)
    input_slots = [mode.passive is False and (joined or mode.more is None) for mode in modes]
    if unserved or fixed.stable is False or any(input_slots):
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
        limitations=(),
    )


def _directions(system: Model, prepared: Prepared) -> dict[str, Model]:
    """Return the model along each direction of its devices, empty where they move along a line.

    Raises
    ------
    ApcError
        E933 a motion along one direction acts on one along another.
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
            message = f"{OPTION}: devices move along {', '.join(along)}, which act on one another"
            raise ApcError(Diagnostic("E933", SourceLocation(system.origin.topology), message))
    return along


def _together(parts: Mapping[str, AbsoluteStability], replaced: tuple[str, ...]) -> AbsoluteStability:
    """Return the result of all directions together, which are uncoupled."""
    verdicts = [part.stable for part in parts.values()]
    stable = False if False in verdicts else None if None in verdicts else True
    deciding = next(part for part in parts.values() if part.stable is stable)
    modes = tuple(
        replace(mode, name=f"{mode.name}, {axis}") for axis, part in parts.items() for mode in part.modes
    )
    joined = all(part.joined for part in parts.values())
    return replace(deciding, modes=modes, joined=joined, limitations=(*replaced, *deciding.limitations))


def _as_at_start(system: Model, prepared: Prepared, *, linear: bool) -> tuple[str, ...]:
    """Return a note on contacts that are assumed constant, although hands may open and close them."""
    if linear:
        return ()
    try:
        parts = contact_modes(system, prepared=prepared).parts
    except ApcError:  # too many to list: a note on linearization is given
        return ()
    if not parts:
        return ()
    text = (
        f"left out: {', '.join(parts)} as at the start, whether they touch then or not; hands may change that"
    )
    return (text,)


def passivity_radius(system: Model, prepared: Prepared, *, bounded: bool = True) -> StabilityMeasure:
    """Return a measure below 1 for stability with every passive hand, and above it otherwise.

    With n the damping required at each device and b the largest present one, it is e^{2 (n − b)/(n + b)}. n
    grows without end where the model becomes unstable with devices clamped, and as 1/n this is continuous
    there; beyond it is e².

    Parameters
    ----------
    system, prepared
        As for `absolute_stability`.
    bounded
        Whether bounds are required.
    """
    each = loop_growths(system, prepared, bounded=bounded)
    radius, low, high = (max(getattr(growth, name) for growth in each) for name in ("radius", "low", "high"))
    return StabilityMeasure(radius, low, high, exact=True, proved=True)


def loop_growths(system: Model, prepared: Prepared, *, bounded: bool = True) -> list[StabilityMeasure]:
    """Return the same measure of each closed loop: the largest is that of the model.

    Parameters
    ----------
    system, prepared, bounded
        As for `passivity_radius`.
    """
    of_topology, system = system, without_hands(system, OPTION)
    prepared = prepared if system is of_topology else prepare(system)
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
        result.append((-np.inf, -np.inf, -np.inf))  # floats alone decided
    return [_passivity_radius(scale, *item) for item in result]


def _passivity_radius(scale: float, *spare: float) -> StabilityMeasure:
    """Return e^{2 (n − b)/(n + b)}, with b the largest damping and bounds on the reserve b − n."""
    needed = [scale - value for value in spare]
    logs = [np.sign(value) if np.isinf(value) else (value - scale) / (abs(value) + scale) for value in needed]
    radius, high, low = (float(np.exp(2 * log)) for log in logs)
    if spare[1] >= 0:  # passive, at the margin
        high = min(high, float(np.nextafter(1.0, 0.0)))
    return StabilityMeasure(radius, low, high, exact=True, proved=True)


def _verdict_of(loop: PortLoop) -> PassiveMode:
    """Return whether hands can extract energy from a mode."""
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
    """Return the smallest eigenvalue of He H + diag(b/τ), proved bounds on it, and its angle.

    The proved lower bound is the nearest of some relative widths that can be proved.

    −∞ where the model is unstable with its devices clamped, which this does not prove, and where slow motions
    extract energy, which it does.
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
        less = MIDPOINT_RADIUS.subtract(
            loop.weight, MIDPOINT_RADIUS.exact(shift * np.eye(len(loop.weight[0])))
        )
        if proves_positive(*matrices, less, spared=[share * width for share in SPARED]):
            low = shift
            break
    else:
        if least > 0 and proves_positive(*matrices, loop.weight):
            low = 0.0
    return least, low, _draws(loop, angle), angle


def _least(loop: PortLoop) -> tuple[float, float]:
    """Return the smallest eigenvalue of He H + diag(b/τ) over all angles, and its angle, in floats."""
    return least_real(*map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight)))


def circulates(loop: PortLoop) -> bool:
    """Return whether the static stiffness is not that of any spring.

    Parameters
    ----------
    loop
        A mode.

    Notes
    -----
    The residue at z = 1 has to be symmetric and positive semidefinite, or hands that move devices slowly
    around a cycle extract energy. A residue that is zero up to rounding counts as zero.
    """
    value, error_bound = value_of(loop.static), error_radius(loop.static)
    turned = np.abs(value - value.T) > error_bound + error_bound.T
    least = float(np.linalg.eigvalsh((value + value.T) / 2).min())
    return bool(turned.any()) or least < -2 * float((error_bound + error_bound.T).sum())


def _draws(loop: PortLoop, angle: float) -> float:
    """Return an upper bound on the Hermitian part in the worst direction at an angle.

    Notes
    -----
    The Rayleigh quotient of an estimated worst direction bounds the smallest eigenvalue. e^{jθ} is replaced
    by a nearby point of the circle with rational coordinates.
    """
    tangent = float(np.tan(angle / 2))
    z = complex(1 - tangent**2, 2 * tangent) / (1 + tangent**2)
    direction = _worst_mode(loop, z)[:, None]
    # Both parts are quotients of sums of order 1: their errors are roundings of 1, however small they are.
    unit, v = np.eye(loop.a.shape[-1]), MIDPOINT_RADIUS.exact(direction)
    states = solve(
        MIDPOINT_RADIUS.subtract(with_error_radius(z * unit, 16 * UNIT_ROUNDOFF * unit), loop.a),
        MIDPOINT_RADIUS.multiply(loop.b, v),
    )
    if states is None:
        return np.inf
    through = MIDPOINT_RADIUS.multiply(MIDPOINT_RADIUS.add(loop.d, loop.weight), v)
    input_slots = MIDPOINT_RADIUS.multiply(
        MIDPOINT_RADIUS.exact(direction.conj().T),
        MIDPOINT_RADIUS.add(MIDPOINT_RADIUS.multiply(loop.c, states), through),
    )
    size = float(np.vdot(direction, direction).real)
    top = float(input_slots[0, 0, 0].real + input_slots[1, 0, 0].real)
    return top / size + 8 * UNIT_ROUNDOFF * abs(top)


def _worst_mode(loop: PortLoop, z: complex) -> Complexes:
    """Return the vector of the smallest eigenvalue of He H + diag(b/τ) at a point of the circle."""
    a, b, c, d, weight = map(value_of, (loop.a, loop.b, loop.c, loop.d, loop.weight))
    response = c @ np.linalg.solve(z * np.eye(len(a)) - a, b + 0j) + d
    return np.asarray(np.linalg.eigh((response + response.conj().T) / 2 + weight)[1][:, 0])


def frequency_of(loop: PortLoop, angle: float) -> float:
    """Return the frequency of the motion of largest extractable energy at an angle, in Hz.

    Parameters
    ----------
    loop
        A mode.
    angle
        The phase advance in a frame, up to multiples of 2π.

    Notes
    -----
    Frequencies that differ by a multiple of the frame rate have one angle: the motion within a frame selects
    among them the dominant one.
    """
    moved = _worst_mode(loop, complex(np.exp(1j * angle))) * np.sqrt(loop.seconds)
    most = round(loop.frame_s / float(loop.seconds.min()) / 2) + 1
    values = sorted(angle + 2 * np.pi * turn for turn in range(-most, most + 1))
    values.sort(key=abs)  # of two with equal shares, the slower
    # A device moves at constant velocity in each interval: the share of each frequency, over all devices.
    middles, device = loop.starts + loop.seconds / 2, np.cumsum(loop.starts == 0) - 1
    each = device == np.arange(device[-1] + 1)[:, None]
    turned = np.outer(values, middles) / loop.frame_s
    shares = np.sinc(np.outer(values, loop.seconds) / (2 * np.pi * loop.frame_s))
    fits = np.linalg.norm((np.exp(-1j * turned) * shares * moved) @ each.T, axis=1)
    best = next(value for value, fit in zip(values, fits, strict=True) if fit >= max(fits) * (1 - SIMILAR))
    return abs(best) / (2 * np.pi * loop.frame_s)
