"""Components that are nearly right: odd equations over all operators, in scenes that are right otherwise.

Takes: a seeded generator. Gives: `odd_equations`.
Guarantees: of equal seed comes equal input; most units agree, some don't; nearly always there are as many
equations as unknowns.
Does not: know whether such equations have a solution.
"""

from __future__ import annotations

import random

from apc.compiler.language.expression import SMOOTH

NUMBERS = ("0", "1", "2", "0.5", "3", "-1", "1e-9", "1e9", "0.1")
POWERS = ("2", "3", "-1", "-2", "0.5", "1.5", "(1/3)", "0", "1", "(-0.5)")
FUNCTIONS = (*SMOOTH, "sqrt", "abs", "sign", "floor")
SMALL = {"m": "L", "N": "F", "m/s": "L/T0", "s": "T0", "N/m": "K", "N*s/m": "D"}


class _Writer:
    """Writes expressions of a unit, continuous ones or those of a clock."""

    def __init__(self, rng: random.Random, *, clocked: bool, heard: bool, own: tuple[str, ...]) -> None:
        self.rng = rng
        self.clocked = clocked
        self.heard = heard
        self.own = own  # variables with the unit m

    def atom(self, unit: str) -> str:
        """Return a name, or an operator of a name."""
        rng = self.rng
        if unit == "1":
            return rng.choice((*NUMBERS, f"{self.atom('m')}/L", "F/(K*L)", "time/T0", "peers", "G"))
        if unit == "m":
            positions = ["a.x", "b.x"]
            if self.clocked:
                found = [f"sample({rng.choice(positions)})", f"sample({self._moving()})", *self.own]
                found += [f"previous({name})" for name in self.own]
                found += [f"initial({name})" for name in self.own]
                found += [f"sample(hold({name}))" for name in self.own]
                if self.heard:
                    found += ["mean(others.x)", "sum(others.x - L)", "max(others.x)", "sum(min(L, others.x))"]
            else:
                found = [
                    *positions,
                    *self.own,
                    "F/K",
                    "T0*der(a.x)",
                    *(f"initial({name})" for name in self.own),
                ]
            return rng.choice([*found, *found, "L", "0*L"])
        if unit == "m/s":
            found = ["L/T0"]
            if self.clocked:
                found += ["sample(der(a.x))", "sample(der(b.x))"]
            else:
                found += ["der(a.x)", "der(b.x)", *(f"der({name})" for name in self.own)]
            return rng.choice(found)
        if unit == "N":
            found = ["F", f"K*{self.atom('m')}", f"D*{self.atom('m/s')}", "0*F"]
            if not self.clocked:
                found.append(rng.choice(("a.f", "b.f")))
            return rng.choice(found)
        return SMALL[unit] if unit != "s" or self.rng.random() < 0.5 else "time"

    def _moving(self) -> str:
        plain = _Writer(self.rng, clocked=False, heard=False, own=())
        return plain.expression("m", 1)

    def expression(self, unit: str, depth: int) -> str:
        """Return an expression of a unit, now and then of another."""
        rng = self.rng
        if rng.random() < 0.006:
            unit = rng.choice((*SMALL, "1"))
        if depth <= 0 or rng.random() < 0.25:
            return self.atom(unit)

        def part(of: str = unit) -> str:
            return self.expression(of, depth - 1)

        size = SMALL.get(unit, "1")
        made = (
            lambda: f"({part()} + {part()})",
            lambda: f"({part()} - {part()})",
            lambda: f"({part()} + {part('1')}*{part()})",
            lambda: f"{part('1')}*{part()}",
            lambda: f"{part()}/{part('1')}",
            lambda: f"-{part()}",
            lambda: f"max({part()}, {part()})",
            lambda: f"min({part()}, {part()}, {part()})",
            lambda: f"abs({part()})",
            lambda: f"(if {self.condition(depth)} then {part()} else {part()})",
            lambda: (
                f"(if {self.condition(depth)} then {part()} "
                f"elseif {self.condition(depth)} then {part()} else {part()})"
            ),
            lambda: f"{size}*{rng.choice(FUNCTIONS)}({part()}/({size}))",
            lambda: f"{size}*({part()}/({size}))^{rng.choice(POWERS)}",
            lambda: f"sqrt({part()}*{part()})",
            lambda: f"sqrt(({part()})^2 + ({part()})^2)",
            lambda: f"{part()}*{part()}/({size})",
        )
        return rng.choice(made)()

    def condition(self, depth: int) -> str:
        """Return a condition."""
        unit = self.rng.choice(("m", "1", "N"))
        left, right = self.expression(unit, depth - 2), self.expression(unit, depth - 2)
        told = f"{left} {self.rng.choice(('<', '<=', '>', '>=', '==', '!='))} {right}"
        return f"not {told}" if self.rng.random() < 0.1 else told


def odd_equations(rng: random.Random) -> dict[str, bytes]:
    """Return a scene whose one coupler has odd equations."""
    clocked, heard = rng.random() < 0.5, rng.random() < 0.25
    clocked = clocked or heard
    variables = rng.sample(("z", "w", "q"), rng.choice((0, 1, 1, 2)))
    equations, declared = [], []
    moving: list[str] = []  # continuous variables
    ticking: list[str] = []
    for name in variables:
        (ticking if clocked and rng.random() < 0.7 else moving).append(name)
    depth = rng.choice((1, 2, 2, 3))
    plain = _Writer(rng, clocked=False, heard=False, own=tuple(moving))
    ticks = _Writer(rng, clocked=True, heard=heard, own=tuple(ticking))
    for name in variables:
        if rng.random() < 0.97:
            start = rng.choice(("0 m", "1 mm", "-1 mm", "1 m"))
            declared.append(
                f"  {name}: {{unit: m" + (f", start: {start}" if rng.random() < 0.95 else "") + "}"
            )
        writer = ticks if name in ticking else plain
        side = writer.expression("m", depth)
        forms = [f"{name} = {side}", f"{name} = {side}", f"{side} = {writer.expression('m', depth)}"]
        forms += [f"{name} = {rng.choice(('max', 'min'))}({name}, {side})", f"{name} = 0.5*{name} + {side}"]
        if name in moving:
            rate = plain.expression("m/s", depth)
            forms += [f"der({name}) = {rate}", f"der({name}) = {rate}", f"T0*der({name}) + {name} = {side}"]
        else:
            forms.append(f"{name} = 0.5*previous({name}) + {side}")
        equations.append(rng.choice(forms))
    force = plain.expression("N", depth)
    if clocked and rng.random() < 0.8:
        force = f"hold({ticks.expression('N', depth)}{rng.choice(('', '', ', T0', ', T0/2'))})"
    forces = [f"a.f = {force}"] * 4 + [f"a.x = b.x + {plain.expression('m', 1)}", f"a.x = {plain.atom('m')}"]
    forces += [f"{force} = {plain.expression('N', 1)}", f"a.f + b.f = {force}"]
    equations += [
        rng.choice(forces),
        rng.choice(("b.f = -a.f",) * 5 + ("b.f = -2*a.f", "b.f = 0*a.f", "a.f = -b.f")),
    ]
    if rng.random() < 0.03:
        equations.append(f"{rng.choice((*variables, 'y'))} = {plain.expression('m', 1)}")
    rng.shuffle(equations)
    lines = ["component: Own", "connectors: {a: Flange, b: Flange}"]
    if heard:
        sent = rng.choice(("sample(a.x)", "sample(a.x - b.x)", f"sample({plain.expression('m', 1)})"))
        lines.append(f"sends: {{x: '{sent}'}}")
    lines += [
        "parameters:",
        f"  K: {{unit: N/m, default: {rng.choice(('100', '0', '1e4'))}}}",
        f"  D: {{unit: N*s/m, default: {rng.choice(('0', '1', '-1'))}}}",
        f"  F: {{unit: N, default: {rng.choice(('1', '0', '-2'))}}}",
        f"  L: {{unit: m, default: {rng.choice(('1', '0.001', '0'))}}}",
        f"  T0: {{unit: s, default: {rng.choice(('0.01', '0.001', '0'))}}}",
        "  G: {unit: 1, default: 2}",
    ]
    lines += ["  clock: clock"] * clocked + ["  link: link"] * heard
    lines += (["variables:", *declared] if declared else []) + [
        "equations:",
        *(f"  - {one}" for one in equations),
    ]
    two = rng.random() < 0.5
    own = f"{{type: Own, a: m, b: {'n' if two else 'ground'}{', clock: h' * clocked}{', link: lan' * heard}}}"
    scene = [
        "topology: odd",
        "library: ./parts",
        "clocks: {h: 1 ms, c: 4 ms}",
        f"peers: {{u: {{count: {rng.choice((1, 2, 2, 3, 3)) if heard else 1}}}}}",
        "masses:",
        f"  m: {{mass: 1 kg, damping: {rng.choice((0, 5))} N*s/m, x: {rng.choice((0, 1, -1))} mm}}",
        *(["  n: {mass: 0.2 kg, damping: 2 N*s/m}"] if two else []),
        "couplers:",
        f"  own: {own}",
        *(
            ["  tie: {type: SpringDamper, a: m, b: n, stiffness: 100 N/m}"]
            if two and rng.random() < 0.3
            else []
        ),
        *(["links: {lan: {clock: c, delay: 4 ms}}"] if heard else []),
    ]
    return {"scene.yaml": "\n".join(scene).encode(), "parts/own.yaml": "\n".join(lines).encode()}
