"""What a recording of packets amounts to, and the keys of a link that say so.

Takes: recorded delays. Gives: `LinkFit`, `describe`, `describe_delays`, `Share`, `Law`.
Guarantees: a share has an interval that holds its probability in 95 of 100 recordings (Clopper and Pearson
1934), whatever that is; what a link's keys can't say of the recording stands in `left_out`.
Does not: judge a scene (see `moments`).

Losses are netem's simple `gemodel`: lost in the bad state, never in the good one, so that p is the share of
arrived packets that a lost one follows, and r that of lost ones which one that arrives follows; independent
losses have r = 1 − p. Of a jitter's distributions that one is taken which the recorded delays are least far
from (Kolmogorov and Smirnov's distance), with their median and quartiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import SourceLocation
from apc.compiler.language.probes import HALVED
from apc.compiler.language.recordings import read_trace
from apc.network.channel import LATEST, deviates
from apc.result import Result

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
# A dependence is said to be one where luck alone would show it less than once in a thousand recordings.
CHANCE = 1e-3
# Times the root of their number: how far packets drawn from a distribution are from it once in a thousand
# times.
MISFIT = 1.95
# The shares of packets whose delay is told, each only if this many packets are later.
QUANTILES = (0.5, 0.95, 0.99, 0.999)
LATER = 5
QUARTILES = (0.25, 0.5, 0.75)
# Points at which the distribution of a jitter is put together: an error of its distance of 1/POINTS.
POINTS = 1 << 14


NO_END = "no burst of losses ended within the recording: how long they last is not known"


@dataclass(frozen=True, slots=True)
class Share:
    """A share of `of` packets, and the `interval` that its probability lies in."""

    count: int
    of: int
    interval: tuple[float, float]

    @property
    def value(self) -> float:
        """The share, 0 of none."""
        return self.count / self.of if self.of else 0.0


@dataclass(frozen=True, slots=True)
class Law:
    """The keys of a link, in seconds: `delay`, `jitter` (0 if there is none) and its `distribution`.

    `distance` is the largest difference between the shares of packets that it and the recording have below a
    delay.
    """

    delay: float
    jitter: float
    distribution: str
    distance: float


@dataclass(frozen=True, slots=True, eq=False)
class LinkFit(Result):
    """What a recording amounts to; times in seconds.

    `lost`, `turns_bad` (a lost packet follows one that arrived) and `turns_good` are shares; `bursty` says
    whether losses follow losses more than luck explains, `bursts` and `longest_burst` count them. `quantiles`
    has pairs of a share of packets and the delay that it does not exceed; `correlation` is that of the delays
    of neighbours (NaN if there are too few), `overtaken` how many packets arrived after one sent later, None
    where the interval is not known; `delays` (n,) are all, infinite for a lost packet.
    """

    shown_by: ClassVar[str] = "network_output:recording"

    file: str
    program: str
    packets: int
    interval: float
    left_out: tuple[str, ...]
    lost: Share
    turns_bad: Share
    turns_good: Share
    bursty: bool
    bursts: int
    longest_burst: int
    shortest: float
    mean: float
    longest: float
    deviation: float
    quantiles: tuple[tuple[float, float], ...]
    correlation: float
    overtaken: int | None
    law: Law | None
    delays: Floats


def describe(path: str | Path, interval: float | None = None) -> LinkFit:
    """Say what a recording of packets amounts to.

    Parameters
    ----------
    path
        A CSV file with a column `delay [ms]`, or what ping or `irtt client -o` wrote.
    interval
        What lies between two packets, in seconds, where the file doesn't say.

    Raises
    ------
    ApcError
        E701 to E703, as for a link's `trace`.
    """
    trace = read_trace(Path(path), SourceLocation(str(path)))
    between = trace.interval if interval is None else interval
    return describe_delays(trace.delays, str(path), program=trace.program, interval=between)


def describe_delays(delays: Floats, name: str, *, program: str = "", interval: float = math.nan) -> LinkFit:
    """Say what recorded delays amount to.

    Parameters
    ----------
    delays
        Of each packet (n,), in seconds, infinite for one that was lost.
    name, program
        What they are called, and the program that recorded round trips, if one did.
    interval
        What lies between two packets, in seconds, not a number where that isn't known.
    """
    gone = np.isinf(delays)
    arrived = delays[~gone]
    after, before = gone[1:], gone[:-1]
    turns_bad = _share(after & ~before, ~before)
    turns_good = _share(~after & before, before)
    lost = _share(gone, np.ones_like(gone))
    bursty = _follow(turns_bad, turns_good) and turns_good.count > 0
    correlation = _correlation(delays)
    law = _law(arrived)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], gone, [False]]))))[::2]
    return LinkFit(
        file=name,
        program=program,
        packets=len(delays),
        interval=interval,
        left_out=(
            *_left_out(program, len(delays), law, correlation, interval),
            *([NO_END] if gone.any() and before.any() and not turns_good.count else []),
        ),
        lost=lost,
        turns_bad=turns_bad,
        turns_good=turns_good,
        bursty=bursty,
        bursts=len(runs),
        longest_burst=int(runs.max(initial=0)),
        shortest=float(arrived.min(initial=math.inf)),
        mean=float(arrived.mean()) if len(arrived) else math.nan,
        longest=float(arrived.max(initial=-math.inf)),
        deviation=float(arrived.std(ddof=1)) if len(arrived) > 1 else math.nan,
        quantiles=tuple(
            (share, _quantile(arrived, share)) for share in QUANTILES if len(arrived) * (1 - share) >= LATER
        ),
        correlation=correlation,
        overtaken=None if math.isnan(interval) else _overtaken(delays, interval),
        law=law,
        delays=delays,
    )


def _left_out(
    program: str, packets: int, law: Law | None, correlation: float, between: float
) -> tuple[str, ...]:
    """Return what the keys of a link say nothing of, or take for granted."""
    remarks = [HALVED] if program else []
    if law is None:
        return (*remarks, "every packet was lost: nothing is known of delays")
    if correlation:
        remarks.append(
            f"delays follow one another (correlation {correlation:.2f} from packet to packet), and a jitter "
            "is drawn for each packet on its own; a trace has them as they were"
        )
    if law.distance > MISFIT / math.sqrt(packets):
        remarks.append(
            "delays are spread as none of the distributions that a jitter can have; a trace has them as they "
            "were"
        )
    if not math.isnan(between):
        remarks.append(
            f"a packet was recorded every {between * 1e3:.4g} ms: a link sends at its own clock, and a trace "
            "gives it a row a packet, whatever time lay between them"
        )
    return tuple(remarks)


def _share(these: NDArray[np.bool_], among: NDArray[np.bool_]) -> Share:
    """Return a share with its interval."""
    from scipy.stats import beta

    count, of = int(these.sum()), int(among.sum())
    rest = (1 - CONFIDENCE) / 2
    low = float(beta.ppf(rest, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(1 - rest, count + 1, of - count)) if count < of else 1.0
    return Share(count, of, (low, high))


def _follow(bad: Share, good: Share) -> bool:
    """Return whether losses follow losses more often than luck explains (Fisher's exact test)."""
    from scipy.stats import fisher_exact

    table = [[good.of - good.count, good.count], [bad.count, bad.of - bad.count]]
    return bool(fisher_exact(table, alternative="greater").pvalue < CHANCE)


def _correlation(delays: Floats) -> float:
    """Return the correlation of neighbours' delays; 0 where luck alone would show as much."""
    both = np.isfinite(delays[1:]) & np.isfinite(delays[:-1])
    first, second = delays[:-1][both], delays[1:][both]
    if len(first) < 10 or not first.std() or not second.std():
        return 0.0
    value = float(np.corrcoef(first, second)[0, 1])
    # Of independent numbers it has the standard deviation 1/√n; 3.3 of these are left once in a thousand.
    return value if abs(value) > 3.3 / math.sqrt(len(first)) else 0.0


def _quantile(arrived: Floats, share: float) -> float:
    return float(np.quantile(arrived, share, method="inverted_cdf"))


def _overtaken(delays: Floats, interval: float) -> int:
    """Return how many packets arrived after one that was sent later."""
    arrivals = np.arange(len(delays)) * interval + delays
    soonest_later = np.minimum.accumulate(arrivals[::-1])[::-1]
    return int(np.sum(np.isfinite(arrivals[:-1]) & (arrivals[:-1] > soonest_later[1:])))


def _law(arrived: Floats) -> Law | None:
    """Return the law of a jitter nearest to delays; None of none."""
    if not len(arrived):
        return None
    mean, deviation = float(arrived.mean()), float(arrived.std(ddof=1)) if len(arrived) > 1 else 0.0
    if deviation <= 1e-12 * mean:
        return Law(mean, 0.0, "uniform", 0.0)
    laws = []
    # All pairs that a normal number is drawn from, and the same number twice for the others.
    evenly = (np.arange(POINTS) + 0.5) / POINTS
    quartiles = [_quantile(arrived, share) for share in QUARTILES]
    for distribution in LATEST:
        unit = _unit(distribution, evenly)
        low, middle, high = (_quantile(unit, share) for share in QUARTILES)
        if quartiles[2] > quartiles[0]:  # which a few very late packets don't move
            jitter = (quartiles[2] - quartiles[0]) / (high - low)
            delay = quartiles[1] - jitter * middle
        else:
            jitter = deviation / float(unit.std())
            delay = mean - jitter * float(unit.mean())
        if delay >= 0:
            made = np.sort(np.maximum(delay + jitter * unit, 0.0))
            laws.append(Law(delay, jitter, distribution, _distance(np.sort(arrived), made)))
    return min(laws, key=lambda law: law.distance)


def _unit(distribution: str, evenly: Floats) -> Floats:
    """Return numbers spread as a distribution's are, rising or falling."""
    if distribution == "normal":
        from scipy.special import ndtri

        return np.asarray(ndtri(evenly), dtype=np.float64)
    return deviates(distribution, evenly, evenly)


def _distance(values: Floats, other: Floats) -> float:
    """Return Kolmogorov and Smirnov's distance of two sorted samples."""
    where = np.concatenate([values, other])
    shares = [np.searchsorted(sample, where, side="right") / len(sample) for sample in (values, other)]
    return float(np.abs(shares[0] - shares[1]).max())
