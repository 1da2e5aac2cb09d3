"""Recordings by ping and irtt as delays of packets.

Takes: a text. Gives: `Probe`, `read_probe`; None for a text that is neither.
Guarantees: one delay a packet, in the order of sending; a packet without an answer is lost. The result agrees
with the statistics at the end of the recording, or the recording is refused. Both programs record round trips
only (one-way delays of irtt need two equal clocks): half of each is the delay, and a remark states it.
Does not: quote the file, which may be private.

ping is that of iputils in any of its languages, of BusyBox, Toybox, BSD and macOS (`icmp_seq=7 … time=12.3
ms`), which number packets, or of Windows in any language, which has one line a packet between its heading and
a blank line; irtt is the file of `irtt client -o FILE`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.source.reading import fault

HALVED = (
    "round trips were recorded: half of each stands for one way, as if both took as long, and a packet "
    "lost on either way counts as lost"
)
LATEST_DELAY = 1e9  # seconds: a longer one is no packet's, and its square would leave the range of floats
_LINE_END = re.compile("\r\n|\n|\r")
# Spaces are those of any language: French has no-break ones before a unit. U+FFFD is one in a code page.
_MS = "ms|мс|ミリ秒|毫秒|밀리초|მწმ|mts"
_TIME = rf"[=<][\s\ufffd]?(?P<time>\d{{1,15}}(?:[.,]\d{{1,15}})?)[\s\ufffd]?(?P<unit>{_MS}|us|µs|s)(?!\w)"
_TOOK = re.compile(rf"\w\s?{_TIME}")
_NUMBER = re.compile(r"\b(?:icmp?_s(?:eq|ql)|seq|pořadí)\s?[= ]\s?(?P<number>\d{1,18})(?!\d)")
_ANSWERED = re.compile(r"\b(?:ttl|hlim)\s?=\s?\d", re.IGNORECASE)
_DUPLICATE = re.compile(r"\([^()\d]*[!！]\)|DUP")  # the second of two answers
_STAMP = re.compile(r"\[(?P<stamp>\d{1,15}\.\d{1,15})\] ")
_HEADING = re.compile(r"(?:PING6?|ПІНГ)[ (]|Ping \S+ \(\S+\):")
_FROM_ZERO = re.compile(
    r"PING6?\b.*(?:: (?:\d+|\(.*\)) data bytes| --> )"
)  # these programs begin to count at 0
# A run that was stopped within a line, and the heading of the next one behind it.
_CUT_HEADING = re.compile(r".+?PING6? \S+ \(\S+\).*\d+(?:\(\d+\))? (?:data )?bytes")
_TCPING = re.compile(r"Probing \S+:\d+/tcp")
_PARTS = re.compile(r"[,，](?!\d)")
_TOTAL = re.compile(rf"(?<![\d.,-])(?P<total>\d{{1,15}})\s?(?:{_MS})\W*\Z")
_WINDOWS = re.compile(rf"\w\s?{_TIME}(?:\s*TTL=\d+)?\s*\Z")
_WINDOWS_STATISTICS = re.compile(r"\s.*?" + r"=\s?(\d{1,9})(?=[\s,，、(]|\Z)[^=]*" * 3)
_WRAPS = 1 << 16  # a packet's number has 16 bits
_SECONDS = {"us": 1e-6, "µs": 1e-6, "s": 1.0}  # any other unit is a word for milliseconds
# Of numbers that leave a gap: what one line may claim to be lost.
_LONGEST_GAP = 1 << 15
# A step of the clock further from the usual one, in usual steps, is that of a clock that was set.
_STEADY = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Packets sent at a fixed interval, recorded by a `program`.

    `delays` (n,) in seconds, infinite for a packet that was lost; `interval` in seconds, above 0, NaN where
    it is not known.
    """

    program: str
    delays: NDArray[np.float64]
    interval: float


def read_probe(text: str, file: str = "") -> Probe | None:
    """Return the packets recorded by ping or irtt; None of another text, or one without packets.

    Raises
    ------
    ApcError
        E704 the recording holds two runs, an answer without a readable time, or other numbers of packets than
        its statistics.
    """
    if text.lstrip()[:1] == "{":
        return _irtt(text, SourceLocation(file))
    lines = _LINE_END.split(text)
    return _ping(lines, file) or _windows_ping(lines, file)


def _irtt(text: str, location: SourceLocation) -> Probe | None:
    try:
        written = json.loads(text)
        trips = {int(item["seqno"]): _round_trip(item) for item in written["round_trips"]}
        interval = float(written["config"]["params"]["interval"]) * 1e-9
        statistics = written.get("stats") or {}
        expected = {
            name: float(statistics[key]) - float(statistics.get(less, 0))
            for name, key, less in (
                ("packets", "packets_sent", ""),
                ("answers", "packets_received", "duplicates"),
            )
            if key in statistics
        }
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError):
        return None
    if (
        not trips
        or min(trips) < 0
        or max(trips) - len(trips) > _LONGEST_GAP
        or any(map(math.isnan, trips.values()))
    ):
        return None
    counted = {"packets": len(written["round_trips"]), "answers": _answers(trips)}
    for name, number in expected.items():
        if number != counted[name]:
            raise _disagreement(name, number, counted[name], location)
    delays = _in_order(trips, 0, max(trips))
    return Probe("irtt", delays, interval if 0 < interval <= LATEST_DELAY else math.nan)


def _round_trip(item: dict[str, Any]) -> float:
    """Return a round trip of irtt in seconds, less the time at the server; infinite if it was lost."""
    if item["lost"] is not False and item["lost"] != "false":
        return math.inf
    took = float(item["delay"]["rtt"]) * 1e-9
    return took if 0 <= took <= LATEST_DELAY else math.nan


def _ping(lines: Sequence[str], file: str) -> Probe | None:
    """Read a ping that numbers packets."""
    trips: dict[int, float] = {}
    stamps: list[tuple[int, float]] = []
    statistics: tuple[float, float, float] | None = None
    turns, last, first, headed = 0, 0, 1, False
    ended = SourceLocation(file)
    for at, line in enumerate(lines, start=1):
        counted = _NUMBER.search(line)
        if counted is not None and at == len(lines) and counted.end() == len(line):
            break  # the recording ends within a number
        if counted is None:
            if _CUT_HEADING.match(line):
                raise _second_run(SourceLocation(file, at, 1))
            if _HEADING.match(line):
                if headed or trips or statistics:
                    raise _second_run(SourceLocation(file, at, 1))
                headed, first = True, 0 if _FROM_ZERO.match(line) else 1
            elif not (headed or trips):
                continue  # no line of a ping yet
            elif (result := _statistics(line)) is not None:
                if statistics:
                    raise _second_run(SourceLocation(file, at, 1))
                statistics, ended = result, SourceLocation(file, at, 1)
            elif line.startswith("--") and statistics is None and _unread(lines[at : at + 1]):
                expected = "numbers of packets sent, received and lost"
                raise fault(
                    "E704", SourceLocation(file, at + 1, 1), "the statistics of a recording", expected
                )
            elif "TTL=" in line and _windows_answer(line):
                raise _second_run(SourceLocation(file, at, 1))
            continue
        if statistics:
            raise _second_run(SourceLocation(file, at, 1))
        number = int(counted["number"]) + turns * _WRAPS
        if trips and number < last - _WRAPS // 2:  # the count of packets has begun again
            turns, number = turns + 1, number + _WRAPS
        if abs(number - last) > _LONGEST_GAP:
            expected = f"at most {_LONGEST_GAP} away from the one before"
            raise fault("E704", SourceLocation(file, at, 1), "the number of a packet", expected)
        last = max(last, number)
        took = _TOOK.search(line)
        if took is None:
            if _ANSWERED.search(line):
                if at == len(lines):  # the recording ends within this line
                    break
                raise _untimed(SourceLocation(file, at, 1))
            trips.setdefault(number, math.inf)  # no answer yet: one may come
        elif math.isinf(trips.get(number, math.inf)):
            trips[number] = _seconds(took, file, at)
            if (stamp := _STAMP.match(line)) is not None:
                stamps.append((number, float(stamp["stamp"]) - trips[number]))
        elif number < last and not _DUPLICATE.search(line):
            raise _second_run(SourceLocation(file, at, 1))
    first = min(first, *trips) if trips else first
    final = max(trips, default=first - 1)
    total = math.nan
    if statistics is not None:
        sent, received, total = statistics
        if received != _answers(trips):
            raise _disagreement("answers", received, _answers(trips), ended)
        if not 0 <= sent - (final - first + 1) <= _LONGEST_GAP:
            raise _disagreement("packets", sent, final - first + 1, ended)
        final = first + int(sent) - 1
    if final < first:
        return None
    interval = _steady_step(stamps)
    if math.isnan(interval) and final > first and total > 0:
        interval = total / (final - first)
    return Probe("ping", _in_order(trips, first, final), interval)


def _statistics(line: str) -> tuple[float, float, float] | None:
    """Return packets sent and received, and the seconds it took (NaN if unknown), of a line of statistics.

    In any language these are the first two of its parts between commas, and a later one is a percentage.
    """
    parts = _PARTS.split(line)
    if len(parts) < 3 or "=" in line or not any("%" in part for part in parts[2:]):
        return None
    numbers = [re.findall(r"\d+", part) for part in parts[:2]]
    if [len(result) for result in numbers] != [1, 1]:
        return None
    total = _TOTAL.search(parts[-1])
    seconds = math.nan if total is None else float(total["total"]) * 1e-3
    return float(numbers[0][0]), float(numbers[1][0]), seconds


def _unread(following: Sequence[str]) -> bool:
    """Return whether the line below the heading of the statistics is not the statistics."""
    return any(line.strip() and _statistics(line) is None for line in following)


def _steady_step(stamps: Sequence[tuple[int, float]]) -> float:
    """Return the mean time between packets, without the steps of a clock that was set; NaN if unknown."""
    if len(stamps) < 2:
        return math.nan
    numbers, times = np.array(sorted(stamps)).T
    counts, spans = np.diff(numbers), np.diff(times)
    steps = spans / counts
    if not (steps > 0).any():
        return math.nan
    typical = float(np.quantile(steps[steps > 0], 0.5, method="inverted_cdf"))
    steady = np.abs(steps - typical) <= _STEADY * typical
    step = float(spans[steady].sum() / counts[steady].sum())
    return step if step > 0 else typical


def _windows_ping(lines: Sequence[str], file: str) -> Probe | None:
    """Read a ping without numbers: each line between its heading and a blank line is the next packet."""
    trips: list[float] = []
    statistics: tuple[int, ...] | None = None
    ended, repeated, replies = SourceLocation(file), None, 0
    headed = inside = False
    for at, line in enumerate(lines, start=1):
        if _TCPING.match(line):
            return None
        if inside and line[:1].isspace() and line.strip():
            continue  # routes and time stamps of the answer above
        if not line.strip() or line[0].isspace():
            if statistics is None and (result := _WINDOWS_STATISTICS.match(line)):
                statistics, ended = tuple(map(int, result.groups())), SourceLocation(file, at, 1)
            headed = headed and not line.strip()  # the heading of statistics has indented lines below it
            inside = False
        elif line.rstrip().endswith((":", "：")):
            headed, inside = True, False
        else:
            took = _windows_answer(line)
            if headed and trips:
                repeated = repeated or SourceLocation(file, at, 1)
            inside, headed = inside or headed or took is not None, False
            if took is not None:
                trips.append(_seconds(took, file, at))
            elif inside and (at < len(lines) or line.endswith((".", "。"))):  # not cut within this line
                if _ANSWERED.search(line):
                    raise _untimed(SourceLocation(file, at, 1))
                trips.append(math.inf)
                replies += ":" in line
    if not np.isfinite(trips).any() and (statistics is None or not trips):
        return None
    if repeated is not None:
        raise _second_run(repeated)
    if statistics is not None:
        sent, received, _ = statistics
        answers = int(np.isfinite(trips).sum())
        if sent != len(trips):
            raise _disagreement("packets", sent, len(trips), ended)
        # Windows counts a reply such as "Destination host unreachable" as received.
        if not answers <= received <= answers + replies:
            raise _disagreement("answers", received, answers, ended)
    return Probe("ping", np.array(trips) / 2, math.nan)


def _windows_answer(line: str) -> re.Match[str] | None:
    """Return the time in an answer, which follows the address and a colon."""
    return _WINDOWS.search(line) if ":" in line or "：" in line else None


def _seconds(took: re.Match[str], file: str, line: int) -> float:
    """Return the time of an answer in seconds. Raises ApcError of a time no packet takes."""
    seconds = float(took["time"].replace(",", ".")) * _SECONDS.get(took["unit"], 1e-3)
    if seconds > LATEST_DELAY:
        raise _untimed(SourceLocation(file, line, 1))
    return seconds


def _answers(trips: dict[int, float]) -> int:
    return sum(map(math.isfinite, trips.values()))


def _second_run(location: SourceLocation) -> ApcError:
    return fault("E704", location, "a recording", "one run of ping", "a second run from this line on")


def _untimed(location: SourceLocation) -> ApcError:
    expected = f"a round trip of at most {LATEST_DELAY:.0e} s, such as time=12.3 ms"
    return fault("E704", location, "an answer", expected)


def _disagreement(subject: str, expected: float, got: int, location: SourceLocation) -> ApcError:
    of_statistics = f"{expected:.12g}, as in its statistics"
    return fault("E704", location, f"the number of {subject} in a recording", of_statistics, str(got))


def _in_order(trips: dict[int, float], first: int, last: int) -> NDArray[np.float64]:
    """Return half of each round trip, by number; infinite where there is none."""
    delays = np.full(last - first + 1, math.inf)
    if trips:
        delays[np.array(list(trips)) - first] = np.array(list(trips.values())) / 2
    return delays
