# ruff: noqa: E501 -- lists of hostile texts read best as they are
"""Hostile inputs: bytes, YAML, expressions, units, components and tables that nobody should write.

Takes: a seeded generator. Gives: `Input`, `make_input`.
Guarantees: of equal seed comes equal input.
Does not: run anything.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from apc.compiler.language.expression import SMOOTH
from tests.fuzz.grammar import grown, odd_equations, odd_vectors, rules_of
from tests.fuzz.trees import Pairs, Tree, as_yaml, changed, of_yaml, spots

MODELS = Path(__file__).resolve().parents[2] / "models"
TOPOLOGY = "topology.yaml"
PLAYED = "equations"  # the sort that is analysed and simulated as well
SENTINEL = "sentinel"  # the file that a run of foreign code would leave behind
Files = dict[str, bytes]


@dataclass(frozen=True, slots=True)
class Input:
    """Files by name, and the sort of input they are."""

    sort: str
    files: tuple[tuple[str, bytes], ...]


def _read(folder: str) -> dict[str, str]:
    return {path.stem: path.read_text(encoding="utf-8") for path in sorted((MODELS / folder).rglob("*.yaml"))}


TOPOLOGIES = _read("topologies")
COMPONENTS = [text for text in _read("").values() if "component: " in text]
USERS = (MODELS / "topologies" / "users.csv").read_text(encoding="utf-8")
PUSH = "time [s],force [N]\n0,0\n1,2\n2,-1\n"

# Values that YAML, units, names or expressions may stumble over: three spaces or a line apart in the file.
_WORDS = re.split("   |\n", (Path(__file__).parent / "hostile.txt").read_text(encoding="utf-8").rstrip("\n"))
_LONG = (("9", 400), ("9", 5000), ("a", 63), ("a", 64), ("A", 3000), ("x ", 200), ("-", 201), ("1+", 400), ("2^", 61), ("1 kg*", 200))  # fmt: skip
HOSTILE = [*_WORDS, *(text * times for text, times in _LONG), "(" * 150 + "1" + ")" * 150, "", "x\ty", "x\ny", "  x  ", "\xa0", "x\r\ny"]  # fmt: skip
_RULES = rules_of(f"""\
e: 0  1  2  0.5  1e-3  1e300  3/2  $name  $name
e+: -$e  ($e)^$power  $unary($e)  $unary($e, $e)  if $e $test $e then $e else $e  {{$e, $e}}  $e + $e  $e - $e  $e * $e  $e / $e
power: 2  -1  0  (1/2)  1.5  100  101  x
test: <  <=  >  >=  ==  !=  and  or
unary: der  sample  hold  previous  initial  abs  sign  sqrt  atan2  age  floor  mean  sum  max  min  count  dot  norm  cross  foo  {"  ".join(SMOOTH)}
own: q  peers  2  0  1/3  1e-3  1e30
own+: ($own + $own)  ($own / $own)  ($own * $own)  $call($own)  (if $own $sign $own then $own else $own)  ($own)^$whole  max($own, $own)
call: abs  sqrt  exp  log  tanh  floor  sign  cos
sign: <  >=  ==  !=
whole: 2  3  -1  (1/2)  100
quantity: $amount $unit  $amount
amount: 0  1  -1  0.5  1e-9  1e9  1/3  1e300  5  1000  2.5e-3  .5  5.
unit: kg  N  N/m  N*s/m  s  ms  m  m/s  Hz  1  rad  N/m^(3/2)  kg*m/s^2  furlong  µm  N//m  N/m/  ^2  m^0  m^(1/3)
count: 0  -1  1  2  3  7  1e3  1e9  1000000  1000000000  1000000001  10000  3.0  three  {"1" * 500}
key: topology  about  library  clocks  parameters  peers  masses  couplers  links  hands  experiment  studies  count  set  table  type  at  shared  a  b  object  flange  clock  delay  link  stiffness  damping  mass  graph  delays  edges  arcs  period  phase  region  x  y  v  unit  min  max  above  default  options  start  size  component  connector  extends  connectors  variables  parts  connect  sends  equations  source  potentials  flows  <<  device  cube  haptic  user  lan  device.mass  contact.stiffness  duration  seed
name: x  v  f  a.x  b.x  a.f  b.f  flange.x  flange.f  object.x  object.f  mass  damping  stiffness  delay  limit  side  others.x  others.v  others  time  peers  device.x  kt  haptic  held1  q  a  b  x[1]  a.x[2]  device.x[1]
cut: (  )  *  ^  /  =  ,  .  ..  [1]  __  é  '  if   then  1e  {"9" * 30}  :
""") | {"hostile": HOSTILE}  # fmt: skip
_NEW = ("$hostile", "$hostile", "$quantity", "$cut", "$key", "$name", "$count", "$e")
_LIKE = str.maketrans({"a": "а", "e": "е", "o": "о", "c": "с", "x": "х", "-": "−", ":": "：", "*": "∗", "/": "∕", " ": "\u00a0"})  # fmt: skip
_MARKS = [b"\0", b"\t", b"\r", b"\r\n", b"\x1b", b"\xff", b"\xc0\xaf", b"\xed\xa0\x80", b"\xe2\x80\xa8", b"\x85", b"\n...\n", b"\n---\n", b"%YAML 1.1\n", b"\xef\xbb\xbf", b"   ", b"- ", b"\n\n", *(mark.encode() for mark in "{}[],:#&*!|>'\"%@`^/+-=.()<")]  # fmt: skip

# What is asked for too much of. Between « and » stands what comes hundreds of times, ‹ › at most a hundred
# times, ¿ ‡ thousands of bytes; # is the number of a time and @ the next. What stands before => is replaced;
# the rest is added to a topology.
BOMBS = (
    "x0: &x0 [1]\n«x@: &x@ [*x#, *x#, *x#, *x#, *x#, *x#, *x#, *x#, *x#]\n»", "x: «[»«]»\n", "x: «{a: »1«}»\n",
    "«- »1\n", "about2: ¿x‡\n", "0.1 kg=>¿1‡ kg", "0.1 kg=>«(»1 kg«)»", '0.1 kg=>"«1+»1"', "0.1 kg=>1 «m*»kg",
    "parameters: {p0: 2, «p@: p#*p#, »q: 1}\n", "parameters: {«p#: p@, »q: 1}\n", "parameters: {p0: 1, «p@: p#, »q: 1}\n",
    "count: 3=>count: $count", "{mass: 0.1 kg=>{count: 100, mass: 0.1 kg", "haptic: 1 ms=>haptic: 1e-200 s",
    "haptic: 1 ms=>haptic: 1/999999999999 s", "haptic: 1 ms=>haptic: 7/11 ms", "haptic: 1 ms=>haptic: 0.0010000001 s",
    "delay: 8 ms}=>delay: 1e9 s}", "delay: 8 ms}=>delay: 1e-99 s}", "delay: 8 ms}=>delay: 1/7 ms}", "«k: v\n»", "«k#: v\n»",
    "count: 3=>count: 3, set: {device.mass: [«1 kg, »1 kg]}", "delay: 8 ms}=>delay: 8 ms, graph: {edges: [«[#, @], »]}}",
    "hands: {‹h#: {type: ConstantForce, flange: device, force: 1 N}, ›}\n", "# ¿x‡\n", "«? »x\n", "x: |\n« line\n»",
    "x: '«\n\n»'\n", "«!»\n", "x: !<«a»> 1\n", "«a:\n »", "\n&a [*a, *a]\n", "¿ ‡\n",
)  # fmt: skip


def make_input(rng: random.Random, sort: str | None = None) -> Input:
    """Return one input, of a sort if one is given."""
    requested = [one for one in SORTS if sort in (None, one[0])]
    sort, make, _ = rng.choices(requested, weights=[weight for _, _, weight in requested])[0]
    files = {"users.csv": USERS.encode(), "push.csv": PUSH.encode()} | make(rng)
    return Input(sort, tuple(files.items()))


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Return bytes changed at random.

    A line, word, cell or byte is taken away, doubled, replaced by what nobody expects, marked, or made to look
    like itself, once or more; rarely all of it is cut or in another encoding.
    """
    for _ in range(rng.randrange(1, 4)):
        between = rng.choice([b"\n", b"\n", b" ", b",", b""])
        pieces = data.split(between) if between else [data[at : at + 1] for at in range(len(data))]
        at = rng.randrange(max(1, len(pieces)))
        old = b"".join(pieces[at : at + 1])
        new = _encoded(grown(rng, _RULES, rng.choice(_NEW), 2))
        interchangeable = _encoded(old.decode("utf-8", "replace").translate(_LIKE))
        turned = bytes(one ^ (1 << rng.randrange(8)) for one in old[:1]) + old[1:]
        marked = rng.choice(_MARKS) + old
        pieces[at : at + 1] = rng.choice(
            ([], [old, old], [new], [new], [marked], [interchangeable], [old.lstrip()], [turned])
        )
        data = (rng.choice(_MARKS) if rng.random() < 0.03 else between).join(pieces)
    if rng.random() < 0.05:
        data = data.decode("utf-8", "replace").encode(rng.choice(["utf-16", "utf-32", "cp1252"]), "replace")
    return data[: rng.randrange(len(data) + 1)] if rng.random() < 0.05 else data


def _topology(rng: random.Random) -> str:
    return rng.choice(list(TOPOLOGIES.values()))


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _hostile(rng: random.Random) -> str:
    return grown(rng, _RULES, rng.choice(["$hostile"] * 4 + ["$quantity"]))


def _mutated(rng: random.Random, text: str) -> str:
    return mutated(rng, _encoded(text)).decode("utf-8", "replace")


def _bytes(rng: random.Random) -> Files:
    return {
        TOPOLOGY: rng.choice(
            [rng.randbytes(rng.randrange(400)), *[mutated(rng, _encoded(_topology(rng)))] * 20]
        )
    }


# ---- structure ----


def any_value(rng: random.Random) -> Tree:
    """Return what may be put in a place of a tree."""
    text = grown(rng, _RULES, rng.choice(_NEW))
    few = [_hostile(rng) for _ in range(rng.randrange(4))]
    return rng.choice([few, Pairs([[text, one] for one in few]), [[text, *few]], text, text, text, text])


def _once_changed(tree: Tree, rng: random.Random, donor: Tree) -> None:
    changed(tree, rng, donor, value=lambda: any_value(rng), key=lambda: grown(rng, _RULES, rng.choice(_NEW)))


def _structure(rng: random.Random) -> Files:
    tree, donor = of_yaml(_topology(rng)), of_yaml(_topology(rng))
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        _once_changed(tree, rng, donor)
    return {TOPOLOGY: _encoded(as_yaml(tree, rng))}


# ---- expressions and units ----


def _numbers(rng: random.Random) -> Files:
    """Put expressions, quantities and units where a topology has numbers."""
    tree = of_yaml(_topology(rng))
    numbers = [pair for pair in _pairs_of(tree) if isinstance(pair[1], str) and re.match(r"-?[\d.]", pair[1])]
    tree[:] = [pair for pair in tree if pair[0] != "parameters"]
    named = [["kt", "2000 N/m"], ["tick", "1 ms"], ["q", "3"]]
    if rng.random() < 0.3:
        named.append([grown(rng, _RULES, "$name"), grown(rng, _RULES, rng.choice(["$quantity", "$own"]))])
    tree.append(["parameters", Pairs(named)])
    for _ in range(rng.choice([1, 1, 2, 4])):
        pair = rng.choice(numbers)
        number, _, unit = pair[1].partition(" ")
        fits = {"N/m": "kt*$own", "ms": "tick*$own"}.get(unit, f"{number}*$own*1")
        made = grown(rng, _RULES, rng.choice(["$quantity", "$e", "$own", "$hostile", fits, fits]))
        pair[1] = _mutated(rng, made) if rng.random() < 0.5 else made
    return {TOPOLOGY: _encoded(as_yaml(tree))}


def _pairs_of(tree: Tree) -> list[list[Tree]]:
    return [node[at] for node, at in spots(tree) if isinstance(node, Pairs)]


# ---- components ----


def _component(rng: random.Random) -> Files:
    """Shadow a component of the library by a changed one of the same name, in a folder of the topology's own."""
    topology = of_yaml(_topology(rng))
    shown = str(topology)
    used = [text for text in COMPONENTS if text.partition("component: ")[2].split()[0] in shown]
    text = rng.choice(used or COMPONENTS)
    tree, donor = of_yaml(text), of_yaml(rng.choice(COMPONENTS))
    for _ in range(rng.choice([1, 1, 2, 4])):
        rng.choice([_change_equation, _once_changed])(tree, rng, donor)
    part = mutated(rng, _encoded(text)) if rng.random() < 0.3 else _encoded(as_yaml(tree))
    topology.append(["library", rng.choice(["parts"] * 40 + ["./parts", ["parts"], "."])])
    return {TOPOLOGY: _encoded(as_yaml(topology)), "parts/own.yaml": part}


def _change_equation(tree: Tree, rng: random.Random, donor: Tree) -> None:
    """Replace an equation, or a name or number in one."""
    for key, value in tree:
        if key == "equations" and value and type(value) is list:
            at = rng.randrange(len(value))
            new = grown(rng, _RULES, rng.choice(["$e = $e", "$name = $e"]))
            other = _mutated(rng, str(value[at]))
            value[at] = rng.choice([new, other])


# ---- tables ----


def _table(rng: random.Random) -> Files:
    """Change a table, or what names it."""
    topology, name, text = rng.choice(
        (
            (TOPOLOGIES["users-table"], "users.csv", USERS),
            (
                f"{TOPOLOGIES['three-users-average']}hands: {{h: {{type: TableForce, flange: device, force: push.csv}}}}\n",
                "push.csv",
                PUSH,
            ),
            (
                TOPOLOGIES["three-users-average"].replace("8 ms}", "8 ms, graph: {arcs: edges.csv}}"),
                "edges.csv",
                "from,to,weight\n1,2,1\n2,3,0.5\n3,1,2\n",
            ),
        )
    )
    return {TOPOLOGY: _encoded(topology), name: mutated(rng, _encoded(text))}


def _bomb(rng: random.Random) -> Files:
    """Ask for too much: of memory, depth, length or number."""
    topology = _topology(rng)
    count = rng.choice([10, 100, 300, 1000] * 5 + [10_000])
    large = rng.choice([1 << 16, 1 << 20, 10 << 20]) if rng.random() < 0.15 else 1 << 12
    old, replaces, new = rng.choice(BOMBS).partition("=>")

    def many(match: re.Match[str]) -> str:
        text, times = match[0][1:-1], {"«": count, "‹": min(count, 100), "¿": large}[match[0][0]]
        if not set(text) & set("#@"):
            return text * times
        return "".join(text.replace("#", str(at)).replace("@", str(at + 1)) for at in range(times))

    made = re.sub("(?s)«.*?»|‹.*?›|¿.*?‡", many, grown(rng, _RULES, new if replaces else old))
    return {TOPOLOGY: _encoded(topology.replace(old, made, 1) if replaces else topology + made)}


CONSTANT = """\
component: Constant
connectors: {{a: Flange, b: Flange}}
parameters: {{stiffness: {{unit: N/m, min: 0, default: 1}}, q: {{unit: 1, default: 2}}}}
variables: {{f: {{unit: N}}}}
equations: ["f = stiffness*(a.x - b.x)*({constant})", a.f = f, b.f = -f]
"""
OF_CONSTANTS = """\
topology: constants
library: ./parts
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}
couplers: {own: {type: Constant, a: device, b: ground}}
"""


def _number(rng: random.Random, depth: int) -> str:
    """Return an expression of numbers, rarely with a parameter, that may be huge, tiny, or no number."""
    if depth == 0 or rng.random() < 0.1:
        numbers = ("0", "1", "2", "3", "10", "25", "0.1", "1e9", "1e-9", "1e300", "1e-300", "pi", "700", "q")
        return rng.choice(numbers)
    one, other = _number(rng, depth - 1), _number(rng, depth - 1)
    form = rng.choice(
        (
            *(f"{word}({one})" for word in ("exp", "exp", "log", "sin", "tan", "cosh", "sqrt", "atan")),
            *(f"{word}({one})" for word in ("floor", "abs", "sign", "floor", "abs", "sign")),
            *(f"({one})^{power}" for power in ("100", "-100", "(1/3)", "2", "99")),
            *(f"({one}){sign}({other})" for sign in "+-*/"),
            *(f"{word}({one}, {other})" for word in ("max", "min", "atan2")),
            f"if {one} < {other} then {one} else {other}",
        )
    )
    return f"({form})" if form.startswith("if") else form


def _constant(rng: random.Random) -> Files:
    """Return a component one of whose equations holds a constant."""
    text = CONSTANT.format(constant=_number(rng, rng.randrange(1, 7)))
    return {TOPOLOGY: OF_CONSTANTS.encode(), "parts/constant.yaml": text.encode()}


SORTS: tuple[tuple[str, Callable[[random.Random], Files], int], ...] = (
    ("bytes", _bytes, 26),
    ("structure", _structure, 26),
    ("numbers", _numbers, 18),
    ("component", _component, 20),
    ("table", _table, 8),
    ("bomb", _bomb, 2),
    ("constant", _constant, 4),
    (PLAYED, odd_equations, 3),
    ("vectors", odd_vectors, 6),
)
