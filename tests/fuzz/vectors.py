# ruff: noqa: E501 -- models in text, built in one line, read best as they are
"""Components of vectors that are nearly right, arrays inside them, and topologies that give vectors values.

Takes: a seeded generator. Gives: `odd_vectors`.
Guarantees: of equal seed comes equal input; most sizes and units agree, some don't; nearly always there are as
many equations as unknowns.
Does not: know whether such equations have a solution.
"""

from __future__ import annotations

import random

ODD = 0.004  # how often something is of another size or unit, or is no vector


class _Writer:
    """Writes vectors and numbers of a unit, continuous ones or those of a clock."""

    def __init__(self, rng: random.Random, size: int, *, clocked: bool, heard: bool) -> None:
        self.rng, self.size, self.clocked, self.heard = rng, size, clocked, heard

    def vector(self, unit: str, depth: int) -> str:
        """Return a vector of m or N."""
        rng = self.rng
        if rng.random() < ODD:
            return self.number(unit, depth)
        if depth <= 0 or rng.random() < 0.2:
            if unit == "N":
                return rng.choice(("P", f"K*{self.vector('m', 0)}", self._literal("N", 0)))
            atoms = ["a.x", "b.x", "q"] if not self.clocked else ["sample(a.x)", "sample(b.x)", "previous(q)"]
            atoms += ["initial(q)", "O", self._literal("m", 0)]
            atoms += ["mean(others.x)", "sum(others.x - sample(a.x))", "max(others.x)"] * self.heard
            return rng.choice(atoms)

        def part() -> str:
            return self.vector(unit, depth - 1)

        made = [
            lambda: f"({part()} + {part()})",
            lambda: f"({part()} - {part()})",
            lambda: f"-{part()}",
            lambda: f"{self.number('1', depth - 1)}*{part()}",
            lambda: f"{part()}/{self.number('1', depth - 1)}",
            lambda: (
                f"(if {self.number(unit, depth - 1)} > {self.number(unit, depth - 1)} then {part()} else {part()})"
            ),
            lambda: f"max({part()}, {part()})",
            lambda: f"abs({part()})",
            lambda: self._literal(unit, depth - 1),
            lambda: f"{self.number(unit, depth - 1)}*{part()}/norm({part()})",
        ]
        if self.size == 3:
            made.append(lambda: f"cross({part()}, {part()})/{'L' if unit == 'm' else 'F'}")
        return rng.choice(made)()

    def _literal(self, unit: str, depth: int) -> str:
        size = self.size + (self.rng.choice((-1, 1)) if self.rng.random() < ODD else 0)
        return "{" + ", ".join(self.number(unit, depth) for _ in range(size)) + "}"

    def number(self, unit: str, depth: int) -> str:
        """Return a number of m, N or 1."""
        rng = self.rng
        if rng.random() < ODD / 2:
            return self.vector("m", depth - 1)
        if unit == "1":
            return rng.choice(("2", "0.5", "3", f"{self.number('m', depth)}/L"))
        if depth <= 0 or rng.random() < 0.3:
            index = rng.randint(1, self.size) if rng.random() > ODD else rng.choice((0, 4, 99))
            entry = f"sample(a.x[{index}])" if self.clocked else f"a.x[{index}]"
            return rng.choice(("L", "0*L", entry) if unit == "m" else ("F", "0*F", f"K*{entry}"))
        one, two = self.vector(unit, depth - 1), self.vector(unit, depth - 1)
        made = [
            f"norm({one})",
            f"dot({one}, {two})/{'L' if unit == 'm' else 'F'}",
            f"sqrt(dot({one}, {one}))",
        ]
        if self.size == 2:
            made.append(f"cross({one}, {two})/{'L' if unit == 'm' else 'F'}")
        return rng.choice(made)


def odd_vectors(rng: random.Random) -> dict[str, bytes]:
    """Return a scene whose couplers and masses are of vectors."""
    size = rng.choice((2, 3))
    heard = rng.random() < 0.3
    clocked = heard or rng.random() < 0.5
    told = size if rng.random() > ODD else rng.choice((0, 1, 4, "two", "2.0", "[2]"))

    def listed(unit: str, *, nested: int = 0) -> str:
        if nested:
            return f"[{', '.join(listed(unit) for _ in range(nested))}]"
        count = size if rng.random() > ODD else rng.choice((1, 4))
        values = (f"{rng.choice((0, 1, -2, 0.5))} {unit}" for _ in range(count))
        return f"[{', '.join(values)}]" if rng.random() > ODD else f"1 {unit}"

    depth = rng.choice((0, 1, 2, 2))
    plain = _Writer(rng, size, clocked=False, heard=False)
    ticks = _Writer(rng, size, clocked=True, heard=heard)
    force = plain.vector("N", depth)
    if clocked:
        force = f"hold(K*q + {ticks.vector('N', depth)}{rng.choice(('', ', T0'))})"
    moving = rng.choice(("der(q) = (a.x - q)/T0", "q = b.x - O", f"q = {plain.vector('m', 1)}"))
    if clocked:
        moving = f"q = {rng.choice(('0.5*previous(q) + ', ''))}{ticks.vector('m', 1)}"
    equations = [
        moving,
        f"a.f = {force}",
        rng.choice(("b.f = -a.f",) * 20 + ("b.f = -2*a.f", "b.f[1] = -a.f[1]")),
    ]
    twist = rng.random() < 0.3  # a second pair at each connector
    if twist:
        equations += ["a.n = K*(a.s - b.s)", "b.n = -a.n"]
    if rng.random() < 0.2:
        equations.append("y = norm(a.x - b.x)" if rng.random() < 0.5 else "y = 2*(a.x - b.x)")
    rng.shuffle(equations)
    second = (", s: {unit: m}", ", n: {unit: N}") if twist else ("", "")
    if twist and rng.random() < 0.03:
        second = (second[0], "")
    point = [
        "connector: Point",
        f"potentials: {{x: {{unit: m, size: {size}}}{second[0]}}}",
        f"flows: {{f: {{unit: N, size: {size}}}{second[1]}}}",
    ]
    body = [
        "component: Body",
        "connectors: {flange: Point}",
        "parameters: {mass: {unit: kg, above: 0, shared: divided}}",
        "variables:",
        f"  x: {{unit: m, size: {size}, start: {listed('m')}}}",
        f"  v: {{unit: m/s, size: {told}, start: {listed('m/s')}}}",
        *(["  s: {unit: m, start: 0 m}", "  w: {unit: m/s, start: 0 m/s}"] if twist else []),
        "equations:",
        "  - der(x) = v",
        "  - mass*der(v) = flange.f",
        "  - flange.x = x",
        *(["  - der(s) = w", "  - mass*der(w) = flange.n", "  - flange.s = s"] if twist else []),
    ]
    own = [
        "component: Own",
        "connectors: {a: Point, b: Point}",
        *(["sends: {x: sample(a.x)}"] if heard else []),
        "parameters:",
        "  K: {unit: N/m, default: 100}",
        "  F: {unit: N, default: 1}",
        "  L: {unit: m, default: 1}",
        "  T0: {unit: s, default: 0.01}",
        f"  O: {{unit: m, size: {size}, default: {listed('m')}}}",
        f"  P: {{unit: N, size: {size}, default: {listed('N')}}}",
        *["  clock: clock"] * clocked,
        *["  link: link"] * heard,
        "variables:",
        f"  q: {{unit: m, size: {size}, start: {listed('m')}}}",
        "equations:",
        *(f"  - {one}" for one in equations),
    ]
    count = rng.choice((3,) * 9 + (2,)) if rng.random() > ODD else rng.choice((0, -1, 501, "n", 1000))
    references = ", clock: clock" * clocked + ", link: link" * heard
    handed = rng.choice(("O", "2*O", "-O", "O[1]*O/O[1]", "O", "{O[1], O[2]}" if size == 2 else "O", "mass"))
    row = [
        "component: Row",
        "connectors: {end: Point}",
        f"parameters: {{mass: {{unit: kg, above: 0}}, O: {{unit: m, size: {size}}}{', clock: clock' * clocked}{', link: link' * heard}}}",
        "parts:",
        f"  link: {{type: Body, count: {count}, mass: mass, x: '{handed}'}}",
        f'  tie: {{type: Own, count: {rng.choice((2,) * 9 + (3,))}, a: "link[1:2]", b: "link[2:3]", O: O{references}}}',
        f'connect: {{end: "link[{rng.choice((1, 1, 1, 2, 3, 1, 1, 1, 9))}].flange"}}',
    ]
    arrays = rng.random() < 0.4
    peers = rng.choice((2, 3)) if heard else rng.choice((1, 2))
    name = (
        rng.choice(("m.x", "m.x", "own.O", "m.v", "row.link.x", "row.O"))
        if arrays
        else rng.choice(("m.x", "own.O", "own.P"))
    )
    unit = {"v": "m/s", "P": "N"}.get(name[-1], "m")
    group = rng.choice(
        (
            f"count: {peers}",
            f"count: {peers}, set: {{{name}: {listed(unit)}}}",
            f"count: {peers}, set: {{{name}: {listed(unit, nested=peers)}}}",
            f"set: {{{name}: {listed(unit, nested=peers)}}}",
            f"set: {{{name}: {listed(unit)}}}",
            f'count: {peers}, set: {{"{name}[{rng.choice((1, 2, 3, 4))}]": 1 {unit}}}',
            "table: vectors.csv",
        )
    )
    table = f"{name}[1] [{unit}],{name}[2] [{unit}]\n" + "1,2\n" * peers
    part = f"{{type: Own, a: m, b: {rng.choice(('n', 'ground'))}, O: {listed('m')}{', clock: h' * clocked}{', link: lan' * heard}}}"
    scene = [
        "topology: odd",
        "library: ./parts",
        "clocks: {h: 1 ms, c: 4 ms}",
        f"peers: {{u: {{{group}}}}}",
        "masses:",
        f"  m: {{type: Body, mass: 1 kg, x: {listed('m')}}}",
        f"  n: {{type: Body, mass: 2 kg{', shared: true' * (rng.random() < 0.3)}}}",
        *(
            [
                f"  row: {{type: Row, mass: 1 kg, O: {listed('m')}{', clock: h' * clocked}{', link: lan' * heard}}}"
            ]
            if arrays
            else []
        ),
        "couplers:",
        f"  own: {part}",
        *(
            ["  more: {type: Own, a: row.end, b: m" + f"{', clock: h' * clocked}{', link: lan' * heard}}}"]
            if arrays
            else []
        ),
        *(["links: {lan: {clock: c, delay: 4 ms}}"] if heard else []),
    ]
    files = {"point": point, "body": body, "own": own} | ({"row": row} if arrays else {})
    return {
        "scene.yaml": "\n".join(scene).encode(),
        "vectors.csv": table.encode(),
        **{f"parts/{key}.yaml": "\n".join(lines).encode() for key, lines in files.items()},
    }
