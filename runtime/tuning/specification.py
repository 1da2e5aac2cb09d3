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

from apc.analysis.parametric_frames import parse_range
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.frame.devices import FREE as FREE_HANDS
from apc.frame.devices import with_hands
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, Range, find, given_ranges, overlap, proposed_range
from apc.network.nominal_criterion import unreliable
from apc.option_value import option_value
from apc.parameter_studies.count_range import count_range
from apc.parameter_studies.delay_interval_proof import is_delay
from apc.parameter_studies.evaluator import reaches_count
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE, criterion_of, refuse_time

LOCATION = SourceLocation("tune")
FREE, CONSTRAINT, OVER, TRADEOFF = (
    SourceLocation(f"--{text}") for text in ("free", "constraint", "over", "tradeoff")
)

# The demand that a delay may change from packet to packet.
CHANGING = "delay=changing"

# Objectives of minimization other than a gain.
RADIUS, SETTLING = "spectral_radius", "settling_time"

# Transparency metrics with a frequency of their own: that of the maximum.
HINF = "coordination_error_hinf"

# Transparency metrics by name: the unit, and whether the metric is taken at a frequency.
# `coordination_error_h2` is the rms at the ticks of a copy's error for white forces of 1 N rms at all hands,
# `coordination_error_hinf` the largest gain from any forces, which add up to 0 over equal peers, to how far a
# copy is from the mean of all.
TRANSPARENCY = {
    "impedance": ("N*s/m", True),
    "transmitted_velocity": ("m/s/N", True),
    "coordination_error": ("m/N", True),
    "damping": ("N*s/m", False),
    "coordination_error_h2": ("m/N", False),
    HINF: ("m/N", False),
}
_METRICS = ", ".join(f"{name}{' at 5 Hz' if at else ''}" for name, (_, at) in TRANSPARENCY.items())

# Former names, for a message.
FORMER = {
    "feel.impedance": "impedance",
    "feel.transmitted": "transmitted_velocity",
    "feel.error": "coordination_error",
    "feel.error_h2": "coordination_error_h2",
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
    """A transparency metric: `name` in `TRANSPARENCY`, frequency (NaN for none); in a demand, its limit
    `most`.
    """

    name: str
    frequency_hz: float
    most: float = math.inf

    @property
    def label(self) -> str:
        """The name in a demand."""
        at = f" at {self.frequency_hz:.6g} Hz" if TRANSPARENCY[self.name][1] else ""
        return f"{self.name}{at}"


@dataclass(frozen=True, slots=True)
class Objective:
    """The objective: a `column` to maximize or minimize; None is the decay rate of the slowest mode.

    It is reported as spectral radius or as settling time (2 %), with the same optimal gains. Columns are the
    gains and, with `terms`, a level that bounds their weighted sum in all scenarios: (weight, index of a gain
    or a transparency metric), in SI. `level` is the search range of the level, `scale` its magnitude.
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

    `counts` is a range of numbers of peers; `delay` a range of a link's constant delays; `box` are ranges of
    other parameters. `decay` is the required decay factor per second, 1 for stability only.
    `transparency_metrics` are the limits of transparency metrics. `criterion` is one of those of
    `parameter_studies.stability_criteria`. `changing` demands stability, too, where the delay changes from
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
        """All that is chosen: the gains, and the level of an aim that has one."""
        return (*self.free, *((self.objective.level,) if self.objective.level else ()))

    @property
    def measured(self) -> tuple[TransparencyMetric, ...]:
        """All transparency metrics in use: the demands, then the terms of the objective."""
        return (
            *self.transparency_metrics,
            *(metric for _, metric in self.objective.terms if isinstance(metric, TransparencyMetric)),
        )

    def at_frequency(self, frequency_hz: float) -> TuningSpec:
        """Return the specification with maxima over frequency replaced by values at one frequency."""

        def there(metric: TransparencyMetric) -> TransparencyMetric:
            return replace(metric, frequency_hz=frequency_hz) if metric.name == HINF else metric

        terms = tuple(
            (
                weight,
                there(metric) if isinstance(metric, TransparencyMetric) else metric,
            )
            for weight, metric in self.objective.terms
        )
        return replace(
            self,
            transparency_metrics=tuple(map(there, self.transparency_metrics)),
            objective=replace(self.objective, terms=terms),
        )

    @property
    def over(self) -> tuple[Range, ...]:
        """All ranges of the scenarios."""
        return (*self.counts, *((self.delay,) if self.delay else ()), *self.box)


def read_tuning_spec(
    system: Model,
    free: Sequence[str] = (),
    *,
    maximize: str = "",
    minimize: str = "",
    constraint: Sequence[str] = (),
    over: Sequence[str] = (),
    criterion: str | None = None,
) -> TuningSpec:
    """Read a specification; omitted items are those of the topology's `studies: tune:`.

    Parameters
    ----------
    system
        The model.
    free
        The gains: `NAME=LOW:HIGH` each.
    maximize, minimize
        One of the two, the objective: a gain, `spectral_radius`, `settling_time`, a transparency metric such
        as `coordination_error at 1 Hz`, or a weighted sum of these in SI, `damping -
        0.01*coordination.stiffness`.
    constraint
        Demands in addition to stability: `decay=60 dB in 2 s`, `impedance at 5 Hz < 20 N*s/m`,
        `delay=changing`.
    over
        The ranges of the scenarios: `user.count=2:10`, `device.mass=±20%`, `lan.delay=8 ms:20 ms`.
    criterion
        The stability criterion, one of `parameter_studies.stability_criteria` or None.

    Raises
    ------
    ApcError
        E995 nothing is free, or a time or number of peers is; E996 an unknown objective or demand; E842, and
        those of `parametric_frames.parse_range`: an invalid range; E831 a number with two ranges.
    """
    free, constraint, over = (
        given or [text for word, text in system.tune if word == key]
        for key, given in (("free", free), ("subject", constraint), ("over", over))
    )
    if not (maximize or minimize):
        maximize, minimize = (dict(system.tune).get(key, "") for key in ("maximize", "minimize"))
    if not free:
        raise ApcError(
            Diagnostic(
                "E995",
                FREE,
                "no number is free: which may be chosen?",
                hint=f'--free "{proposed_range(system, maximize or minimize)}"',
            )
        )
    gains = [_range(system, text, FREE) for text in free]
    for gain in gains:
        if reaches_count(system, gain.free) or is_delay(system, gain.free):
            message = f"{gain.free.label} is no gain that can be chosen by degrees"
            raise ApcError(Diagnostic("E995", FREE, message, hint=f"--over {gain.free.label}=…"))
    required = given_ranges(system, [_range(system, text, OVER) for text in over])
    for index, gain in enumerate((*gains, *required)):
        if any(overlap(system, other.free, gain.free) for other in (*gains, *required)[:index]):
            raise ApcError(Diagnostic("E831", LOCATION, f"{gain.free.label} has two ranges"))
    delays = [interval for interval in required if is_delay(system, interval.free)]
    if len(delays) > 1:
        names = " and ".join(delay.free.label for delay in delays)
        raise ApcError(Diagnostic("E831", OVER, f"one delay has a range, not more: {names}"))
    counts = tuple(interval for interval in required if reaches_count(system, interval.free))
    box = tuple(interval for interval in required if interval not in counts and interval not in delays)
    chosen = criterion_of(system, criterion, LOCATION, [interval.free for interval in (*gains, *box)])
    if chosen == NOMINAL and unreliable(system):
        message = "gains are chosen for the network as it is, which loses or delays packets"
        raise ApcError(Diagnostic("E996", LOCATION, message, hint=f"{MEAN_SQUARE}, or another topology"))
    if chosen == PASSIVE:
        for gain in (*gains, *box):
            refuse_time(system, gain.free, LOCATION, chosen)
    for text in constraint:
        _refuse_former(text, CONSTRAINT)
    metrics = tuple(_transparency_metric(text) for text in constraint if _names_metric(text))
    changing = [text for text in constraint if "".join(text.split()) == CHANGING]
    decays = [text for text in constraint if text not in changing and not _names_metric(text)]
    decay = min(map(_decay, decays), default=1.0)
    best = _objective(gains, maximize, minimize)
    if chosen == PASSIVE and (decay < 1 or best.column is None):
        requested = "a decay" if decay < 1 else best.label
        message = (
            f"{requested} and --hands passive don't go together: what hands can draw has no modes that decay"
        )
        raise ApcError(
            Diagnostic("E930", CONSTRAINT if decay < 1 else LOCATION, message, hint="--hands clamped")
        )
    delay = delays[0] if delays else None
    if changing and (delay is None or chosen != NOMINAL):
        message = f"{CHANGING} is of a link's delay with a range, and of the criterion {NOMINAL}"
        hint = next((f'--over "{link.delay}=8 ms:20 ms"' for link in system.links), "")
        raise ApcError(Diagnostic("E996", CONSTRAINT, message, hint=hint if delay is None else ""))
    return TuningSpec(tuple(gains), best, counts, delay, box, decay, metrics, chosen, bool(changing))


def gripped_as_studied(system: Model) -> tuple[Model, str | None]:
    """Return the model with hands as in `studies: tune:`, and the criterion; None for the default one."""
    hands = dict(system.tune).get("hands", FREE_HANDS)
    return (system, PASSIVE) if hands == PASSIVE else (with_hands(system, hands), None)


def read_seconds(text: str) -> float:
    """Return the time limit of a search, infinite if none is given."""
    if not text:
        return math.inf
    number = option_value("--time", text, subject="a time", unit="s")
    if number <= 0:
        raise ApcError(Diagnostic("E996", SourceLocation("--time"), "a time", "more than 0 s", text[:80]))
    return float(number)


def _range(system: Model, text: str, location: SourceLocation) -> Range:
    """Read a range, also of a number of peers; errors are located at the option."""
    name = text.partition("=")[0].strip()
    try:
        free = find(system, name, location, counts=True) if name else None
        if free is not None and reaches_count(system, free):
            return _counted(system, free, text, location)
        return parse_range(system, text)
    except ApcError as error:
        raise ApcError(replace(mistake, location=location) for mistake in error.mistakes) from None


def _counted(system: Model, free: ParameterRef, text: str, location: SourceLocation) -> Range:
    ends = [part.strip() for part in text.partition("=")[2].split(":")]
    if len(ends) != 2 or not all(ends):
        got = text[:80]
        raise ApcError(
            Diagnostic("E830", location, "numbers of peers", "NAME=LOW:HIGH", got, f"{free.label}=2:10")
        )
    constraints = [option_value(location.file, end, subject=free.label, unit="1") for end in ends]
    low, high = count_range(system, free, constraints, float(constraints[0]), location)
    if low < 1:
        message, hint = f"the range of {free.label}", f"{free.label}=2:{max(high, 2)}"
        raise ApcError(Diagnostic("E842", location, message, "1 peer or more", f"{low}", hint))
    if low > high:
        message, got = f"the range of {free.label}", f"{low} to {high}"
        raise ApcError(
            Diagnostic("E842", location, message, "the lower number first", got, f"{free.label}={high}:{low}")
        )
    try:
        apply(system, [Override(free, Fraction(low))])
    except ApcError as error:  # too few for the dependent parameters
        raise ApcError(replace(mistake, location=location) for mistake in error.mistakes) from None
    return Range(free, "1", Fraction(low), Fraction(high))


def _objective(gains: Sequence[Range], maximize: str, minimize: str) -> Objective:
    """Return the objective."""
    if bool(maximize) == bool(minimize):
        message = "--maximize and --minimize both say what is best" if maximize else "nothing is to be best"
        raise ApcError(Diagnostic("E996", LOCATION, message, hint=f"--maximize {gains[0].free.label}"))
    text, larger = (maximize or minimize).strip(), bool(maximize)
    names = [gain.free.label for gain in gains]
    if text in names:
        return Objective(text, names.index(text), larger, gains[names.index(text)].unit)
    if text in (RADIUS, SETTLING) and not larger:
        return Objective(text, None, larger, "1")
    option = SourceLocation("--maximize" if larger else "--minimize")
    _refuse_former(text, option)
    terms = []
    for sign, weight, name in _TERM.findall(text if text.startswith(("+", "-")) else f"+ {text}"):
        if spaced := _UNSPACED.search(name):
            separation = re.sub(r"\s*([+-])\s*", " \\1 ", text)
            hint = f'{option.file} "{separation}"'
            raise ApcError(
                Diagnostic("E996", option, f"{spaced[0]}: a sum has spaces around + and -", hint=hint)
            )
        if not 0 < float(weight or 1) < math.inf:
            raise ApcError(Diagnostic("E996", option, "a weight", "a number above 0", weight[:40]))
        if name not in names and not _names_metric(name):
            message = f"{option.file} {text[:60] or 'nothing'}"
            others = "" if larger else f", {RADIUS} or {SETTLING}"
            expected = f"a free number ({', '.join(names)}), {_METRICS}, a weighted sum of them{others}"
            hint = f"{option.file} {nearest(name, names) or names[0]}"
            raise ApcError(Diagnostic("E996", option, message, expected, hint=hint))
        local = names.index(name) if name in names else _measure(name, option)
        terms.append((float(f"{sign}{weight or 1}"), local))
    unit = "1"
    if len(terms) == 1 and terms[0][0] == 1 and isinstance(terms[0][1], TransparencyMetric):
        unit = TRANSPARENCY[terms[0][1].name][0]
    return Objective(text, len(gains), larger, unit, tuple(terms))


def _names_metric(text: str) -> bool:
    """Whether a text begins with the name of a metric, or with a former one."""
    name = re.split(r"[\s<=]", text.strip(), maxsplit=1)[0]
    return name in TRANSPARENCY or name.startswith("feel.")


def _refuse_former(text: str, location: SourceLocation) -> None:
    """Refuse a former name of a metric in a text. Raises ApcError E996 with the text in present names."""
    written = re.findall(r"\bfeel\.\w+", text)
    named = [name for name in written if name in FORMER]
    if named:
        present = re.sub(r"\bfeel\.\w+", lambda name: FORMER.get(name[0], name[0]), text.strip())
        if present in TRANSPARENCY and TRANSPARENCY[present][1]:
            present += " at 5 Hz"
        message = f"{named[0]} is named {FORMER[named[0]]} now"
        raise ApcError(Diagnostic("E996", location, message, hint=f'{location.file} "{present}"'))


def _measure(text: str, location: SourceLocation, wants: str = "") -> TransparencyMetric:
    """Read `impedance at 5 Hz`, or `damping`."""
    name, at, frequency = (item.strip() for item in text.strip().partition(" at "))
    if name not in TRANSPARENCY or bool(at) != TRANSPARENCY[name][1]:
        example = f'{location.file} "impedance at 5 Hz{wants}"'
        expected = f"one of {_METRICS}"
        raise ApcError(Diagnostic("E996", location, "what is felt", expected, text[:80], example))
    if not at:
        return TransparencyMetric(name, math.nan)
    hertz = _part(frequency, "a frequency", "Hz", f"{name} at 5 Hz{wants}", location)
    if hertz <= 0:
        raise ApcError(Diagnostic("E996", location, "a frequency", "more than 0 Hz", text[:80]))
    return TransparencyMetric(name, float(hertz))


def _decay(text: str) -> float:
    """Read `decay=60 dB in 2 s`; return the factor of a second."""
    name, _, value = (item.strip() for item in text.partition("="))
    size, within, time = (text.strip() for text in value.partition(" in "))
    if name != "decay" or not (within and size.lower().endswith("db")):
        wants = f"decay=… dB in …, {CHANGING}, or a bound < … on one of {_METRICS}"
        raise ApcError(Diagnostic("E996", CONSTRAINT, "a demand", wants, text[:80], '"decay=60 dB in 2 s"'))
    decibels = _part(size[:-2].strip(), "decibels", "1", "decay=60 dB in 2 s", CONSTRAINT)
    seconds = _part(time, "a time", "s", "decay=60 dB in 2 s", CONSTRAINT)
    if not (decibels > 0 and seconds > 0):
        raise ApcError(
            Diagnostic("E996", CONSTRAINT, "a decay", "more than 0 dB in more than 0 s", value[:80])
        )
    return float(10 ** (-decibels / 20 / seconds))


def _transparency_metric(text: str) -> TransparencyMetric:
    """Read `impedance at 5 Hz < 20 N*s/m`, of a topology `impedance at 5 Hz=< 20 N*s/m`."""
    named, less, most = (item.strip() for item in text.replace("=<", "<").replace("= <", "<").partition("<"))
    metric = _measure(named if less else text, CONSTRAINT, " < 20 N*s/m")
    unit = TRANSPARENCY[metric.name][0]
    limit = _part(most, metric.label, unit, f"{metric.label} < 20 {unit}", CONSTRAINT)
    if limit <= 0:
        raise ApcError(
            Diagnostic("E996", CONSTRAINT, "a demand on what is felt", "a number above 0", text[:80])
        )
    return replace(metric, most=float(limit))


def read_tradeoff(text: str) -> TransparencyMetric:
    """Read the second metric of a Pareto front, `impedance at 5 Hz`."""
    _refuse_former(text, TRADEOFF)
    return _measure(text, TRADEOFF)


def _part(text: str, subject: str, unit: str, example: str, location: SourceLocation) -> Fraction:
    """Read a quantity within a demand, of which an example is the line to write."""
    try:
        return option_value(location.file, text, subject=subject, unit=unit)
    except ApcError as error:
        raise ApcError(
            replace(mistake, hint=f'{location.file} "{example}"') for mistake in error.mistakes
        ) from None
