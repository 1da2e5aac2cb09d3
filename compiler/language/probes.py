"""What people measure networks with: the output of ping, and of irtt, as delays of packets.

Takes: a text. Gives: `Probe`, `read_probe`; None for a text that is neither.
Guarantees: a packet has one delay, in the order of sending, and one that isn't told of is lost. Both know
round trips only (irtt knows more if two clocks agree, which nothing shows): half of one stands for one way,
and says so.
Does not: tell text of the file, which may be somebody's.

ping is that of iputils, BusyBox, BSD and macOS (`icmp_seq=7 … time=12.3 ms`, the word for time in whatever
language), which counts packets, or of Windows in English (`bytes=32 time=12ms TTL=57`), which doesn't; irtt
is what `irtt client -o FILE` writes.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HALVED = (
    "round trips were recorded: half of each stands for one way, as if both took as long, and a packet "
    "lost on either way counts as lost"
)
_COUNTED = re.compile(r"\b(?:icmp_)?seq[= ](?P<count>\d{1,18})")
_TOOK = re.compile(r"\w[=<] ?(?P<time>\d{1,15}(?:[.,]\d+)?) ?(?P<unit>ms|us|s|мс|ミリ秒|毫秒|밀리초)(?!\w)")
_ANSWERED = re.compile(r"\bttl=\d", re.IGNORECASE)
_STAMP = re.compile(r"\[(?P<stamp>\d+\.\d+)\] ")
_WINDOWS = re.compile(r"\bbytes=\d+ time[=<](?P<time>\d+)ms TTL=")
_WINDOWS_LOST = re.compile(r"(?:Request timed out|Destination (?:host|net) unreachable|General failure)\.")
# Of any language: sent, received, per cent lost, and with iputils how long it took.
_SUMMARY = re.compile(r"^(?P<sent>\d{1,18}) [^\d,]+, \d+ .*%[^\d]*(?:, [^\d,]+ (?P<time>\d{1,18}) ?\w+)?$")
_WRAPS = 1 << 16  # a packet's number has 16 bits
_SECONDS = {"us": 1e-6, "s": 1.0}  # any other unit is a word for milliseconds
# Of numbers that leave a gap: what one line may claim to be lost.
_LONGEST_GAP = 1 << 15


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Packets sent at a fixed interval, as a `program` saw them.

    `delays` (n,) in seconds, infinite for a packet that was lost; `interval` in seconds, not a number where
    it isn't told.
    """

    program: str
    delays: NDArray[np.float64]
    interval: float


def read_probe(text: str) -> Probe | None:
    """Read what ping or irtt wrote; None if a text is of neither, or has no packet."""
    if text.lstrip()[:1] == "{":
        return _irtt(text)
    lines = text.splitlines()
    return _ping(lines) or _windows_ping(lines)


def _irtt(text: str) -> Probe | None:
    try:
        written = json.loads(text)
        trips = {int(item["seqno"]): _round_trip(item) for item in written["round_trips"]}
        interval = float(written["config"]["params"]["interval"]) * 1e-9
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if (
        not trips
        or min(trips) < 0
        or max(trips) - len(trips) > _LONGEST_GAP
        or any(map(math.isnan, trips.values()))
    ):
        return None
    return Probe("irtt", _in_order(trips, 0, max(trips)), interval)


def _round_trip(item: dict[str, Any]) -> float:
    """Return a round trip of irtt in seconds, less what the server took for it; infinite if it was lost."""
    if item["lost"] is not False and item["lost"] != "false":
        return math.inf
    took = float(item["delay"]["rtt"]) * 1e-9
    return took if took >= 0 else math.nan


def _ping(lines: Iterable[str]) -> Probe | None:
    trips: dict[int, float] = {}
    stamps: list[tuple[int, float]] = []
    sent = total = 0
    turns, last, untimed = 0, 0, False
    for line in lines:
        counted = _COUNTED.search(line)
        if counted is None:
            if (summary := _SUMMARY.search(line)) is not None:
                sent, total = int(summary["sent"]), int(summary["time"] or 0)
            continue
        number = int(counted["count"]) + turns * _WRAPS
        if trips and number < last - _WRAPS // 2:  # the count of packets has begun again
            turns, number = turns + 1, number + _WRAPS
        if abs(number - last) > _LONGEST_GAP:
            return None
        last = max(last, number)
        took = _TOOK.search(line)
        if took is None:
            trips.setdefault(number, math.inf)  # no answer yet: one may come
            untimed |= _ANSWERED.search(line) is not None
        elif math.isinf(trips.get(number, math.inf)):  # and not the second of two answers
            trips[number] = float(took["time"].replace(",", ".")) * _SECONDS.get(took["unit"], 1e-3)
            if (stamp := _STAMP.match(line)) is not None:
                stamps.append((number, float(stamp["stamp"]) - trips[number]))
    # Answers whose time can't be read, as of packets too small for ping to time them, are no losses.
    if not trips or (untimed and not np.isfinite(list(trips.values())).any()):
        return None
    first = min(1, *trips)
    final = max(*trips, first + sent - 1 if sent - len(trips) <= _LONGEST_GAP else 0)
    if len(stamps) > 1 and stamps[-1][0] > stamps[0][0]:
        interval = (stamps[-1][1] - stamps[0][1]) / (stamps[-1][0] - stamps[0][0])
    else:
        interval = total * 1e-3 / (sent - 1) if sent > 1 and total else math.nan
    return Probe("ping", _in_order(trips, first, final), interval)


def _windows_ping(lines: Iterable[str]) -> Probe | None:
    """Read a ping that doesn't count: every line of a packet is the next one."""
    trips = []
    for line in lines:
        if (took := _WINDOWS.search(line)) is not None:
            trips.append(float(took["time"]) * 1e-3)
        elif _WINDOWS_LOST.search(line):
            trips.append(math.inf)
    return Probe("ping", np.array(trips) / 2, math.nan) if np.isfinite(trips).any() else None


def _in_order(trips: dict[int, float], first: int, last: int) -> NDArray[np.float64]:
    """Return half of each round trip, by number; infinite where there is none."""
    delays = np.full(last - first + 1, math.inf)
    delays[np.array(list(trips)) - first] = np.array(list(trips.values())) / 2
    return delays
