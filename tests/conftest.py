"""What holds for all tests: none of them depends on time, so a busy machine changes no outcome."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# How long an example takes, or the making of one, says nothing of whether a claim is true.
settings.register_profile("apc", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("apc")
