"""Schemes side by side: of several scenes the same numbers, each as its own command gives it.

Takes: `Model`s.
Gives: `SchemeComparison`, `Scheme`, `compare`; `FREQUENCIES`.
Guarantees: every number is that of `analysis`, `vary.critical_values`, `hands.frequency_response`,
`simulation` or `effort`; what can't be had says why and keeps nothing else from being told.
Does not: compute any of it itself, or say which scheme is the better one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from apc.analysis.analysis import Analysis, analyze
from apc.comparison.choice import DELAY, LOSS, STIFFNESS, SweepChoice, check_over, choose
from apc.comparison.effort import Effort, effort
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.frame.instance import Prepared, prepare
from apc.hands.answers import held_names
from apc.hands.frequency_response import Transparency, feel
from apc.moments.network_verdict import MeanSquareStability, judge_network
from apc.result import PlotStyle, Result
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare as prepare_to_play
from apc.simulation.trajectory import SimulationReport, duration_of, play, provenance_of
from apc.vary.critical_values import Critical, critical
from apc.vary.crossing import Progress
from apc.vary.growth import NOMINAL, PASSIVE, criterion_of

if TYPE_CHECKING:
    import pandas

    from apc.hands.passivity import AbsoluteStability

FREQUENCIES = (1.0, 10.0)  # Hz, at which is told what a hand feels
NOTHING: Mapping[int, str] = MappingProxyType({})  # refused


_Found = TypeVar("_Found")


@dataclass(frozen=True, slots=True, eq=False)
class Scheme:
    """One scene of a comparison, each part as the command gives it that is named.

    `analysis` and `network` (None where all packets are on time, or are taken to be) are those of `analyze`;
    `passive` that of `analyze --hands passive`, where stable means that. `played` is what `simulate` tells of
    a scene that is not linear, where all else is of its linearization; None of one that is. `stiffness`,
    `delay` and `loss` are those of `critical`; `feel` that of `feel` at `FREQUENCIES`, at the device of the
    first peer that has one. `missing` says why a part is None, by its name. A scene that can't be asked at
    all, as one with hands can't about passive ones, is `refused`, with why: only its effort is known.
    """

    topology: str
    peers: int
    analysis: Analysis | None
    network: MeanSquareStability | None
    passive: AbsoluteStability | None
    played: SimulationReport | None
    stiffness: Critical | None
    delay: Critical | None
    loss: Critical | None
    feel: Transparency | None
    effort: Effort
    missing: tuple[tuple[str, str], ...]
    refused: str = ""

    @property
    def verdict(self) -> str:
        """The verdict by what stable means: with passive hands, over the network as it is, or nominal."""
        judged = self.passive or self.network or self.analysis
        return "refused" if judged is None else judged.verdict

    @property
    def stable(self) -> bool | None:
        """Whether it is stable, in the same sense."""
        judged = self.passive or self.network or self.analysis
        return None if judged is None else judged.stable

    @property
    def linearized(self) -> bool:
        """Whether all but what is played is of a linearization."""
        return self.analysis is not None and self.analysis.linearized

    @property
    def left_out(self) -> tuple[str, ...]:
        """What of the scene some of its numbers don't look at."""
        parts = (self.analysis, self.stiffness, self.delay, self.loss, self.feel)
        return tuple(dict.fromkeys(text for part in parts if part is not None for text in part.left_out))


@dataclass(frozen=True, slots=True, eq=False)
class SchemeComparison(Result):
    """Schemes side by side, in the order asked for; `notes` say in what they can't be compared."""

    shown_by = "comparison_output:comparison"

    schemes: tuple[Scheme, ...]
    notes: tuple[str, ...]

    @property
    def left_out(self) -> tuple[str, ...]:
        """What some numbers don't look at, with the places (from 1) of the schemes it is said of."""
        said: dict[str, list[str]] = {}
        for place, scheme in enumerate(self.schemes):
            for text in scheme.left_out:
                said.setdefault(text, []).append(str(place + 1))
        every = len(self.schemes)
        return tuple(f"{', '.join(on)}: {text}" if len(on) < every else text for text, on in said.items())

    def plot(self, **look: Unpack[PlotStyle]) -> Any:
        """Draw all schemes beside each other, as `look` says; return the matplotlib Figure."""
        return self._drawn(look=look)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a table with a row a scheme, in SI."""
        result: pandas.DataFrame = self._shown("table")
        return result


@part("compare")
def compare(
    systems: Sequence[Model],
    *,
    over: Sequence[str] = (),
    criterion: str | None = None,
    at: str = "",
    refused: Mapping[int, str] = NOTHING,
    progress: Progress | None = None,
) -> SchemeComparison:
    """Ask the same of several scenes.

    Parameters
    ----------
    systems
        The compiled scenes, with the numbers to analyse.
    over
        Which stiffness, delay and loss are varied, in the scenes that have them: see `choice.choose`.
    criterion
        What stable means, as for `vary.critical_values.critical`.
    at
        The device whose hand feels, as `frequency_response.feel` takes it; if not given, of the first peer
        with one.
    refused
        Of scenes, by their places, that can't be asked: why. They have a place in the table all the same.
    progress
        Is told how far the work is.

    Raises
    ------
    ApcError
        E940, E941 and E622, as `choice`; E898 no such criterion.
    """
    check_over(systems, over)
    asked = {place: system for place, system in enumerate(systems) if place not in refused}
    for system in asked.values():
        criterion_of(system, criterion, SourceLocation("criterion"))
    chosen = {place: choose(system, over) for place, system in asked.items()}
    schemes = []
    for place, system in enumerate(systems):
        why = refused.get(place, "")
        if not why:
            try:
                schemes.append(_scheme(system, chosen[place], criterion, at, progress))
                continue
            except ApcError as error:
                why = error.mistakes[0].reason
        nothing = (None,) * 8
        schemes.append(Scheme(system.name, system.peers, *nothing, effort(system), (), why))
    return SchemeComparison(tuple(schemes), _notes(schemes))


def _scheme(
    system: Model,
    axes: Mapping[str, SweepChoice],
    criterion: str | None,
    at: str,
    progress: Progress | None,
) -> Scheme:
    """Return what is told of one scene. Raises ApcError, as `analyze` and `passive_hands`, if it can't be."""
    names = {axis: item.name for axis, item in axes.items()}
    missing = {axis: item.why for axis, item in axes.items() if item.why}
    say = progress or (lambda _: None)

    def had(key: str, command: str, compute: Callable[[], _Found]) -> _Found | None:
        try:
            return compute()
        except ApcError as error:
            missing[key] = f"{command}: {error.mistakes[0].reason}"
            return None

    def crossing(axis: str) -> Critical | None:
        if not names[axis]:
            return None
        command = f"apc critical {names[axis]}"
        say(f"{system.name}: {command}")
        return had(
            axis, command, lambda: critical(system, names[axis], criterion=criterion, progress=progress)
        )

    say(f"{system.name}: its verdict")
    prepared = prepare(system)
    network = judge_network(system, prepared) if criterion not in (NOMINAL, PASSIVE) else None
    if network is not None and network.mean_square_radius is None:
        missing["verdict"] = "; ".join(network.notes)
    analysis = analyze(system, prepared=prepared)
    return Scheme(
        topology=system.name,
        peers=system.peers,
        analysis=analysis,
        network=network,
        passive=_passive(system, prepared) if criterion == PASSIVE else None,
        played=had("played", "apc simulate", lambda: _played(system, say)) if analysis.linearized else None,
        stiffness=crossing(STIFFNESS),
        delay=crossing(DELAY),
        loss=crossing(LOSS),
        feel=had("feel", "apc feel", lambda: _feel(system, prepared, at)),
        effort=effort(system),
        missing=tuple(missing.items()),
    )


def _played(system: Model, say: Progress) -> SimulationReport:
    """Return what a scene does in time, by its experiment."""
    simulation = prepare_to_play(system, Settings(duration_of(system, None)))
    say(f"{system.name}: apc simulate")
    summary, interrupted = play(simulation, [])
    if interrupted:
        raise KeyboardInterrupt
    return SimulationReport(
        topology=system.name, summary=summary, provenance=provenance_of(simulation), interrupted=False
    )


def _feel(system: Model, prepared: Prepared, at: str) -> Transparency:
    """Return what is felt, at the first device there is if it isn't said: a server has none."""
    names = held_names(system, prepared)
    at = at or (names[0].partition(".")[0] if names else "")
    return feel(system, FREQUENCIES, at=at, beside=(), prepared=prepared)


def _passive(system: Model, prepared: Prepared) -> AbsoluteStability:
    """Return the verdict with all passive hands; imported here, as few comparisons ask for it."""
    from apc.hands.passivity import passive_hands

    return passive_hands(system, prepared)


def _notes(schemes: Sequence[Scheme]) -> tuple[str, ...]:
    """Say in what the schemes differ beside their couplings."""
    peers = dict.fromkeys(scheme.peers for scheme in schemes)
    frames = dict.fromkeys(scheme.analysis.frame_s for scheme in schemes if scheme.analysis is not None)
    judged = dict.fromkeys(scheme.network is None for scheme in schemes if scheme.analysis is not None)
    notes = {
        f"they have different numbers of peers: {', '.join(f'{peer:,}' for peer in peers)}": len(peers) > 1,
        "their frames differ, and with them what a spectral radius is of: "
        f"{', '.join(f'{frame * 1e3:.6g} ms' for frame in frames)}": len(frames) > 1,
        "some are judged in mean square over the network as it is, some with every packet on time": len(
            judged
        )
        > 1,
    }
    return tuple(text for text, applies in notes.items() if applies)
