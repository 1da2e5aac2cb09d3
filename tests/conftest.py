"""What holds for all tests: none of them depends on time, so a busy machine changes no outcome.

None depends on another either, or on what the user keeps: they run in several processes at once.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes, or the making of one, says nothing of whether a claim is true.
settings.register_profile("apc", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("apc")


@pytest.fixture(scope="session", autouse=True)
def users_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep what apc keeps for a user in a folder of this process, and not among the user's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        # Nothing is said of how far work is, however long it takes.
        patch.setattr("apc.cli.progress.QUIET", float("inf"))
        # Processes that tests start keep what Python compiled, as where apc is installed.
        patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
        yield
