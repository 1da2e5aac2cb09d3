"""Comparison table: the same quantities of several models, each from its own analysis.

Takes: `Model`s.
Gives: `SchemeComparison`, `Scheme`, `compare`; `FREQUENCIES`.
Guarantees: every number is from `analysis`, `studies.critical_values`,
`haptics.frequency_response`, `simulation` or `effort`; a missing value has a reason and does not affect
the other values.
Does not: compute values, or rank schemes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.haptics.frequency_response import Transparency, transparency
from apc.haptics.peer_responses import device_labels
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.mean_square.mean_square_stability import MeanSquareStability, mean_square_stability
from apc.result import PlotStyle, Result
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare as prepare_simulation
from apc.simulation.trajectory import SimulationReport, duration_of, provenance_of, run_simulation
from apc.studies.choice import DELAY, LOSS, STIFFNESS, SweepChoice, check_over, choose
from apc.studies.critical_values import Critical, critical
from apc.studies.crossing import Progress
from apc.studies.effort import Effort, effort
from apc.studies.stability_criteria import NOMINAL, PASSIVE, criterion_of

if TYPE_CHECKING:
    import pandas

    from apc.haptics.absolute_stability import AbsoluteStability

FREQUENCIES = (1.0, 10.0)  # frequencies of the transparency, in Hz
NOTHING: Mapping[int, str] = MappingProxyType({})  # no refused models


_Value = TypeVar("_Value")


@dataclass(frozen=True, slots=True, eq=False)
class Scheme:
    """One model of a comparison, with the results of the commands.

    `analysis` and `network` (None if all packets are on time, or assumed to be) are results of `analyze`;
    `passive` is the result with all passive hands, for the criterion "passive". `simulated` is the simulation
    of a nonlinear model, whose other results are of its linearization; None for a linear model. `stiffness`,
    `delay` and `loss` are results of `critical`; `transparency` is the transparency at `FREQUENCIES`, at the
    first device. `missing` has the reason for each result that is None. If a model cannot be analyzed, such
    as a model with hands for passive hands, `refused` is the reason, and only `effort` is available.
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
        """Whether the model is stable by the same criterion; None if undecided or refused."""
        decided = self.passive or self.network or self.analysis
        return None if decided is None else decided.stable

    @property
    def linearized(self) -> bool:
        """Whether all results except the simulation are results of a linearization."""
        return self.analysis is not None and self.analysis.linearized

    @property
    def limitations(self) -> tuple[str, ...]:
        """The limitations of the results, each once."""
        parts = (self.analysis, self.stiffness, self.delay, self.loss, self.transparency)
        return tuple(dict.fromkeys(text for part in parts if part is not None for text in part.limitations))


@dataclass(frozen=True, slots=True, eq=False)
class SchemeComparison(Result):
    """The compared schemes in the given order; `notes` are limitations of the comparison."""

    shown_by = "comparison_output:comparison"

    schemes: tuple[Scheme, ...]
    notes: tuple[str, ...]

    @property
    def limitations(self) -> tuple[str, ...]:
        """The limitations of the results, with the numbers of the schemes, from 1."""
        reasons: dict[str, list[str]] = {}
        for index, scheme in enumerate(self.schemes):
            for text in scheme.limitations:
                reasons.setdefault(text, []).append(str(index + 1))
        count = len(self.schemes)
        return tuple(f"{', '.join(on)}: {text}" if len(on) < count else text for text, on in reasons.items())

    def plot(self, **style: Unpack[PlotStyle]) -> Any:
        """Return a matplotlib Figure of all schemes, in a style (see `PlotStyle`)."""
        return self._plotted(style=style)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a table with one row per scheme, in SI units."""
        result: pandas.DataFrame = self._shown("table")
        return result


@part("compare")
def compare(
    models: Sequence[Model],
    *,
    over: Sequence[str] = (),
    criterion: str | None = None,
    at: str = "",
    refused: Mapping[int, str] = NOTHING,
    progress: Progress | None = None,
) -> SchemeComparison:
    """Return the comparison of several models.

    Parameters
    ----------
    models
        The models, with the parameter values to analyze.
    over
        The varied stiffness, delay and loss, for the models that have them: see `choice.choose`.
    criterion
        The stability criterion, as for `studies.critical_values.critical`.
    at
        The device of the transparency analysis, as for `frequency_response.transparency`; by default the
        first.
    refused
        The reasons for models that cannot be analyzed, by index; they have a row in the table too.
    progress
        The function called with a text on the progress.

    Raises
    ------
    ApcError
        E940, E941 and E622, as in `choice`; E898 an unknown criterion.
    """
    check_over(models, over)
    analyzed = {index: model for index, model in enumerate(models) if index not in refused}
    for model in analyzed.values():
        criterion_of(model, criterion, SourceLocation("criterion"))
    chosen = {index: choose(model, over) for index, model in analyzed.items()}
    schemes = []
    for index, model in enumerate(models):
        reason = refused.get(index, "")
        if not reason:
            try:
                schemes.append(_scheme(model, chosen[index], criterion, at, progress))
                continue
            except ApcError as error:
                reason = error.mistakes[0].reason
        no_results = (None,) * 8
        schemes.append(Scheme(model.name, model.peers, *no_results, effort(model), (), reason))
    return SchemeComparison(tuple(schemes), _notes(schemes))


def _scheme(
    model: Model,
    axes: Mapping[str, SweepChoice],
    criterion: str | None,
    at: str,
    progress: Progress | None,
) -> Scheme:
    """Return the results of one model. Raises ApcError as `analyze` and `absolute_stability` do."""
    names = {axis: item.name for axis, item in axes.items()}
    missing = {axis: item.why for axis, item in axes.items() if item.why}
    notify = progress or (lambda _: None)

    def result_or_none(key: str, command: str, compute: Callable[[], _Value]) -> _Value | None:
        """Return the result of a computation, or None if it is not available, with the reason added to
        `missing`.
        """
        try:
            return compute()
        except ApcError as error:
            missing[key] = f"{command}: {error.mistakes[0].reason}"
            return None

    def crossing(axis: str) -> Critical | None:
        """Return the values of a parameter at which the verdict changes, None if not available."""
        if not names[axis]:
            return None
        command = f"apc critical {names[axis]}"
        notify(f"{model.name}: {command}")
        return result_or_none(
            axis, command, lambda: critical(model, names[axis], criterion=criterion, progress=progress)
        )

    notify(f"{model.name}: apc analyze")
    numeric = numeric_model(model)
    network = mean_square_stability(numeric) if criterion not in (NOMINAL, PASSIVE) else None
    if network is not None and network.mean_square_radius is None:
        missing["verdict"] = "; ".join(network.notes)
    analysis = analyze(numeric)
    return Scheme(
        topology=model.name,
        peers=model.peers,
        analysis=analysis,
        network=network,
        passive=_passive(numeric) if criterion == PASSIVE else None,
        simulated=result_or_none("simulated", "apc simulate", lambda: _simulated(model, notify))
        if analysis.linearized
        else None,
        stiffness=crossing(STIFFNESS),
        delay=crossing(DELAY),
        loss=crossing(LOSS),
        transparency=result_or_none("transparency", "apc transparency", lambda: _transparency(numeric, at)),
        effort=effort(model),
        missing=tuple(missing.items()),
    )


def _simulated(model: Model, notify: Progress) -> SimulationReport:
    """Return the simulation of a model over the duration of its experiment."""
    simulation = prepare_simulation(model, Settings(duration_of(model, None)))
    notify(f"{model.name}: apc simulate")
    summary, interrupted = run_simulation(simulation, [])
    if interrupted:
        raise KeyboardInterrupt
    return SimulationReport(
        topology=model.name, summary=summary, provenance=provenance_of(simulation), interrupted=False
    )


def _transparency(numeric: NumericModel, at: str) -> Transparency:
    """Return the transparency at a device, by default of the first peer with a device."""
    names = device_labels(numeric)
    at = at or (names[0].partition(".")[0] if names else "")
    return transparency(numeric, FREQUENCIES, at=at, alongside=())


def _passive(numeric: NumericModel) -> AbsoluteStability:
    """Return the verdict with all passive hands; imported here, as rarely required."""
    from apc.haptics.absolute_stability import absolute_stability

    return absolute_stability(numeric)


def _notes(schemes: Sequence[Scheme]) -> tuple[str, ...]:
    """Return notes on differences between the models other than their couplings."""
    peers = dict.fromkeys(scheme.peers for scheme in schemes)
    frames = dict.fromkeys(scheme.analysis.frame_s for scheme in schemes if scheme.analysis is not None)
    decided = dict.fromkeys(scheme.network is None for scheme in schemes if scheme.analysis is not None)
    notes = {
        f"the numbers of peers differ: {', '.join(f'{peer:,}' for peer in peers)}": len(peers) > 1,
        "the frames differ, so spectral radii are per different times: "
        f"{', '.join(f'{frame * 1e3:.6g} ms' for frame in frames)}": len(frames) > 1,
        "some verdicts are mean-square, others are for the nominal network": len(decided) > 1,
    }
    return tuple(text for text, applies in notes.items() if applies)
