"""Contact modes: the analysis of a model with each combination of contacts on or off.

Takes: a `NumericModel` whose peers have switching parts (see `switches`).
Gives: `ContactMode`, `ContactModes`, `contact_modes`; `parts_of_peer_types`, `settings`.
Guarantees: in each mode every switching part is fully on or off, and the other parts are unchanged; where a
piece is linear, the result holds globally.
Does not: prove boundedness of a motion that changes between modes, or distinguish peers of one group.

The modes: every switching part on at every peer; none on; each group separately with all of its own on; and
where several parts switch, each part on at every peer.
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
from apc.lifting.numeric_model import NumericModel
from apc.linearization.branch_conditions import SwitchedPeerType, find_switches
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import linearize
from apc.parameter_values.parameters import ResolvedNumbers, resolve
from apc.result import Result
from apc.verdict import StabilityVerdict

EVERYONE = "on at every peer"
NOBODY = "on at no peer"

# For each group of the model, the names of the parts that are on.
_Setting = tuple[frozenset[str], ...]


@dataclass(frozen=True, slots=True)
class ContactMode:
    """One contact mode: `on` lists for each group the names of its parts that are on.

    The spectral radius is per frame; `frequency_hz` is that of the mode with the largest eigenvalue.
    `linearized` states that some piece is not linear, so that the result holds near the start values only. If
    a mode cannot be analysed, `verdict` is None and `refusal` is the reason.
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
    radius_excess: tuple[float, float] | None = None  # of 1, see `Analysis`


@dataclass(frozen=True, slots=True)
class ContactModes(Result):
    """Every contact mode of a model; empty if no part switches.

    `parts` are the switching parts by name; `notes` are the limitations.
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
        """The verdict over all modes in one sentence, with the unstable modes; "" if no part switches."""
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
def contact_modes(
    numeric: NumericModel,
) -> ContactModes:
    """Return the stability analysis of a model for each on/off combination of its contacts and limits.

    Parameters
    ----------
    numeric
        The model with its parameter values.

    Raises
    ------
    ApcError
        E863 a contact, wall or limit with too many conditions.
    """
    model = numeric.model
    switched = [find_switches(subsystem.peer_type) for subsystem in numeric.jacobians]
    with_nonlinear_loop = dict.fromkeys(
        switched_peer_type.peer_type.name
        for switched_peer_type in switched
        if not switched_peer_type.walkable
    )
    notes = tuple(f"not analyzed: {name}, which has a nonlinear loop" for name in with_nonlinear_loop)
    with np.errstate(all="ignore"):
        parts = parts_of_peer_types(model, switched, numeric.numbers)
    names = tuple(dict.fromkeys(part.name for parts_of_type in parts for part in parts_of_type))
    parts_of_groups = [frozenset(part.name for part in parts[group.peer_type]) for group in model.groups]

    def subsystem(peer_type: int, on: frozenset[str]) -> SubsystemJacobians:
        """Return the Jacobians of a peer type with the parts named in `on` on, and all others off."""
        if not switched[peer_type].decisions:
            return numeric.jacobians[peer_type]
        setting = settings((part for part in parts[peer_type] if part.name in on), on=True)
        setting |= settings((part for part in parts[peer_type] if part.name not in on), on=False)
        return bind(switched[peer_type], numeric.jacobians[peer_type], setting)

    def mode(name: str, setting: _Setting) -> ContactMode:
        """Return the analysis of the model with the parts of each group in `setting` on."""
        # Groups of one peer type with different parts on have two types now.
        numbers: dict[tuple[int, frozenset[str]], int] = {}
        groups = tuple(
            replace(group, peer_type=numbers.setdefault((group.peer_type, parts_on), len(numbers)))
            for group, parts_on in zip(model.groups, setting, strict=True)
        )
        subsystems = tuple(subsystem(*number) for number in numbers)
        peer_types = tuple(model.peer_types[peer_type] for peer_type, _ in numbers)
        changed = replace(model, peer_types=peer_types, groups=groups)
        on = tuple(
            (group.name, tuple(sorted(parts_on))) for group, parts_on in zip(groups, setting, strict=True)
        )
        analysis, refusal = None, _missing_slope_note(changed, subsystems)
        if not refusal:
            try:
                analysis = analyze(replace(numeric.with_jacobians(subsystems), model=changed))
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
            radius_excess=analysis.radius_excess,
        )

    modes = tuple(mode(name, setting) for setting, name in _settings(model, names, parts_of_groups).items())
    return ContactModes(model.name, names, modes, notes)


def parts_of_peer_types(
    model: Model, switched: Sequence[SwitchedPeerType], numbers: ResolvedNumbers
) -> list[tuple[SwitchingPart, ...]]:
    """Return the switching parts of each peer type, at the parameters of its first peer.

    Raises
    ------
    ApcError
        E863 a contact, wall or limit with too many conditions.
    """
    parts: list[tuple[SwitchingPart, ...]] = []
    for index, switched_peer_type in enumerate(switched):
        rows = [numbers.parameters[g][0] for g, group in enumerate(model.groups) if group.peer_type == index]
        parts.append(switching_parts(switched_peer_type, rows[0]) if rows else ())
    return parts


def settings(parts: Iterable[SwitchingPart], *, on: bool) -> dict[int, bool]:
    """Return the settings, by index of the decision, that switch some parts fully on or off."""
    return {
        index: value
        for part in parts
        for index, value in zip(part.decisions, part.on if on else part.switched_off, strict=True)
    }


def _settings(
    model: Model, names: Sequence[str], parts_of_groups: Sequence[frozenset[str]]
) -> dict[_Setting, str]:
    """Return the name of each contact mode by its setting, each setting once; empty if no part switches."""
    no_parts: frozenset[str] = frozenset()
    result = (
        {tuple(parts_of_groups): EVERYONE, tuple(no_parts for _ in parts_of_groups): NOBODY} if names else {}
    )
    for index, group in enumerate(model.groups if names else ()):
        single = tuple(part_names if g == index else no_parts for g, part_names in enumerate(parts_of_groups))
        result.setdefault(single, f"on at {group.name} alone")
    for name in names:
        result.setdefault(tuple(part_names & {name} for part_names in parts_of_groups), f"{name} on alone")
    return result


def _missing_slope_note(model: Model, subsystems: Sequence[SubsystemJacobians]) -> str:
    """Return a note on a group whose piece has no slope at its start values, "" if all groups have slopes."""
    numbers = resolve(model)
    for group, rows in zip(model.groups, numbers.parameters, strict=True):
        subsystem = subsystems[group.peer_type]
        if subsystem.affine or subsystem.edges:  # slopes everywhere, or linearized with their senders
            continue
        try:
            linearize(subsystem, rows[0])
        except ApcError:
            return f"this piece of {group.name} is not linear and has no slope at the initial values"
    return ""
