# ruff: noqa: E501 -- a line of a grammar is one name's
"""Texts at random by a grammar: expressions, and components and topologies that are nearly right.

Takes: a seeded generator. Gives: `grown`, `rules_of`, `odd_equations`, `odd_vectors`.
Guarantees: of equal seed comes equal text; most units and sizes agree, some don't; nearly always there are as
many equations as unknowns.
Does not: know whether such equations have a solution.

A line of a grammar is `name: alternative  alternative`, two spaces apart; those of `name+` go deeper. In an
alternative `$name` stands for a text of that name; one that asks for a name nobody gave is left out.
"""

from __future__ import annotations

import random
import re
from collections.abc import Mapping

from apc.compiler.language.expression import SMOOTH

Rules = Mapping[str, list[str]]
_NAME = re.compile(r"\$(\w+)")
ODD = 0.005  # how often a name is another: of another size or unit


def rules_of(text: str) -> dict[str, list[str]]:
    """Return a grammar."""
    lines = (line.partition(": ") for line in text.strip("\n").splitlines())
    return {name: alternatives.split("  ") for name, _, alternatives in lines}


def grown(
    rng: random.Random, rules: Rules, text: str, depth: int = 3, odd: Mapping[str, str] | None = None
) -> str:
    """Return a text with every `$name` replaced.

    Parameters
    ----------
    rng
        The luck of it.
    rules
        The grammar.
    text
        Where `$name` stands.
    depth
        How often one alternative may stand inside another.
    odd
        Names that are now and then taken for another.
    """

    def made(name: str, left: int) -> str:
        if odd and name in odd and rng.random() < ODD:
            name = odd[name]
        deeper = rules.get(f"{name}+") if left > 0 and rng.random() < 0.75 else None
        listed = deeper or rules.get(name) or rules[f"{name}+"]
        able = [one for one in listed if all({n, f"{n}+"} & rules.keys() for n in _NAME.findall(one))]
        return filled(rng.choice(able), left - 1)

    def filled(part: str, left: int) -> str:
        return _NAME.sub(lambda match: made(match[1], left), part)

    return filled(text, depth)


def _in_contexts(text: str, units: Mapping[str, str], contexts: str) -> dict[str, list[str]]:
    """Return a grammar whose lines are repeated, `@` a context and `%` each unit, whose size is `~`."""
    lines = []
    for line in text.strip("\n").splitlines():
        for unit, size in units.items() if "%" in line else [("", "")]:
            one = line.replace("%", unit).replace("~", size)
            lines += [one.replace("@", context) for context in contexts] if "@" in one else [one]
    return rules_of("\n".join(lines))


# ---- odd equations ----

# Of c, what is continuous, and t, what ticks: numbers of m, m/s (v), N and 1.
_EQUATIONS = f"""
@%+: ($@% + $@%)  ($@% - $@%)  ($@% + $@1*$@%)  $@1*$@%  $@%/$@1  -$@%  max($@%, $@%)  min($@%, $@%, $@%)  abs($@%)  (if $@if then $@% else $@%)  (if $@if then $@% elseif $@if then $@% else $@%)  ~*$function($@%/(~))  ~*($@%/(~))^$power  sqrt($@%*$@%)  sqrt(($@%)^2 + ($@%)^2)  $@%*$@%/(~)
@if: $@m $relation $@m  $@1 $relation $@1  $@N $relation $@N  not $@m $relation $@m
@1: $number  $number  ($@m/L)  (F/(K*L))  (time/T0)  peers  G
tN: F  K*$tm  K*$tm  D*$tv
@v: (L/T0)  $@rate
cm: a.x  b.x  $cown  (F/K)  T0*der(a.x)  initial($cown)  L  L  0*L
crate: der(a.x)  der(b.x)  der($cown)
cN: F  K*$cm  D*$cv  0*F  a.f  b.f
tm: sample(a.x)  sample(b.x)  sample($cm)  $town  previous($town)  initial($town)  sample(hold($town))  $told  L  L  0*L
trate: sample(der(a.x))  sample(der(b.x))
number: 0  1  2  0.5  3  -1  1e-9  1e9  0.1
power: 2  3  -1  -2  0.5  1.5  (1/3)  0  1  (-0.5)
relation: <  <=  >  >=  ==  !=
function: {"  ".join((*SMOOTH, "sqrt", "abs", "sign", "floor"))}
start: 0 m  1 mm  -1 mm  1 m
cforms: NAME = $cm  NAME = $cm  $cm = $cm  NAME = max(NAME, $cm)  NAME = 0.5*NAME + $cm  der(NAME) = $cv  der(NAME) = $cv  T0*der(NAME) + NAME = $cm
tforms: NAME = $tm  NAME = $tm  $tm = $tm  NAME = min(NAME, $tm)  NAME = 0.5*NAME + $tm  NAME = 0.5*previous(NAME) + $tm
force: a.f = $cN  a.f = $cN  $cN = $cN  a.f + b.f = $cN  a.x = b.x + $cm  a.x = $cm
force+: a.f = $held  a.f = $held  a.f = $held  a.f + b.f = $held
held: hold($tN)  hold($tN, T0)  hold($tN, T0/2)  $cN
back: b.f = -a.f  b.f = -a.f  b.f = -a.f  b.f = -a.f  b.f = -2*a.f  b.f = 0*a.f  a.f = -b.f
"""
_HEARD = "told: mean(others.x)  sum(others.x - L)  max(others.x)  sum(min(L, others.x))\nsent: sample(a.x)  sample(a.x - b.x)  sample($cm)"
_DEFAULTS = """
K: 100  0  1e4
D: 0  1  -1
F: 1  0  -2
L: 1  0.001  0
T0: 0.01  0.001  0
damping: 0  5
offset: 0  1  -1
"""
_PART = """\
component: Own
connectors: {a: Flange, b: Flange}
SENDSparameters:
  K: {unit: N/m, default: $K}
  D: {unit: N*s/m, default: $D}
  F: {unit: N, default: $F}
  L: {unit: m, default: $L}
  T0: {unit: s, default: $T0}
  G: {unit: 1, default: 2}
REFERENCES"""
_TOPOLOGY = """\
topology: odd
library: ./parts
clocks: {h: 1 ms, c: 4 ms}
peers: {u: {count: COUNT}}
masses:
  m: {mass: 1 kg, damping: $damping N*s/m, x: $offset mm}
  n: {mass: 0.2 kg, damping: 2 N*s/m}
couplers:
  own: {type: Own, a: m, b: n GIVEN}
LINKS"""
_UNITS = {"m": "L", "v": "L/T0", "N": "F", "1": "1"}
_UNLIKE = {f"{context}{one}": f"{context}{other}" for context in "ct" for one, other in zip("mvN1", "N1mv", strict=True)}  # fmt: skip


def _context(rng: random.Random, received: bool) -> dict[str, str]:
    """Return what a topology that ticks, or that is heard too, or neither, says of its clock and link."""
    clocked = received or rng.random() < 0.5
    return {
        "REFERENCES": "  clock: clock\n" * clocked + "  link: link\n" * received,
        "GIVEN": ", clock: h" * clocked + ", link: lan" * received,
        "LINKS": "links: {lan: {clock: c, delay: 4 ms}}\n" * received,
        "COUNT": rng.choice("12233") if received else "1",
    }


def _replaced(text: str, words: Mapping[str, str]) -> str:
    for word, meant in words.items():
        text = text.replace(word, meant)
    return text


def odd_equations(rng: random.Random) -> dict[str, bytes]:
    """Return a topology whose one coupler has odd equations."""
    received = rng.random() < 0.25
    words = _context(rng, received) | {"SENDS": "sends: {x: '$sent'}\n" * received}
    rules = _in_contexts(_EQUATIONS, _UNITS, "ct") | rules_of(_DEFAULTS)
    rules |= rules_of(_HEARD) if received else {}
    clocked = bool(words["GIVEN"])
    if not clocked:
        del rules["force+"]
    names = rng.sample(("z", "w", "q"), rng.choice((0, 1, 1, 2)))
    context = {name: "t" if clocked and rng.random() < 0.7 else "c" for name in names}
    for one in set(context.values()):
        rules[f"{one}own"] = [name for name in names if context[name] == one]
    equations = [f"${one}forms" for one in context.values()] + ["$force", "$back"]
    depth = rng.choice((1, 2, 2, 3))
    lines = [
        grown(rng, rules, form, depth + 1, _UNLIKE).replace("NAME", name)
        for form, name in zip(equations, [*names, "", ""], strict=True)
    ]
    rng.shuffle(lines)
    declared = "".join(f"  {name}: {{unit: m, start: $start}}\n" for name in names if rng.random() < 0.97)
    part = _replaced(_PART, words) + f"variables:\n{declared}" * bool(declared)
    part = grown(rng, rules, part) + "equations:\n" + "".join(f"  - {one}\n" for one in lines)
    topology = grown(rng, rules, _replaced(_TOPOLOGY, words))
    return {"topology.yaml": topology.encode(), "parts/own.yaml": part.encode()}


# ---- odd vectors ----

# V% are vectors and S% numbers of a unit, L% vectors written out, e an entry of a position.
_VECTORS = """
@V%+: ($@V% + $@V%)  ($@V% - $@V%)  -$@V%  $@S1*$@V%  $@V%/$@S1  (if $@S% > $@S% then $@V% else $@V%)  max($@V%, $@V%)  abs($@V%)  $@L%  $@S%*$@V%/norm($@V%)VECTORCROSS
@S%+: norm($@V%)  dot($@V%, $@V%)/~  sqrt(dot($@V%, $@V%))NUMBERCROSS
@L%: {ENTRIES}
@Sm: L  0*L  $@e
@SN: F  0*F  K*$@e
@S1: 2  0.5  3  ($@Sm/L)
@VN: P  K*$@Vm  $@LN
cVm: a.x  b.x  q  initial(q)  O  $cLm
tVm: sample(a.x)  sample(b.x)  previous(q)  initial(q)  O  $tLm  $told
ce: a.x[$index]
te: sample(a.x[$index])
odd_index: 0  4  99
list_%: [LIST]
odd_list_%: 1 %  [1 %]  [1 %, 2 %, 3 %, 4 %]
value: 0  1  -2  0.5
cmoving: der(q) = (a.x - q)/T0  q = b.x - O  q = $cVm
tmoving: q = $tVm  q = 0.5*previous(q) + $tVm
cforce: a.f = $cVN
tforce: a.f = hold(K*q + $tVN)  a.f = hold(K*q + $tVN, T0)
back: b.f = -a.f
odd_back: b.f = -2*a.f  b.f[1] = -a.f[1]
odd_size: 0  1  4  two  2.0  [2]
count: 3
odd_count: 0  -1  501  n  1000
handed: O  2*O  -O  O[1]*O/O[1]  O  O  mass
first: 1  1  1  2  3  1  9
set: m.x: $list_m  own.O: $list_m  own.P: $list_N  m.x: [$list_m, $list_m]  own.O: [$list_m, $list_m]  "m.x[$index]": 1 m  $of_row
group: count: COUNT  count: COUNT, set: {$set}  set: {$set}  table: vectors.csv
ground: n  ground
shared: , shared: true
"""
_TOLD = "told: mean(others.x)  sum(others.x - sample(a.x))  max(others.x)"
_FILES = {
    "parts/point.yaml": """\
connector: Point
potentials: {x: {unit: m, size: SIZE}SECOND}
flows: {f: {unit: N, size: SIZE}THIRD}
""",
    "parts/body.yaml": """\
component: Body
connectors: {flange: Point}
parameters: {mass: {unit: kg, exclusive_min: 0, shared: divided}}
variables:
  x: {unit: m, size: SIZE, start: $list_m}
  v: {unit: m/s, size: $size, start: $list_v}
TWISTED_STATESequations: [der(x) = v, mass*der(v) = flange.f, flange.x = xTWISTED_BODY]
""",
    "parts/own.yaml": """\
component: Own
connectors: {a: Point, b: Point}
SENDSparameters:
  K: {unit: N/m, default: 100}
  F: {unit: N, default: 1}
  L: {unit: m, default: 1}
  T0: {unit: s, default: 0.01}
  O: {unit: m, size: SIZE, default: $list_m}
  P: {unit: N, size: SIZE, default: $list_N}
REFERENCESvariables: {q: {unit: m, size: SIZE, start: $list_m}}
equations:
""",
    "parts/row.yaml": """\
component: Row
connectors: {end: Point}
parameters:
  mass: {unit: kg, exclusive_min: 0}
  O: {unit: m, size: SIZE}
REFERENCESparts:
  link: {type: Body, count: $count, mass: mass, x: '$handed'}
  tie: {type: Own, count: 2, a: "link[1:2]", b: "link[2:3]", O: O OWN}
connect: {end: "link[$first].flange"}
""",
    "topology.yaml": """\
topology: odd
library: ./parts
clocks: {h: 1 ms, c: 4 ms}
peers: {u: {$group}}
masses:
  m: {type: Body, mass: 1 kg, x: $list_m}
  n: {type: Body, mass: 2 kg}
ROWcouplers:
  own: {type: Own, a: m, b: $ground, O: $list_m GIVEN}
MORELINKS""",
}
_OF_VECTORS = {"m": "L", "N": "F"}


def odd_vectors(rng: random.Random) -> dict[str, bytes]:
    """Return a topology whose couplers and masses are of vectors."""
    size, received = rng.choice((2, 3)), rng.random() < 0.3
    twist, row = rng.random() < 0.3, rng.random() < 0.4  # a second pair at each connector; an array of parts
    words = _context(rng, received) | {
        "SIZE": str(size),
        "SENDS": "sends: {x: sample(a.x)}\n" * received,
        "SECOND": ", s: {unit: m}" * twist,
        "THIRD": ", n: {unit: N}" * (twist and rng.random() > ODD),
        "TWISTED_STATES": "  s: {unit: m, start: 0 m}\n  w: {unit: m/s, start: 0 m/s}\n" * twist,
        "TWISTED_BODY": ", der(s) = w, mass*der(w) = flange.n, flange.s = s" * twist,
        "ENTRIES": ", ".join(["$@S%"] * size),
        "VECTORCROSS": "  cross($@V%, $@V%)/~" * (size == 3),
        "NUMBERCROSS": "  cross($@V%, $@V%)/~" * (size == 2),
        "LIST": ", ".join(["$value %"] * size),
        "ROW": "  row: {type: Row, mass: 1 kg, O: $list_m GIVEN}\n" * row,
        "MORE": "  more: {type: Own, a: row.end, b: m GIVEN}\n" * row,
    }
    words |= {"OWN": _replaced(words["GIVEN"], {": h": ": clock", ": lan": ": link"})}
    grammar = _replaced(_replaced(_VECTORS, words), words)
    rules = _in_contexts(grammar, _OF_VECTORS, "ct") | rules_of(
        f"size: {size}\nindex: {'  '.join('123'[:size])}\nlist_v: [{', '.join(['$value m/s'] * size)}]"
    )
    rules |= rules_of(_TOLD) if received else {}
    rules |= rules_of("of_row: row.O: $list_m  row.link.x: $list_m") if row else {}
    context = "t" if words["GIVEN"] else "c"
    odd = {f"{one}V{unit}": f"{one}S{unit}" for one in "ct" for unit in "mN"}
    odd |= {other: one for one, other in odd.items()}
    odd |= {name.removeprefix("odd_"): name for name in rules if name.startswith("odd_")}
    equations = [f"${context}moving", f"${context}force", "$back"]
    equations += ["a.n = K*(a.s - b.s)", "b.n = -a.n"] * twist
    rng.shuffle(equations)
    depth = rng.choice((1, 2, 3, 3))
    texts = {name: _replaced(_replaced(text, words), words) for name, text in _FILES.items()}
    files = {name: grown(rng, rules, text, odd=odd) for name, text in texts.items()}
    lines = (grown(rng, rules, one, depth, odd) for one in equations)
    files["parts/own.yaml"] += "".join(f"  - {one}\n" for one in lines)
    if not row:
        del files["parts/row.yaml"]
    files["vectors.csv"] = "m.x[1] [m],m.x[2] [m]\n" + "1,2\n" * int(words["COUNT"])
    return {name: text.encode() for name, text in files.items()}
