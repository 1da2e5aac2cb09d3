"""The command `apc analyze`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from apc.analysis.methods import AUTO, METHODS
from apc.cli.options import command, note_aside, option, picture_option, print_result
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

if TYPE_CHECKING:
    from apc.compiler.compiled import Model
    from apc.parameter_values.parameter_names import Range
    from apc.result import Result

# Of peers that all differ, by the thousand: 100,000 took 9 s on one core of 2026.
SECONDS_A_PEER = 1e-4


@command
def analyze_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    method: str = option("Method, see above.", "METHOD", type=click.Choice(METHODS), default=AUTO),
    certify: bool = option("Prove the verdict in ball arithmetic."),
    box: tuple[str, ...] = option(
        "Prove stability over a range (repeatable).",
        "PATH=RANGE",
    ),
    cells: int | None = option(
        "Most cells of --box.",
        "N",
        type=click.IntRange(min=1),
        show_default="some seconds",
    ),
    changing: tuple[str, ...] = option("Analyze changes of a number of peers.", "PATH=COUNTS"),
    every_convention: bool = option("Repeat for every order of simultaneous events.", name="--event-order"),
    margins: bool | None = option(
        "Compute all margins, or none.",
        name="--margins/--no-margins",
        default=None,
        show_default="if fast",
    ),
    nominal: bool = option("Also analyze the nominal network (no loss)."),
    with_limit_cycle: bool = option("Predict limit cycles of contacts, and simulate.", name="--limit-cycle"),
    modes: str = option("Rows of the mode table.", type=click.Choice(("slowest", "all")), default="slowest"),
    hands: str,
    operating_point: str,
    plot: Path | None = picture_option("Plot the eigenvalues (.png, .svg, .pdf)."),
    as_json: bool,
) -> None:
    """Analyze stability: verdict, margins, sensitivities, modes.

    A topology is stable if its spectral radius per frame is below 1; free
    common translations are excluded. The frame is the least common multiple
    of the clock periods. FILE is a topology or a compiled model.

    \b
    --method  auto; modes: decoupled subsystems; dense: one matrix;
              determinant: non-identical peers, long delays; paper: Rakhsha
              and Constantinescu, eqs. (18) to (20)
    --box     e.g. contact.stiffness=±1% or lan.delay="8 ms:16 ms"
    --changing  e.g. user.count=2:10
    --operating-point  start (start values) or equilibrium (rest position)
    --hands   free; clamped: fixed devices; held: hand.mass, hand.damping and
              hand.stiffness by --set; passive: absolute stability with any
              passive operator; or a hand of the library (StylusArmForward)
    """
    from apc.analysis_report import answer
    from apc.inputs.open_model import open_topology
    from apc.lifting.devices import HANDS, PASSIVE, published

    if cells is not None and not box and hands in (*HANDS, PASSIVE):  # hands of the library make a box
        raise click.UsageError("--cells requires --box")
    if len(changing) > 1:
        message, advice = "--changing is given twice", "give one number of peers with all its counts"
        raise ApcError(Diagnostic("E890", SourceLocation("--changing"), message, advice=advice))
    if changing:
        given = {"--plot": plot is not None, "--box": bool(box), "--event-order": every_convention}
        given |= {"--limit-cycle": with_limit_cycle, "--certify": certify, "--method": method != AUTO}
        given |= {"--margins": margins is not None, "--nominal": nominal, "--modes": modes != "slowest"}
        given |= {"--hands passive": hands == PASSIVE, "--operating-point": operating_point != "start"}
        if refused := [name for name, is_given in given.items() if is_given]:
            raise click.UsageError(f"--changing can't be combined with {', '.join(refused)}")
    model = open_topology(
        file,
        settings,
        {"--plot": plot},
        hands=hands,
        operating_point=operating_point,
        varied=box,
        notify=note_aside,
    )
    if hands == PASSIVE:
        requested = {
            "--method": method != AUTO,
            "--event-order": every_convention,
            "--limit-cycle": with_limit_cycle,
        }
        requested |= {"--margins": bool(margins), "--plot": plot is not None}
        refused = [name for name, given in requested.items() if given]
        _absolute_stability(model, refused, box, certify=certify, as_json=as_json)
        return
    if hands not in HANDS:  # one of the library: all that were measured
        box = (*box, *(f"{name}={low}:{high}" for name, (low, high, _) in published(hands).items()))
    if changing:
        print_result(_changing_counts(model, *changing), as_json=as_json)
        return
    ranges = _ranges(model, box)
    listed = sum(group.count for group in model.groups if group.columns)
    with at_work(f"analyzing {model.peers:,} peers", about=SECONDS_A_PEER * listed):
        result = answer(
            model,
            method=method,
            certify=certify,
            box=ranges,
            cells=cells,
            every_convention=every_convention,
            margins=margins,
            with_limit_cycle=with_limit_cycle,
        )
    result = replace(result, nominal=nominal, all_modes=modes == "all")
    if plot is not None:
        from apc.output.pictures import write_picture

        write_picture(result.analysis.plot, plot)
    print_result(result, as_json=as_json, written=[plot])


def _changing_counts(model: Model, changing: str) -> Result:
    """Return the stability while the number of peers changes."""
    from apc.lifting.numeric_model import numeric_model
    from apc.network.nominal_criterion import unreliable
    from apc.support.extension_table import require_extension

    extension, lossy = require_extension("changing_counts"), bool(unreliable(model))
    result: Result = extension.changing_counts(numeric_model(model), changing, lossy=lossy)
    return result


def _ranges(model: Model, box: tuple[str, ...]) -> list[Range]:
    """Return the ranges of --box and those of the topology."""
    from apc.parameter_values.parameter_names import given_ranges
    from apc.studies.parameter_ranges import parse_range

    return given_ranges(model, [parse_range(model, text, SourceLocation("--box")) for text in box])


def _absolute_stability(
    model: Model, requested: list[str], box: tuple[str, ...], *, certify: bool, as_json: bool
) -> None:
    """Print the absolute stability, also for ranges of delays. Raises ApcError E930 for other options."""
    from apc.haptics.absolute_stability import absolute_stability
    from apc.lifting.numeric_model import numeric_model

    if requested:
        verb = "is" if len(requested) == 1 else "are"
        message = f"{' and '.join(requested)} {verb} not available with --hands passive"
        raise ApcError(Diagnostic("E930", SourceLocation("--hands"), message, fix="--hands clamped"))
    if ranges := _ranges(model, box):
        from apc.analysis_report import robust_stability

        print_result(robust_stability(model, ranges, passive=True), as_json=as_json)
        return
    print_result(absolute_stability(numeric_model(model), certify=certify), as_json=as_json)
