"""Recorded networks: each packet that ping or irtt wrote is read, and what is told of them is true."""

from __future__ import annotations

import gzip
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from mpmath import betainc, workdps

import apc
from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.compiler.language.ping_recordings import read_probe
from apc.network.channel import ChannelLaw, PacketSource
from apc.network.link_fit import CONFIDENCE, LinkFit, fit_recording
from tests.lossy import LINK
from tests.topologies import AVERAGE, replaced

LOST = math.inf
LANGUAGES = "cs de es fi fr id it ja ka kab ko pt_BR ro tr uk zh_CN zh_Hant"  # po/LINGUAS of iputils
# One table of samples: each program and language, and what is refused.
SAMPLES = [
    (*heading.split(": ", 1), text)
    for heading, text in re.findall(
        r"^## (.+)\n((?:(?!## ).*\n)*)",
        Path(__file__).with_name("pings.txt").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
]

IPUTILS = """\
PING host.example (192.0.2.7) 56(84) bytes of data.
64 bytes from 192.0.2.7: icmp_seq=1 ttl=57 time=16.4 ms
64 bytes from 192.0.2.7: icmp_seq=3 ttl=57 time=18.2 ms
64 bytes from 192.0.2.7: icmp_seq=2 ttl=57 time=31.0 ms
64 bytes from 192.0.2.7: icmp_seq=3 ttl=57 time=40.0 ms (DUP!)
From 192.0.2.1 icmp_seq=5 Destination Host Unreachable

--- host.example ping statistics ---
6 packets transmitted, 3 received, +1 duplicates, 50% packet loss, time 50ms
rtt min/avg/max/mdev = 16.4/21.8/31.0/1.0 ms
"""
STAMPED = """\
PING host.example (192.0.2.7) 56(84) bytes of data.
[1600000000.016400] 64 bytes from 192.0.2.7: icmp_seq=1 ttl=57 time=16,4 ms
no answer yet for icmp_seq=2
[1600000000.032000] 64 bytes from 192.0.2.7: icmp_seq=3 ttl=57 time=16.0 ms
no answer yet for icmp_seq=4
[1600000000.064000] 64 bytes from 192.0.2.7: icmp_seq=4 ttl=57 time=40.0 ms
"""
GERMAN = """\
PING host.example (192.0.2.7) 56(84) Bytes an Daten.
64 Bytes von 192.0.2.7: icmp_seq=1 ttl=57 Zeit=16.4 ms
Von 192.0.2.1 icmp_seq=2 Zielhost nicht erreichbar
64 Bytes von 192.0.2.7: icmp_seq=3 ttl=57 Zeit=0,5 ms

--- host.example Ping-Statistiken ---
4 Pakete übertragen, 2 empfangen, 50% Paketverlust, Zeit 60ms
"""
JAPANESE = """\
64 バイト応答 送信元 192.0.2.7: icmp_seq=1 ttl=57 時間=16.4ミリ秒
64 バイト応答 送信元 192.0.2.7: icmp_seq=3 ttl=57 時間=2ミリ秒
"""
MACOS = """\
PING host.example (192.0.2.7): 56 data bytes
Request timeout for icmp_seq 0
64 bytes from 192.0.2.7: icmp_seq=1 ttl=57 time=0.250 ms
Request timeout for icmp_seq 2
"""
BUSYBOX = """\
PING host.example (192.0.2.7): 56 data bytes
64 bytes from 192.0.2.7: seq=0 ttl=57 time=12.345 ms
64 bytes from 192.0.2.7: seq=2 ttl=57 time=1.000 s

3 packets transmitted, 2 packets received, 33% packet loss
"""
WINDOWS = """\
Pinging host.example [192.0.2.7] with 32 bytes of data:
Reply from 192.0.2.7: bytes=32 time=12ms TTL=57
Request timed out.
Reply from 192.0.2.7: bytes=32 time<1ms TTL=57
"""
# More than 65,535 packets: their count begins again after sixteen bits.
LONG = "\n".join(f"64 bytes: icmp_seq={n % 65536} time=2 ms" for n in range(1, 70_000) if n % 1000)


def irtt(*trips: float | str) -> str:
    """Return what `irtt client -o` writes of round trips in ms, or of how they were lost."""
    found = [
        {"seqno": count, "lost": "false", "delay": {"rtt": round(trip * 1e6), "send": 5, "receive": 5}}
        if not isinstance(trip, str)
        else {"seqno": count, "lost": trip, "delay": {}}
        for count, trip in enumerate(trips)
    ]
    return json.dumps({"config": {"params": {"interval": 8_000_000}}, "round_trips": found})


@pytest.mark.parametrize(
    ("text", "delays", "interval"),
    [
        (IPUTILS, [8.2, 15.5, 9.1, LOST, LOST, LOST], 0.01),
        (STAMPED, [8.2, LOST, 8.0, 20.0], 0.008),
        (MACOS, [LOST, 0.125, LOST], math.nan),
        (GERMAN, [8.2, LOST, 0.25, LOST], 0.02),
        (JAPANESE, [8.2, LOST, 1.0], math.nan),
        (BUSYBOX, [6.1725, LOST, 500.0], math.nan),
        (WINDOWS, [6.0, LOST, 0.5], math.nan),
        (LONG, [LOST if n % 1000 == 0 else 1.0 for n in range(1, 70_000)], math.nan),
        (irtt(16.0, "true", 17.0, "true_up", "true_down"), [8.0, LOST, 8.5, LOST, LOST], 0.008),
    ],
    ids=["iputils", "stamped", "macOS", "German", "Japanese", "BusyBox", "Windows", "long", "irtt"],
)
def test_every_packet_has_its_delay_in_the_order_of_sending(
    text: str, delays: list[float], interval: float
) -> None:
    found = read_probe(text)
    assert found is not None
    np.testing.assert_allclose(found.delays * 1e3, delays, rtol=1e-12)
    # A stamp of 1.6e9 s has 2e-7 s left for digits.
    assert found.interval == pytest.approx(interval, rel=1e-4, nan_ok=True)


@pytest.mark.parametrize(("name", "expected", "text"), SAMPLES, ids=[name for name, _, _ in SAMPLES])
def test_each_program_and_language_is_read_or_refused(name: str, expected: str, text: str) -> None:
    """Its packets and interval are those of the heading; its statistics agree with them."""
    if expected[0] in "123456789" and ";" not in expected:
        line, words = expected.split(" ", 1)
        with pytest.raises(ApcError) as caught:
            read_probe(text.rstrip("\n"), "lan.txt")
        [mistake] = caught.value.mistakes
        assert (mistake.code, mistake.location.line) == ("E704", int(line)), str(mistake)
        assert words in mistake.sentence
        return
    listed, interval = expected.split("; ")
    found = read_probe(text.rstrip("\n"), "lan.txt")  # one was killed within a line
    assert found is not None
    delays = [LOST if word == "-" else float(word) for word in listed.split()]
    np.testing.assert_allclose(found.delays * 1e3, delays, rtol=1e-12)
    between = math.nan if interval == "?" else float(interval) * 1e-3
    assert found.interval == pytest.approx(between, rel=1e-9, nan_ok=True)


def test_all_languages_of_iputils_are_among_the_samples() -> None:
    names = " ".join(name.removeprefix("iputils ") for name, _, _ in SAMPLES if name.startswith("iputils "))
    assert {*names.split()} >= {*re.findall(r"\w+", LANGUAGES)}


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8-sig", "cp850", "cp1252"])
def test_windows_writes_in_code_pages_and_in_utf_16(tmp_path: Path, encoding: str) -> None:
    texts = {name: text for name, _, text in SAMPLES}
    for name, lost in {"Windows de": 4, "Windows fr": 3}.items():
        text = texts[name].replace("’", "'").replace("12 ms", "12\xa0ms").replace("\n", "\r\n")
        mark = "\ufeff" if encoding == "utf-16-le" else ""
        (tmp_path / "lan.txt").write_bytes((mark + text).encode(encoding))
        found = fit_recording(tmp_path / "lan.txt")
        assert (found.lost.count, found.lost.of - found.lost.count, found.longest) == (lost, 2, 0.006)


@pytest.mark.parametrize(
    ("changed", "of"), [({"packets_sent": 4}, "packets"), ({"packets_received": 3}, "answers")]
)
def test_statistics_of_irtt_agree_with_its_packets(changed: dict[str, int], of: str) -> None:
    """A duplicate is received, and answers no packet."""
    written = json.loads(irtt(16.0, "true", 17.0))
    written["stats"] = {"packets_sent": 3, "packets_received": 3, "duplicates": 1}
    assert read_probe(json.dumps(written)) is not None
    written["stats"] |= {"duplicates": 0, "packets_received": 2, **changed}
    with pytest.raises(ApcError, match=f"E704 number of {of} in the recording"):
        read_probe(json.dumps(written))


@pytest.mark.parametrize("interval", [0, -8_000_000, 1e300])
def test_an_interval_of_irtt_that_is_none_is_not_known(interval: float) -> None:
    found = read_probe(irtt(16.0, 17.0).replace("8000000", str(interval)))
    assert found is not None
    assert math.isnan(found.interval)


def test_no_text_is_taken_for_a_recording_that_is_none() -> None:
    """Neither text with numbers nor other JSON."""
    huge = "9" * 5000
    for text in (
        "",
        "{}",
        '{"round_trips": []}',
        "seq=5",
        "{" * 100_000,
        "64 bytes from 192.0.2.7: icmp_seq=1 ttl=57\n16 bytes from 192.0.2.7: icmp_seq=2 ttl=57",  # untimed
        f"icmp_seq=1 time={huge} ms\n{huge} packets transmitted, 1 received, 0% packet loss",
        f"icmp_seq={huge} time=1 ms",
        "icmp_seq=1 time=1 ms\nicmp_seq=999999999999 time=1 ms",
        irtt("true").replace("0", "-1", 1),
        irtt(-1.0),
        irtt(1.0).replace('"seqno": 0', '"seqno": Infinity'),
        "The hosts:\nfirst\nsecond\n\nThe networks:\nthird: 5\n",
        "In 2019, 45 hosts, 30 % of all",
    ):
        try:
            probe = read_probe(text)
        except ApcError as error:
            assert {one.code for one in error.mistakes} == {"E704"}
            continue
        assert probe is None or not np.isfinite(probe.delays).any()


def recorded(folder: Path, law: ChannelLaw, count: int, seed: int) -> LinkFit:
    delays = PacketSource(law, "lan", [[0, 1]], seed=seed).take(count)[0]
    rows = ("lost" if math.isinf(delay) else repr(delay * 1e3) for delay in delays.tolist())
    (folder / "t.csv").write_text("\n".join(["delay [ms]", *rows]), encoding="utf-8")
    return fit_recording(folder / "t.csv", 0.008)


@pytest.mark.few(1)
@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto"])
def test_the_keys_are_those_of_the_link_that_was_recorded(tmp_path: Path, distribution: str) -> None:
    """Of a simulated link, whose law is known: shares in their intervals, delays to a few standard errors."""
    law = ChannelLaw(0.02, 0.3, 1.0, 0.0, 0.02, 0.003, distribution, None)
    found = recorded(tmp_path, law, 20_000, 3)
    assert found.bursty
    assert found.p.interval[0] < 0.02 < found.p.interval[1]
    assert found.r.interval[0] < 0.3 < found.r.interval[1]
    assert found.distribution is not None and found.distribution.distribution == distribution
    # Of 20,000 the standard errors of a median and of a distance of quartiles are below 0.01 of the jitter.
    assert found.distribution.delay == pytest.approx(0.02, abs=5 * 0.01 * 0.003)
    assert found.distribution.jitter == pytest.approx(0.003, rel=5 * 0.01)
    assert not any(
        "distributions" in reported or "follow one another" in reported for reported in found.limitations
    )


@pytest.mark.whole
def test_bursts_are_told_from_luck(tmp_path: Path) -> None:
    """Of 100 recordings of independent losses at most one is called bursty (0.1 are to be expected)."""
    law = ChannelLaw(0.05, 0.95, 1.0, 0.0, 0.02, 0.0, "uniform", None)
    found = [recorded(tmp_path, law, 1000, seed) for seed in range(100)]
    assert sum(one.bursty for one in found) <= 1
    held = sum(one.lost.interval[0] <= 0.05 <= one.lost.interval[1] for one in found)
    assert held >= 88  # 95 are to be expected at least; fewer than 88 of 100 come twice in a thousand times


def test_an_interval_is_where_the_tails_hold_what_is_left_out(tmp_path: Path) -> None:
    """By 30 digits: at its ends, as many losses or more (fewer) have the probability (1 − 0.95)/2."""
    rest = (1 - CONFIDENCE) / 2
    (tmp_path / "t.csv").write_text("delay [ms]\n" + "lost\n" * 7 + "8\n" * 93, encoding="utf-8")
    low, high = fit_recording(tmp_path / "t.csv").lost.interval
    with workdps(30):  # P(7 or more of 100) = I(p; 7, 94), P(7 or fewer) = 1 − I(p; 8, 93)
        assert abs(float(betainc(7, 94, 0, low, regularized=True)) - rest) < 1e-10
        assert abs(float(1 - betainc(8, 93, 0, high, regularized=True)) - rest) < 1e-10
    (tmp_path / "t.csv").write_text("delay [ms]\n" + "8\n" * 100, encoding="utf-8")
    none = fit_recording(tmp_path / "t.csv").lost.interval
    # Of packets sent every 8 ms the first two arrive behind the third, a lost one behind nobody.
    (tmp_path / "o.csv").write_text("delay [ms]\n30\n20\n5\nlost\n9\n", encoding="utf-8")
    assert fit_recording(tmp_path / "o.csv", 0.008).reordered == 2
    assert fit_recording(tmp_path / "o.csv").reordered is None
    assert none == (0.0, pytest.approx(1 - rest ** (1 / 100), rel=1e-12))


def test_what_the_keys_leave_out_is_said_first(tmp_path: Path) -> None:
    slow = 20 + 5 * np.sin(np.arange(500) / 20)
    (tmp_path / "t.csv").write_text("delay [ms]\n" + "\n".join(map(repr, slow.tolist())), encoding="utf-8")
    text = str(apc.fit_link(tmp_path / "t.csv", interval="8 ms"))
    head = " ".join(text.partition("  lost ")[0].split())
    assert "consecutive delays are correlated (coefficient 1.00" in head
    assert "the delays fit none of the distributions" in head
    (tmp_path / "p.txt").write_text(IPUTILS, encoding="utf-8")
    assert "half of each is used as the delay of one direction" in str(apc.fit_link(tmp_path / "p.txt"))


def test_the_entry_is_a_links_and_a_trace_reads_the_same_file(tmp_path: Path) -> None:
    (tmp_path / "lan.txt").write_text(irtt(*[16.0] * 40, "true", *[16.0] * 20), encoding="utf-8")
    with gzip.open(tmp_path / "lan.json.gz", "wb") as packed:
        packed.write((tmp_path / "lan.txt").read_bytes())
    (tmp_path / "t.csv").write_text("delay [ms]\n" + "8\n" * 40 + "lost\n" + "8\n" * 20, encoding="utf-8")
    entry = apc.fit_link(tmp_path / "lan.txt").to_dict()["entry"]
    assert entry == "lan: {clock: network, delay: 8 ms, loss: 1.64 %}"
    links = [f"  {entry}", *(f"{LINK[:-1]}, trace: {name}}}" for name in ("t.csv", "lan.txt", "lan.json.gz"))]
    verdicts = []
    for link in links:
        (tmp_path / "s.yaml").write_text(replaced(AVERAGE, (LINK, link)), encoding="utf-8")
        found = apc.mean_square_stability(apc.compile(tmp_path / "s.yaml"))
        assert found is not None
        verdicts.append(found.to_dict())
    assert verdicts[1] == verdicts[2] == verdicts[3]


def test_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.txt").write_text(IPUTILS, encoding="utf-8")
    assert run(["network", "p.txt", "--json", "--out", "t.csv"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert (
        reported["packets"],
        reported["lost"]["count"],
        reported["lost"]["share"],
        reported["reordered"],
    ) == (
        6,
        3,
        0.5,
        0,
    )
    rows = Path("t.csv").read_text(encoding="utf-8").splitlines()
    assert rows == ["delay [ms]", "8.2", "15.5", "9.1", "lost", "lost", "lost"]
    Path("none.txt").write_text("root:x:0:0:secret\n", encoding="utf-8")
    for words, message in {
        "none.txt": "none.txt:1:1: E702 recording: expected the output of ping or irtt, or a table",
        "no.txt": "no.txt: E701 the table no.txt does not exist.",
        "p.txt --out t.json": "t.json: E878 suffix of --out: expected .csv, got .json. Try: --out t.csv",
        "p.txt --interval 0ms": "--interval: E207 interval: expected more than 0 s, got 0ms. Try: --interval",
    }.items():
        assert run(["network", *words.split()]) == 1
        told_wrong = " ".join(capsys.readouterr().err.split())
        assert told_wrong.startswith(message)
        assert "secret" not in told_wrong


@pytest.mark.whole
def test_a_packed_file_is_unpacked_within_bounds(tmp_path: Path) -> None:
    with gzip.open(tmp_path / "bomb.csv.gz", "wb") as packed:
        packed.write(b"delay [ms]\n" + b"8\n" * (1 << 25))
    (tmp_path / "torn.json.gz").write_bytes((tmp_path / "bomb.csv.gz").read_bytes()[:100])
    for name, words in (
        ("bomb.csv.gz", "is larger than 64 MiB when unpacked"),
        ("torn.json.gz", "not a complete gzip file"),
    ):
        with pytest.raises(ApcError, match=words):
            fit_recording(tmp_path / name)
