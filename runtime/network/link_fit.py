"""Statistics of a packet recording and the link parameters fitted to it.

Takes: recorded delays. Gives: `LinkFit`, `fit_recording`, `fit_delays`, `Share`, `Law`.
Guarantees: a share has a 95 % confidence interval (Clopper and Pearson 1934). `limitations` lists the
properties of the recording that the link's keys cannot represent.
Does not: analyze the stability of a model (see `mean_square`).

Losses are netem's simple `gemodel`: all packets are lost in the bad state, none in the good state. Hence p is
the probability of a loss after an arrival, and r that of an arrival after a loss; independent losses have r =
1 − p. The jitter distribution selected has the smallest Kolmogorov-Smirnov distance to the recorded delays,
with their median and quartiles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import SourceLocation
from apc.compiler.files import FileReader, InputFile
from apc.compiler.language.ping_recordings import HALVED
from apc.compiler.language.recordings import read_trace
from apc.network.channel import LATEST, deviates
from apc.result import Result

Floats = NDArray[np.float64]

CONFIDENCE = 0.95  # of the intervals of a recording
# Losses are reported as dependent if independent losses would show the same dependence in less than one
# recording in a thousand.
CHANCE = 1e-3
# A Kolmogorov-Smirnov distance, times the square root of the number of packets, that packets of the same
# distribution exceed once in a thousand recordings.
MISFIT = 1.95
# The shares of packets for which a delay quantile is reported; each requires this many later packets.
QUANTILES = (0.5, 0.95, 0.99, 0.999)
LATER = 5
QUARTILES = (0.25, 0.5, 0.75)
# The number of samples of a jitter's distribution: the error of its distance is 1/POINTS.
POINTS = 1 << 14


NO_END = "no loss burst ended within the recording; the burst length is unknown"


@dataclass(frozen=True, slots=True)
class Share:
    """The share `count` of `of` packets, and the confidence `interval` of its probability."""

    count: int
    of: int
    interval: tuple[float, float]

    @property
    def value(self) -> float:
        """The share, 0 if there are no packets."""
        return self.count / self.of if self.of else 0.0


@dataclass(frozen=True, slots=True)
class Law:
    """The fitted delay and jitter of a link, in seconds: `delay`, `jitter` (0 without) and its
    `distribution`.

    `distance` is the Kolmogorov-Smirnov distance between the distribution and the recorded delays.
    """

    delay: float
    jitter: float
    distribution: str
    distance: float


@dataclass(frozen=True, slots=True, eq=False)
class LinkFit(Result):
    """Statistics of a packet recording; times in seconds.

    `lost`, `p` (a lost packet after one that arrived) and `r` (the reverse) are shares; `bursty` states
    whether losses cluster significantly, `bursts` and `longest_burst` count them. `quantiles` has pairs
    (share of packets, delay not exceeded); `correlation` is the lag-one autocorrelation of the delays (NaN
    with too few packets). `reordered` is the number of reordered packets, None with an unknown interval;
    `delays` (n,) are the recorded delays, infinite for a lost packet.
    """

    shown_by: ClassVar[str] = "network_output:recording"

    file: str
    program: str
    packets: int
    interval: float
    limitations: tuple[str, ...]
    lost: Share
    p: Share
    r: Share
    bursty: bool
    bursts: int
    longest_burst: int
    shortest: float
    mean: float
    longest: float
    std: float
    quantiles: tuple[tuple[float, float], ...]
    correlation: float
    reordered: int | None
    distribution: Law | None
    delays: Floats


def fit_recording(path: str | Path, interval: float | None = None) -> LinkFit:
    """Return the statistics of a packet recording read from a file.

    Parameters
    ----------
    path
        A CSV file with a column `delay [ms]`, or the output of ping or `irtt client -o`.
    interval
        The sending interval in seconds, used if the file does not contain it.

    Raises
    ------
    ApcError
        E701 to E703, as for a link's `trace`.
    """
    trace = read_trace(InputFile(Path(path), FileReader()), SourceLocation(str(path)))
    sending_interval = trace.interval if interval is None else interval
    return fit_delays(trace.delays, str(path), program=trace.program, interval=sending_interval)


def fit_delays(delays: Floats, name: str, *, program: str = "", interval: float = math.nan) -> LinkFit:
    """Return the statistics of recorded delays.

    Parameters
    ----------
    delays
        The delay of each packet (n,) in seconds, infinite for a lost packet.
    name, program
        The name of the recording, and the program that recorded round trips, if any.
    interval
        The sending interval in seconds, NaN if unknown.
    """
    is_lost = np.isinf(delays)
    arrived = delays[~is_lost]
    after, before = is_lost[1:], is_lost[:-1]
    p = _share_of(after & ~before, ~before)
    r = _share_of(~after & before, before)
    lost = _share_of(is_lost, np.ones_like(is_lost))
    bursty = _is_bursty(p, r) and r.count > 0
    correlation = _correlation(delays)
    fitted = _fitted_law(arrived)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], is_lost, [False]]))))[::2]
    return LinkFit(
        file=name,
        program=program,
        packets=len(delays),
        interval=interval,
        limitations=(
            *_limitations(program, len(delays), fitted, correlation, interval),
            *([NO_END] if is_lost.any() and before.any() and not r.count else []),
        ),
        lost=lost,
        p=p,
        r=r,
        bursty=bursty,
        bursts=len(runs),
        longest_burst=int(runs.max(initial=0)),
        shortest=float(arrived.min(initial=math.inf)),
        mean=float(arrived.mean()) if len(arrived) else math.nan,
        longest=float(arrived.max(initial=-math.inf)),
        std=float(arrived.std(ddof=1)) if len(arrived) > 1 else math.nan,
        quantiles=tuple(
            (share, _quantile(arrived, share)) for share in QUANTILES if len(arrived) * (1 - share) >= LATER
        ),
        correlation=correlation,
        reordered=None if math.isnan(interval) else _reordered_count(delays, interval),
        distribution=fitted,
        delays=delays,
    )


def _limitations(
    program: str, packets: int, law: Law | None, correlation: float, between: float
) -> tuple[str, ...]:
    """Return remarks on properties of the recording that the link's keys omit or assume."""
    remarks = [HALVED] if program else []
    if law is None:
        return (*remarks, "every packet was lost, so the delays are unknown")
    if correlation:
        remarks.append(
            f"consecutive delays are correlated (coefficient {correlation:.2f}); jitter draws independent "
            "delays, a trace reproduces the recorded ones"
        )
    if law.distance > MISFIT / math.sqrt(packets):
        remarks.append(
            "the delays fit none of the distributions of jitter; a trace reproduces the recorded ones"
        )
    if not math.isnan(between):
        remarks.append(
            f"packets were recorded every {between * 1e3:.4g} ms; a trace has one row for each packet, at "
            "any clock period of the link"
        )
    return tuple(remarks)


def _share_of(selected: NDArray[np.bool_], among: NDArray[np.bool_]) -> Share:
    """Return the share of packets with a property among some packets, with its confidence interval."""
    from scipy.stats import beta

    count, total = int(selected.sum()), int(among.sum())
    tail = (1 - CONFIDENCE) / 2
    low = float(beta.ppf(tail, count, total - count + 1)) if count else 0.0
    high = float(beta.ppf(1 - tail, count + 1, total - count)) if count < total else 1.0
    return Share(count, total, (low, high))


def _is_bursty(bad: Share, good: Share) -> bool:
    """Return whether losses cluster significantly (Fisher's exact test)."""
    from scipy.stats import fisher_exact

    table = [[good.of - good.count, good.count], [bad.count, bad.of - bad.count]]
    return bool(fisher_exact(table, alternative="greater").pvalue < CHANCE)


def _correlation(delays: Floats) -> float:
    """Return the correlation of consecutive delays; 0 if it is not significant."""
    both_arrived = np.isfinite(delays[1:]) & np.isfinite(delays[:-1])
    first, second = delays[:-1][both_arrived], delays[1:][both_arrived]
    if len(first) < 10 or not first.std() or not second.std():
        return 0.0
    value = float(np.corrcoef(first, second)[0, 1])
    # The correlation of independent numbers has the standard deviation 1/√n, and exceeds 3.3/√n once in 1000.
    return value if abs(value) > 3.3 / math.sqrt(len(first)) else 0.0


def _quantile(arrived: Floats, share: float) -> float:
    """Return the smallest delay that a share of packets does not exceed."""
    return float(np.quantile(arrived, share, method="inverted_cdf"))


def _reordered_count(delays: Floats, interval: float) -> int:
    """Return the number of packets that arrived after a packet sent later."""
    arrivals = np.arange(len(delays)) * interval + delays
    soonest_later = np.minimum.accumulate(arrivals[::-1])[::-1]
    return int(np.sum(np.isfinite(arrivals[:-1]) & (arrivals[:-1] > soonest_later[1:])))


def _fitted_law(arrived: Floats) -> Law | None:
    """Return the jitter law nearest to recorded delays; None without delays."""
    if not len(arrived):
        return None
    mean, deviation = float(arrived.mean()), float(arrived.std(ddof=1)) if len(arrived) > 1 else 0.0
    if deviation <= 1e-12 * mean:
        return Law(mean, 0.0, "uniform", 0.0)
    laws = []
    # Evenly spaced uniform numbers, from which each distribution is computed.
    uniforms = (np.arange(POINTS) + 0.5) / POINTS
    quartiles = [_quantile(arrived, share) for share in QUARTILES]
    for distribution in LATEST:
        unit = _unit_samples(distribution, uniforms)
        low, middle, high = (_quantile(unit, share) for share in QUARTILES)
        if quartiles[2] > quartiles[0]:  # robust against a few very late packets
            jitter = (quartiles[2] - quartiles[0]) / (high - low)
            delay = quartiles[1] - jitter * middle
        else:
            jitter = deviation / float(unit.std())
            delay = mean - jitter * float(unit.mean())
        if delay >= 0:
            samples = np.sort(np.maximum(delay + jitter * unit, 0.0))
            laws.append(Law(delay, jitter, distribution, _distance(np.sort(arrived), samples)))
    return min(laws, key=lambda law: law.distance)


def _unit_samples(distribution: str, uniforms: Floats) -> Floats:
    """Return samples of a distribution with unit jitter, from evenly spaced uniform numbers."""
    if distribution == "normal":
        from scipy.special import ndtri

        return np.asarray(ndtri(uniforms), dtype=np.float64)
    return deviates(distribution, uniforms, uniforms)


def _distance(values: Floats, other_values: Floats) -> float:
    """Return the Kolmogorov-Smirnov distance of two sorted samples."""
    points = np.concatenate([values, other_values])
    shares = [
        np.searchsorted(sample, points, side="right") / len(sample) for sample in (values, other_values)
    ]
    return float(np.abs(shares[0] - shares[1]).max())
