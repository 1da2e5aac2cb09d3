"""Names of a topology in C and C++: keywords, macros and identifiers of the texts themselves."""

from __future__ import annotations

import functools
import random
import re
import subprocess
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.exports.c_text import driver, header, source
from apc.exports.code import topology_unit
from apc.exports.fmu import OPTIONS
from apc.exports.identifiers import identifier, prefixed
from apc.exports.peer_step import ExportedPeer, peer_of
from apc.simulation.settings import DEFAULT
from apc.simulation.simulation import plan_of
from tests.hand_over.in_c import compiler
from tests.topologies import ROOT, compiled

C_WORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int
long register restrict return short signed sizeof static struct switch typedef union unsigned void
volatile while asm typeof
"""
CPP_WORDS = """
alignas alignof and and_eq bitand bitor bool catch char16_t char32_t class compl const_cast
constexpr decltype delete dynamic_cast explicit export false friend mutable namespace new noexcept
not not_eq nullptr operator or or_eq private protected public reinterpret_cast static_assert
static_cast template this thread_local throw true try typeid typename using virtual wchar_t xor
xor_eq override final import module
"""
MACROS = """
NAN INFINITY M_PI M_E HUGE_VAL MATH_ERRNO FP_NAN FP_ZERO isnan linux unix NULL EOF stdin y0 y1 yn j0
gamma
"""
OWN = """
in out start clear time tick next send force move p p_sent x y u t k late quanta instant missing
none model peer begin run real flag given own link value state packet
"""
LANGUAGE = {"else", "if", "and", "not", "or", "time"}  # no names of a topology
NAMES = [
    *dict.fromkeys(word for word in (C_WORDS + CPP_WORDS + MACROS + OWN).split() if word not in LANGUAGE)
]
TAKEN = ["int", "NAN", "in", "linux", "out"]  # of clocks, masses and a group
RESERVED = {*C_WORDS.split(), *CPP_WORDS.split(), *MACROS.split(), *OWN.split()}
STRICT = ("-Wall", "-Wextra", "-Werror")


def topology(links: list[str], groups: list[str], clocks: tuple[str, str], masses: tuple[str, str]) -> str:
    """Return a topology whose links, groups of two peers, clocks and masses have these names."""
    (fast, slow), (device, copy) = clocks, masses
    lines = [
        "topology: class", f"clocks: {{'{fast}': 1 ms, '{slow}': 8 ms}}", "peers:",
        *(f"  '{name}': {{count: 2}}" for name in groups),
        "masses:",
        f"  '{device}': {{mass: 0.1 kg, damping: 5 N*s/m}}",
        f"  '{copy}': {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}",
        "couplers:",
        f"  contact: {{type: SampledSpringDamper, a: '{device}', b: '{copy}', stiffness: 1000 N/m,"
        f" clock: '{fast}', delay: 1 ms}}",
        *(
            f"  coupler{k}: {{type: AveragePosition, object: '{copy}', stiffness: 5 N/m, clock: '{fast}',"
            f" delay: 1 ms, link: '{name}'}}"
            for k, name in enumerate(links)
        ),
        "links:",
        *(f"  '{name}': {{clock: '{slow}', delay: 8 ms}}" for name in links),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


@functools.cache
def hostile() -> apc.Model:
    """Return a model that has all the names."""
    links = [name for name in NAMES if name not in TAKEN]
    return compiled(topology(links, TAKEN[4:], (TAKEN[0], TAKEN[1]), (TAKEN[2], TAKEN[3])))


def compile_all(peer: ExportedPeer, folder: Path) -> None:
    """Compile a peer as C99 and gnu17, and link it with a program of C++17 that calls all its functions."""
    name = peer.identifier
    texts = {
        f"{name}.h": header(peer),
        f"{name}.c": source(peer, f"{name}.h"),
        f"{name}_test.c": driver(peer, f"{name}.h"),
        "main.cpp": f"""#include <cmath>
#include <cstdlib>
#include "{name}.h"
int main() {{
  {name} peer; {name}_in in; {name}_out out;
  {name}_start(&peer);
  {name}_clear(&in);
  {name}_send(&peer, &in, &out);
  {name}_force(&peer, &in, &out);
  {name}_move(&peer);
  {name}_tick(&peer, &in, &out);
  return {name}_time(&peer) > 0 && {name}_next(&peer) > 0 ? 0 : 1;
}}
""",
    }
    for file, text in texts.items():
        (folder / file).write_text(text, encoding="ascii")
    c, cpp = compiler(), compiler().replace("gcc", "g++")
    for command in (
        (c, "-std=c99", *STRICT, "-c", f"{name}.c", f"{name}_test.c"),
        (c, "-std=gnu17", *STRICT, "-c", f"{name}.c", f"{name}_test.c"),
        (cpp, "-std=c++17", *STRICT, "main.cpp", f"{name}.o", "-o", "main", "-lm"),
        (cpp, "-std=gnu++17", *STRICT, "-c", "main.cpp"),
        ("./main",),
    ):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (command, done.stderr[:2000])


def test_links_of_any_name_compile_as_c_and_cpp(tmp_path: Path) -> None:
    assert len(NAMES) >= 120
    compile_all(peer_of(plan_of(hostile(), DEFAULT), 0, DEFAULT, device=None), tmp_path)


def compile_fmu(model: apc.Model, folder: Path, peer: str = "") -> None:
    unit = topology_unit(model, peer=peer)
    for file, text in unit.texts.items():
        (folder / file).write_text(text, encoding="ascii")
    listed = [file for file in unit.texts if file.endswith(".c")]
    assert len({file.lower() for file in unit.texts}) == len(unit.texts)
    options = [word for word in OPTIONS if word != "-O2"]
    command = [compiler(), *options, *STRICT, "-Wno-unused-function", *listed, "-o", "unit.so", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:2000]


@pytest.mark.parametrize("name", ['q"x.c', "q\\x.c", "q\nx.c"])
def test_a_name_that_no_include_can_hold_is_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topology_text = ROOT / "models" / "topologies" / "three-users-average.yaml"
    assert run(["export", str(topology_text), "--peer", "user[1]", "--out", str(tmp_path / name)]) == 1
    assert "E601" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.whole
def test_so_does_an_fmu_of_them(tmp_path: Path) -> None:
    compile_fmu(hostile(), tmp_path)


# A type of one peer, were it put together from names alone, would be another peer or a function of the
# topology.
GROUPS = ["begin", "next", "a", "A", "a_1_link_b", "link_b_1", "newest_link_b", "class", "M_SQRT1", "site0_a"]


@pytest.mark.whole
def test_peers_of_any_name_are_distinct_in_an_fmu(tmp_path: Path) -> None:
    names = ["b_1", "b_1_newest", "b_1_way", "p", "p_sent"]
    model = compiled(topology(names, GROUPS, ("while", "linux"), ("x", "quanta")))
    compile_fmu(model, tmp_path)
    codes = [peer_of(plan_of(model, DEFAULT), 2 * k, DEFAULT) for k in range(len(GROUPS))]
    assert len({code.identifier for code in codes}) == len(GROUPS)
    assert "M_SQRT1_2" not in {identifier("M_SQRT1[2]")}


@pytest.mark.parametrize("prefix", ["link", "measured", "force", "value", "PARAMETER"])
def test_identifiers_are_valid_and_of_several_no_two_are_equal(prefix: str) -> None:
    """10,000 names: of any characters, of words of C, and such as differ only where C has no character."""
    chosen = random.Random(52)
    pool = 'aA_.[]019 -:é日\n\\"*/?'
    names = [*NAMES]
    while len(names) < 10_000:
        word = "".join(chosen.choices(pool, k=chosen.randrange(9)))
        names.append(chosen.choice([word, chosen.choice(NAMES) + word, word + chosen.choice(NAMES)]))
    made = prefixed(prefix, names)
    assert len(set(made)) == len(made) == len(names) == 10_000
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in made)
    assert not RESERVED & set(made)


@pytest.mark.whole
def test_random_names_compile(tmp_path: Path) -> None:
    chosen = random.Random(5)
    names = {
        chosen.choice("aZx") + "".join(chosen.choices("aA_09", k=chosen.randrange(6))) for _ in range(60)
    }
    model = compiled(topology(sorted(names)[:40], ["peers_1"], ("h", "n"), ("d__", "d_")))
    compile_all(peer_of(plan_of(model, DEFAULT), 0, DEFAULT, device=None), tmp_path)


def test_the_command_writes_such_names(tmp_path: Path) -> None:
    text = topology(["in", "NAN", "p", "p_sent"], ["class"], ("h", "n"), ("x", "y0"))
    (tmp_path / "t.yaml").write_text(text, encoding="utf-8")
    assert (
        run(["export", str(tmp_path / "t.yaml"), "--peer", "class[1]", "--out", str(tmp_path / "x.c")]) == 0
    )
    subprocess.run([compiler(), "-std=c99", *STRICT, "-c", "x.c"], cwd=tmp_path, check=True)
