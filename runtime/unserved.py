"""A question that a method can't answer for a scene that is described correctly.

Takes: nothing.
Gives: `NotSupportedError`.
Guarantees: its text says to a user why.
Does not: name a user's mistake (see `compiler.errors`).
"""

from __future__ import annotations


class NotSupportedError(Exception):
    """Raised where a method does not serve a scene; its text is the reason."""
