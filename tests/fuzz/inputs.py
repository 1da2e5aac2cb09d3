# ruff: noqa: E501 -- lists of hostile texts, and texts built in one line, read best as they are
"""Hostile inputs: bytes, YAML, expressions, units, components and tables that nobody should write.

Takes: a seeded generator. Gives: `Input`, `make_input`.
Guarantees: of equal seed comes equal input.
Does not: run anything.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from apc.compiler.language.expression import SMOOTH
from tests.fuzz.equations import odd_equations
from tests.fuzz.vectors import odd_vectors

MODELS = Path(__file__).resolve().parents[2] / "models"
TOPOLOGY = "scene.yaml"
PLAYED = "equations"  # the sort that is analysed and simulated as well
SENTINEL = "sentinel"  # the file that a run of foreign code would leave behind

# A tree of YAML that can hold a key twice: mappings are lists of pairs in a `Pairs`.
Tree = Any


class Pairs(list[list[Any]]):
    """A mapping as (key, value) pairs, keys not necessarily different."""


@dataclass(frozen=True, slots=True)
class Input:
    """Files by name, `TOPOLOGY` among them, and the sort of input they are."""

    sort: str
    files: tuple[tuple[str, bytes], ...]


def _read(folder: str) -> dict[str, str]:
    return {path.stem: path.read_text(encoding="utf-8") for path in sorted((MODELS / folder).rglob("*.yaml"))}


SCENES = _read("scenes")
COMPONENTS = {
    name: text
    for folder in ("contacts", "coordination", "devices", "hands", "mechanics", "network")
    for name, text in _read(folder).items()
}
TITLES = {
    text.partition("component: ")[2].split()[0]: text for text in COMPONENTS.values() if "component: " in text
}
TABLES = {"users.csv": (MODELS / "scenes" / "users.csv").read_text(encoding="utf-8")}
PUSH = "time [s],force [N]\n0,0\n1,2\n2,-1\n"

CODE = f"__import__('os').system('touch {SENTINEL}')"
HOSTILE = (
    "", "~", "null", "true", "false", "on", "no", "1:30", "2001-01-01", ".nan", ".inf", "-.inf", "nan", "inf",
    "NaN kg", "inf N/m", "-0", "0", "0x10", "0o17", "1_000", "1e400", "1e-400", "1e300 N/m", "-1e300 kg",
    "9"*400, "9"*5000, "9**9**9**9", "9^9^9^9", "2^-100", "(-8)^(1/3)", "1/0", "0/0", "1/0 s", "1/3 ms", "1e308 m",
    "10**100", "1 N/0", "0 s", "-1 ms", "1e-300 s", "1/999999999 s", "1e99 s", "5 kg kg", "5 kg^999", "5 kg^(1/0)",
    "5 degC", "3 dB", "1 MS", "1 ms", "1 m s", "1 N·m", "1 µs", "1 μs", "5 Ω", "５ kg", "٣ kg", "1０0 N/m", "½ kg",
    "dеvice", "сube", "devi\u200bce", "dev\u0301ice", "ｄevice", "ﬁnger", "İ", "ß", "𝒙", "😀", "\u202edevice",
    "__class__", "device.__class__", "().__class__.__bases__[0]", "{}.format", "lambda: 0", CODE, "!!python/name:os.system",
    f"!!python/object/apply:os.system ['touch {SENTINEL}']", "{{7*7}}", "${HOME}", "$(id)", "%s%s%n", "../../etc/passwd",
    "/etc/passwd", "/dev/zero", ".", "..", "\\", "'", '"', "`", "|", ">", "&a", "*a", "*missing", "!tag x", "? x", "- x", "[", "]",
    "{", "}", "[[[[]]]]", "{a: {b: {c: d}}}", "[1, 2", "a: b: c", "<<", "=", "==", "a = b", "a == b", "x = = y",
    "device", "cube", "device.flange", "cube.flange.f", "ground", "others", "others.x", "peers", "time", "user[1]", "user[0]", "user[-1]",
    "chain[1:3]", "device[1]", "device[999999]", "device[1", "haptic", "network", "lan", "Mass", "Flange", "FullMesh", "Link",
    "mean(others.x)", "sum(others.x)", "der(der(der(x)))", "sample(hold(sample(x)))", "previous(previous(f))", "hold(f, delay)",
    "hold(f, -1)", "initial(x)", "interpolate(force, time)", "if a then b else c", "if then else", "peers/(peers - peers)",
    "sqrt(-1)", "log(0)", "exp(1000)", "exp(exp(exp(10)))", "floor(1e300)", "max()", "min(1)", "abs(1, 2)", "f(x)", "sin(x",
    "users.csv", "push.csv", "missing.csv", "complete", "ring", "star", "stars", "right", "left", "all", "own",
    "a" * 64, "a" * 63, "A" * 3000, "x " * 200, "(" * 150 + "1" + ")" * 150, "-" * 200 + "1", "1+" * 400 + "1", "2^" * 60 + "2",
    "1 " + "kg*" * 200 + "kg", "1 (" + "(" * 100 + "m" + ")" * 101, "x\ty", "x\ny", "  x  ", "\u00a0", "x\r\ny", "#", "x # y", "x: y",
    "count(others)", "1 N/m, 2 N/m", "500N/m", "500  N/m", "5,0 N", "1.2.3 kg", "+5 kg", "--5 kg", "1 /2 s", "1/ 2 s", "1e3", "1E3 N/m", "1 Hz", "-1 Hz", "1 kHz",
    "0 Hz", "1 1/s", "1 rad", "90 deg", "100 %", "1 kg*m/s^2", "1 lb", "1 in", "1 lightyear", "1 year", "1 eV", "1 h",
)  # fmt: skip
COUNTS = (
    "0",
    "-1",
    "1",
    "2",
    "3",
    "7",
    "1e3",
    "1e9",
    "1000000",
    "1000000000",
    "1000000001",
    "10000",
    "3.0",
    "three",
    "1" * 500,
)
KEYS = (
    "topology", "about", "library", "clocks", "parameters", "peers", "masses", "couplers", "links", "hands", "experiment", "studies",
    "count", "set", "table", "type", "at", "shared", "a", "b", "object", "flange", "clock", "delay", "link", "stiffness", "damping", "mass",
    "graph", "delays", "edges", "arcs", "period", "phase", "region", "x", "y", "v", "unit", "min", "max", "above", "default", "options",
    "start", "size", "component", "connector", "extends", "connectors", "variables", "parts", "connect", "sends", "equations", "source",
    "potentials", "flows", "<<", "device", "cube", "haptic", "user", "lan", "device.mass", "contact.stiffness", "duration", "seed",
)  # fmt: skip
NAMES = ("x", "v", "f", "a.x", "b.x", "a.f", "b.f", "flange.x", "flange.f", "object.x", "object.f", "mass", "damping", "stiffness", "delay",
         "limit", "side", "others.x", "others.v", "others", "time", "peers", "device.x", "kt", "haptic", "held1", "q", "a", "b", "x[1]", "a.x[2]", "device.x[1]")  # fmt: skip
UNITS = ("", "kg", "N", "N/m", "N*s/m", "s", "ms", "m", "m/s", "Hz", "1", "rad", "N/m^(3/2)", "kg*m/s^2", "furlong", "µm", "N//m", "N/m/", "^2", "m^0", "m^(1/3)")  # fmt: skip
UNARY = ("der", "sample", "hold", "previous", "initial", "abs", "sign", "sqrt", *SMOOTH, "atan2", "age", "floor",
         "mean", "sum", "max", "min", "count", "dot", "norm", "cross", "foo")  # fmt: skip
LIKE = str.maketrans(
    {"a": "а", "e": "е", "o": "о", "c": "с", "x": "х", "-": "−", ":": "：", "*": "∗", "/": "∕", " ": "\u00a0"}
)


def make_input(rng: random.Random, sort: str | None = None) -> Input:
    """Return one input, of a sort if one is given."""
    wanted = [one for one in SORTS if sort in (None, one[0])]
    sort, make, _ = rng.choices(wanted, weights=[weight for _, _, weight in wanted])[0]
    files = make(rng)
    files.setdefault("users.csv", TABLES["users.csv"].encode())
    files.setdefault("push.csv", PUSH.encode())
    return Input(sort, tuple(files.items()))


def _scene(rng: random.Random) -> str:
    return rng.choice(list(SCENES.values()))


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


# ---- bytes and text ----


def _bytes(rng: random.Random) -> dict[str, bytes]:
    data = bytearray(_encoded(_scene(rng)))
    how = rng.randrange(8)
    if how == 0:
        data = bytearray(rng.randbytes(rng.randrange(400)))
    elif how == 1:
        data = bytearray(b"\xef\xbb\xbf" * rng.randrange(1, 3)) + data
    elif how == 2:
        data = bytearray(
            bytes(data).decode().encode(rng.choice(["utf-16", "utf-32", "cp1252", "utf-16-le"]), "replace")
        )
    elif how == 3:
        data = data[: rng.randrange(len(data))]
    else:
        for _ in range(rng.randrange(1, 6)):
            where = rng.randrange(len(data))
            if how == 4:
                data[where] ^= 1 << rng.randrange(8)
            elif how == 5:
                data[where:where] = rng.randbytes(rng.randrange(1, 5))
            elif how == 6:
                del data[where : where + rng.randrange(1, 20)]
            else:
                data[where:where] = rng.choice([b"\0", b"\t", b"\r", b"\r\n", b"\x1b", b"\xff", b"\xc0\xaf", b"\xed\xa0\x80", b"\xe2\x80\xa8", b"\x85", b"\n...\n", b"\n---\n", b"%YAML 1.1\n"])  # fmt: skip
    return {TOPOLOGY: bytes(data)}


def _lines(rng: random.Random) -> dict[str, bytes]:
    return {TOPOLOGY: _encoded(_mangled(_scene(rng), rng))}


def _mangled(text: str, rng: random.Random) -> str:
    """Change a text by lines, words and characters."""
    for _ in range(rng.randrange(1, 4)):
        lines = text.splitlines() or [""]
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        how = rng.randrange(11)
        if how == 0:
            del lines[at]
        elif how == 1:
            lines.insert(other, lines[at])
        elif how == 2:
            lines[at], lines[other] = lines[other], lines[at]
        elif how == 3:
            lines[at] = rng.choice([" ", "\t", "   ", "- "]) + lines[at]
        elif how == 4:
            lines[at] = lines[at].lstrip()
        elif how == 5:
            lines[at] = lines[at].translate(LIKE)
        elif how == 6:
            return rng.choice(["\r\n", "\r", "\u2028", "\x85"]).join(lines)
        elif how == 7 and lines[at]:
            cut = rng.randrange(len(lines[at]))
            lines[at] = (
                lines[at][:cut]
                + rng.choice("{}[],:#&*!|>'\"%@`^/+-=.()<\t")
                + lines[at][cut + rng.randrange(2) :]
            )
        else:
            words = re.split(r"([\w.]+)", lines[at])
            if len(words) > 1:
                words[2 * rng.randrange(len(words) // 2) + 1] = rng.choice(
                    [_hostile(rng), rng.choice(KEYS), rng.choice(NAMES)]
                )
                lines[at] = "".join(words)
        text = "\n".join(lines) + "\n"
    return text


# ---- structure ----


def _hostile(rng: random.Random) -> str:
    return rng.choice(HOSTILE) if rng.random() < 0.8 else _quantity(rng)


def _quantity(rng: random.Random) -> str:
    number = rng.choice(
        ["0", "1", "-1", "0.5", "1e-9", "1e9", "1/3", "1e300", "5", "1000", "2.5e-3", ".5", "5."]
    )
    return f"{number} {rng.choice(UNITS)}".strip()


class _Loader(yaml.BaseLoader):
    """Everything a string, mappings as `Pairs`."""


_Loader.add_constructor(
    "tag:yaml.org,2002:map",
    lambda loader, node: Pairs(
        [
            [loader.construct_object(k, deep=True), loader.construct_object(v, deep=True)]
            for k, v in node.value
        ]
    ),
)


_trees: dict[str, Tree] = {}  # of the texts that come again and again


def tree_of(text: str) -> Tree:
    """Return a YAML text as a tree that can be changed."""
    if text not in _trees:
        _trees[text] = yaml.load(text, Loader=_Loader)
    return _copied(_trees[text])


def _spots(tree: Tree) -> list[tuple[Any, int]]:
    """Return every (collection, index) of a tree."""
    found: list[tuple[Any, int]] = []
    open_: list[Tree] = [tree]
    while open_:
        node = open_.pop()
        if isinstance(node, list):
            for i, item in enumerate(node):
                found.append((node, i))
                open_.append(item[1] if isinstance(node, Pairs) else item)
    return found


def _value(rng: random.Random) -> Tree:
    how = rng.randrange(12)
    if how == 0:
        return [_hostile(rng) for _ in range(rng.randrange(4))]
    if how == 1:
        return Pairs([[rng.choice(KEYS), _hostile(rng)] for _ in range(rng.randrange(4))])
    if how == 2:
        return rng.choice(COUNTS)
    if how == 3:
        return _expression(rng, 3)
    if how == 4:
        return rng.choice(NAMES)
    if how == 5:
        return [[_hostile(rng), rng.choice(COUNTS)], [rng.choice(COUNTS)]]
    if how in (6, 7):
        return _quantity(rng)
    return _hostile(rng)


def changed(tree: Tree, rng: random.Random, donor: Tree) -> None:
    """Change a tree in place, once."""
    spots = _spots(tree)
    if not spots:
        return
    node, i = rng.choice(spots)
    how = rng.randrange(9)
    if how == 0:
        del node[i]
    elif how == 1:
        node.insert(rng.randrange(len(node) + 1), _copied(node[i]))
    elif how == 2:  # moved
        to, _ = rng.choice(spots)
        if isinstance(to, Pairs) == isinstance(node, Pairs):
            to.append(_copied(node[i]))
            if to is not node:
                del node[i]
    elif how == 3 and isinstance(node, Pairs):
        node[i][0] = rng.choice(
            [rng.choice(KEYS), _hostile(rng), str(node[i][0])[:-1], str(node[i][0]) + "s"]
        )
    elif how == 4 and isinstance(node, Pairs):
        node.append([rng.choice(KEYS), _value(rng)])
    elif how == 5:
        other, j = rng.choice(_spots(donor))
        if isinstance(other, Pairs) == isinstance(node, Pairs):
            node[i] = _copied(other[j])
    elif isinstance(node, Pairs):
        node[i][1] = _value(rng)
    else:
        node[i] = _value(rng)


def _copied(tree: Tree) -> Tree:
    if isinstance(tree, Pairs):
        return Pairs([[key, _copied(value)] for key, value in tree])
    if isinstance(tree, list):
        return [_copied(item) for item in tree]
    return tree


_PLAIN = re.compile(r"[\w./*+^()<=·µ-][\w ./*+^()<=·µ-]*\Z")


def written(tree: Tree, rng: random.Random | None = None) -> str:
    """Return a tree as YAML in one line a top key, scalars plain where YAML allows, and sometimes where not."""
    if isinstance(tree, Pairs):
        return "\n".join(f"{_flow(key, rng)}: {_flow(value, rng)}" for key, value in tree) + "\n"
    return _flow(tree, rng) + "\n"


def _flow(tree: Tree, rng: random.Random | None) -> str:
    if isinstance(tree, Pairs):
        return "{" + ", ".join(f"{_flow(key, rng)}: {_flow(value, rng)}" for key, value in tree) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join(_flow(item, rng) for item in tree) + "]"
    text = str(tree)
    plain = _PLAIN.match(text) and text == text.strip()
    if plain or (rng is not None and rng.random() < 0.05):
        return text
    return json.dumps(text, ensure_ascii=False)


def _structure(rng: random.Random) -> dict[str, bytes]:
    tree, donor = tree_of(_scene(rng)), tree_of(_scene(rng))
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        changed(tree, rng, donor)
    return {TOPOLOGY: _encoded(written(tree, rng))}


# ---- expressions and units ----


def _expression(rng: random.Random, depth: int) -> str:
    how = rng.randrange(10) if depth else rng.randrange(3)
    if how == 0:
        return rng.choice(["0", "1", "2", "0.5", "1e-3", "1e300", "3/2"])
    if how in (1, 2):
        return rng.choice(NAMES)
    inner = _expression(rng, depth - 1)
    if how == 3:
        return f"-{inner}"
    if how == 4:
        return f"({inner})^{rng.choice(['2', '-1', '0', '(1/2)', '1.5', '100', '101', 'x'])}"
    if how == 5:
        more = f", {_expression(rng, depth - 1)}" if rng.random() < 0.3 else ""
        return f"{rng.choice(UNARY)}({inner}{more})"
    if how == 6:
        other = _expression(rng, depth - 1)
        test = rng.choice(["<", "<=", ">", ">=", "==", "!=", "and", "or"])
        return f"if {inner} {test} {other} then {_expression(rng, depth - 1)} else {other}"
    if how == 7:
        return f"{{{inner}, {_expression(rng, depth - 1)}}}"
    return f"{inner} {rng.choice('+-*/')} {_expression(rng, depth - 1)}"


def _own_expression(rng: random.Random, depth: int = 2) -> str:
    """Return an expression over the number q that has no unit."""
    if not depth or rng.random() < 0.2:
        return rng.choice(["q", "peers", "2", "0", "1/3", "1e-3", "1e30"])
    one, two = _own_expression(rng, depth - 1), _own_expression(rng, depth - 1)
    call = f"{rng.choice(['abs', 'sqrt', 'exp', 'log', 'tanh', 'floor', 'sign', 'cos'])}({one})"
    choice = f"(if {one} {rng.choice(['<', '>=', '==', '!='])} {two} then {one} else {two})"
    return rng.choice([f"({one} {rng.choice('+-*/')} {two})", call, choice, f"({one})^{rng.choice(['2', '3', '-1', '(1/2)', '100'])}", f"max({one}, {two})"])  # fmt: skip


def _scrambled(text: str, rng: random.Random) -> str:
    for _ in range(rng.randrange(3)):
        at = rng.randrange(len(text) + 1)
        text = text[:at] + rng.choice(["(", ")", "*", "^", "/", "=", ",", ".", " ", "..", "[1]", "__", "é", "'", "if ", "then", "1e", "9" * 30, ":"]) + text[at + rng.randrange(3) :]  # fmt: skip
    return text


def _numbers(rng: random.Random) -> dict[str, bytes]:
    """Put expressions, quantities and units where a topology has numbers."""
    tree = tree_of(_scene(rng))
    numbers = [
        (node, i)
        for node, i in _spots(tree)
        if isinstance(node, Pairs) and isinstance(node[i][1], str) and re.match(r"-?[\d.]", node[i][1])
    ]
    tree[:] = [pair for pair in tree if pair[0] != "parameters"]
    named = [["kt", "2000 N/m"], ["tick", "1 ms"], ["q", "3"]]
    if rng.random() < 0.3:
        named.append([rng.choice(NAMES), rng.choice([_quantity, _own_expression])(rng)])
    tree.append(["parameters", Pairs(named)])
    for _ in range(rng.choice([1, 1, 2, 4])):
        node, i = rng.choice(numbers)
        if rng.random() < 0.3:  # what fits in its unit
            made = f"{node[i][1].split(' ')[0]}*{_own_expression(rng)}*1"
            unit = node[i][1].partition(" ")[2]
            made = {"N/m": f"kt*{_own_expression(rng)}", "ms": f"tick*{_own_expression(rng)}"}.get(unit, made)
        else:
            made = rng.choice([_quantity, lambda r: _expression(r, 3), _own_expression, _hostile])(rng)
        node[i][1] = _scrambled(made, rng) if rng.random() < 0.5 else made
    return {TOPOLOGY: _encoded(written(tree))}


# ---- components ----


def _component(rng: random.Random) -> dict[str, bytes]:
    """Shadow a component of the library by a changed one of the same name, in a folder of the scene's own."""
    scene = tree_of(_scene(rng))
    shown = str(scene)
    used = [text for name, text in TITLES.items() if name in shown]
    text = rng.choice(used or list(COMPONENTS.values()))
    if rng.random() < 0.3:
        text = _mangled(text, rng)
    else:
        tree, donor = tree_of(text), tree_of(rng.choice(list(COMPONENTS.values())))
        for _ in range(rng.choice([1, 1, 2, 4])):
            if rng.random() < 0.5:
                _change_equation(tree, rng)
            else:
                changed(tree, rng, donor)
        text = written(tree)
    scene.append(
        ["library", rng.choice(["./parts", "parts", ["parts"], "."] if rng.random() < 0.05 else ["parts"])]
    )
    return {TOPOLOGY: _encoded(written(scene)), "parts/own.yaml": _encoded(text)}


def _change_equation(tree: Tree, rng: random.Random) -> None:
    """Replace an equation, or a name or number in one."""
    for key, value in tree:
        if key == "equations" and value and type(value) is list:
            i = rng.randrange(len(value))
            how = rng.randrange(5)
            if how == 0:
                value[i] = f"{_expression(rng, 2)} = {_expression(rng, 3)}"
            elif how == 1:
                value.append(f"{rng.choice(NAMES)} = {_expression(rng, 3)}")
            elif how == 2:
                value[i] = _scrambled(str(value[i]), rng)
            else:
                words = re.split(r"([\w.]+)", str(value[i]))
                if len(words) > 1:
                    words[2 * rng.randrange(len(words) // 2) + 1] = rng.choice(
                        [rng.choice(NAMES), _expression(rng, 1), _expression(rng, 2)]
                    )
                    value[i] = "".join(words)


# ---- tables ----


def _table(rng: random.Random) -> dict[str, bytes]:
    """Change a table, or what names it."""
    name = rng.choice(["users.csv", "push.csv", "edges.csv"])
    if name == "users.csv":
        text, scene = TABLES[name], SCENES["users-table"]
    elif name == "push.csv":
        text = PUSH
        scene = (
            SCENES["three-users-average"]
            + "hands:\n  hand: {type: TableForce, flange: device, force: push.csv}\n"
        )
    else:
        text = "from,to,weight\n1,2,1\n2,3,0.5\n3,1,2\n"
        scene = SCENES["three-users-average"].replace(
            "delay: 8 ms}\n", "delay: 8 ms, graph: {arcs: edges.csv}}\n"
        )
    for _ in range(rng.choice([1, 1, 2, 5])):
        cells = [line.split(",") for line in text.splitlines()] or [[""]]
        row = rng.randrange(len(cells))
        how = rng.randrange(8)
        if how == 0:
            del cells[row]
        elif how == 1:
            cells[row].append(_hostile(rng))
        elif how == 2 and cells[row]:
            cells[row].pop()
        elif how == 3:
            cells.insert(row, list(cells[rng.randrange(len(cells))]))
        elif how == 4:
            text = rng.choice(["\r\n", "\r", "\n\n", ";\n", "\x00\n"]).join(",".join(line) for line in cells)
            continue
        elif cells[row]:
            made = rng.choice([_hostile(rng), rng.choice(COUNTS), f"{rng.choice(KEYS)} [{rng.choice(UNITS)}]", f"{rng.choice(NAMES)}[", '"', '"1', "1\n2"])  # fmt: skip
            cells[row][rng.randrange(len(cells[row]))] = made
        text = "\n".join(",".join(line) for line in cells) + "\n"
    return {
        TOPOLOGY: _encoded(scene),
        name: _encoded(text) + (rng.randbytes(3) if rng.random() < 0.03 else b""),
    }


# ---- blow-ups ----


def _bomb(rng: random.Random) -> dict[str, bytes]:
    """Ask for too much: of memory, depth, length or number."""
    scene = _scene(rng)
    n = rng.choice([10, 100, 1000, 10000])
    if n == 10000 and rng.random() < 0.8:
        n = 300
    large = rng.choice([1 << 16, 1 << 20, 10 << 20]) if rng.random() < 0.15 else 1 << 12
    texts: list[Callable[[], str]] = [
        lambda: scene + "".join(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 9) if i else 1}]\n" for i in range(12)),
        lambda: scene + "x: " + "[" * n + "]" * n + "\n",
        lambda: scene + "x: " + "{a: " * n + "1" + "}" * n + "\n",
        lambda: scene + "\n".join(" " * i + "a:" for i in range(min(n, 1000))) + "\n",
        lambda: scene + "- " * n + "1\n",
        lambda: scene + "about2: " + "x" * large + "\n",
        lambda: scene.replace("0.1 kg", "1" * large + " kg", 1),
        lambda: scene.replace("0.1 kg", "(" * n + "1 kg" + ")" * n, 1),
        lambda: scene.replace("0.1 kg", '"' + "1+" * n + '1"', 1),
        lambda: scene.replace("0.1 kg", "1 " + "m*" * n + "kg", 1),
        lambda: scene + "parameters: {" + ", ".join(f"p{i}: {f'p{i - 1}*p{i - 1}' if i else 2}" for i in range(min(n, 300))) + "}\n",
        lambda: scene + "parameters: {" + ", ".join(f"p{i}: p{i + 1}" for i in range(n)) + "}\n",
        lambda: scene + "parameters: {" + ", ".join(f"p{i}: p{i + 1}" for i in range(n)) + f", p{n}: 1}}\n",
        lambda: scene.replace("count: 3", "count: " + rng.choice(COUNTS)),
        lambda: scene.replace("{mass: 0.1 kg", f"{{count: {min(n, 100)}, mass: 0.1 kg", 1),
        lambda: scene.replace("haptic: 1 ms", "haptic: " + rng.choice(["1e-200 s", "1/999999999999 s", "1e200 s", "7/11 ms", "0.0010000001 s"])),
        lambda: scene.replace("delay: 8 ms}", "delay: " + rng.choice(["1e9 s", "1e-99 s", "1e300 s", "0 s", "1/7 ms"]) + "}"),
        lambda: scene + "k: v\n" * n,
        lambda: scene + "\n".join(f"k{i}: v" for i in range(n)) + "\n",
        lambda: scene.replace("count: 3", "count: 3, set: {device.mass: [" + ", ".join(["1 kg"] * n) + "]}"),
        lambda: scene.replace("delay: 8 ms}", "delay: 8 ms, graph: {edges: [" + ", ".join(f"[{i}, {i + 1}]" for i in range(n)) + "]}}"),
        lambda: scene + "hands: {" + ", ".join(f"h{i}: {{type: ConstantForce, flange: device, force: 1 N}}" for i in range(min(n, 100))) + "}\n",
        lambda: "&a [*a, *a]\n",
        lambda: "# " + "x" * large + "\n" + scene,
        lambda: scene + " " * large + "\n",
        lambda: scene + "? " * min(n, 1000) + "x\n",
        lambda: scene + "x: |\n" + " line\n" * n,
        lambda: scene + "x: '" + "\n\n" * n + "'\n",
        lambda: scene + "!" * n + "\n",
        lambda: scene + "x: !<" + "a" * n + "> 1\n",
    ]  # fmt: skip
    return {TOPOLOGY: _encoded(rng.choice(texts)())}


SORTS: tuple[tuple[str, Callable[[random.Random], dict[str, bytes]], int], ...] = (
    ("bytes", _bytes, 12),
    ("lines", _lines, 14),
    ("structure", _structure, 26),
    ("numbers", _numbers, 18),
    ("component", _component, 20),
    ("table", _table, 8),
    ("bomb", _bomb, 2),
    (PLAYED, odd_equations, 3),
    ("vectors", odd_vectors, 6),
)
