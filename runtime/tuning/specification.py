"""The tuning specification: free gains, objective, and demands to be met in all scenarios.

Takes: a `Model` and texts such as `coordination.stiffness=10 N/m:5000 N/m`.
Gives: `Objective`, `TransparencyMetric`, `TuningSpec`, `read_tuning_spec`, `read_tradeoff`,
`gripped_as_studied`, `read_seconds`; `LOCATION`, `RADIUS`, `SETTLING`, `HINF`.
Guarantees: an invalid specification is refused before any computation.
Does not: compute.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.lifting.devices import FREE as FREE_HANDS
from apc.lifting.devices import with_hands
from apc.network.nominal_criterion import unreliable
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import (
    ParameterRef,
    Range,
    find,
    given_ranges,
    overlap,
    proposed_range,
    proposed_range_of,
)
from apc.studies.count_range import count_range
from apc.studies.evaluator import reaches_count
from apc.studies.parameter_ranges import parse_range, pasted
from apc.studies.representative_delays import is_delay
from apc.studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    PASSIVE,
    criterion_of,
    refuse_timing_parameter,
)
from apc.support.extension_table import require_extension
from apc.support.option_value import NamedValues, Values, named_values, option_value, text_of

LOCATION = SourceLocation("tune")
FREE, CONSTRAINT, OVER, TRADEOFF = (
    SourceLocation(f"--{text}") for text in ("free", "constraint", "over", "tradeoff")
)

# The demand of stability with a delay that changes from packet to packet.
CHANGING = "delay=changing"

# Objectives to minimize other than a gain or metric.
RADIUS, SETTLING = "spectral_radius", "settling_time"

# The transparency metric that is a maximum over frequency.
# The relative improvement that counts as irrelevant.
OPTIMALITY_GAP = Fraction(2, 100)

H2, HINF = "coordination_error_h2", "coordination_error_hinf"

# Transparency metrics by name: the unit, and whether the metric is evaluated at a frequency.
# `coordination_error_h2` is the rms of a copy's error at the ticks for white forces of 1 N rms at all hands,
# `coordination_error_hinf` the largest gain from arbitrary forces with sum 0 over equal peers to the distance
# of a copy from the mean of all copies.
TRANSPARENCY = {
    "impedance": ("N*s/m", True),
    "transmitted_velocity": ("m/s/N", True),
    "coordination_error": ("m/N", True),
    "damping": ("N*s/m", False),
    H2: ("m/N", False),
    HINF: ("m/N", False),
}
_METRICS = ", ".join(f"{name}{' at 5 Hz' if at else ''}" for name, (_, at) in TRANSPARENCY.items())

# Former names, for a message.
FORMER = {
    "feel.impedance": "impedance",
    "feel.transmitted": "transmitted_velocity",
    "feel.error": "coordination_error",
    "feel.error_h2": H2,
    "feel.error_hinf": HINF,
    "feel.damping": "damping",
}

# A sign within a name, but not in an exponent.
_UNSPACED = re.compile(r"(?<![\d.])[a-z]\s*[+-]\s*[\d.a-z]")

# A term of a weighted sum: its sign, its weight if it has one, its name.
_TERM = re.compile(
    r"([+-])\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*\s*)?(.*?)\s*(?=\s[+-]\s|$)", re.ASCII
)


@dataclass(frozen=True, slots=True)
class TransparencyMetric:
    """A transparency metric by its `name` in `TRANSPARENCY`, its frequency, and its limit `most` in a demand.

    The frequency is NaN for a metric without one.
    """

    name: str
    frequency_hz: float
    most: float = math.inf

    @property
    def label(self) -> str:
        """The name of the metric as written in a demand."""
        at = f" at {self.frequency_hz:.6g} Hz" if TRANSPARENCY[self.name][1] else ""
        return f"{self.name}{at}"


@dataclass(frozen=True, slots=True)
class Objective:
    """The objective: the index of a `column` to maximize or minimize.

    A column of None is the decay rate of the slowest mode. The decay rate is reported as spectral radius or
    as settling time (2 %), with the same optimal gains. Columns are the gains and, with `terms`, a level that
    bounds their weighted sum in all scenarios: (weight, index of a gain or a transparency metric), in SI.
    `level` is the search range of the level, `scale` its magnitude.
    """

    label: str
    column: int | None
    maximize: bool
    unit: str
    terms: tuple[tuple[float, int | TransparencyMetric], ...] = ()
    level: Range | None = None
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class TuningSpec:
    """The tuning specification: free gains with ranges, objective, and demands.

    `counts` are ranges of numbers of peers; `delay` is a range of a link's constant delays; `box` are ranges
    of other parameters. `decay` is the required decay factor per second, 1 for stability only.
    `transparency_metrics` are the limits of transparency metrics. `criterion` is one of those of
    `studies.stability_criteria`. `changing` demands stability also for a delay that changes from
    packet to packet within its range.
    """

    free: tuple[Range, ...]
    objective: Objective
    counts: tuple[Range, ...]
    delay: Range | None
    box: tuple[Range, ...]
    decay: float
    transparency_metrics: tuple[TransparencyMetric, ...]
    criterion: str
    changing: bool = False

    @property
    def columns(self) -> tuple[Range, ...]:
        """The variables of the optimization: the gains, then the level of the objective, if it has one."""
        return (*self.free, *((self.objective.level,) if self.objective.level else ()))

    @property
    def measured(self) -> tuple[TransparencyMetric, ...]:
        """All transparency metrics in use: those of the demands, then those of the objective."""
        return (
            *self.transparency_metrics,
            *(metric for _, metric in self.objective.terms if isinstance(metric, TransparencyMetric)),
        )

    def at_frequency(self, frequency_hz: float) -> TuningSpec:
        """Return the specification with maxima over frequency replaced by values at one frequency."""

        def with_frequency(metric: TransparencyMetric) -> TransparencyMetric:
            """Return a metric with its maximum over frequency replaced by the value at the frequency."""
            return replace(metric, frequency_hz=frequency_hz) if metric.name == HINF else metric

        terms = tuple(
            (
                weight,
                with_frequency(metric) if isinstance(metric, TransparencyMetric) else metric,
            )
            for weight, metric in self.objective.terms
        )
        return replace(
            self,
            transparency_metrics=tuple(map(with_frequency, self.transparency_metrics)),
            objective=replace(self.objective, terms=terms),
        )

    @property
    def over(self) -> tuple[Range, ...]:
        """All ranges of the scenarios."""
        return (*self.counts, *((self.delay,) if self.delay else ()), *self.box)


def read_tuning_spec(
    model: Model,
    free: Sequence[str | NamedValues] = (),
    *,
    maximize: str = "",
    minimize: str = "",
    constraint: Sequence[str] = (),
    over: Sequence[str | NamedValues] = (),
    criterion: str | None = None,
) -> TuningSpec:
    """Return the specification from texts; omitted items are those of the topology's `studies: tune:`.

    Parameters
    ----------
    model
        The model.
    free
        The gains, each as `NAME=LOW:HIGH`.
    maximize, minimize
        The objective as one of the two: a gain, `spectral_radius`, `settling_time`, a transparency metric
        such as `coordination_error at 1 Hz`, or a weighted sum of these in SI, `damping -
        0.01*coordination.stiffness`.
    constraint
        Demands in addition to stability: `decay=60 dB in 2 s`, `impedance at 5 Hz < 20 N*s/m`,
        `delay=changing`.
    over
        The ranges of the scenarios: `user.count=2:10`, `device.mass=±20%`, `lan.delay=8 ms:20 ms`.
    criterion
        The stability criterion, one of `studies.stability_criteria` or None.

    Raises
    ------
    ApcError
        E995 no free parameter, or a free time or number of peers; E996 an unknown objective or demand; E842,
        and the errors of `parameter_ranges.parse_range`: an invalid range; E831 a parameter with two ranges.
    """
    by_study = {key: [text for word, text in model.tune if word == key] for key, _ in model.tune}
    free, over = free or by_study.get("free", []), over or by_study.get("over", [])
    constraint = constraint or by_study.get("subject", [])
    if not (maximize or minimize):
        maximize, minimize = (dict(model.tune).get(key, "") for key in ("maximize", "minimize"))
    if not free:
        raise ApcError(
            Diagnostic(
                "E995",
                FREE,
                "no tunable parameter (--free)",
                fix=f'--free "{proposed_range(model, maximize or minimize)}"',
            )
        )
    gains = [_parse_gain(model, text) for text in free]
    scenario_ranges = given_ranges(model, [_parse_range(model, text, OVER) for text in over])
    for index, gain in enumerate((*gains, *scenario_ranges)):
        if any(overlap(model, earlier.free, gain.free) for earlier in (*gains, *scenario_ranges)[:index]):
            raise ApcError(Diagnostic("E831", LOCATION, f"{gain.free.label} has two ranges"))
    delays = [interval for interval in scenario_ranges if is_delay(model, interval.free)]
    if len(delays) > 1:
        names = " and ".join(delay.free.label for delay in delays)
        raise ApcError(Diagnostic("E831", OVER, f"only one delay can have a range, got {names}"))
    counts = tuple(interval for interval in scenario_ranges if reaches_count(model, interval.free))
    box = tuple(interval for interval in scenario_ranges if interval not in counts and interval not in delays)
    chosen_criterion = criterion_of(
        model, criterion, LOCATION, [interval.free for interval in (*gains, *box)]
    )
    if chosen_criterion == NOMINAL and unreliable(model):
        message = "the criterion of this topology is mean-square, as its network loses or delays packets"
        raise ApcError(Diagnostic("E996", LOCATION, message, fix=f"--criterion {MEAN_SQUARE}"))
    if chosen_criterion == PASSIVE:
        for gain in (*gains, *box):
            refuse_timing_parameter(model, gain.free, LOCATION, chosen_criterion)
    for text in constraint:
        _refuse_former(text, CONSTRAINT)
    metrics = tuple(_parse_limit(text) for text in constraint if _names_metric(text))
    changing = [text for text in constraint if "".join(text.split()) == CHANGING]
    decays = [text for text in constraint if text not in changing and not _names_metric(text)]
    decay = min(map(_parse_decay, decays), default=1.0)
    best = _objective(gains, maximize, minimize)
    if chosen_criterion == PASSIVE and (decay < 1 or best.column is None):
        requested = "a decay" if decay < 1 else best.label
        message = (
            f"{requested} and --hands passive can't be combined: the criterion of passive hands has no "
            "decaying modes"
        )
        raise ApcError(
            Diagnostic("E930", CONSTRAINT if decay < 1 else LOCATION, message, fix="--hands clamped")
        )
    delay = delays[0] if delays else None
    if changing:
        require_extension("loss_models")
    if changing and (delay is None or chosen_criterion != NOMINAL):
        message = f"{CHANGING} needs a link delay with a range and the criterion {NOMINAL}"
        fix = next((f'--over "{link.delay}=8 ms:20 ms"' for link in model.links), "")
        raise ApcError(Diagnostic("E996", CONSTRAINT, message, fix=fix if delay is None else ""))
    return TuningSpec(
        tuple(gains), best, counts, delay, box, decay, metrics, chosen_criterion, bool(changing)
    )


def gripped_as_studied(model: Model) -> tuple[Model, str | None]:
    """Return the model with the hands of `studies: tune:`, and the criterion.

    A criterion of None is the default criterion.
    """
    hands = dict(model.tune).get("hands", FREE_HANDS)
    return (model, PASSIVE) if hands == PASSIVE else (with_hands(model, hands), None)


def read_seconds(text: str) -> float:
    """Return the time limit of a search, infinite if none is given."""
    if not text:
        return math.inf
    number = option_value("--time", text, subject="time", unit="s")
    if number <= 0:
        raise ApcError(Diagnostic("E996", SourceLocation("--time"), "time", "more than 0 s", text[:80]))
    return float(number)


def _parse_gain(model: Model, given: str | NamedValues) -> Range:
    """Return the range of a gain; an error E995 for a delay or a number of peers."""
    name = named_values(given)[0]
    if name:
        parameter_ref = find(model, name, FREE, counts=True)
        is_count = reaches_count(model, parameter_ref)
        if is_count or is_delay(model, parameter_ref):
            message = f"{parameter_ref.label} can't be tuned continuously"
            proposed = f"{parameter_ref.label}=2:10" if is_count else proposed_range_of(model, parameter_ref)
            raise ApcError(Diagnostic("E995", FREE, message, fix=pasted(OVER, proposed)))
    return _parse_range(model, given, FREE)


def _parse_range(model: Model, given: str | NamedValues, location: SourceLocation) -> Range:
    """Return a range of a parameter or of a number of peers; errors are located at the option."""
    name, values = named_values(given)
    parameter_ref = find(model, name, location, counts=True) if name else None
    if parameter_ref is not None and reaches_count(model, parameter_ref):
        return _count_range(model, parameter_ref, values, location)
    return parse_range(model, given, location)


def _count_range(
    model: Model, parameter_ref: ParameterRef, values: Values, location: SourceLocation
) -> Range:
    """Return a range of numbers of peers from its values; an error E830 or E842 for an invalid range."""
    ends = [part.strip() for part in values.split(":")] if isinstance(values, str) else list(values)
    if len(ends) != 2 or "" in ends:
        subject = f"range of {parameter_ref.label}"
        got = ":".join(text_of(end, "1") for end in ends)[:80] or "nothing"
        fix = pasted(location, f"{parameter_ref.label}=2:10")
        raise ApcError(Diagnostic("E830", location, subject, "LOW:HIGH", got, fix))
    end_values = [option_value(location.file, end, subject=parameter_ref.label, unit="1") for end in ends]
    low, high = count_range(model, parameter_ref, end_values, float(end_values[0]), location)
    if low < 1:
        message, fix = f"range of {parameter_ref.label}", f"{parameter_ref.label}=2:{max(high, 2)}"
        raise ApcError(Diagnostic("E842", location, message, "1 peer or more", f"{low}", fix))
    if low > high:
        message, got = f"range of {parameter_ref.label}", f"{low} to {high}"
        raise ApcError(
            Diagnostic(
                "E842", location, message, "the lower end first", got, f"{parameter_ref.label}={high}:{low}"
            )
        )
    try:
        apply(model, [Override(parameter_ref, Fraction(low))])
    except ApcError as error:  # too few for the dependent parameters
        raise ApcError(replace(mistake, location=location) for mistake in error.mistakes) from None
    return Range(parameter_ref, "1", Fraction(low), Fraction(high))


def _objective(gains: Sequence[Range], maximize: str, minimize: str) -> Objective:
    """Return the objective of one of two texts; an error E996 for an invalid one."""
    if bool(maximize) == bool(minimize):
        message = (
            "--maximize and --minimize are both given"
            if maximize
            else "no objective (--maximize or --minimize)"
        )
        raise ApcError(Diagnostic("E996", LOCATION, message, fix=f"--maximize {gains[0].free.label}"))
    text, is_maximized = (maximize or minimize).strip(), bool(maximize)
    names = [gain.free.label for gain in gains]
    if text in names:
        return Objective(text, names.index(text), is_maximized, gains[names.index(text)].unit)
    if text in (RADIUS, SETTLING) and not is_maximized:
        return Objective(text, None, is_maximized, "1")
    option = SourceLocation("--maximize" if is_maximized else "--minimize")
    _refuse_former(text, option)
    terms = []
    for sign, weight, name in _TERM.findall(text if text.startswith(("+", "-")) else f"+ {text}"):
        if spaced := _UNSPACED.search(name):
            separation = re.sub(r"\s*([+-])\s*", " \\1 ", text)
            fix = f'{option.file} "{separation}"'
            raise ApcError(
                Diagnostic("E996", option, f"{spaced[0]}: a sum needs spaces around + and -", fix=fix)
            )
        if not 0 < float(weight or 1) < math.inf:
            raise ApcError(Diagnostic("E996", option, "weight", "a number above 0", weight[:40]))
        if name not in names and not _names_metric(name):
            message = f"{option.file} {text[:60] or 'nothing'}"
            others = "" if is_maximized else f", {RADIUS} or {SETTLING}"
            expected = (
                f"a parameter of --free ({', '.join(names)}), {_METRICS}, a weighted sum of them{others}"
            )
            fix = f"{option.file} {nearest(name, names) or names[0]}"
            raise ApcError(Diagnostic("E996", option, message, expected, fix=fix))
        term = names.index(name) if name in names else _parse_metric(name, option)
        terms.append((float(f"{sign}{weight or 1}"), term))
    unit = "1"
    if len(terms) == 1 and terms[0][0] == 1 and isinstance(terms[0][1], TransparencyMetric):
        unit = TRANSPARENCY[terms[0][1].name][0]
    return Objective(text, len(gains), is_maximized, unit, tuple(terms))


def _names_metric(text: str) -> bool:
    """Return whether a text begins with the name of a metric, or with a former name."""
    name = re.split(r"[\s<=]", text.strip(), maxsplit=1)[0]
    return name in TRANSPARENCY or name.startswith("feel.")


def _refuse_former(text: str, location: SourceLocation) -> None:
    """Raise ApcError E996 for a former name of a metric in a text, with the text in present names."""
    former_style = re.findall(r"\bfeel\.\w+", text)
    named = [name for name in former_style if name in FORMER]
    if named:
        present = re.sub(r"\bfeel\.\w+", lambda name: FORMER.get(name[0], name[0]), text.strip())
        if present in TRANSPARENCY and TRANSPARENCY[present][1]:
            present += " at 5 Hz"
        message = f"the present name of {named[0]} is {FORMER[named[0]]}"
        raise ApcError(Diagnostic("E996", location, message, fix=f'{location.file} "{present}"'))


def _parse_metric(text: str, location: SourceLocation, wants: str = "") -> TransparencyMetric:
    """Return the transparency metric of a text such as `impedance at 5 Hz` or `damping`."""
    name, at, frequency = (part_text.strip() for part_text in text.strip().partition(" at "))
    if name not in TRANSPARENCY or bool(at) != TRANSPARENCY[name][1]:
        example = f'{location.file} "impedance at 5 Hz{wants}"'
        expected = f"one of {_METRICS}"
        raise ApcError(Diagnostic("E996", location, "metric", expected, text[:80], example))
    if name in (H2, HINF):
        require_extension("system_norms")
    if not at:
        return TransparencyMetric(name, math.nan)
    hertz = _quantity_of(frequency, "frequency", "Hz", f"{name} at 5 Hz{wants}", location)
    if hertz <= 0:
        raise ApcError(Diagnostic("E996", location, "frequency", "more than 0 Hz", text[:80]))
    return TransparencyMetric(name, float(hertz))


def _parse_decay(text: str) -> float:
    """Return the decay factor per second of a text such as `decay=60 dB in 2 s`."""
    name, _, value = (part_text.strip() for part_text in text.partition("="))
    size, within, time = (part_text.strip() for part_text in value.partition(" in "))
    if name != "decay" or not (within and size.lower().endswith("db")):
        wants = f"decay=… dB in … s, {CHANGING}, or an upper bound (<) of one of {_METRICS}"
        raise ApcError(Diagnostic("E996", CONSTRAINT, "constraint", wants, text[:80], '"decay=60 dB in 2 s"'))
    decibels = _quantity_of(size[:-2].strip(), "decibels", "1", "decay=60 dB in 2 s", CONSTRAINT)
    seconds = _quantity_of(time, "time", "s", "decay=60 dB in 2 s", CONSTRAINT)
    if not (decibels > 0 and seconds > 0):
        raise ApcError(Diagnostic("E996", CONSTRAINT, "decay", "more than 0 dB in more than 0 s", value[:80]))
    return float(10 ** (-decibels / 20 / seconds))


def _parse_limit(text: str) -> TransparencyMetric:
    """Return the limit of a metric from a text such as `impedance at 5 Hz < 20 N*s/m`.

    In a topology the text is `impedance at 5 Hz=< 20 N*s/m`.
    """
    metric_text, separator, limit_text = (
        part_text.strip() for part_text in text.replace("=<", "<").replace("= <", "<").partition("<")
    )
    metric = _parse_metric(metric_text if separator else text, CONSTRAINT, " < 20 N*s/m")
    unit = TRANSPARENCY[metric.name][0]
    limit = _quantity_of(limit_text, metric.label, unit, f"{metric.label} < 20 {unit}", CONSTRAINT)
    if limit <= 0:
        raise ApcError(Diagnostic("E996", CONSTRAINT, "bound of a metric", "a number above 0", text[:80]))
    return replace(metric, most=float(limit))


def read_tradeoff(text: str) -> TransparencyMetric:
    """Return the second metric of a Pareto front from a text such as `impedance at 5 Hz`."""
    _refuse_former(text, TRADEOFF)
    return _parse_metric(text, TRADEOFF)


def _quantity_of(text: str, subject: str, unit: str, example: str, location: SourceLocation) -> Fraction:
    """Return a quantity within a demand; an error has a complete example of the demand as its fix."""
    try:
        return option_value(location.file, text, subject=subject, unit=unit)
    except ApcError as error:
        raise ApcError(
            replace(mistake, fix=f'{location.file} "{example}"') for mistake in error.mistakes
        ) from None
