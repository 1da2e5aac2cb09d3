"""The command `apc tune`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; how far the search is goes to a
terminal only.
Does not: compute.
"""

from __future__ import annotations

from apc.cli.options import command, criterion_with, note_aside, note_usual, option, print_result
from apc.cli.progress import status_line


@command
def tune_command(
    *,
    file: str | None,
    free: tuple[str, ...] = option(
        "A gain that may be chosen, and from where to where. Repeat it.", "PATH=LO:HI"
    ),
    maximize: str = option("The gain that is to be as large as can be.", "PATH"),
    minimize: str = option("The gain, or spectral_radius, that is to be as small as can be.", "PATH"),
    subject: tuple[str, ...] = option('Beside stability: "decay=60 dB in 2 s".', "DEMAND"),
    over: tuple[str, ...] = option(
        "What the gains have to bear, all of it: user.count=2:10, device.mass=±20%, lan.loss=0:0.05, or "
        '"lan.delay=8 ms:20 ms", at every constant delay. May be repeated.',
        "PATH=LO:HI",
    ),
    hands: str,
    time: str = option("End after this long, with the best found and what is not proved of it.", '"TIME"'),
    settings: tuple[str, ...],
    as_json: bool,
) -> None:
    """Find the gains that do best, and prove that they do.

    The free gains are chosen so that one of them is as large (or small) as can
    be while the scene is stable in all that stands in --over. They are printed
    to four digits, and proved at these: in boxes, for every number of peers,
    over the network as it is. That no other gains are better is not proved:
    the answer says how many points were looked at.

    \b
        apc tune --free "coordination.stiffness=10 N/m:5000 N/m" \\
                 --free "coordination.damping=0 N*s/m:50 N*s/m" \\
                 --maximize coordination.stiffness \\
                 --over user.count=2:10 --over device.mass=±20%
    """
    from apc.inputs import open_scene
    from apc.tune.demands import read_aim, read_demands, read_seconds
    from apc.tune.tune import tune

    note_usual(hands)
    system = open_scene(file, settings, hands=hands, told=note_aside)
    demands = read_demands(
        system,
        free,
        read_aim(maximize, minimize),
        subject=subject,
        over=over,
        criterion=criterion_with(hands, None),
    )
    with status_line() as told:
        found = tune(system, demands, seconds=read_seconds(time), told=told)
    print_result(found, as_json=as_json)
