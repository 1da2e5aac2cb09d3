"""The entry point of the command line: `apc …` or `python -m apc …`, and the exit codes.

0 done (also with the result "unstable"), 1 invalid input, 2 usage error, 3 internal error.
"""

from __future__ import annotations

import atexit
import errno
import gc
import io
import os
import sys
import threading
from contextlib import suppress

# Errors of files have their own messages; these errors can only come from the terminal or a pipe.
OUTPUT_ERRORS = (errno.ENOSPC, errno.EIO, errno.EDQUOT, errno.EFBIG)

STOPPED = 130  # the exit code after Ctrl-C: 128 plus the number of the signal

# Minimum line width in columns, also on a narrower terminal.
NARROWEST = 40

# Objects created between two garbage collections. Imports create 50,000 to 100,000 permanent objects: with
# Python's default of 700, repeated collections take a tenth of the time of a short command.
COLLECTION_THRESHOLD = 100_000


def main() -> None:
    """Run the command line and exit."""
    gc.set_threshold(COLLECTION_THRESHOLD)
    try:
        from apc.support.memory import hold_to_memory

        hold_to_memory()
        code = run(sys.argv[1:])
    except KeyboardInterrupt:  # while modules are imported
        sys.stderr.write("stopped\n")
        code = STOPPED
    _end(code)


def _end(code: int) -> None:
    """End the process immediately, without the interpreter's cleanup of objects.

    Threads are joined, and profilers notified, as at a normal exit.
    """
    if threading.active_count() > 1 or sys.getprofile() or sys.gettrace():
        sys.exit(code)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(
            OSError, ValueError, AttributeError
        ):  # closed, or not writable, which `run` has reported
            stream.flush()
    os._exit(code)


def run(arguments: list[str]) -> int:
    """Run a command and return its exit code; exceptions are converted to messages."""
    import click

    from apc.cli.commands import apc
    from apc.compiler.errors import ApcError, visible

    if sys.stdout is None:  # closed before the start
        click.echo("apc: can't write the output: stdout is closed", err=True)
        return 1
    try:
        apc.main(arguments, prog_name="apc", standalone_mode=False)
        sys.stdout.flush()
    except ApcError as error:
        for mistake in error.mistakes:
            click.echo(_fitting(str(mistake)), err=True)
        return 1
    except click.ClickException as error:
        error.show(shown := io.StringIO())
        click.echo(_fitting(visible(shown.getvalue())), err=True, nl=False)
        return 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("stopped", err=True)
        return STOPPED
    except SystemExit:
        # click exits this way only for a broken pipe: the reader of the output has ended.
        return 0
    except BrokenPipeError:
        _silence_stdout()  # the same at the last flush
        return 0
    except OSError as error:
        if error.errno not in OUTPUT_ERRORS:
            return _bug(arguments)
        _silence_stdout()
        click.echo(f"apc: can't write the output: {error.strerror}", err=True)
        return 1
    except Exception as error:
        from apc.support.memory import is_lack, lacking

        if not is_lack(error):
            return _bug(arguments)
        click.echo(str(lacking(" ".join(["apc", *arguments[:1]]))), err=True)
        return 1
    return 0


def _fitting(text: str) -> str:
    """Return a text wrapped to the terminal; for a pipe or file each line is unchanged.

    Indented lines, such as source lines with a caret, are unchanged.
    """
    if not sys.stderr.isatty():
        return text
    import shutil
    import textwrap

    fit = textwrap.TextWrapper(
        max(shutil.get_terminal_size().columns, NARROWEST),
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    lines = text.split("\n")
    return "\n".join(line if line.startswith("    ") else fit.fill(line) for line in lines)


def _silence_stdout() -> None:
    """Redirect the standard output to the null device, so that the flush at exit raises no second error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _bug(arguments: list[str]) -> int:
    """Write the report of an internal error, print its location, and return the exit code."""
    import click

    where = _report(arguments)
    click.echo(f"apc: internal error, not an error of the input; report: {where}", err=True)
    return 3


def _report(arguments: list[str]) -> str:
    """Write the report of an internal error to a temporary file, and return the path of the file."""
    import tempfile
    import traceback
    from pathlib import Path

    from apc.support.distribution import program_version

    text = (
        f"apc {program_version()}, Python {sys.version}\narguments: {arguments}\n\n{traceback.format_exc()}"
    )
    try:
        handle, name = tempfile.mkstemp(prefix="apc-bug-", suffix=".txt")
        os.close(handle)
        Path(name).write_text(text, encoding="utf-8")
    except OSError:
        return f"no file (not writable):\n{text}"
    return name


if __name__ == "__main__":
    main()
