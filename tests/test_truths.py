"""Every topology with a known result, by every method: refused with a message, or right within its bound.

A method takes a case and returns its result; a new method is one more line of `METHODS`. Every topology is
analyzed each time, and by some of the other methods; `pytest --whole` takes all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from tests.bruteforce import TopologySource
from tests.fifty_digits.truth import spectral_truth
from tests.reference import CONTACT_LIMITS, HELPED_LIMITS, LIMITS, OPERATORS
from tests.topologies import compiled
from tests.truths import CASES, LIBRARY, UNTOLD, distance, model, text_of, truth


@dataclass(frozen=True, slots=True)
class MethodResult:
    """The result of a method: the spectral radius and its error bound, the free motions, and the verdict."""

    radius: float
    error: float
    rigid: int | None = None
    stable: bool | None = None
    verdict: str = ""
    notes: tuple[str, ...] = ()


def _point(name: str, **requested: object) -> MethodResult:
    one = apc.analyze(model(name), **requested)  # type: ignore[arg-type] # a method or a proof
    if requested.get("certify"):
        # Floats that decided stay where balls do not; of determinants there is no proof.
        printed = ("proved", "decided with") if one.stable is not None else "undecided at"
        assert str(one.proof).startswith(printed) or one.method == "determinant"
    return MethodResult(
        one.spectral_radius, one.spectral_radius_error, one.rigid_modes, one.stable, one.verdict, one.notes
    )


def _by(method: str) -> Callable[[str], MethodResult]:
    return lambda name: _point(name, method=method)


def _number(name: str) -> tuple[str, float, str]:
    """Return a number that may be set, its value and its unit."""
    for one in apc.parameters(model(name)).rows:
        if one.low == one.high > 0 and one.unit in ("kg", "N/m", "N*s/m") and not (one.follows or one.fixed):
            return one.name, one.low, one.unit
    raise LookupError(name)


def _many(name: str) -> MethodResult:
    parameter, value, _ = _number(name)
    # Of points side by side some bounds are shared: the first of them is the topology's own.
    found = apc.analyze_many(model(name), {parameter: value * np.linspace(1, 1.01, 6)})
    if found.message[0]:
        raise RuntimeError(found.message[0])
    undecided = found.verdict[0].startswith("undecided")
    return MethodResult(
        found.spectral_radius[0],
        found.spectral_radius_error[0],
        int(found.rigid_modes[0]),
        None if undecided else bool(found.stable[0]),
        str(found.verdict[0]),
    )


def _sweep(name: str) -> MethodResult:
    parameter, value, unit = _number(name)
    found = apc.sweep(model(name), {parameter: [f"{value!r} {unit}"]}, jobs=1)
    reported = {heading: found.column(heading)[0] for heading in found.headings}
    if reported["message"]:
        raise RuntimeError(reported["message"])
    verdict = str(reported["verdict"])
    return MethodResult(
        float(reported["spectral_radius"]),
        float(reported["spectral_radius_error"]),
        int(reported["rigid_modes"]),
        None if verdict.startswith("undecided") else verdict.startswith("stable"),
        verdict,
    )


def _export(name: str) -> MethodResult:
    found = apc.export(model(name), to="npz").a
    rigid = truth(name).rigid
    values = np.linalg.eigvals(found)
    stored = values[np.argsort(np.abs(values - 1))][rigid:]
    return MethodResult(float(np.abs(stored).max(initial=0.0)), 1e-7, rigid)


def _box(name: str) -> MethodResult:
    parameter, _, _ = _number(name)
    found = apc.robust_stability(model(name), {parameter: "±1e-9%"})
    return MethodResult(float(truth(name).radius), 1e-15 * float(truth(name).radius), None, found.stable)


METHODS: dict[str, Callable[[str], MethodResult]] = {
    "point": _point,
    "dense": _by("dense"),
    "determinant": _by("determinant"),
    "paper": _by("paper"),
    "certify": lambda name: _point(name, certify=True),
    "many": _many,
    "sweep": _sweep,
    "export": _export,
    "box": _box,
}

# The messages with which a method may refuse a case.
REFUSED = {
    "dense": ("states; the limit is 1,000",),
    "determinant": ("rounding within a frame exceeds the eigenvalues of single peers",),
    "paper": ("E861", "E862", "E808 watch of user has a kink", "states; the limit is 1,000"),
    "export": ("E951", "E808 watch of user has a kink"),
    "box": ("E832", "states; the limit is 1,000"),
}

# Bounds that are wide all the same, relative to a radius above 1: of eigenvalues that are one (to the root of
# a rounding), of nothing left but the rigid, of poles that nearly cancel, of what a thousand ticks round.
USEFUL = 1e-6
WIDE = {
    "determinant": {"coasting": 1, "defective": 1e-2, "nearly-defective": 1e-2, "ninety-hertz": 1e-4}
    | {
        "a frame of 1 s without clocks": 1,
        "a damped mass": 1,
        "a light one": 1,
        "critically damped": 1e-5,
        "1/90 s": 1e-4,
    },
    "export": {"coasting": 2, "defective": 1e-5},
}

# Where a verdict is left open, and rightly: floats can't tell, or there is nothing to tell it by.
OPEN = {"box": ("coasting", "stiff-contact", "a cycle one way")} | dict.fromkeys(
    ("determinant", "paper"), ("boundary-inside-13", "boundary-outside-13", "boundary-inside-9")
)

# Minutes, for what nobody does: packets of a thousand frames, or a hundred in a frame, as states.
LEFT_OUT = {
    *(("sweep", name) for name in ("lossy-average", "two-rooms")),  # asks another question: in mean square
    ("export", "very-long-delay"),
    ("box", "non-commensurate"),
    ("determinant", "sixty-hertz-user"),  # a frame of 200 ms with the three rates of 1000, 125 and 60 Hz
}

LONG = {(method, "non-commensurate") for method in ("point", "dense", "many", "sweep", "certify")} | {
    ("point", "ring-of-eight"),
    ("box", "stiff-contact"),
    ("box", "a cycle one way"),
}


def _pairs() -> list[object]:
    """Return every case with every method; `point` and a few others do not require --whole."""
    found = []
    for place, (name, case) in enumerate(CASES.items()):
        for column, method in enumerate(METHODS):
            if (method, case.name) in LEFT_OUT or (case.source == "closed" and method == "paper"):
                continue
            ordinary = (method == "point" or (place + column) % 6 == 0) and (
                method,
                case.name,
            ) not in LONG
            marks = () if ordinary else pytest.mark.whole
            found.append(pytest.param(name, method, marks=marks, id=f"{name}-{method}"))
    return found


@pytest.mark.needs_extension("paper_method", "parameter_boxes")
@pytest.mark.few(70)
@pytest.mark.parametrize(("name", "method"), _pairs())
def test_every_method_is_right_within_its_bound_or_refuses(name: str, method: str) -> None:
    case, reported = CASES[name], truth(name)
    try:
        printed = METHODS[method](name)
    except ApcError as error:
        assert any(words in str(error) for words in REFUSED.get(method, ())), str(error)
        return
    wide = WIDE.get(method, {}).get(case.name, USEFUL)
    error = wide * max(1.0, printed.radius) if method == "export" else printed.error
    assert distance(printed.radius, reported) <= error
    assert error <= wide * max(1.0, printed.radius)
    assert printed.rigid is None or printed.rigid == reported.rigid
    if method == "export" or (method == "box" and abs(reported.radius - 1) < 1e-8):
        return
    if printed.stable is None:
        assert case.name in OPEN.get(method, ()) or abs(reported.radius - 1) < 1e-30
    else:
        assert printed.stable == (reported.radius < 1 and reported.verdict != "drifts")
        assert not (printed.verdict and reported.verdict) or printed.verdict == reported.verdict


def test_every_topology_of_the_library_is_followed_or_says_why_not() -> None:
    for path in LIBRARY:
        if path.stem in UNTOLD:
            assert UNTOLD[path.stem] in str(spectral_truth(apc.compile(path)))
    assert {path.stem for path in LIBRARY} >= set(UNTOLD)


# ---- limits: where the verdict changes as one number grows ----


@dataclass(frozen=True, slots=True)
class Limit:
    """The first value of a parameter at which a topology of the paper is no longer stable, right to
    `error`.
    """

    text: str
    parameter: str
    value: float
    error: float


def _limits() -> dict[str, Limit]:
    """Return the limits of `tests.reference`, each scheme's own."""
    found = {}
    for delayed, delays, damping, contact, average, mesh in LIMITS:
        for scheme, value in (("AP", average), ("VC", mesh)):
            text = _text(scheme, delayed=delayed, own=delays == "own", kc=contact, damping=damping)
            words = f"{scheme} {'late' if delayed else 'at once'} {delays} B={damping} K_C={contact}"
            found[words] = Limit(text, "coordination.stiffness", value, 6e-4)
    for damping, value in CONTACT_LIMITS:
        text = text_of(TopologySource(kt=0.0, bc=float(damping)))
        found[f"contact alone B_C={damping}"] = Limit(text, "contact.stiffness", value, 6e-4)
    for late, value in HELPED_LIMITS:
        text = text_of(TopologySource(bt=2.0, bc=2.0, kc=2000.0, comm=Fraction(late, 1000)))
        found[f"{late} ms late"] = Limit(text, "coordination.stiffness", value, 0.5)
    return found


def _text(scheme: str, *, delayed: bool, own: bool, kc: float, damping: float) -> str:
    delays = {} if delayed else {"comp": Fraction(0), "comm": Fraction(0)}
    gains = {"kc": float(kc), "bt": float(damping), "bc": float(damping)}
    return text_of(TopologySource(OPERATORS[scheme], own_delay=own, **gains, **delays))


LIMIT = _limits()


def _critical(one: Limit) -> float:
    found = apc.critical(compiled(one.text), one.parameter, lower="1 N/m", upper=f"{2 * one.value} N/m")
    first = found.crossings[0]
    assert first.stable_side == "below" and str(first.proof).startswith("proved") and found.complete
    assert first.error <= 1e-12 * first.value
    return first.value


def _curves(one: Limit) -> float:
    """Return where the boundary crosses the middle of a narrow strip of another parameter."""
    other = "device.mass"
    x, y = f"{one.parameter}={0.9 * one.value} N/m:{1.1 * one.value} N/m", f"{other}=0.0999 kg:0.1001 kg"
    found = apc.region(compiled(one.text), x=x, y=y)
    assert found.corner
    points = np.concatenate([curve.points for curve in found.curves])
    points = points[np.argsort(points[:, 1])]
    return float(np.interp(0.1, points[:, 1], points[:, 0]))


def _margin(one: Limit) -> float:
    model = compiled(one.text)
    begin = {one.parameter: f"{one.value / 2} N/m"}
    rows = {row.parameter: row for row in apc.margins(model, params=begin).rows}
    return rows[one.parameter].value


def _both_sides(one: Limit) -> float:
    """Return the middle of two points of which one is stable, both as many points and one by one."""
    sides = [one.value - one.error, one.value + one.error]
    found = apc.analyze_many(compiled(one.text), {one.parameter: [0.5 * one.value, *sides]})
    assert found.stable.tolist() == [True, True, False]
    each = [
        apc.analyze(compiled(one.text), params={one.parameter: f"{value!r} N/m"}).stable for value in sides
    ]
    assert each == [True, False]
    return one.value


def _boxes(one: Limit) -> float:
    below = f"{0.5 * one.value} N/m:{one.value - max(one.error, 1e-3 * one.value)} N/m"
    proved = apc.robust_stability(compiled(one.text), {one.parameter: below}).stable
    assert proved or (proved is None and "delays: own" in one.text)
    beyond = f"{0.99 * one.value} N/m:{one.value + one.error} N/m"
    assert apc.robust_stability(compiled(one.text), {one.parameter: beyond}).stable is False
    return one.value


SEARCHES = {
    "critical": _critical,
    "margin": _margin,
    "region": _curves,
    "both sides": _both_sides,
    "boxes": _boxes,
}


@pytest.mark.needs_extension("parameter_boxes")
@pytest.mark.few(16)
@pytest.mark.parametrize("method", SEARCHES)
@pytest.mark.parametrize("name", LIMIT)
def test_a_limit_is_that_of_the_reference(name: str, method: str) -> None:
    one = LIMIT[name]
    assert SEARCHES[method](one) == pytest.approx(one.value, abs=one.error)


def test_without_damping_the_mesh_holds_exactly_half_of_what_the_average_does() -> None:
    """Fig. 3 of the paper: the limit of K_T with the average is twice that of the mesh; with damping less."""
    for delayed, delays, damping, contact, _, _ in LIMITS[4:7]:
        words = f"late {delays} B={damping} K_C={contact}"
        ratio = _critical(LIMIT[f"AP {words}"]) / _critical(LIMIT[f"VC {words}"])
        assert delayed
        assert ratio == pytest.approx(2, rel=1e-9) if damping == 0 else 1.5 < ratio < 1.85
