"""The error of a method that does not support a valid model.

Takes: nothing.
Gives: `NotSupportedError`.
Guarantees: the text of the error is the reason.
Does not: represent a mistake in the input (see `compiler.errors`).
"""

from __future__ import annotations


class NotSupportedError(Exception):
    """A method does not support a model; the text is the reason."""
