"""The command `apc explore`.

Takes: words of a command line. Gives: the link of a page on stdout.
Guarantees: what can't be explored, a port that is taken and a library that is missing are told before a page
is served; Ctrl-C ends the command.
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
        "Listen on this port of this machine; any that is free if not given.",
        "N",
        type=WholeNumber(0, 65535),
        default=0,
    ),
    no_browser: bool = option("Only print the link."),
) -> None:
    """Open a page in the browser: sliders, and what follows from them.

    Sliders of the topology's parameters, delays, periods and number of users;
    beside them the stable region of two of them, the verdict and what
    limits it, eigenvalues, the response to a push, what a hand feels, how
    much loss and jitter the network may have, redrawn as a slider moves. A
    click in the region sets both its sliders, a button looks for the best
    gains. The link holds the values; buttons download the topology with
    them, the picture and the numbers. FILE is a topology or a compiled
    model. The page is this machine's own, for whoever has the link that is
    printed; Ctrl-C ends it.

    \b
        apc explore three-users.yaml --set "lan.delay=16 ms" --no-browser
    """
    from apc.inputs import find_input, open_topology
    from apc.optional import need

    need("bokeh.server.server", "explore")
    from apc.app.page import open_page, topology_of
    from apc.app.server import bound, run
    from apc.compiler.source.source import read_source

    path = find_input(file, compiled_too=True)
    system = open_topology(str(path), ())
    topology = path.with_suffix(".yaml")
    text = read_source(topology).text if topology.is_file() else None
    topology_file = topology_of(system, settings, text)
    server, link = bound(lambda document: open_page(topology_file, document), port)
    echo(link)
    run(server, link, browser=not no_browser)
    echo("ended", err=True)
