"""Many verdicts: margins, critical values, sensitivities, sweeps, comparison of schemes."""
