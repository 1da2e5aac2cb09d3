"""Settings, file names and numbers that nobody expects end in an answer or a diagnostic."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import Cli, write
from tests.topologies import AVERAGE

NESTED = """\
component: Outer
connectors: {{a: Flange, b: Flange}}
parameters: {{s: {{unit: N/m, min: 0, default: 1}}, q: {{unit: 1, default: 10}}}}
parts:
  inside: {{type: SpringDamper, a: a, b: b, stiffness: "{stiffness}"}}
"""
OUTER = """\
topology: nested
library: ./parts
peers: {u: {count: 1}}
masses: {d: {mass: 1 kg, damping: 1 N*s/m}}
couplers: {o: {type: Outer, a: d, b: ground}}
"""


@pytest.mark.parametrize(
    ("stiffness", "why"),
    [
        ("s*q^100*q^100*q^100*q^100", "is too large for a number"),
        ("s*exp(exp(q))", "is too large for a number"),
        ("s/(q - 10)", "divides by zero"),
        ("s*log(q - 10)", "has no real value"),
    ],
)
def test_a_number_of_an_inner_part_without_a_value_is_a_diagnostic(
    stiffness: str, why: str, cli: Cli
) -> None:
    Path("parts").mkdir()
    write("parts/outer.yaml", NESTED.format(stiffness=stiffness))
    write("nested.yaml", OUTER)
    code, _, err = cli("check nested.yaml")
    assert code == 1
    assert err.startswith("parts/outer.yaml:5:")
    assert "E331" in err
    assert why in err


def test_a_library_file_whose_name_has_a_line_break_is_one_file(cli: Cli) -> None:
    Path("parts").mkdir()
    write("parts/ou\nter.yaml", NESTED.format(stiffness="s"))
    write("nested.yaml", OUTER)
    assert cli("analyze nested.yaml --no-margins").code == 0


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux only")
def test_a_library_file_whose_name_is_no_text_is_refused_where_it_would_be_stored(cli: Cli) -> None:
    Path("library").mkdir()
    write("library/flat.yaml", NESTED.format(stiffness="s").replace("Outer", "Other"))
    Path("library/flat.yaml").rename(os.fsdecode(b"library/\xff\xfe.yaml"))
    write("topology.yaml", AVERAGE + "library: ./library\n")
    assert cli("analyze topology.yaml").code == 0
    ran = cli("compile topology.yaml")
    assert (ran.code, "E601" in ran.err) == (1, True), ran.err


def test_an_unknown_backend_of_windows_is_none_of_our_business(tmp_path: Path) -> None:
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    words = [sys.executable, "-m", "apc", "analyze", "topology.yaml", "--no-margins", "--plot", "p.svg"]
    environment = {**os.environ, "MPLBACKEND": "none-such"}
    ran = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "p.svg").exists()


def test_a_failed_request_is_logged_without_the_token() -> None:
    server = pytest.importorskip("apc.app.server")
    try:
        raise OSError("of somebody else")
    except OSError:
        reported = sys.exc_info()
    record = logging.LogRecord("tornado", logging.ERROR, "", 0, "GET /?token=%s\nmore", ("secret",), reported)
    assert server._without_token("secret", record)
    assert (record.getMessage(), record.exc_info) == ("a request failed: OSError('of somebody else')", None)
    wrong = logging.LogRecord("bokeh", logging.ERROR, "", 0, "token secret of %s", (1, 2), None)
    assert server._without_token("secret", wrong)
    assert wrong.getMessage() == "token … of %s"
    plain = logging.LogRecord("bokeh", logging.ERROR, "", 0, "session of /?token=secret", (), None)
    assert server._without_token("secret", plain)
    assert plain.getMessage() == "session of /?token=…"
