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


# A rms value in µm, or µm/s, from which it is printed in mm.
PREFIXED = 10000.0


def noise_rows(noise: H2Gains) -> Iterator[tuple[str, str, str]]:
    """Yield the rms responses to one noise: input, output, value; of samples off by 1 mm in µm."""
    source, small = "1 N rms at every hand", "m"
    if noise.source != "hands":
        source, small = "1 mm rms on every device sample", "µ"
    outputs = (
        ("coordination error", noise.error_m, noise.errors[0], f"{small}m"),
        ("velocity", noise.velocity_m_s, noise.errors[1], f"{small}m/s"),
    )
    for output, value, error, unit in outputs:
        if value is not None and error is not None:
            by, shown = 1e3, unit
            if value * by >= PREFIXED and small == "µ":
                by, shown = 1.0, unit.replace("µ", "m")
            yield source, output, with_error(value * by, error * by, shown)
    if noise.error_m is None and noise.velocity_m_s is None:
        yield source, "", "unbounded drift, or rounding does not exclude it"


def norm_row(gains: HinfGains) -> tuple[str, str, str, str]:
    """Return the table row of the H∞ norm of one mode: mode, output, norm, frequency."""
    peak = gains.sampled_data
    output, unit = ("velocity", "m/s/N") if gains.of == "velocity" else ("coordination error", "m/N")
    if np.isfinite(peak.norm):
        norm = with_error(peak.norm, peak.error, unit)
        return gains.mode, output, norm, f"{peak.frequency_hz:.5g} Hz"
    return gains.mode, output, "unknown (overflow)" if np.isnan(peak.norm) else "infinite (drift)", NONE
