"""What is asked of gains: which are free, what they are to do best, and all that they have to bear.

Takes: a `Model` and texts such as `coordination.stiffness=10 N/m:5000 N/m`.
Gives: `Objective`, `TransparencyMetric`, `TuningSpec`, `read_demands`, `read_against`, `held_as_studied`,
`read_seconds`; `PLACE`, `RADIUS`, `SETTLING`, `HINF`.
Guarantees: what can't be meant is refused before anything is computed.
Does not: compute.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.analysis.box import parse_range
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.frame.devices import FREE as FREE_HANDS
from apc.frame.devices import with_hands
from apc.frame.names import ParameterRef, Range, find, given_ranges, overlap, proposed_range
from apc.frame.overrides import Override, apply
from apc.network.nominal import unreliable
from apc.option_value import option_value
from apc.vary.counts import count_range
from apc.vary.delay_box import is_delay
from apc.vary.evaluator import reaches_count
from apc.vary.growth import MEAN_SQUARE, NOMINAL, PASSIVE, criterion_of, refuse_time

PLACE = SourceLocation("tune")
FREE, SUBJECT, OVER, AGAINST = (
    SourceLocation(f"--{text}") for text in ("free", "subject", "over", "against")
)

# The demand that a delay may change from packet to packet.
CHANGING = "delay=changing"

# What may be minimized beside a gain.
RADIUS, SETTLING = "spectral_radius", "settling_time"

# What is felt that has a frequency of its own: where it is largest.
HINF = "error_hinf"

# What hands feel, by its name in a demand: its unit, and whether it is at a frequency. `error_h2` is the rms
# at the ticks of a copy's error for white forces of 1 N rms at all hands, `error_hinf` the largest gain from
# any forces, which add up to 0 over equal peers, to how far a copy is from the mean of all.
FELT = {
    "impedance": ("N*s/m", True),
    "transmitted": ("m/s/N", True),
    "error": ("m/N", True),
    "damping": ("N*s/m", False),
    "error_h2": ("m/N", False),
    HINF: ("m/N", False),
}

# A sign that stands in a name, and in no exponent.
_UNSPACED = re.compile(r"(?<![\d.])[a-z]\s*[+-]\s*[\d.a-z]")

# A term of a weighted sum: its sign, its weight if it has one, its name.
_TERM = re.compile(
    r"([+-])\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*\s*)?(.*?)\s*(?=\s[+-]\s|$)", re.ASCII
)


@dataclass(frozen=True, slots=True)
class TransparencyMetric:
    """What a hand feels, by its `name` in `FELT`, at a frequency or (NaN) of all; of a demand its `most`."""

    name: str
    frequency_hz: float
    most: float = math.inf

    @property
    def label(self) -> str:
        """What it is called in a demand."""
        at = f" at {self.frequency_hz:.6g} Hz" if FELT[self.name][1] else ""
        return f"feel.{self.name}{at}"


@dataclass(frozen=True, slots=True)
class Objective:
    """What is to be best: the number in a `column`, large or not; None is how fast all motions die out.

    That is the spectral radius, or the time after which none is left but for 2 %: the same gains. Columns are
    the gains and, where there are `terms`, a level that the weighted sum of these is to stay on the good side
    of: (weight, the place of a gain or what is felt), in SI, with the largest value of all scenarios. `level`
    is the range it is looked for in, `scale` how large it is.
    """

    label: str
    column: int | None
    larger: bool
    unit: str
    terms: tuple[tuple[float, int | TransparencyMetric], ...] = ()
    level: Range | None = None
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class TuningSpec:
    """All that is asked: the free gains with their ranges, the aim, and what has to be borne.

    `counts` are numbers of peers, every one from the low end to the high one; `delay` is a link's, at every
    constant value; `box` are other numbers. `decay` is the factor by which motions have to die out in a
    second, 1 where it is enough that they do. `felt` is what hands may feel at most. `criterion` is one of
    those of `vary.growth`. `changing` demands stability, too, where the delay changes from packet to packet
    within its range.
    """

    free: tuple[Range, ...]
    aim: Objective
    counts: tuple[Range, ...]
    delay: Range | None
    box: tuple[Range, ...]
    decay: float
    felt: tuple[TransparencyMetric, ...]
    criterion: str
    changing: bool = False

    @property
    def columns(self) -> tuple[Range, ...]:
        """All that is chosen: the gains, and the level of an aim that has one."""
        return (*self.free, *((self.aim.level,) if self.aim.level else ()))

    @property
    def measured(self) -> tuple[TransparencyMetric, ...]:
        """All that has to be known of what hands feel: the demands, then the terms of the aim."""
        return (*self.felt, *(felt for _, felt in self.aim.terms if isinstance(felt, TransparencyMetric)))

    def at_frequency(self, frequency_hz: float) -> TuningSpec:
        """Return the same with what is largest over all frequencies at one of them."""

        def there(felt: TransparencyMetric) -> TransparencyMetric:
            return replace(felt, frequency_hz=frequency_hz) if felt.name == HINF else felt

        terms = tuple(
            (weight, there(felt) if isinstance(felt, TransparencyMetric) else felt)
            for weight, felt in self.aim.terms
        )
        return replace(self, felt=tuple(map(there, self.felt)), aim=replace(self.aim, terms=terms))

    @property
    def over(self) -> tuple[Range, ...]:
        """All that has to be borne."""
        return (*self.counts, *((self.delay,) if self.delay else ()), *self.box)


def read_demands(
    system: Model,
    free: Sequence[str] = (),
    *,
    maximize: str = "",
    minimize: str = "",
    subject: Sequence[str] = (),
    over: Sequence[str] = (),
    criterion: str | None = None,
) -> TuningSpec:
    """Read what is asked; what is left out is as the scene's `studies: tune:` says.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The gains: `NAME=LOW:HIGH` each.
    maximize, minimize
        One of them: what is to be best, a gain, `spectral_radius`, `settling_time`, what is felt such as
        `feel.error at 1 Hz`, or a weighted sum of these in SI, `feel.damping - 0.01*coordination.stiffness`.
    subject
        Demands in addition to stability: `decay=60 dB in 2 s`, `feel.impedance at 5 Hz < 20 N*s/m`,
        `delay=changing`.
    over
        What has to be borne: `user.count=2:10`, `device.mass=±20%`, `lan.delay=8 ms:20 ms`.
    criterion
        What stable means, one of `vary.growth` or None.

    Raises
    ------
    ApcError
        E995 nothing is free, or a time or number of peers is; E996 no such aim, or demand; E842, and those of
        `box.parse_range`: a range that is none; E831 a number with two ranges.
    """
    free, subject, over = (
        given or [text for word, text in system.tune if word == key]
        for key, given in (("free", free), ("subject", subject), ("over", over))
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
            what = f"{gain.free.label} is no gain that can be chosen by degrees"
            raise ApcError(Diagnostic("E995", FREE, what, hint=f"--over {gain.free.label}=…"))
    borne = given_ranges(system, [_range(system, text, OVER) for text in over])
    for place, gain in enumerate((*gains, *borne)):
        if any(overlap(system, other.free, gain.free) for other in (*gains, *borne)[:place]):
            raise ApcError(Diagnostic("E831", PLACE, f"{gain.free.label} has two ranges"))
    delays = [interval for interval in borne if is_delay(system, interval.free)]
    if len(delays) > 1:
        names = " and ".join(delay.free.label for delay in delays)
        raise ApcError(Diagnostic("E831", OVER, f"one delay has a range, not more: {names}"))
    counts = tuple(interval for interval in borne if reaches_count(system, interval.free))
    box = tuple(interval for interval in borne if interval not in counts and interval not in delays)
    chosen = criterion_of(system, criterion, PLACE, [interval.free for interval in (*gains, *box)])
    if chosen == NOMINAL and unreliable(system):
        what = "gains are chosen for the network as it is, which loses or delays packets"
        raise ApcError(Diagnostic("E996", PLACE, what, hint=f"{MEAN_SQUARE}, or another topology"))
    if chosen == PASSIVE:
        for gain in (*gains, *box):
            refuse_time(system, gain.free, PLACE, chosen)
    felt = tuple(_felt(text) for text in subject if text.strip().startswith("feel."))
    changing = [text for text in subject if "".join(text.split()) == CHANGING]
    decays = [text for text in subject if text not in changing and not text.strip().startswith("feel.")]
    decay = min(map(_decay, decays), default=1.0)
    best = _aim(gains, maximize, minimize)
    if chosen == PASSIVE and (decay < 1 or best.column is None):
        asked = "a decay" if decay < 1 else best.label
        what = f"{asked} and --hands passive don't go together: what hands can draw has no modes that decay"
        raise ApcError(Diagnostic("E930", SUBJECT if decay < 1 else PLACE, what, hint="--hands clamped"))
    delay = delays[0] if delays else None
    if changing and (delay is None or chosen != NOMINAL):
        what = f"{CHANGING} is of a link's delay with a range, and of the criterion {NOMINAL}"
        hint = next((f'--over "{link.delay}=8 ms:20 ms"' for link in system.links), "")
        raise ApcError(Diagnostic("E996", SUBJECT, what, hint=hint if delay is None else ""))
    return TuningSpec(tuple(gains), best, counts, delay, box, decay, felt, chosen, bool(changing))


def held_as_studied(system: Model) -> tuple[Model, str | None]:
    """Return a scene held as its `studies: tune:` says, and the criterion; None is the scene's own."""
    hands = dict(system.tune).get("hands", FREE_HANDS)
    return (system, PASSIVE) if hands == PASSIVE else (with_hands(system, hands), None)


def read_seconds(text: str) -> float:
    """Return how long a search may take, without end if nothing is said. Raises ApcError E996."""
    if not text:
        return math.inf
    number = option_value("--time", text, what="a time", unit="s")
    if number <= 0:
        raise ApcError(Diagnostic("E996", SourceLocation("--time"), "a time", "more than 0 s", text[:80]))
    return float(number)


def _range(system: Model, text: str, place: SourceLocation) -> Range:
    """Read a range, of a number of peers too, with what is wrong told at its option."""
    name = text.partition("=")[0].strip()
    try:
        free = find(system, name, place, counts=True) if name else None
        if free is not None and reaches_count(system, free):
            return _counted(system, free, text, place)
        return parse_range(system, text)
    except ApcError as error:
        raise ApcError(replace(mistake, place=place) for mistake in error.mistakes) from None


def _counted(system: Model, free: ParameterRef, text: str, place: SourceLocation) -> Range:
    ends = [part.strip() for part in text.partition("=")[2].split(":")]
    if len(ends) != 2 or not all(ends):
        got = text[:80]
        raise ApcError(
            Diagnostic("E830", place, "numbers of peers", "NAME=LOW:HIGH", got, f"{free.label}=2:10")
        )
    limits = [option_value(place.file, end, what=free.label, unit="1") for end in ends]
    low, high = count_range(system, free, limits, float(limits[0]), place)
    if low < 1:
        what, hint = f"the range of {free.label}", f"{free.label}=2:{max(high, 2)}"
        raise ApcError(Diagnostic("E842", place, what, "1 peer or more", f"{low}", hint))
    if low > high:
        what, got = f"the range of {free.label}", f"{low} to {high}"
        raise ApcError(
            Diagnostic("E842", place, what, "the lower number first", got, f"{free.label}={high}:{low}")
        )
    try:
        apply(system, [Override(free, Fraction(low))])
    except ApcError as error:  # too few for what follows the others
        raise ApcError(replace(mistake, place=place) for mistake in error.mistakes) from None
    return Range(free, "1", Fraction(low), Fraction(high))


def _aim(gains: Sequence[Range], maximize: str, minimize: str) -> Objective:
    """Return what is to be best."""
    if bool(maximize) == bool(minimize):
        what = "--maximize and --minimize both say what is best" if maximize else "nothing is to be best"
        raise ApcError(Diagnostic("E996", PLACE, what, hint=f"--maximize {gains[0].free.label}"))
    text, larger = (maximize or minimize).strip(), bool(maximize)
    names = [gain.free.label for gain in gains]
    if text in names:
        return Objective(text, names.index(text), larger, gains[names.index(text)].unit)
    if text in (RADIUS, SETTLING) and not larger:
        return Objective(text, None, larger, "1")
    option = SourceLocation("--maximize" if larger else "--minimize")
    terms = []
    for sign, weight, name in _TERM.findall(text if text.startswith(("+", "-")) else f"+ {text}"):
        if spaced := _UNSPACED.search(name):
            apart = re.sub(r"\s*([+-])\s*", " \\1 ", text)
            hint = f'{option.file} "{apart}"'
            raise ApcError(
                Diagnostic("E996", option, f"{spaced[0]}: a sum has spaces around + and -", hint=hint)
            )
        if not 0 < float(weight or 1) < math.inf:
            raise ApcError(Diagnostic("E996", option, "a weight", "a number above 0", weight[:40]))
        if name not in names and not name.startswith("feel."):
            what = f"{option.file} {text[:60] or 'nothing'}"
            others = "" if larger else f", {RADIUS} or {SETTLING}"
            expected = f"a free number ({', '.join(names)}), feel.…, a weighted sum of them{others}"
            hint = f"{option.file} {nearest(name, names) or names[0]}"
            raise ApcError(Diagnostic("E996", option, what, expected, hint=hint))
        own = names.index(name) if name in names else _measure(name, option)
        terms.append((float(f"{sign}{weight or 1}"), own))
    unit = "1"
    if len(terms) == 1 and terms[0][0] == 1 and isinstance(terms[0][1], TransparencyMetric):
        unit = FELT[terms[0][1].name][0]
    return Objective(text, len(gains), larger, unit, tuple(terms))


def _measure(text: str, place: SourceLocation, wants: str = "") -> TransparencyMetric:
    """Read `feel.impedance at 5 Hz`, or `feel.damping`."""
    name, at, frequency = (item.strip() for item in text.strip().removeprefix("feel.").partition(" at "))
    if name not in FELT or bool(at) != FELT[name][1]:
        names = ", ".join(f"feel.{text}{' at 5 Hz' if at else ''}" for text, (_, at) in FELT.items())
        example = f'{place.file} "feel.impedance at 5 Hz{wants}"'
        raise ApcError(Diagnostic("E996", place, "what is felt", f"one of {names}", text[:80], example))
    if not at:
        return TransparencyMetric(name, math.nan)
    hertz = _part(frequency, "a frequency", "Hz", f"feel.{name} at 5 Hz{wants}", place)
    if hertz <= 0:
        raise ApcError(Diagnostic("E996", place, "a frequency", "more than 0 Hz", text[:80]))
    return TransparencyMetric(name, float(hertz))


def _decay(text: str) -> float:
    """Read `decay=60 dB in 2 s`; return the factor of a second."""
    name, _, value = (item.strip() for item in text.partition("="))
    size, within, time = (text.strip() for text in value.partition(" in "))
    if name != "decay" or not (within and size.lower().endswith("db")):
        wants = f"decay=… dB in …, feel.… at … < … or {CHANGING}"
        raise ApcError(Diagnostic("E996", SUBJECT, "a demand", wants, text[:80], '"decay=60 dB in 2 s"'))
    decibels = _part(size[:-2].strip(), "decibels", "1", "decay=60 dB in 2 s", SUBJECT)
    seconds = _part(time, "a time", "s", "decay=60 dB in 2 s", SUBJECT)
    if not (decibels > 0 and seconds > 0):
        raise ApcError(Diagnostic("E996", SUBJECT, "a decay", "more than 0 dB in more than 0 s", value[:80]))
    return float(10 ** (-decibels / 20 / seconds))


def _felt(text: str) -> TransparencyMetric:
    """Read `feel.impedance at 5 Hz < 20 N*s/m`, of a topology `feel.impedance at 5 Hz=< 20 N*s/m`."""
    named, less, most = (item.strip() for item in text.replace("=<", "<").replace("= <", "<").partition("<"))
    felt = _measure(named if less else text, SUBJECT, " < 20 N*s/m")
    unit = FELT[felt.name][0]
    limit = _part(most, felt.label, unit, f"{felt.label} < 20 {unit}", SUBJECT)
    if limit <= 0:
        raise ApcError(Diagnostic("E996", SUBJECT, "a demand on what is felt", "a number above 0", text[:80]))
    return replace(felt, most=float(limit))


def read_against(text: str) -> TransparencyMetric:
    """Read what a gain is weighed against, `feel.impedance at 5 Hz`. Raises ApcError E996."""
    return _measure(text if text.strip().startswith("feel.") else f"feel.{text.strip()}", AGAINST)


def _part(text: str, what: str, unit: str, example: str, place: SourceLocation) -> Fraction:
    """Read a quantity within a demand, of which an example is the line to write."""
    try:
        return option_value(place.file, text, what=what, unit=unit)
    except ApcError as error:
        raise ApcError(
            replace(mistake, hint=f'{place.file} "{example}"') for mistake in error.mistakes
        ) from None
