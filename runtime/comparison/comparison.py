"""Comparison table: the same quantities of several models, each from its own analysis.

Takes: `Model`s.
Gives: `SchemeComparison`, `Scheme`, `compare`; `FREQUENCIES`.
Guarantees: every number is that of `analysis`, `parameter_studies.critical_values`,
`haptics.frequency_response`, `simulation` or `effort`; an unavailable value has a reason and does not affect
the others.
Does not: compute any value itself, or rank schemes.
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
from apc.frame.numeric_model import Prepared, prepare
from apc.haptics.frequency_response import Transparency, transparency
from apc.haptics.peer_responses import gripped_names
from apc.mean_square.mean_square_stability import MeanSquareStability, mean_square_stability
from apc.parameter_studies.critical_values import Critical, critical
from apc.parameter_studies.crossing import Progress
from apc.parameter_studies.stability_criteria import NOMINAL, PASSIVE, criterion_of
from apc.result import PlotStyle, Result
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare as prepare_to_play
from apc.simulation.trajectory import SimulationReport, duration_of, provenance_of, run_simulation

if TYPE_CHECKING:
    import pandas

    from apc.haptics.absolute_stability import AbsoluteStability

FREQUENCIES = (1.0, 10.0)  # frequencies of the transparency, in Hz
NOTHING: Mapping[int, str] = MappingProxyType({})  # refused


_Found = TypeVar("_Found")


@dataclass(frozen=True, slots=True, eq=False)
class Scheme:
    """One model of a comparison, with the results of the commands.

    `analysis` and `network` (None if all packets are on time, or assumed to be) are those of `analyze`;
    `passive` that of `analyze --hands passive`, with that criterion. `simulated` is the `simulate` result of
    a nonlinear model, whose other results are of its linearization; None for a linear one. `stiffness`,
    `delay` and `loss` are those of `critical`; `transparency` that of `transparency` at `FREQUENCIES`, at the
    first device. `missing` has the reason for each part that is None. A model that cannot be analyzed, such
    as one with hands under passive hands, is `refused` with the reason, and has its effort only.
    """

    topology: str
    peers: int
    analysis: Analysis | None
    network: MeanSquareStability | None
    passive: AbsoluteStability | None
    simulated: SimulationReport | None
    stiffness: Critical | None
    delay: Critical | None
    loss: Critical | None
    transparency: Transparency | None
    effort: Effort
    missing: tuple[tuple[str, str], ...]
    refused: str = ""

    @property
    def verdict(self) -> str:
        """The verdict by the criterion: with passive hands, over the lossy network, or nominal."""
        decided = self.passive or self.network or self.analysis
        return "refused" if decided is None else decided.verdict

    @property
    def stable(self) -> bool | None:
        """Whether it is stable, in the same sense."""
        decided = self.passive or self.network or self.analysis
        return None if decided is None else decided.stable

    @property
    def linearized(self) -> bool:
        """Whether all results except the simulation are of a linearization."""
        return self.analysis is not None and self.analysis.linearized

    @property
    def limitations(self) -> tuple[str, ...]:
        """The limitations of some results of the model."""
        parts = (self.analysis, self.stiffness, self.delay, self.loss, self.transparency)
        return tuple(dict.fromkeys(text for part in parts if part is not None for text in part.limitations))


@dataclass(frozen=True, slots=True, eq=False)
class SchemeComparison(Result):
    """The compared schemes in the given order; `notes` list limits of the comparison."""

    shown_by = "comparison_output:comparison"

    schemes: tuple[Scheme, ...]
    notes: tuple[str, ...]

    @property
    def limitations(self) -> tuple[str, ...]:
        """The limitations of some results, with the one-based indices of the schemes."""
        reasons: dict[str, list[str]] = {}
        for index, scheme in enumerate(self.schemes):
            for text in scheme.limitations:
                reasons.setdefault(text, []).append(str(index + 1))
        every = len(self.schemes)
        return tuple(f"{', '.join(on)}: {text}" if len(on) < every else text for text, on in reasons.items())

    def plot(self, **style: Unpack[PlotStyle]) -> Any:
        """Plot all schemes in the style `look`; return the matplotlib Figure."""
        return self._plotted(style=style)

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
    """Compare several models.

    Parameters
    ----------
    systems
        The models, with the parameter values to analyze.
    over
        The varied stiffness, delay and loss, for the models that have them: see `choice.choose`.
    criterion
        The stability criterion, as for `parameter_studies.critical_values.critical`.
    at
        The device of the transparency analysis, as for `frequency_response.transparency`; by default the
        first.
    refused
        The reasons for models that cannot be analyzed, by index. They have a row in the table all the same.
    progress
        Called with the progress.

    Raises
    ------
    ApcError
        E940, E941 and E622, as `choice`; E898 an unknown criterion.
    """
    check_over(systems, over)
    requested = {index: system for index, system in enumerate(systems) if index not in refused}
    for system in requested.values():
        criterion_of(system, criterion, SourceLocation("criterion"))
    chosen = {index: choose(system, over) for index, system in requested.items()}
    schemes = []
    for index, system in enumerate(systems):
        why = refused.get(index, "")
        if not why:
            try:
                schemes.append(_scheme(system, chosen[index], criterion, at, progress))
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
    """Return the results of one model. Raises ApcError as `analyze` and `absolute_stability`."""
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
    network = mean_square_stability(system, prepared) if criterion not in (NOMINAL, PASSIVE) else None
    if network is not None and network.mean_square_radius is None:
        missing["verdict"] = "; ".join(network.notes)
    analysis = analyze(system, prepared=prepared)
    return Scheme(
        topology=system.name,
        peers=system.peers,
        analysis=analysis,
        network=network,
        passive=_passive(system, prepared) if criterion == PASSIVE else None,
        simulated=had("simulated", "apc simulate", lambda: _simulated(system, say))
        if analysis.linearized
        else None,
        stiffness=crossing(STIFFNESS),
        delay=crossing(DELAY),
        loss=crossing(LOSS),
        transparency=had("transparency", "apc transparency", lambda: _transparency(system, prepared, at)),
        effort=effort(system),
        missing=tuple(missing.items()),
    )


def _simulated(system: Model, say: Progress) -> SimulationReport:
    """Return the simulation of a model's experiment."""
    simulation = prepare_to_play(system, Settings(duration_of(system, None)))
    say(f"{system.name}: apc simulate")
    summary, interrupted = run_simulation(simulation, [])
    if interrupted:
        raise KeyboardInterrupt
    return SimulationReport(
        topology=system.name, summary=summary, provenance=provenance_of(simulation), interrupted=False
    )


def _transparency(system: Model, prepared: Prepared, at: str) -> Transparency:
    """Return the transparency, by default at the first device: a server has none."""
    names = gripped_names(system, prepared)
    at = at or (names[0].partition(".")[0] if names else "")
    return transparency(system, FREQUENCIES, at=at, alongside=(), prepared=prepared)


def _passive(system: Model, prepared: Prepared) -> AbsoluteStability:
    """Return the verdict with all passive hands; imported here, as few comparisons ask for it."""
    from apc.haptics.absolute_stability import absolute_stability

    return absolute_stability(system, prepared)


def _notes(schemes: Sequence[Scheme]) -> tuple[str, ...]:
    """Return the differences between the models other than their couplings."""
    peers = dict.fromkeys(scheme.peers for scheme in schemes)
    frames = dict.fromkeys(scheme.analysis.frame_s for scheme in schemes if scheme.analysis is not None)
    decided = dict.fromkeys(scheme.network is None for scheme in schemes if scheme.analysis is not None)
    notes = {
        f"they have different numbers of peers: {', '.join(f'{peer:,}' for peer in peers)}": len(peers) > 1,
        "their frames differ, and with them what a spectral radius is of: "
        f"{', '.join(f'{frame * 1e3:.6g} ms' for frame in frames)}": len(frames) > 1,
        "some are judged in mean square over the network as it is, some with every packet on time": len(
            decided
        )
        > 1,
    }
    return tuple(text for text, applies in notes.items() if applies)
