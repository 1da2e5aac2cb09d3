"""The file suffixes that a command can write.

Takes: the path given to an option, and the suffixes it may have. Gives: `check_suffix`, `written`.
Guarantees: a file of an unknown suffix is never written as something else.
Does not: write.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import is_special

# What goes into a device or pipe whose name has no suffix: text, as whoever reads there expects.
TEXTS = (".csv", ".txt", ".json", ".svg", ".py", ".mo")

# What other programs take for standard output.
DASH = Path("-")


def check_suffix(path: Path, known: Iterable[str], option: str) -> str:
    """Return the suffix that determines the format of an output file.

    Parameters
    ----------
    path
        A file, or a device or pipe: without a suffix, such as /dev/stdout, it takes the first of `TEXTS`.
    known
        The valid suffixes, the first of which is suggested.
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
    message, proposed = f"the suffix of {option.removesuffix('=')}", Path(path.name or "result")
    if path == DASH:  # whoever writes it wants standard output, which takes text
        as_text = any(text in names for text in TEXTS)
        instead = Path("/dev/stdout") if as_text else Path("result").with_suffix(names[0])
        raise ApcError(
            Diagnostic(
                "E878", SourceLocation(str(path)), message, requested, "none", written(option, instead)
            )
        )
    hint = written(option, path.parent / proposed.with_suffix(names[0]))
    raise ApcError(
        Diagnostic("E878", SourceLocation(str(path)), message, requested, path.suffix or "none", hint)
    )


def written(option: str, path: Path) -> str:
    """Return an option with its path, as on the command line or in Python: see `check_suffix`."""
    return f'{option}"{path}"' if option.endswith("=") else f"{option} {path}"
