"""Extensions that can't be imported, as if their folders were deleted."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType

from apc.support.extension_table import FOLDER


class HiddenExtensions:
    """A finder for `sys.meta_path` that refuses to import some extensions."""

    def __init__(self, names: set[str]) -> None:
        self.names = names

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> None:
        """Raise ModuleNotFoundError for a hidden extension; leave all others to the next finder."""
        if name.startswith(f"{FOLDER}.") and name.split(".")[2] in self.names:
            hidden = ".".join(name.split(".")[:3])
            raise ModuleNotFoundError(f"No module named {hidden!r}", name=hidden)


@contextmanager
def hidden(*names: str) -> Iterator[None]:
    """Hide extensions, those already imported among them."""
    prefixes = tuple(f"{FOLDER}.{name}" for name in names)
    kept = {name: module for name, module in sys.modules.items() if name.startswith(prefixes)}
    for name in kept:
        del sys.modules[name]
    finder = HiddenExtensions({*names})
    sys.meta_path.insert(0, finder)  # type: ignore[arg-type] # a finder without `invalidate_caches`
    try:
        yield
    finally:
        sys.meta_path.remove(finder)  # type: ignore[arg-type]
        sys.modules.update(kept)
