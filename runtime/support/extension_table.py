"""The table of extensions: answers that few users need, each in a folder of its own.

Takes: the name of an extension.
Gives: `Extension`, `EXTENSIONS`, `find_extension`, `require_extension`, `not_installed`.
Guarantees: core and studies import no extension; they ask this table. Without the folder of an extension, its
own question is refused by name (E882), and its line in another answer is replaced by a limitation.
Does not: import an extension before its first use.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.verdict import Limitation, LimitationCode

FOLDER = "apc.extensions"


@dataclass(frozen=True, slots=True)
class Extension:
    """An extension, a folder of `apc.extensions`; its attributes are its functions, imported on first use.

    `answers` is what it answers, as a noun; `applies` is when: a criterion, a property of the model, or an
    option; `functions` are those that others call, as "module:function"; `output` is the module that formats
    the answers, "" for plain data.
    """

    name: str
    answers: str
    applies: str
    functions: tuple[str, ...]
    output: str = ""

    def __getattr__(self, name: str) -> Any:
        for text in self.functions:
            module, _, function = text.partition(":")
            if function == name:
                return getattr(import_module(f"{FOLDER}.{self.name}.{module}"), name)
        raise AttributeError(f"extension {self.name} has no function {name}")


EXTENSIONS = {
    extension.name: extension
    for extension in (
        Extension(
            "changing_counts",
            "stability while users join and leave",
            "--changing; apc.changing_counts; joins and leaves of a simulation",
            (
                "changing_engine:changing_engine",
                "changing_engine:pair_indices",
                "joins_and_leaves:changing_counts",
                "peer_times:model_at_end",
                "peer_times:model_of_present",
                "peer_times:presence_of",
                "peer_times:with_peer_times",
            ),
            "changing_counts_output",
        ),
        Extension(
            "event_order",
            "the verdict under every order of simultaneous events",
            "every analysis; all orders with --event-order",
            ("coincident_events:event_order",),
            "event_order_output",
        ),
        Extension(
            "loss_models",
            "losses beyond independent ones: bursts, substitution, recorded delays, consecutive losses",
            "links with these losses; delay=changing; --trace-of worst",
            (
                "channel_models:channel_growth",
                "dropout_bounds:worst_case",
                "dropout_bounds:worst_trace",
                "lyapunov_exponent:top_lyapunov_exponent",
                "time_varying_delay:loop_gain",
                "time_varying_delay:unstable_delays",
            ),
        ),
        Extension(
            "paper_method",
            "the lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20)",
            "--method paper",
            ("lifted_matrices:paper_method", "lifted_matrices:analyze_paper"),
            "paper_method_output",
        ),
        Extension(
            "parameter_boxes",
            "proofs of stability over ranges of parameters and delays",
            "--box; apc tune over ranges",
            (
                "delay_interval_proof:prove_over_delay",
                "delay_interval_proof:varying_delay_result",
                "mean_square_box:prove_mean_square",
                "optimality_bound:cells_without_better_gains",
                "robust_stability:prove_robust_stability",
            ),
        ),
        Extension(
            "parameter_fit",
            "parameters estimated from recorded force and motion",
            "apc fit",
            ("parameter_estimation:fit", "parameter_estimation:read_free"),
            "parameter_fit_output",
        ),
        Extension(
            "pareto_front",
            "the Pareto front of two objectives",
            "apc tune --tradeoff",
            ("trade_off:pareto_front",),
            "pareto_front_output",
        ),
        Extension(
            "switching",
            "stability with contacts that switch arbitrarily, and limit cycles",
            "analyses of models with contacts; --limit-cycle",
            ("arbitrary_switching:arbitrary_switching", "limit_cycle:limit_cycle"),
            "switching_output",
        ),
        Extension(
            "system_norms",
            "system norms of the responses, and the damping due to the network",
            "apc transparency; objectives coordination_error_h2 and coordination_error_hinf",
            (
                "mode_norms:h2_gains",
                "mode_norms:hinf_gains",
                "network_damping:network_damping",
                "system_norms_output:noise_rows",
                "system_norms_output:norm_row",
            ),
            "system_norms_output",
        ),
        Extension(
            "wall_conditions",
            "published conditions of a virtual wall over a region",
            "apc region --overlay",
            ("overlay:overlay_points", "overlay:parse_overlay"),
        ),
    )
}


def find_extension(name: str) -> Extension | None:
    """Return an extension, None if its folder is absent."""
    package = f"{FOLDER}.{name}"
    try:
        import_module(package)
    except ModuleNotFoundError as error:
        if error.name not in (FOLDER, package):
            raise
        return None
    return EXTENSIONS[name]


def require_extension(name: str) -> Extension:
    """Return an extension. Raises ApcError (E882) if its folder is absent."""
    extension = find_extension(name)
    if extension is None:
        absent = EXTENSIONS[name]
        message = f"{absent.answers} ({absent.applies}): the extension {name} is not installed"
        advice = f"install apc with the folder extensions/{name}"
        raise ApcError(Diagnostic("E882", SourceLocation("apc"), message, advice=advice))
    return extension


def not_installed(name: str) -> Limitation:
    """Return the limitation of an answer without a line that an absent extension adds."""
    return Limitation(LimitationCode.NOT_INSTALLED, (EXTENSIONS[name].answers, name))
