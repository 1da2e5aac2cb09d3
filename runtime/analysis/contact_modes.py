"""Which contact makes it unstable: the analysis of a scene in each of its modes.

Takes: a `Model` whose peers have parts that switch (see `switches`).
Gives: `ContactMode`, `ContactModes`, `contact_modes`.
Guarantees: in each mode every such part is wholly on or wholly off, and the rest is as in the scene; where a
piece is linear, so is the answer, wherever the motion is.
Does not: prove that a motion which changes from mode to mode stays bounded, or try peers of one group apart.

The modes: every switching part on at every peer; none on; each group alone with all of its own on; and where
several parts switch, each part alone on at every peer.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from apc.analysis.analysis import analyze
from apc.analysis.switches import SwitchingPart, bind, switching_parts
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.frame.decisions import SwitchedPeerType, find_switches
from apc.frame.instance import Prepared, prepare
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linearize import linearize
from apc.frame.parameters import ResolvedNumbers, resolve
from apc.result import Result
from apc.verdict import StabilityVerdict

EVERYONE = "on at every peer"
NOBODY = "on at no peer"

# For each group of the scene, the names of the parts that are on.
_Setting = tuple[frozenset[str], ...]


@dataclass(frozen=True, slots=True)
class ContactMode:
    """One mode: `on` lists (group, its parts that are on).

    The spectral radius is per frame; `frequency_hz` is that of the mode of motion with it. `linearized` says
    that some piece is not linear, so that the answer holds near the start values only. Where a mode can't be
    analysed, `verdict` is None and `refusal` is the reason.
    """

    name: str
    on: tuple[tuple[str, tuple[str, ...]], ...]
    verdict: StabilityVerdict | None
    stable: bool | None
    spectral_radius: float
    spectral_radius_error: float
    frequency_hz: float
    linearized: bool
    refusal: str
    beyond: tuple[float, float] | None = None  # of 1, see `Analysis`


@dataclass(frozen=True, slots=True)
class ContactModes(Result):
    """Every mode of a scene; none where nothing switches.

    `parts` are the switching parts by name; `notes` say what was not looked into.
    """

    shown_by = "analysis_output:contact_modes"

    topology: str
    parts: tuple[str, ...]
    modes: tuple[ContactMode, ...]
    notes: tuple[str, ...]

    @property
    def unstable(self) -> tuple[str, ...]:
        """The names of the modes that are unstable."""
        return tuple(mode.name for mode in self.modes if mode.verdict is StabilityVerdict.UNSTABLE)

    @property
    def summary(self) -> str:
        """Which mode is unstable, in one sentence; "" where nothing switches."""
        if not self.modes:
            return ""
        unstable = self.unstable
        unknown = [mode.name for mode in self.modes if mode.stable is None]
        if len(unstable) == len(self.modes):
            words = "unstable in every mode"
        elif unstable:
            words = f"unstable when {' or '.join(unstable)}"
        else:
            words = "no mode is known to be unstable" if unknown else "stable in every mode"
        if unknown:
            words += f"; not decided when {' or '.join(unknown)}"
        return f"{', '.join(self.parts)}: {words}"


@part("contact modes")
def contact_modes(system: Model, *, prepared: Prepared | None = None) -> ContactModes:
    """Analyse a scene in each mode of its contacts, walls and limits.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with these timings; saves building the Jacobians again.

    Raises
    ------
    ApcError
        E863 a part that takes too many decisions.
    """
    prepared = prepared or prepare(system)
    switched = [find_switches(site.kind) for site in prepared.jacobians]
    hidden = dict.fromkeys(
        switched_kind.kind.name for switched_kind in switched if not switched_kind.walkable
    )
    notes = tuple(f"not looked into: {name}, which has a nonlinear loop" for name in hidden)
    with np.errstate(all="ignore"):
        parts = parts_of_kinds(system, switched, resolve(system))
    names = tuple(dict.fromkeys(part.name for listed in parts for part in listed))
    has = [frozenset(part.name for part in parts[group.kind]) for group in system.groups]

    def site(kind: int, on: frozenset[str]) -> SubsystemJacobians:
        """Return the Jacobians of a kind with these parts on and all others off."""
        if not switched[kind].decisions:
            return prepared.jacobians[kind]
        setting = settings((part for part in parts[kind] if part.name in on), on=True)
        setting |= settings((part for part in parts[kind] if part.name not in on), on=False)
        return bind(switched[kind], prepared.jacobians[kind], setting)

    def mode(name: str, setting: _Setting) -> ContactMode:
        """Analyse the scene with these parts on."""
        # Groups of one kind with other parts on are of two kinds now.
        numbers: dict[tuple[int, frozenset[str]], int] = {}
        groups = tuple(
            replace(group, kind=numbers.setdefault((group.kind, own), len(numbers)))
            for group, own in zip(system.groups, setting, strict=True)
        )
        sites = tuple(site(*number) for number in numbers)
        kinds = tuple(system.kinds[kind] for kind, _ in numbers)
        changed = replace(system, kinds=kinds, groups=groups)
        on = tuple((group.name, tuple(sorted(own))) for group, own in zip(groups, setting, strict=True))
        analysis, refusal = None, _no_slope(changed, sites)
        if not refusal:
            try:
                analysis = analyze(changed, prepared=replace(prepared, jacobians=sites))
            except ApcError as error:
                refusal = error.mistakes[0].sentence
        if analysis is None:
            nan = float("nan")
            return ContactMode(name, on, None, None, nan, nan, 0.0, linearized=False, refusal=refusal)
        return ContactMode(
            name=name,
            on=on,
            verdict=analysis.verdict,
            stable=analysis.stable,
            spectral_radius=analysis.spectral_radius,
            spectral_radius_error=analysis.spectral_radius_error,
            frequency_hz=analysis.modes[0].frequency_hz if analysis.modes else 0.0,
            linearized=analysis.linearized,
            refusal="",
            beyond=analysis.beyond,
        )

    modes = tuple(mode(name, setting) for setting, name in _settings(system, names, has).items())
    return ContactModes(system.name, names, modes, notes)


def parts_of_kinds(
    system: Model, switched: Sequence[SwitchedPeerType], numbers: ResolvedNumbers
) -> list[tuple[SwitchingPart, ...]]:
    """Return the switching parts of each kind, as they are of the first of its peers.

    Raises
    ------
    ApcError
        E863 a part that takes too many decisions.
    """
    parts: list[tuple[SwitchingPart, ...]] = []
    for index, switched_kind in enumerate(switched):
        rows = [numbers.parameters[g][0] for g, group in enumerate(system.groups) if group.kind == index]
        parts.append(switching_parts(switched_kind, rows[0]) if rows else ())
    return parts


def settings(parts: Iterable[SwitchingPart], *, on: bool) -> dict[int, bool]:
    """Return the settings of all decisions of some parts, each wholly on or wholly off."""
    return {
        place: value
        for part in parts
        for place, value in zip(part.decisions, part.on if on else part.off, strict=True)
    }


def _settings(system: Model, names: Sequence[str], has: Sequence[frozenset[str]]) -> dict[_Setting, str]:
    """Return the modes of a scene with their names, each once; none where nothing switches."""
    nothing: frozenset[str] = frozenset()
    result = {tuple(has): EVERYONE, tuple(nothing for _ in has): NOBODY} if names else {}
    for place, group in enumerate(system.groups if names else ()):
        alone = tuple(texts if g == place else nothing for g, texts in enumerate(has))
        result.setdefault(alone, f"on at {group.name} alone")
    for name in names:
        result.setdefault(tuple(texts & {name} for texts in has), f"{name} on alone")
    return result


def _no_slope(system: Model, sites: Sequence[SubsystemJacobians]) -> str:
    """Say which peers' pieces have no slopes at the start values, "" if all have."""
    numbers = resolve(system)
    for group, rows in zip(system.groups, numbers.parameters, strict=True):
        site = sites[group.kind]
        if site.affine or site.edges:  # slopes everywhere, or found with those who are heard
            continue
        try:
            linearize(site, rows[0])
        except ApcError:
            return f"this piece of {group.name} is not linear and has no slope at the start values"
    return ""
