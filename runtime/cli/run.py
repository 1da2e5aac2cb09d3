"""The command `apc run`.

Takes: words of a command line. Gives: text on stdout.
Guarantees: with --json, stdout holds one JSON document and nothing else; Ctrl-C ends the run and keeps what
is done.
Does not: compute.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from apc.cli.options import command, echo, note_aside, option, print_result, seed_option
from apc.cli.progress import at_work
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation


@command
def run_command(
    *,
    file: str | None,
    duration: str | None,
    settings: tuple[str, ...],
    peer: str | None = option("Run this peer only.", "PEER", show_default="all peers"),
    listen: str | None = option("Address of this peer.", "HOST:PORT"),
    to: tuple[str, ...] = option("Address of another peer (repeatable).", "PEER=HOST:PORT"),
    emulate: bool = option("Emulate delay and loss of the links."),
    seed: int | None = seed_option(),
    device: Path | None = option("Driver of the device (.py, .so), see above."),
    secret_file: Path | None = option("Shared secret; other packets are dropped."),
    patience: str = option("Time to wait for the other peers.", '"TIME"', name="--wait", default="30 s"),
    out: Path | None = option("Folder of the recording.", "FOLDER", show_default="NAME.run"),
    as_json: bool,
) -> None:
    """Run a topology in real time over UDP.

    Each peer runs at its clocks, with a simulated device unless --device is
    given. Without --peer all peers run on this machine. The recording is a
    folder NAME.run; apc compare NAME.run compares it with simulation and
    analysis. Hosts need clocks synchronized by NTP or PTP: a constant offset is
    removed at the start, drift is not.

    \b
    --device  device(time, force) in .py, or apc_device in .so

    \b
        apc run topology.yaml --duration "60 s" --emulate
        apc run topology.yaml --peer "left[1]" --listen 192.0.2.1:5000 \\
                            --to "right[1]=192.0.2.2:5000"
    """
    from apc.inputs.open_model import find_input, open_topology
    from apc.realtime.device import device_function
    from apc.realtime.peer_run import check_folder, write_run
    from apc.realtime.run_folder import read_run
    from apc.realtime.start import LocalRun, run_all, run_single
    from apc.simulation.trajectory import duration_of, parse_duration
    from apc.support.option_value import option_value

    path = find_input(file, compiled_too=True)
    folder = out or Path(f"{path.stem}.run")
    model = open_topology(str(path), settings, notify=note_aside)
    requested = parse_duration(duration) if duration is not None else None
    how = LocalRun(
        duration=duration_of(model, requested),
        secret=_secret(secret_file),
        emulate=emulate,
        seed=seed,
        patience=float(option_value("--wait", patience, subject="a time", unit="s")),
    )
    if how.patience < 0:
        raise ApcError(
            Diagnostic("E207", SourceLocation("--wait"), "time", "0 s or more", patience, '--wait "30 s"')
        )
    check_folder(folder, path)
    if peer is None:
        if listen or to or device:
            raise click.UsageError("--listen, --to and --device require --peer")
        with at_work("running"):
            parts = run_all(model, how)
    else:
        listening, addresses = _addresses(listen, to, has_secret=bool(how.secret))
        outside = None if device is None else device_function(device)
        with at_work("running"):
            parts = (run_single(model, peer, listening, addresses, how, device=outside),)
    troubles = dict.fromkeys(mistake for part in parts if part.trouble for mistake in part.trouble.mistakes)
    played = [part.run for part in parts if part.run is not None]
    if played:
        write_run(folder, model, played, whole=peer is None)
    if troubles:
        if played:
            note_aside(f"{folder} contains the recording up to the error")
        raise ApcError(troubles)
    if not played:
        raise KeyboardInterrupt
    if peer is None:
        from apc.realtime.run_comparison import compare_run

        print_result(compare_run(read_run(folder)), as_json=as_json)
    if not as_json:
        echo(f"\n{folder} is written. Next: apc compare {folder}")


def _secret(path: Path | None) -> bytes:
    """Return the shared secret in a file, b"" without one. Raises ApcError E974."""
    if path is None:
        return b""
    from apc.compiler.files import RefusedError, read_file

    try:
        secret = read_file(path, 1 << 16).strip()
    except RefusedError as refused:
        raise ApcError(
            Diagnostic("E974", SourceLocation("--secret-file"), f"{path} {refused.words}")
        ) from None
    file = shlex.quote(str(path))
    if os.name == "posix" and path.stat().st_mode & 0o077:
        message = f"{path} is readable by other users"
        raise ApcError(Diagnostic("E974", SourceLocation("--secret-file"), message, fix=f"chmod 600 {file}"))
    if len(secret) < SHORTEST:
        fix = f"(umask 077; head -c 32 /dev/urandom | base64 > {file})"
        expected, got = f"{SHORTEST} bytes or more", str(len(secret))
        raise ApcError(Diagnostic("E974", SourceLocation("--secret-file"), "secret", expected, got, fix))
    return secret


SHORTEST = 16


def _addresses(listen: str | None, to: tuple[str, ...], *, has_secret: bool):  # type: ignore[no-untyped-def]
    """Return the socket and the others' addresses."""
    from apc.realtime.start import LOOPBACK, address_of, is_loopback, listen_at

    others = {}
    for text in to:
        name, equals, address = (item.strip() for item in text.partition("="))
        if not (equals and name):
            expected = "PEER=HOST:PORT"
            fix = f'--to "right[1]={text}"' if ":" in text else f'--to "{text or "right[1]"}=192.0.2.7:5000"'
            raise ApcError(
                Diagnostic("E971", SourceLocation("--to"), "address", expected, text[:80] or "nothing", fix)
            )
        if name in others:
            message = f"two addresses of {name}"
            raise ApcError(
                Diagnostic("E971", SourceLocation("--to"), message, fix=f'--to "{name}={address}"')
            )
        others[name] = address_of(address, "--to", name)
    pair = address_of(listen, "--listen") if listen else (LOOPBACK, 0)
    socket = listen_at(pair)
    if not is_loopback(pair) and not has_secret:
        note_aside("packets are not authenticated; --secret-file FILE authenticates them")
    return socket, others
