"""Table rows of system norms.

Takes: `HinfGains`, `H2Gains`. Gives: `norm_row`, `noise_rows`.
Guarantees: digits are limited by the error.
Does not: compute.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from apc.output.formatting import (
    with_error,
)
from apc.output.haptics_output import NONE

if TYPE_CHECKING:
    from apc.haptics.response_norms import H2Gains, HinfGains


def noise_rows(noise: H2Gains) -> Iterator[tuple[str, str, str]]:
    """Yield the rms responses to one noise in mm and mm/s: input, output, value."""
    source, by = "1 N rms at every hand", 1e3
    if noise.source != "hands":
        source, by = "1 mm rms on every device sample", 1.0
    outputs = (
        ("coordination error", noise.error_m, noise.errors[0], "mm"),
        ("velocity", noise.velocity_m_s, noise.errors[1], "mm/s"),
    )
    for output, value, error, unit in outputs:
        if value is not None and error is not None:
            yield source, output, with_error(value * by, error * by, unit)
    if noise.error_m is None and noise.velocity_m_s is None:
        yield source, "", "unbounded drift, or rounding does not exclude it"


def norm_row(gains: HinfGains) -> tuple[str, str, str, str]:
    """Return the table row of the H∞ norm of one mode: mode, output, norm, frequency."""
    peak = gains.sampled_data
    output, unit = ("velocity", "mm/s/N") if gains.of == "velocity" else ("coordination error", "mm/N")
    if np.isfinite(peak.norm):
        norm = with_error(1e3 * peak.norm, 1e3 * peak.error, unit)
        return gains.mode, output, norm, f"{peak.frequency_hz:.5g} Hz"
    return gains.mode, output, "unknown (overflow)" if np.isnan(peak.norm) else "infinite (drift)", NONE
