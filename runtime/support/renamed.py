"""Former public names, and the names that replace them: for the messages of one release.

Takes: nothing. Gives: `FORMER_COMMANDS`, `FORMER_OPTIONS`, `FORMER_FUNCTIONS`, `FORMER_ARGUMENTS`.
Guarantees: a former name raises an error with its replacement.
Does not: rename keys of a topology (see `compiler.source.reading`).
"""

from __future__ import annotations

from collections.abc import Mapping

# The present name of each former command.
FORMER_COMMANDS: Mapping[str, str] = {"feel": "transparency", "play": "run"}

# Former options by command; "" for all commands.
FORMER_OPTIONS: Mapping[str, dict[str, str]] = {
    "": {"--in": "--criterion"},
    "analyze": {"--buzz": "--limit-cycle", "--conventions": "--event-order"},
    "export": {"--cut": "--open-at", "--free": "--symbolic"},
    "simulate": {"--strike": "--impulse", "--still": "--snapshot"},
    "tune": {"--subject": "--constraint", "--against": "--tradeoff"},
}

FORMER_FUNCTIONS: Mapping[str, str] = {
    "buzz": "limit_cycle",
    "conventions": "event_order",
    "describe_network": "fit_link",
    "feel": "transparency",
    "front": "pareto_front",
    "judge_network": "mean_square_stability",
    "paper_route": "paper_method",
    "passive_hands": "absolute_stability",
    "prove_box": "robust_stability",
    "switching": "arbitrary_switching",
    # classes
    "BoxProof": "RobustStability",
    "Buzz": "LimitCycle",
    "CompiledSystem": "Model",
    "Conventions": "EventOrder",
    "Feel": "Transparency",
    "Front": "ParetoFront",
    "NetworkRecording": "LinkFit",
    "NetworkVerdict": "MeanSquareStability",
    "PaperRoute": "PaperMethod",
    "PassiveHands": "AbsoluteStability",
    "Switching": "ArbitrarySwitching",
}

# Former arguments by function; "" for all functions.
FORMER_ARGUMENTS: Mapping[str, dict[str, str]] = {
    "": {"set": "params"},
    "export": {"cut": "open_at", "free": "symbolic"},
    "simulate": {"strike": "impulse"},
    "tune": {"subject": "constraint"},
    "pareto_front": {"subject": "constraint", "against": "tradeoff"},
}
