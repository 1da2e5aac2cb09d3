"""Further results for packet losses, as data.

Takes: nothing. Gives: `ConsecutiveLosses`, `LossCertificate`, `TopLyapunovExponent`.
Guarantees: nothing beyond their fields.
Does not: compute them (see `extensions.loss_models`).
"""

from __future__ import annotations

from dataclasses import dataclass

from apc.verdict import Term


class LossCertificate(Term):
    """The proof that consecutive losses are harmless."""

    SMALL_GAIN = "small gain"
    COMMON_FUNCTION = "common quadratic function"


@dataclass(frozen=True, slots=True)
class ConsecutiveLosses:
    """The effect of consecutive losses on stability.

    `certified` consecutive losses are proved harmless for every pattern, chosen separately on every channel;
    None if no number is certified; `certificate` is the proof. `unstable_pattern` is a period of a
    destabilizing pattern, frame by frame (True: all packets of the frame get lost), `growth` its growth
    factor per frame, proved above 1; both are None if no such pattern was found. `note` has remarks, or the
    reason for a missing result.
    """

    certified: int | None
    unstable_pattern: tuple[bool, ...] | None
    growth: float | None
    note: str
    certificate: LossCertificate | None = None


@dataclass(frozen=True, slots=True)
class TopLyapunovExponent:
    """The exponent per frame (log of the growth), and its 95 % confidence interval."""

    exponent: float
    interval: tuple[float, float]
