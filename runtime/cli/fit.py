"""The command `apc fit`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else.
Does not: compute.
"""

from __future__ import annotations

from pathlib import Path

from apc.cli.options import argument, command, note_aside, option, picture_option, print_result
from apc.cli.progress import at_work
from apc.cli.topology_writing import check_topology_name, write_values
from apc.compiler.errors import ApcError


@command
def fit_command(
    *,
    recording: str = argument(),
    file: str | None,
    free: tuple[str, ...] = option("Parameter to estimate, with its range (repeatable).", "PATH=LO:HI"),
    settings: tuple[str, ...],
    signals: tuple[str, ...] = option("Measured signals (repeatable).", "PATTERN", show_default="all"),
    method: str | None = option(
        "Integration method, see simulate.",
        "METHOD",
        show_default="exact",
    ),
    write: Path | None = option("Write the topology with the estimates (.yaml)."),
    plot: Path | None = picture_option("Plot the residuals (.png, .svg, .pdf)."),
    as_json: bool,
) -> None:
    """Estimate parameters from recorded force and motion.

    RECORDING is a table (.csv, .parquet, .mat) with a column "time [s]", or
    the folder of apc run. Columns are signals of apc simulate, "device.x [m]",
    and forces on a hand with a constant force or on a part, "hand [N]". The
    search starts at the values of the topology. Printed are least-squares
    estimates with standard errors, and a test of the residuals.

    \b
        apc fit push.csv topology.yaml --free "device.mass=0.05 kg:1 kg" \\
                --free "device.damping=0 N*s/m:50 N*s/m" --write fitted.yaml
    """
    from apc.inputs.open_model import check_outputs, open_topology
    from apc.output.pictures import write_picture
    from apc.simulation.settings import DEFAULT, parse_method
    from apc.support.extension_table import require_extension

    extension = require_extension("parameter_fit")
    check_topology_name(write, "fitted")
    outputs = {"--write": write, "--plot": plot}
    check_outputs(Path(recording), (), outputs)
    model = open_topology(file, settings, outputs, varied=free, notify=note_aside)
    ranges = extension.read_free(model, free)
    chosen = parse_method(method) if method is not None else DEFAULT
    with at_work("fitting"):
        fit = extension.fit(model, Path(recording), ranges, signals=signals, method=chosen)
    refused: ApcError | None = None
    if write is not None:
        try:
            values = {item.name: (item.value, item.unit) for item in fit.parameters}
            write_values(model, values, settings, write)
        except ApcError as error:  # the estimates are printed all the same
            refused = error
    if plot is not None:
        write_picture(fit.plot, plot)
    print_result(fit, as_json=as_json, written=[write if refused is None else None, plot])
    if refused is not None:
        raise refused
