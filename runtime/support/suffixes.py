"""The file suffixes that a command can write.

Takes: the path given to an option, and the valid suffixes. Gives: `check_suffix`, `written`.
Guarantees: a file with an unknown suffix is never written in another format.
Does not: write files.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import is_special

# The text formats for a device or pipe without suffix, in order of preference.
TEXTS = (".csv", ".txt", ".json", ".svg", ".py", ".mo")

# The name of the standard output in other programs.
DASH = Path("-")


def check_suffix(path: Path, known: Iterable[str], option: str) -> str:
    """Return the suffix that determines the format of an output file.

    Parameters
    ----------
    path
        A file, or a device or pipe: without a suffix, such as /dev/stdout, the format is the first of
        `TEXTS`.
    known
        The valid suffixes; the first is used in the fix.
    option
        The option of the path: `--out` on the command line, `out=` in Python.

    Raises
    ------
    ApcError
        E878 the suffix is not among `known`.
    """
    names = tuple(known)
    suffix = path.suffix.lower()
    if suffix in names:
        return suffix
    if not suffix and is_special(path) and (texts := [text for text in TEXTS if text in names]):
        return texts[0]
    requested = names[0] if len(names) == 1 else f"one of {', '.join(names)}"
    message, proposed = f"suffix of {option.removesuffix('=')}", Path(path.name or "result")
    if path == DASH:  # "-" means standard output, which receives text
        as_text = any(text in names for text in TEXTS)
        instead = Path("/dev/stdout") if as_text else Path("result").with_suffix(names[0])
        raise ApcError(
            Diagnostic(
                "E878", SourceLocation(str(path)), message, requested, "none", written(option, instead)
            )
        )
    fix = written(option, path.parent / proposed.with_suffix(names[0]))
    raise ApcError(
        Diagnostic("E878", SourceLocation(str(path)), message, requested, path.suffix or "none", fix)
    )


def written(option: str, path: Path) -> str:
    """Return the text of an option with a path, as on the command line or in Python (see `check_suffix`)."""
    return f'{option}"{path}"' if option.endswith("=") else f"{option} {path}"
