"""Parameters from recordings: those of an independent least-squares program, with intervals that cover."""

from __future__ import annotations

import doctest
import json
import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.io import savemat
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.stats import binom, t

import apc
from apc.compiler.errors import ApcError
from tests.commands import Cli, write
from tests.topologies import AVERAGE, ROOT, TOPOLOGIES, compiled, replaced, wall

pytestmark = pytest.mark.needs_extension("parameter_fit")

Matrix = NDArray[Any]
HAND = """\
topology: one-device
peers: {user: {count: 1}}
masses: {device: {mass: 0.5 kg, damping: 1 N*s/m}}
hands: {hand: {type: ConstantForce, flange: device, force: 0 N}}
"""
SPRING = """\
topology: spring
peers: {user: {count: 1}}
masses: {device: {mass: 0.5 kg, damping: 1 N*s/m, x: 1 mm}}
couplers: {spring: {type: SpringDamper, a: device, b: ground, stiffness: 300 N/m, damping: 0 N*s/m}}
"""
MASS, DAMPING, STIFFNESS = "device.mass", "device.damping", "spring.stiffness"
RANGES = {MASS: (0.05, 1.0), DAMPING: (0.0, 50.0)}
TRUE = np.array([0.2, 4.0])
PERIOD = 2e-3


def motion(values: Matrix, force: Matrix, start: float = 0.0) -> Matrix:
    """Return x and v (rows, 2) of m x″ + d x′ + k x = f, with f linear between the rows.

    The exponential is that of (x, v, f, f′); complex values are complex steps.
    """
    mass, damping, stiffness = (*values, 0.0)[:3]
    rates = np.zeros((4, 4), dtype=np.asarray(values).dtype)
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, :3] = -stiffness / mass, -damping / mass, 1 / mass
    step, state, rows = expm(rates * PERIOD), np.zeros(4, dtype=rates.dtype), []
    state[0] = start
    for now, later in zip(force, [*force[1:], force[-1]], strict=True):
        state[2:] = now, (later - now) / PERIOD
        rows.append(state[:2])
        state = step @ state
    return np.array(rows)


def slopes(values: Matrix, force: Matrix, start: float, columns: Sequence[int]) -> Matrix:
    """Return the derivatives of `motion` (rows, columns, k) by complex steps."""
    steps = 1e-30j * np.eye(len(values))
    return np.stack([motion(values + one, force, start)[:, columns].imag / 1e-30 for one in steps], axis=-1)


def pushes(rows: int, seed: int = 0) -> Matrix:
    """Return a force that excites all frequencies."""
    generator = np.random.default_rng(seed)
    return np.repeat(generator.normal(size=-(-rows // 5)), 5)[:rows] + np.sin(0.1 * np.arange(rows))


def table(path: Path, columns: Mapping[str, Sequence[float] | Matrix], period: float = PERIOD) -> Path:
    """Write a recording, time first, with all digits."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(["time [s]", *columns])]
    lines += [",".join(map(repr, [i * period, *map(float, row)])) for i, row in enumerate(rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def independent(
    measured: Matrix, force: Matrix, first: Matrix, start: float, columns: Sequence[int]
) -> tuple[Matrix, Matrix]:
    """Return estimates and standard errors by least squares, each column weighted by the rms of its rest."""
    noise, values = measured.std(axis=0), first
    for _ in range(60):
        solution = least_squares(
            lambda p, noise: ((motion(p, force, start)[:, columns] - measured) / noise).ravel(),
            values,
            lambda p, noise: (slopes(p, force, start, columns) / noise[:, None]).reshape(-1, len(first)),
            x_scale=first,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
            kwargs={"noise": noise},
        )
        values = solution.x
        rest = motion(values, force, start)[:, columns] - measured
        noise = np.sqrt(np.mean(rest**2, axis=0))
    jacobian = (slopes(values, force, start, columns) / noise[:, None]).reshape(-1, len(first))
    variance = np.sum((rest / noise) ** 2) / (len(jacobian) - len(first))
    return values, np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian)))


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("text", "force_column", "values", "columns"),
    [
        (HAND, "hand [N]", TRUE, [0]),
        (HAND, "device [N]", TRUE, [0]),
        (SPRING, "user[1].device [N]", np.array([0.2, 4.0, 500.0]), [0]),
        (SPRING, "device [N]", np.array([0.2, 4.0, 500.0]), [0, 1]),
    ],
)
def test_estimates_and_errors_are_those_of_an_independent_program(
    text: str, force_column: str, values: Matrix, columns: list[int], tmp_path: Path
) -> None:
    rows, start = 400, 1e-3 if text == SPRING else 0.0
    force, generator = pushes(rows), np.random.default_rng(3)
    measured = motion(values, force, start)[:, columns]
    measured = measured + generator.normal(size=measured.shape) * 0.05 * measured.std(axis=0)
    names = ["device.x [m]", "device.v [m/s]"]
    data = {force_column: force, **{names[c]: measured[:, j] for j, c in enumerate(columns)}}
    free = RANGES | ({STIFFNESS: (100.0, 900.0)} if text == SPRING else {})
    found = apc.fit(compiled(text), table(tmp_path / "r.csv", data), free=free)
    expected, errors = independent(measured, force, values * 1.1, start, columns)
    assert [*found.params] == [*free]
    assert [*found.params.values()] == pytest.approx(expected, rel=1e-7)
    assert [one.standard_error for one in found.parameters] == pytest.approx(errors, rel=1e-5)
    quantile = t.ppf(0.975, rows * len(columns) - len(values))
    for one in found.parameters:
        margin = quantile * one.standard_error
        assert one.interval == pytest.approx((one.value - margin, one.value + margin), rel=1e-9)
    assert np.allclose(np.diag(found.correlation), 1)


@pytest.mark.whole
def test_intervals_cover_the_truth_in_19_of_20_recordings(tmp_path: Path) -> None:
    """Of 500: within what 999 of 1000 such experiments show."""
    draws, force, generator = 500, pushes(60), np.random.default_rng(11)
    exact, model = motion(TRUE, force)[:, 0], apc.set_parameters(compiled(HAND), {MASS: 0.21, DAMPING: 4.1})
    covered = np.zeros(2, int)
    for _ in range(draws):
        measured = exact + 0.02 * exact.std() * generator.normal(size=len(exact))
        path = table(tmp_path / "r.csv", {"hand [N]": force, "device.x [m]": measured})
        found = apc.fit(model, path, free=RANGES)
        covered += [
            one.interval[0] <= true <= one.interval[1]
            for one, true in zip(found.parameters, TRUE, strict=True)
        ]
    low, high = binom.ppf([0.0005, 0.9995], draws, 0.95)
    assert ((low <= covered) & (covered <= high)).all(), covered


# The values of topologies of the library.
LIBRARY = {"contact.stiffness": 1000.0, "cube.mass": 0.6, "user.device.v": 0.1, DAMPING: 5.0, MASS: 0.1}
LIBRARY |= {"coordination.stiffness": 500.0, "finger.stiffness": 500.0, "wall.stiffness": 800.0}


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("name", "suffix", "free", "signals"),
    [
        ("three-users-average", ".csv", ("contact.stiffness", "cube.mass"), ()),
        ("three-users-average", ".parquet", ("user.device.v", DAMPING), ("*.x",)),
        ("three-users-average", ".mat", ("coordination.stiffness",), ("user[2].cube.x",)),
        ("finger", ".csv", ("finger.stiffness", "wall.stiffness"), ()),
        ("two-users-passivity", ".csv", (MASS,), ("*.x",)),
    ],
)
def test_a_simulation_gives_the_parameters_of_its_topology(
    name: str, suffix: str, free: tuple[str, ...], signals: tuple[str, ...], cli: Cli
) -> None:
    """To eight digits, from a start elsewhere: with a network, a wall, limits, and a nonlinear controller."""
    text = (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")
    write("t.yaml", text.replace("{count: 3}", "{count: 3, set: {device.v: 0.1 m/s}}"))
    assert cli(f"simulate t.yaml --duration '0.4 s' --out run{suffix}").code == 0
    true = {one: LIBRARY[one] for one in free}
    ranges = {one: (value / 3, 2 * value) for one, value in true.items()}
    start = {one: 0.6 * value for one, value in true.items()}
    found = apc.fit("t.yaml", f"run{suffix}", free=ranges, params=start, signals=signals)
    assert found.params == pytest.approx(true, rel=1e-8)
    assert all(signal.used and math.isnan(signal.probability) for signal in found.residuals)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("three-users-mesh", ["device.mass", "coordination.stiffness"]),
        ("two-users-dead-reckoning", ["device.mass", "coordination.stiffness"]),
        ("two-users-waves", ["device.mass", "device.damping"]),
        ("users-table", ["cube.mass"]),
        ("god-object", ["device.mass", "table.stiffness"]),
        ("lifted-box", ["device.damping"]),
        ("finger", ["finger.stiffness", "device.x"]),
    ],
)
def test_derivatives_are_those_of_simulations_nearby(name: str, free: list[str]) -> None:
    """Central differences of all signals agree to six digits of each."""
    from apc.extensions.parameter_fit.sensitivity_model import name_of, with_sensitivities
    from apc.parameter_values.parameter_names import Range, find, value_now

    model = apc.compile(TOPOLOGIES / f"{name}.yaml")
    pushed = [one.name for one in model.parameters if one.name in ("device.v", "device.v[1]")]
    model = apc.set_parameters(model, {f"{model.groups[0].name}.{one}": 0.1 for one in pushed})
    refs = [find(model, one) for one in free]
    ranges = [Range(ref, "", Fraction(0), Fraction(repr(value_now(model, ref)))) for ref in refs]
    extended = apc.simulate(with_sensitivities(model, ranges), duration=0.1, jit=False)
    compared = 0
    for k, (one, interval) in enumerate(zip(free, ranges, strict=True), 1):
        width = float(interval.high)
        near = [
            apc.simulate(model, duration=0.1, jit=False, params={one: width * (1 + side)})
            for side in (1e-5, -1e-5)
        ]
        for signal in near[0].signals:
            derivative = extended[f"{signal.group}[{signal.peer}].{name_of(k, signal.local)}"]
            difference = (near[0][signal.name] - near[1][signal.name]) / 2e-5
            largest = np.abs(derivative).max()
            assert np.abs(derivative - difference).max() <= 1e-6 * largest + 1e-9, (one, signal.name)
            compared += bool(largest)
    assert compared > 2


def test_a_model_at_rest_is_fitted(tmp_path: Path) -> None:
    """The force that holds it there is a start value, which no parameter changes."""
    from apc.extensions.parameter_fit.sensitivity_model import with_sensitivities
    from apc.parameter_values.parameter_names import ParameterRef, Range

    spring = "{type: SampledSpringDamper, a: device, b: ground, stiffness: 300 N/m, clock: tick, delay: 1 ms}"
    text = HAND.replace("force: 0 N", "force: 1 N").replace("masses:", "clocks: {tick: 1 ms}\nmasses:")
    model = apc.operating_point(compiled(f"{text}couplers: {{spring: {spring}}}\n")).model
    ranges = [Range(ParameterRef(STIFFNESS), "N/m", Fraction(100), Fraction(900))]
    rest = apc.simulate(with_sensitivities(model, ranges), duration=0.01)
    assert rest["user[1].d1 spring.f acting"][0] == 0 != rest["user[1].spring.f acting"][0]
    stiff = apc.simulate(apc.set_parameters(model, {STIFFNESS: 400.0}), duration=0.3)
    path = table(tmp_path / "r.csv", {"device.x [m]": stiff["user[1].device.x"]}, 1e-3)
    found = apc.fit(model, path, free={STIFFNESS: (100.0, 900.0)})
    assert found.params[STIFFNESS] == pytest.approx(400.0, rel=1e-8)


def test_a_run_is_fitted_with_the_packets_that_arrived(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apc.realtime.start.claim", tuple)
    changes = [
        ("{count: 3}", "{count: 2, set: {device.x: 3 mm}}"),
        ("delay: 8 ms}", "delay: 8 ms, loss: 20 %}"),
    ]
    write("t.yaml", replaced(AVERAGE, *changes))
    assert cli("run t.yaml --duration '0.5 s' --emulate").code == 0
    ran = cli(
        "fit t.run t.yaml --free 'coordination.stiffness=100 N/m:900 N/m' --json"
        " --set 'coordination.stiffness=300 N/m' --signals '*.x'"
    )
    assert ran.code == 0, ran.err
    (estimate,) = json.loads(ran.out)["parameters"]
    assert estimate["value"] == pytest.approx(500.0, rel=1e-8)
    write("other.yaml", replaced(AVERAGE, changes[0], ("haptic: 1 ms", "haptic: 2 ms")))
    ran = cli("fit t.run other.yaml --free 'coordination.stiffness=100 N/m:900 N/m'")
    assert ran.code == 1 and "E713 the run can't be repeated: it is of another topology" in ran.err


def recorded(tmp_path: Path, rows: int = 300, **changes: Callable[[Matrix], Matrix]) -> Path:
    """Write a recording of the device pushed by its hand, with its columns changed."""
    force = pushes(rows)
    noise = 1e-5 * np.random.default_rng(5).normal(size=rows)
    columns = {"hand [N]": force, "device.x [m]": motion(TRUE, force)[:, 0] + noise}
    columns = {name: changes.get(name[0], lambda column: column)(column) for name, column in columns.items()}
    return table(tmp_path / "push.csv", columns)


def test_correlated_residuals_are_reported_and_white_ones_are_not(tmp_path: Path) -> None:
    model = compiled(HAND)
    white = apc.fit(model, recorded(tmp_path), free=RANGES)
    (residuals,) = white.residuals
    rest = (white.measured - white.fitted)[:, 0]
    rest = rest - rest.mean()
    n, power = len(rest), np.sum(rest**2)
    r = [sum(rest[i] * rest[i + h] for i in range(n - h)) / power for h in range(1, 11)]
    q = n * (n + 2) * sum(r[h - 1] ** 2 / (n - h) for h in range(1, 11))
    # The distribution function of χ² with ten degrees of freedom has a closed form.
    tail = math.exp(-q / 2) * sum((q / 2) ** i / math.factorial(i) for i in range(5))
    assert residuals.probability == pytest.approx(tail, rel=1e-9)
    assert residuals.white and "correlated" not in str(white).partition("Residuals")[2]
    drift = recorded(tmp_path, d=lambda column: column + 1e-3 * np.sin(0.05 * np.arange(len(column))))
    colored = apc.fit(model, drift, free=RANGES)
    assert not colored.residuals[0].white and "are correlated" in str(colored)


def test_an_estimate_at_an_end_of_its_range_is_reported(tmp_path: Path) -> None:
    found = apc.fit(compiled(HAND), recorded(tmp_path), free=RANGES | {MASS: (0.4, 1.0)})
    mass, damping = found.parameters
    assert mass.at_end and mass.value == pytest.approx(0.4, rel=1e-5) and not damping.at_end
    assert "device.mass is at an end of its range" in str(found)


def test_what_is_written_drawn_and_tabulated(tmp_path: Path, cli: Cli) -> None:
    write("t.yaml", HAND)
    path = recorded(tmp_path)
    free = "--free 'device.mass=0.05 kg:1 kg' --free 'device.damping=0 N*s/m:50 N*s/m'"
    ran = cli(f"fit {path} t.yaml {free} --write new.yaml --plot new.png --json")
    assert ran.code == 0, ran.err
    found = apc.fit("t.yaml", path, free={MASS: "0.05 kg:1 kg", DAMPING: ("0 N*s/m", 50)})
    assert json.loads(ran.out)["parameters"] == found.to_dict()["parameters"]
    new = {one.name: one.value for one in apc.compile("new.yaml").parameters}
    assert {name: new[name] for name in RANGES} == pytest.approx(found.params, rel=1e-11)
    assert Path("new.png").stat().st_size > 1000
    assert len(found.plot().axes) == 1 and found.to_dict()["samples"] == 300
    frame = found.to_dataframe()
    assert frame["estimate"].tolist() == [*found.params.values()] and frame["unit"].tolist() == [
        "kg",
        "N*s/m",
    ]
    assert "is refused" not in ran.err and cli(f"fit {path} t.yaml {free} --write new.txt").code == 1


def test_the_example_of_the_docstring_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT / "docs" / "howto")
    text = apc.fit.__doc__ or ""
    example = doctest.DocTestParser().get_doctest(text, {"apc": apc}, "fit", None, None)
    assert len(example.examples) == 3 and doctest.DocTestRunner().run(example).failed == 0


def test_half_of_the_rows_are_at_ticks_of_a_slower_clock(tmp_path: Path) -> None:
    """The force acts from all rows; the first row of the recording is time 0."""
    model = wall(0.5, 1.0, 0.0, 300.0)
    compiled_model = apc.set_parameters(model, {"tick.period": 2 * PERIOD, MASS: 0.2})
    true = apc.simulate(compiled_model, duration=0.4, signals=("device.x",))
    rows = np.interp(np.arange(201) * PERIOD, true.time, true["user[1].device.x"])
    path = table(tmp_path / "r.csv", {"device.x [m]": rows})
    lines = path.read_text(encoding="utf-8").splitlines()
    shifted = [lines[0], *(f"{3 + i * PERIOD!r},{row.split(',')[1]}" for i, row in enumerate(lines[1:]))]
    path.write_text("\n".join(shifted), encoding="utf-8")
    found = apc.fit(apc.set_parameters(model, {"tick.period": 2 * PERIOD}), path, free={MASS: (0.05, 1)})
    assert (found.rows, found.samples, found.start) == (201, 101, 3.0)
    assert found.params[MASS] == pytest.approx(0.2, rel=1e-8)
    assert "time 0 of the topology is the first row, at 3 s" in str(found)


ROW = "0.001,1,2.5e-6"
FREE = {MASS: "0.05 kg:1 kg"}


@pytest.mark.parametrize(
    ("rows", "free", "expected"),
    [
        ("0,1,0\n0.001,1\n", FREE, "E703 row: expected 3 cells"),
        ("0,1,0\n0.001,1,nan\n", FREE, "E703 cell: expected a finite number, got nan"),
        ("0,1,0\n0.001,1,\n", FREE, "E703 cell: expected a finite number, got nothing"),
        (
            "0,1,0\n0.001,1,0\n0.002,1,0\n0.007,1,0\n",
            FREE,
            "E712 time: expected equal intervals of 1 ms, got 5 ms",
        ),
        (
            "0,1,0\n0.002,1,0\n0.001,1,0\n",
            FREE,
            "E712 time: expected equal intervals of 0.5 ms, got 2 ms after row 1",
        ),
        (
            "0.002,1,0\n0.001,1,0\n0,1,0\n",
            FREE,
            "E712 time: expected increasing times, got a step of -1 ms. Sort the rows by time.",
        ),
        ("0;1;0\n0.001;1;0\n", FREE, "got 1. Separate cells by commas, not semicolons."),
        ("0,1,0\n", FREE, "E712 rows: expected two or more, got 1"),
        (f"0,1,0\n{ROW}\n", {}, "E714 no free parameter. Try: --free"),
        (
            f"0,1,0\n{ROW}\n",
            {MASS: "0.6 kg:1 kg"},
            "E714 start value of device.mass: expected 0.6 kg to 1 kg",
        ),
        (
            f"0,1,0\n{ROW}\n",
            FREE | {DAMPING: "0 N*s/m:9 N*s/m"},
            "E712 samples at ticks: expected more than 2 parameters, got 2",
        ),
        ("0,1,0\n0.001,0,0\n0.002,0,0\n", {"hand.force": "-1 N:1 N"}, "E715 hand.force: no effect"),
    ],
)
def test_an_unsuitable_recording_is_refused_with_one_message(
    rows: str, free: dict[str, str], expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "push.csv"
    path.write_text(f"time [s],hand [N],device.x [m]\n{rows}", encoding="utf-8")
    with pytest.raises(ApcError) as error:
        apc.fit(compiled(HAND), path, free=free)
    (mistake,) = error.value.mistakes
    assert expected in str(mistake)


def test_an_empty_recording_lacks_the_time(tmp_path: Path) -> None:
    path = tmp_path / "push.csv"
    path.touch()
    with pytest.raises(ApcError, match="E702 the table has no headings") as error:
        apc.fit(compiled(HAND), path, free=FREE)
    assert error.value.mistakes[0].fix == "time [s]"


@pytest.mark.parametrize(
    ("headings", "expected", "fix"),
    [
        ("time [s],hand [N],device.y [m]", "E711 column device.y: expected a signal", "device.x"),
        ("time [s],hand [N],device.x [N]", "E711 unit of column device.x: expected m, got N", "device.x [m]"),
        ("time [s],hand [m],device.x [m]", "E711 unit of column hand: expected N, got m", "hand [N]"),
        ("time [s],hand [N],hand.force [N]", "E711 column hand.force: expected a signal", ""),
        ("time [s],hand [N],device [N]", "E711 measured signals: expected one or more, got only forces", ""),
        ("time [m],hand [N],device.x [m]", "E711 columns: expected a column time [s]", ""),
        (
            "time [s],hand [N],user[1].device.x [m],device.x [m]",
            "E711 column device.x: expected one column",
            "",
        ),
    ],
)
def test_an_unsuitable_column_is_refused_with_its_fix(
    headings: str, expected: str, fix: str, tmp_path: Path
) -> None:
    path = tmp_path / "push.csv"
    count = headings.count(",")
    path.write_text(
        "\n".join([headings, *(f"{i / 1000}" + ",0" * count for i in range(5))]), encoding="utf-8"
    )
    with pytest.raises(ApcError) as error:
        apc.fit(compiled(HAND), path, free=FREE)
    (mistake,) = error.value.mistakes
    assert expected in str(mistake) and (not fix or mistake.fix == fix)


def test_an_unsuitable_file_is_refused(tmp_path: Path) -> None:
    """Columns of different lengths, other variables, cut files, numbers that are none, and other formats."""
    time, names = np.arange(20) * 1e-3, np.array(["device.x", "hand"], dtype=object)
    variables = {
        "time": time,
        "values": np.zeros((20, 2)),
        "names": names,
        "units": np.array(["m", "N"], object),
    }
    frame = pd.DataFrame({"time [s]": time, "device.x [m]": np.zeros(20)})
    savemat(tmp_path / "short.mat", variables | {"values": np.zeros((19, 2))})
    savemat(tmp_path / "other.mat", {"t": time})
    savemat(tmp_path / "whole.mat", variables, do_compression=True)
    (tmp_path / "cut.mat").write_bytes((tmp_path / "whole.mat").read_bytes()[:-40])
    frame.assign(**{"device.x [m]": "none"}).to_parquet(tmp_path / "text.parquet")
    frame.assign(**{"device.x [m]": np.where(time == 0.003, np.nan, 0.0)}).to_parquet(
        tmp_path / "nan.parquet"
    )
    (tmp_path / "push.txt").write_text("time [s]", encoding="utf-8")
    for name, expected in (
        (
            "short.mat",
            "E711 values: expected 20 rows and 2 columns, as in time, names and units, got 19 by 2",
        ),
        ("other.mat", "E711 recording: expected a table in a .csv"),
        ("cut.mat", "E711 recording: expected a table in a .csv"),
        ("text.parquet", "E711 recording: expected a table in a .csv"),
        ("nan.parquet", "E712 device.x, row 4: expected a finite number, got nan"),
        ("push.txt", "E711 recording: expected a table in a .csv"),
        ("absent.parquet", "absent.parquet does not exist"),
        ("absent.csv", "absent.csv does not exist"),
    ):
        with pytest.raises(ApcError) as error:
            apc.fit(compiled(HAND), tmp_path / name, free=FREE)
        assert expected in str(error.value), name


def test_a_name_of_several_peers_is_refused_with_the_name_of_one(tmp_path: Path) -> None:
    path = table(tmp_path / "r.csv", {"device.x [m]": np.zeros(20)}, 1e-3)
    with pytest.raises(ApcError, match=r"E711 column device\.x.*Try: user\[1\]\.device\.x"):
        apc.fit(compiled(AVERAGE), path, free={MASS: (0.05, 1.0)})
    path = table(tmp_path / "r.csv", {"user[1].device.x [m]": np.zeros(5)}, 1e-3)
    with pytest.raises(ApcError, match="E712 duration: expected at least one frame, 8 ms, got 4 ms"):
        apc.fit(compiled(AVERAGE), path, free={MASS: (0.05, 1.0)})


def test_two_parallel_springs_are_not_determined(tmp_path: Path) -> None:
    """Their sum is; both are named, and without one of them the other is found."""
    text = replaced(
        SPRING,
        ("couplers: {", "couplers: {other: {type: SpringDamper, a: device, b: ground, stiffness: 200 N/m}, "),
        ("damping: 0 N*s/m", "damping: 0 N*s/m"),
    )
    path = table(
        tmp_path / "r.csv", {"device.x [m]": motion(np.array([0.5, 1.0, 700.0]), np.zeros(200), 1e-3)[:, 0]}
    )
    springs = {STIFFNESS: (100.0, 900.0), "other.stiffness": (100.0, 900.0)}
    with pytest.raises(ApcError) as error:
        apc.fit(compiled(text), path, free={MASS: (0.2, 1.0), **springs})
    assert "E715 spring.stiffness, other.stiffness: only a combination" in str(error.value)
    found = apc.fit(compiled(text), path, free={STIFFNESS: (100.0, 900.0)})
    assert found.params[STIFFNESS] == pytest.approx(500.0, rel=1e-8)


def test_a_topology_that_loses_packets_at_random_needs_a_run(tmp_path: Path) -> None:
    path = table(tmp_path / "r.csv", {"user[1].device.x [m]": np.zeros(20)}, 1e-3)
    text = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 10 %}"))
    with pytest.raises(ApcError, match=r"E713 packet loss \(10 %\) of lan"):
        apc.fit(compiled(text), path, free={MASS: (0.05, 1.0)})
    with pytest.raises(ApcError, match=r"E714 lan\.delay is a delay"):
        apc.fit(compiled(AVERAGE), path, free={"lan.delay": ("8 ms", "16 ms")})


def test_a_power_of_the_depth_is_fitted_with_a_fixed_step(cli: Cli) -> None:
    """Its sensitivity equations have no Jacobian at the surface."""
    write(
        "t.yaml",
        "topology: t\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.2 kg, damping: 1 N*s/m, x: 2 mm}}\n"
        "couplers: {wall: {type: HuntCrossleyContact, a: device, b: ground, stiffness: 5e4 N/m^(3/2)}}\n"
        "hands: {hand: {type: ConstantForce, flange: device, force: -1 N}}\n",
    )
    step = "--method rk4:0.1ms"
    assert cli(f"simulate t.yaml --duration '0.1 s' {step} --out r.csv").code == 0
    ran = cli(
        f"fit r.csv t.yaml --free 'wall.stiffness=1e4 N/m^(3/2):1e5 N/m^(3/2)' {step} --json"
        " --set 'wall.stiffness=3e4 N/m^(3/2)'"
    )
    assert json.loads(ran.out)["parameters"][0]["value"] == pytest.approx(5e4, rel=1e-8)
