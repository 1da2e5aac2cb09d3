# ruff: noqa: E501 -- topologies are written by long lines
"""Random topologies, each verdict and bound against 256-bit arithmetic: `python -m tests.bench.random_topologies`.

Topologies of every shape are drawn (see `bench.shapes`), and for each of them numbers over many decades.
The truth comes from the compiled functions alone, event by event (see `fifty_digits.truth`). A bound that does
not hold and a wrong verdict must be none, verdicts left open and topologies refused hardly any.
"""

from __future__ import annotations

import math
import random
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import flint

from apc.analysis.analysis import Analysis, analyze
from apc.analysis_report import sensitivities_of
from apc.benchmark.timing import timed
from apc.compiler.compiled import Model
from apc.compiler.components.component_library import Library
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.overrides import apply
from apc.simulation.simulation import ROW
from apc.spectrum.ball_arithmetic import precision
from apc.support.threads import single_threaded
from tests.bench.judge import decided, parser_of
from tests.bench.sensitivity_truth import check_frequencies, check_sensitivities
from tests.bench.shapes import PARTS, draw_shape, numbers
from tests.fifty_digits.truth import _truth as truth_of
from tests.fifty_digits.truth import classes_of, eigenvalues, frame_matrices
from tests.topologies import compiled

BITS = 256  # a chain of four equal eigenvalues still keeps 19 digits
DRAWS = 8  # of numbers for each structure

# Shares of all topologies. Left open: gains drawn over decades come no nearer to a boundary than floats tell, and
# what is on one by its structure (no damping, no coupling) balls decide; one in a thousand is a draw's luck.
MOST_UNDECIDED = 1e-3
# Refused as beyond floats: a tick of 2 ms drives 1e-4 kg on 1e5 N/m apart 1e4-fold at most, and a frame has
# 20 ticks at most: 1e80, which is a float. None should be refused; one in a thousand is a draw's luck.
MOST_REFUSED = 1e-3
BEYOND = ("E806", "E850")


@contextmanager
def own_library() -> Iterator[Library]:
    """Give the built-in library with the components of `shapes`."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in PARTS.items():
            (Path(folder) / f"{name}.yaml").write_text(text.lstrip(), encoding="utf-8")
        yield Library((Path(folder),))


@dataclass
class Tally:
    """What came out."""

    topologies: int = 0
    refused: int = 0
    as_they_must: int = 0  # refused by name
    undecided: int = 0
    proved: int = 0
    looked_into: int = 0  # derivatives and frequencies of these were checked, too
    seconds: float = 0.0
    tightest: float = 0.0  # the largest error ÷ bound
    verdicts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


def truth(model: Model) -> tuple[flint.arb, int]:
    """Return the radius without eigenvalues that are 1, and how many these are (a drift counts twice)."""
    classes = classes_of(model)
    found = truth_of([(count, eigenvalues(one)) for _, count, one in frame_matrices(model, classes)])
    radius, rigid = found.radius, found.rigid
    # Without clocks any frame will do: the analysis takes a second, the reference a row of a simulation.
    return radius if model.clocks else radius ** int(1 / ROW), rigid


def check(found: Analysis, radius: flint.arb, rigid: int) -> str:
    """Return what is wrong with an analysis, "" if nothing is."""
    if found.stable is None and rigid > found.rigid_modes:
        radius = max(
            radius, flint.arb(1)
        )  # a motion that grows with t² leaves an eigenvalue 1, and is left open
    apart = abs(
        radius - flint.arb(found.spectral_radius)
    ).mid()  # 256 bits: no rounding that floats could see
    if not apart <= flint.arb(found.spectral_radius_error) or not math.isfinite(found.spectral_radius_error):
        return f"radius {found.spectral_radius} ± {found.spectral_radius_error}, truth {radius.str(20)}"
    if found.stable is None:
        return ""
    if found.verdict == "drifts":
        return "" if radius < 1 and rigid > found.rigid_modes else "it does not drift"
    if found.stable != bool(radius < 1):
        return f"{found.verdict}, truth {radius.str(20)}"
    # What an unread memory adds up while a peer stands aside is an eigenvalue 1 more, and no drift of the topology.
    as_many = found.rigid_modes == rigid or (found.unobservable and found.rigid_modes < rigid)
    return "" if as_many or not found.stable else f"{found.rigid_modes} rigid, truth {rigid}"


def _looked_into(model: Model, found: Analysis) -> list[str]:
    """Return what is wrong with what an analysis tells beside its verdict."""
    if found.stable is None and found.spectral_radius == 1:
        return []  # a motion that grows with t² leaves an eigenvalue 1, which the reference takes for a translation
    try:
        reported = sensitivities_of(numeric_model(model), found)
        return [check_sensitivities(model, reported), check_frequencies(found)]
    except Exception as error:  # whatever it is, it is a bug
        return [repr(error)]


def run(points: int, *, seed: int = 0, methods: Sequence[str] = ("auto",), draws: int = DRAWS) -> Tally:
    """Analyse so many random topologies by each method, so many draws of numbers for each structure."""
    generator, tally = random.Random(seed), Tally()
    with single_threaded(), precision(BITS), own_library() as library:
        for number in range(points):
            if number % draws == 0:
                shape = draw_shape(generator)
            text = shape.text
            try:
                plain = compiled(text, library)
                drawn = numbers(generator, shape, plain)
                model = apply(plain, drawn)
                text += ", ".join(f"{one.free.label}={float(one.value)!r}" for one in drawn)
            except Exception as error:  # whatever it is, it is a bug
                tally.wrong.append(f"not compiled: {error!r}\n{text}")
                continue
            for method in methods:
                look = method == "auto" and number % draws == 0
                tally.wrong += [
                    f"{method}: {one}\n{text}" for one in _analysed(model, method, shape.refused, look, tally)
                ]
    return tally


def _analysed(model: Model, method: str, due: str, look: bool, tally: Tally) -> list[str]:
    """Analyse a topology, take it down in the tally, and return what is wrong; `due` is the error it must give."""
    try:
        used, found = timed(partial(analyze, numeric_model(model), method=method))
    except ApcError as error:
        code = error.mistakes[0].code
        tally.as_they_must += code == due
        tally.refused += code in BEYOND
        return [] if code in (*BEYOND, due) else [str(error)]
    except Exception as error:  # whatever it is, it is a bug
        return [repr(error)]
    radius, rigid = truth(model)
    tally.seconds += used
    tally.topologies += 1
    tally.undecided += found.stable is None
    tally.proved += bool(found.proof)
    tally.verdicts[str(found.verdict).partition(":")[0]] += 1
    if found.spectral_radius_error:
        off = float(abs(radius - flint.arb(found.spectral_radius)).mid())
        tally.tightest = max(tally.tightest, off / found.spectral_radius_error)
    faults = [check(found, radius, rigid), f"{due} was due" if due else ""]
    if look:
        tally.looked_into += 1
        faults += _looked_into(model, found)
    return [one for one in faults if one]


def main() -> None:
    """Print what came out, and every topology that is wrong."""
    parser = parser_of("random_topologies", __doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--methods", default="auto", help="auto,dense,determinant")
    with decided(parser) as (judge, given):
        count = 200 if given.quick else given.count
        tally = run(count, seed=given.seed, methods=given.methods.split(","))
        print(replace(tally, wrong=[]))
        for one in tally.wrong:
            judge.right(one, holds=False)
        most = tally.topologies + tally.refused
        judge.within("verdicts left open", tally.undecided, MOST_UNDECIDED * most)
        judge.within("topologies beyond floats", tally.refused, MOST_REFUSED * most)


if __name__ == "__main__":
    main()
