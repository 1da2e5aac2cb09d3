"""The command `apc explore`.

Takes: words of a command line. Gives: the link of a page on stdout.
Guarantees: errors of the topology, an occupied port and a missing library are reported before a page is
served; Ctrl-C ends the command.
Does not: compute.
"""

from __future__ import annotations

from apc.cli.options import WholeNumber, command, echo, option


@command
def explore_command(
    *,
    file: str | None,
    settings: tuple[str, ...],
    port: int = option(
        "Port of the local server.", "N", type=WholeNumber(0, 65535), default=0, show_default="any free port"
    ),
    no_browser: bool = option("Print the link only."),
) -> None:
    """Open the interactive app in a browser.

    Sliders set parameters, delays, periods and numbers of peers. The page shows
    the stability region, verdict, margins, eigenvalues, impulse response,
    impedance, loss and jitter limits; a button tunes gains. The link holds the
    values. The server is local and requires the printed link; Ctrl-C stops it.
    FILE is a topology or a compiled model.

    \b
        apc explore three-users.yaml --set "lan.delay=16 ms" --no-browser
    """
    from apc.inputs.open_model import find_input, open_topology
    from apc.support.optional import need

    path = find_input(file, compiled_too=True)
    echo("starting ...", err=True)
    need("bokeh.server.server", "explore")
    from apc.app.page import open_page, topology_of
    from apc.app.server import bound, run
    from apc.compiler.source.source import read_source

    model = open_topology(str(path), ())
    topology = path.with_suffix(".yaml")
    text = read_source(topology).text if topology.is_file() else None
    topology_file = topology_of(model, settings, text)
    server, link = bound(lambda document: open_page(topology_file, document), port)
    echo(link)
    run(server, link, browser=not no_browser)
    echo("ended", err=True)
