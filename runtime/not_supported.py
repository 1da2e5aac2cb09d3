"""A question that a method can't answer for a model that is described correctly.

Takes: nothing.
Gives: `NotSupportedError`.
Guarantees: its text is the reason for the user.
Does not: name a user's mistake (see `compiler.errors`).
"""

from __future__ import annotations


class NotSupportedError(Exception):
    """Raised where a method does not serve a model; its text is the reason."""
