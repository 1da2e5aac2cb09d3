"""Recordings of ping and irtt as delays of packets.

Takes: a text. Gives: `Probe`, `read_probe`; None for other texts.
Guarantees: one delay per packet, in the order of sending; a packet without an answer is lost. The result
agrees with the statistics at the end of the recording, or an error is raised. Both programs record round
trips only (one-way delays of irtt require synchronized clocks): half of each is the delay, and a remark
states this.
Does not: print text of the file, which may be private.

Supported are ping of iputils in all its languages, of BusyBox, Toybox, BSD and macOS (`icmp_seq=7 … time=12.3
ms`), which number packets, and of Windows in all languages, which prints one line per packet between a
heading and a blank line; and the files of `irtt client -o FILE`.
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
    "recorded round trips: half of each is used as the delay of one direction, and a packet lost in either "
    "direction counts as lost"
)
LATEST_DELAY = 1e9  # seconds: the square of a much longer delay would exceed the range of floats
_LINE_END = re.compile("\r\n|\n|\r")
# Spaces of all languages: French has no-break spaces before a unit, decoded from a code page as U+FFFD.
_MS = "ms|мс|ミリ秒|毫秒|밀리초|მწმ|mts"
_TIME = rf"[=<][\s\ufffd]?(?P<time>\d{{1,15}}(?:[.,]\d{{1,15}})?)[\s\ufffd]?(?P<unit>{_MS}|us|µs|s)(?!\w)"
_TOOK = re.compile(rf"\w\s?{_TIME}")
_NUMBER = re.compile(r"\b(?:icmp?_s(?:eq|ql)|seq|pořadí)\s?[= ]\s?(?P<number>\d{1,18})(?!\d)")
_ANSWERED = re.compile(r"\b(?:ttl|hlim)\s?=\s?\d", re.IGNORECASE)
_DUPLICATE = re.compile(r"\([^()\d]*[!！]\)|DUP")  # a second answer to the same packet
_STAMP = re.compile(r"\[(?P<stamp>\d{1,15}\.\d{1,15})\] ")
_HEADING = re.compile(r"(?:PING6?|ПІНГ)[ (]|Ping \S+ \(\S+\):")
_FROM_ZERO = re.compile(
    r"PING6?\b.*(?:: (?:\d+|\(.*\)) data bytes| --> )"
)  # programs that number packets from 0
# A run that ended within a line, followed by the heading of the next run.
_CUT_HEADING = re.compile(r".+?PING6? \S+ \(\S+\).*\d+(?:\(\d+\))? (?:data )?bytes")
_TCPING = re.compile(r"Probing \S+:\d+/tcp")
_PARTS = re.compile(r"[,，](?!\d)")
_TOTAL = re.compile(rf"(?<![\d.,-])(?P<total>\d{{1,15}})\s?(?:{_MS})\W*\Z")
_WINDOWS = re.compile(rf"\w\s?{_TIME}(?:\s*TTL=\d+)?\s*\Z")
_WINDOWS_STATISTICS = re.compile(r"\s.*?" + r"=\s?(\d{1,9})(?=[\s,，、(]|\Z)[^=]*" * 3)
_WRAPS = 1 << 16  # the number of a packet has 16 bits
_SECONDS = {"us": 1e-6, "µs": 1e-6, "s": 1.0}  # the other units are words for milliseconds
# The largest number of packets lost between two consecutive lines.
_LONGEST_GAP = 1 << 15
# A larger deviation of a time step from the median step, relative to it, is attributed to a clock adjustment.
_STEADY = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Packets sent at a fixed interval, recorded by a `program`.

    `delays` (n,) in seconds, infinite for a lost packet; `interval` > 0 in seconds, NaN if unknown.
    """

    program: str
    delays: NDArray[np.float64]
    interval: float


def read_probe(text: str, file: str = "") -> Probe | None:
    """Return the packets recorded by ping or irtt; None for another text, or one without packets.

    Raises
    ------
    ApcError
        E704 the recording has two runs, an answer without a readable time, or numbers of packets that differ
        from its statistics.
    """
    if text.lstrip()[:1] == "{":
        return _irtt(text, SourceLocation(file))
    lines = _LINE_END.split(text)
    return _ping(lines, file) or _windows_ping(lines, file)


def _irtt(text: str, location: SourceLocation) -> Probe | None:
    """Return the packets of a JSON file of irtt; None for other texts.

    Raises ApcError if its statistics differ.
    """
    try:
        document = json.loads(text)
        trips = {int(item["seqno"]): _round_trip(item) for item in document["round_trips"]}
        interval = float(document["config"]["params"]["interval"]) * 1e-9
        statistics = document.get("stats") or {}
        expected = {
            name: float(statistics[key]) - float(statistics.get(subtracted_key, 0))
            for name, key, subtracted_key in (
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
    counted = {"packets": len(document["round_trips"]), "answers": _answers(trips)}
    for name, number in expected.items():
        if number != counted[name]:
            raise _disagreement(name, number, counted[name], location)
    delays = _one_way_delays(trips, 0, max(trips))
    return Probe("irtt", delays, interval if 0 < interval <= LATEST_DELAY else math.nan)


def _round_trip(item: dict[str, Any]) -> float:
    """Return a round-trip time of irtt in seconds, without the time at the server.

    The result is infinite for a lost packet, NaN if it is invalid.
    """
    if item["lost"] is not False and item["lost"] != "false":
        return math.inf
    seconds = float(item["delay"]["rtt"]) * 1e-9
    return seconds if 0 <= seconds <= LATEST_DELAY else math.nan


def _ping(lines: Sequence[str], file: str) -> Probe | None:
    """Return the packets of a run of ping whose lines have packet numbers; None for other texts.

    `lines` are those of the recording, `file` its name for messages. Raises ApcError (E704) as `read_probe`.
    """
    round_trips: dict[int, float] = {}  # by packet number, in seconds; infinite without an answer
    sending_times: list[tuple[int, float]] = []  # packet number and time in seconds
    statistics: tuple[float, float, float] | None = None
    # The number of wraparounds of the 16-bit packet number, and the largest and the first packet number.
    wraparounds, largest, first_number, has_heading = 0, 0, 1, False
    statistics_location = SourceLocation(file)
    for line_number, line in enumerate(lines, start=1):
        number_match = _NUMBER.search(line)
        if number_match is not None and line_number == len(lines) and number_match.end() == len(line):
            break  # the recording ends within a number
        if number_match is None:
            if _CUT_HEADING.match(line):
                raise _second_run(SourceLocation(file, line_number, 1))
            if _HEADING.match(line):
                if has_heading or round_trips or statistics:
                    raise _second_run(SourceLocation(file, line_number, 1))
                has_heading, first_number = True, 0 if _FROM_ZERO.match(line) else 1
            elif not (has_heading or round_trips):
                continue  # text before the recording
            elif (result := _statistics(line)) is not None:
                if statistics:
                    raise _second_run(SourceLocation(file, line_number, 1))
                statistics, statistics_location = result, SourceLocation(file, line_number, 1)
            elif (
                line.startswith("--") and statistics is None and _unread(lines[line_number : line_number + 1])
            ):
                expected = "numbers of packets sent, received and lost"
                raise fault(
                    "E704",
                    SourceLocation(file, line_number + 1, 1),
                    "statistics of the recording",
                    expected,
                )
            elif "TTL=" in line and _windows_answer(line):
                raise _second_run(SourceLocation(file, line_number, 1))
            continue
        if statistics:
            raise _second_run(SourceLocation(file, line_number, 1))
        number = int(number_match["number"]) + wraparounds * _WRAPS
        if round_trips and number < largest - _WRAPS // 2:  # the 16-bit number of packets has wrapped around
            wraparounds, number = wraparounds + 1, number + _WRAPS
        if abs(number - largest) > _LONGEST_GAP:
            expected = f"at most {_LONGEST_GAP} from the previous one"
            raise fault("E704", SourceLocation(file, line_number, 1), "packet number", expected)
        largest = max(largest, number)
        time_match = _TOOK.search(line)
        if time_match is None:
            if _ANSWERED.search(line):
                if line_number == len(lines):  # the recording ends within this line
                    break
                raise _untimed(SourceLocation(file, line_number, 1))
            round_trips.setdefault(number, math.inf)  # an answer may follow
        elif math.isinf(round_trips.get(number, math.inf)):
            round_trips[number] = _seconds(time_match, file, line_number)
            if (stamp := _STAMP.match(line)) is not None:
                sending_times.append((number, float(stamp["stamp"]) - round_trips[number]))
        elif number < largest and not _DUPLICATE.search(line):
            raise _second_run(SourceLocation(file, line_number, 1))
    first_number = min(first_number, *round_trips) if round_trips else first_number
    last_number = max(round_trips, default=first_number - 1)
    duration = math.nan
    if statistics is not None:
        sent, received, duration = statistics
        if received != _answers(round_trips):
            raise _disagreement("answers", received, _answers(round_trips), statistics_location)
        if not 0 <= sent - (last_number - first_number + 1) <= _LONGEST_GAP:
            raise _disagreement("packets", sent, last_number - first_number + 1, statistics_location)
        last_number = first_number + int(sent) - 1
    if last_number < first_number:
        return None
    interval = _steady_step(sending_times)
    if math.isnan(interval) and last_number > first_number and duration > 0:
        interval = duration / (last_number - first_number)
    return Probe("ping", _one_way_delays(round_trips, first_number, last_number), interval)


def _statistics(line: str) -> tuple[float, float, float] | None:
    """Return the packets sent and received and the duration in seconds, from a line of statistics.

    The result is None for other lines.

    In all languages the numbers are in the first two parts between commas, and a later part is a percentage.
    The duration is NaN if unknown.
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
    """Return whether the line below the heading of the statistics has no valid statistics."""
    return any(line.strip() and _statistics(line) is None for line in following)


def _steady_step(stamps: Sequence[tuple[int, float]]) -> float:
    """Return the mean time between packets in seconds, NaN if unknown; clock adjustments are excluded.

    `stamps` are the number and the sending time of each packet.
    """
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
    """Return the packets of a ping without packet numbers; None for other texts. Raises ApcError (E704).

    Each line between the heading and a blank line is the next packet.
    """
    trips: list[float] = []
    statistics: tuple[int, ...] | None = None
    statistics_location, repeated, replies = SourceLocation(file), None, 0
    after_heading = in_packets = False
    for line_number, line in enumerate(lines, start=1):
        if _TCPING.match(line):
            return None
        if in_packets and line[:1].isspace() and line.strip():
            continue  # routes and time stamps of the preceding answer
        if not line.strip() or line[0].isspace():
            if statistics is None and (result := _WINDOWS_STATISTICS.match(line)):
                statistics, statistics_location = (
                    tuple(map(int, result.groups())),
                    SourceLocation(file, line_number, 1),
                )
            # The heading of statistics has indented lines below it.
            after_heading = after_heading and not line.strip()
            in_packets = False
        elif line.rstrip().endswith((":", "：")):
            after_heading, in_packets = True, False
        else:
            time_match = _windows_answer(line)
            if after_heading and trips:
                repeated = repeated or SourceLocation(file, line_number, 1)
            in_packets, after_heading = in_packets or after_heading or time_match is not None, False
            if time_match is not None:
                trips.append(_seconds(time_match, file, line_number))
            elif in_packets and (
                line_number < len(lines) or line.endswith((".", "。"))
            ):  # the last line may be incomplete
                if _ANSWERED.search(line):
                    raise _untimed(SourceLocation(file, line_number, 1))
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
            raise _disagreement("packets", sent, len(trips), statistics_location)
        # Windows counts a reply such as "Destination host unreachable" as received.
        if not answers <= received <= answers + replies:
            raise _disagreement("answers", received, answers, statistics_location)
    return Probe("ping", np.array(trips) / 2, math.nan)


def _windows_answer(line: str) -> re.Match[str] | None:
    """Return the match of the time in an answer, after the address and a colon; None for other lines."""
    return _WINDOWS.search(line) if ":" in line or "：" in line else None


def _seconds(time_match: re.Match[str], file: str, line: int) -> float:
    """Return the time of an answer in seconds. Raises ApcError if it exceeds `LATEST_DELAY`."""
    seconds = float(time_match["time"].replace(",", ".")) * _SECONDS.get(time_match["unit"], 1e-3)
    if seconds > LATEST_DELAY:
        raise _untimed(SourceLocation(file, line, 1))
    return seconds


def _answers(trips: dict[int, float]) -> int:
    """Return the number of packets with an answer."""
    return sum(map(math.isfinite, trips.values()))


def _second_run(location: SourceLocation) -> ApcError:
    """Return the error E704 for a recording with a second run."""
    return fault("E704", location, "recording", "one run of ping", "a second run that starts in this line")


def _untimed(location: SourceLocation) -> ApcError:
    """Return the error E704 for an answer without a valid time."""
    expected = f"a round trip of at most {LATEST_DELAY:.0e} s, such as time=12.3 ms"
    return fault("E704", location, "reply", expected)


def _disagreement(subject: str, expected: float, got: int, location: SourceLocation) -> ApcError:
    """Return the error E704 for a number of packets or answers that differs from the statistics."""
    of_statistics = f"{expected:.12g}, as in its statistics"
    return fault("E704", location, f"number of {subject} in the recording", of_statistics, str(got))


def _one_way_delays(trips: dict[int, float], first: int, last: int) -> NDArray[np.float64]:
    """Return half of each round-trip time, by packet number from `first` to `last`.

    The delay is infinite for a lost packet.
    """
    delays = np.full(last - first + 1, math.inf)
    if trips:
        delays[np.array(list(trips)) - first] = np.array(list(trips.values())) / 2
    return delays
