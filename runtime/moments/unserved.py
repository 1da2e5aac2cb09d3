"""What of an unreliable network no method here serves.

Takes: nothing.
Gives: `UnservedError`.
Guarantees: its text says to a user what is not served.
Does not: name a user's mistake: a network that is not judged is described correctly.
"""

from __future__ import annotations


class UnservedError(Exception):
    """A question on a network that has no answer, with the reason in words."""
