"""The command line: commands, options, input and output."""

import lazy_loader  # type: ignore[import-untyped] # it ships no types

# The module of each command: it is loaded when the command is asked for, or when all are listed.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "analyze": ["analyze_command"],
        "bench": ["bench_command"],
        "compare": ["compare_command"],
        "compile": ["check_command", "compile_command"],
        "critical": ["critical_command"],
        "explore": ["explore_command"],
        "export": ["export_command"],
        "fit": ["fit_command"],
        "transparency": ["transparency_command"],
        "library": ["library_command", "new_command"],
        "network": ["network_command"],
        "run": ["run_command"],
        "region": ["region_command"],
        "report": ["report_command"],
        "show": ["schema_command", "show_command"],
        "simulate": ["simulate_command"],
        "sweep": ["sweep_command"],
        "tune": ["tune_command"],
    },
)
