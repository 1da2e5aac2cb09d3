"""Verdicts, proofs and limitations as data, each with a unique text.

Takes: nothing.
Gives: `Term`, `Sentence`; `StabilityVerdict`, `BoxVerdict`; `ProofMethod`, `ProofOutcome`, `ProofScope`,
`StabilityProof`, `NO_PROOF`; `LimitationCode`, `Limitation`, `Note`, `code_of`.
Guarantees: decisions depend on members, numbers and codes; the texts are defined here, and are for output
only.
Does not: decide stability (see `spectrum.spectrum`), or format lines (see `output`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Term(StrEnum):
    """A member of an enumeration, equal to its text in every output."""

    def __repr__(self) -> str:
        """Return the text as a Python literal."""
        return repr(self.value)


class Sentence:
    """Data that are written to a document as their text, `str` of them."""

    __slots__ = ()


class StabilityVerdict(Term):
    """The verdict on a spectrum; the numbers of rigid modes are fields of the result with the verdict."""

    STABLE = "stable"
    STABLE_TRANSLATING = "stable up to a common translation"
    STABLE_TURNING = "stable up to a common rotation"
    STABLE_MOVING = "stable up to a common translation and rotation"
    DRIFTS = "drifts"
    UNSTABLE = "unstable"
    UNDECIDED = "undecided: |ρ−1| below the error bound"

    @property
    def stable(self) -> bool | None:
        """Whether the verdict means stable; None if undecided."""
        if self is StabilityVerdict.UNDECIDED:
            return None
        return self not in (StabilityVerdict.DRIFTS, StabilityVerdict.UNSTABLE)

    @property
    def word(self) -> str:
        """The verdict in one word, without rigid modes."""
        if self.stable is None:
            return "undecided"
        return str(StabilityVerdict.STABLE if self.stable else self)

    @property
    def up_to_rigid_modes(self) -> bool:
        """Whether the verdict means stable except for rigid modes."""
        return self.stable is True and self is not StabilityVerdict.STABLE


class BoxVerdict(Term):
    """The verdict over a box of parameters if neither stability nor instability of all points is proved."""

    UNDECIDED = "undecided"


class ProofMethod(Term):
    """The method by which a verdict, or the value at which the verdict changes, was determined."""

    NONE = ""
    BALLS = "ball arithmetic"
    ROUNDED = "in floating point with rigorous error bounds"
    BOUNDED = "rigorous floating-point bounds"
    ESTIMATED = "floating-point estimate"
    COINCIDENT_EVENTS = "events coincide"
    OPEN_BETWEEN = "analyzed on both sides; undecided between"
    ANALYSED_BESIDE = "analyzed on both sides"
    BOTH_COUNTS = "both analyzed"
    SOME_COUNTS = "some counts are undecided"
    BOUNDED_MOMENTS = "rigorous second-moment bounds"
    BOUNDED_HANDS = "rigorous passivity bounds"
    ITERATED_MOMENTS = "second moments by floating-point iteration, not proved"
    ESTIMATED_MOMENTS = "estimate from estimated second moments, not proved"


class ProofOutcome(Term):
    """The outcome of a proof; `PARTLY` if it decides only cases undecided in floats."""

    STABLE = "proved stable"
    DRIFTS = "proved to drift"
    UNSTABLE = "proved unstable"
    UNDECIDED = "undecided"
    PARTLY = "decided"

    @property
    def proved(self) -> bool:
        """Whether the entire verdict is proved."""
        return self not in (ProofOutcome.UNDECIDED, ProofOutcome.PARTLY)


class ProofScope(Term):
    """The subject of a proof, if it is not the unchanged topology."""

    LINEARIZATION = "the linearization"
    NOMINAL_NETWORK = "the nominal network"
    MEAN_SQUARE = "mean square"
    CLAMPED_DEVICES = "clamped devices"


@dataclass(frozen=True, slots=True)
class StabilityProof(Sentence):
    """The proof of a verdict, or of a value at which the verdict changes.

    A proof is false in a condition if there is nothing to report. `bits` is the precision of ball arithmetic,
    0 without it. `outcome` is None for a value at which the verdict changes. `undecided` is the number of
    undecided numbers of peers between two values.
    """

    method: ProofMethod = ProofMethod.NONE
    bits: int = 0
    outcome: ProofOutcome | None = None
    scope: tuple[ProofScope, ...] = ()
    undecided: int = 0

    def __bool__(self) -> bool:
        return self.method is not ProofMethod.NONE

    def __str__(self) -> str:
        """Return the proof as a text, "" without one."""
        if self.undecided:
            return f"{self.undecided} between are undecided"  # numbers of peers between two analyzed ones
        text = str(self.method)
        if self.method is ProofMethod.BALLS:
            at = "at" if self.outcome is ProofOutcome.UNDECIDED else "with"
            text = f"{self.outcome or 'proved'} {at} {self.bits} bits"
            if self.outcome is ProofOutcome.PARTLY:
                text += " where floating point is undecided"
        elif self.method is ProofMethod.ROUNDED:
            criterion = " in mean square," if ProofScope.MEAN_SQUARE in self.scope else ""
            text = f"{self.outcome or 'proved'}{criterion} {self.method}"
        if ProofScope.CLAMPED_DEVICES in self.scope:
            text = f"unstable with clamped devices: {text}"
        of = [
            scope for scope in (ProofScope.LINEARIZATION, ProofScope.NOMINAL_NETWORK) if scope in self.scope
        ]
        return f"{text}, of {' on '.join(of)}" if of else text


NO_PROOF = StabilityProof()


class LimitationCode(Term):
    """The code of a limitation of a result, or of an error in it."""

    NOT_PROVED = "not proved"
    NO_BALLS = "no ball arithmetic"
    ONE_DIRECTION = "one direction"
    UNSTABLE_MAP = "unstable map"
    SLOWER_MOTION = "slower motion"
    COUPLED_COPIES = "coupled copies"
    CLOCK_PHASE = "clock phase"
    WRONG_VERDICT = "wrong verdict"
    OPEN_VERDICT = "open verdict"
    WRONG_BOUND = "wrong bound"
    CRASHED = "crashed"
    NOT_INSTALLED = "not installed"


_TEXTS = {
    LimitationCode.NOT_PROVED: "{}: not proved, as {}",
    LimitationCode.NO_BALLS: "not proved, as method {} has no ball arithmetic",
    LimitationCode.ONE_DIRECTION: "along one direction; along others: {}",
    LimitationCode.UNSTABLE_MAP: "response of the frame map; the topology is unstable",
    LimitationCode.SLOWER_MOTION: ("no low-frequency impedance, as the topology has slower modes"),
    LimitationCode.COUPLED_COPIES: (
        "the H∞ norm of the coordination error is not computed for different peers"
    ),
    LimitationCode.CLOCK_PHASE: "no response to noise, as the fastest clock has a phase",
    LimitationCode.WRONG_VERDICT: "WRONG: {} gives {}, {} {}",
    LimitationCode.OPEN_VERDICT: "WRONG: analyze is undecided: {}",
    LimitationCode.WRONG_BOUND: "WRONG: the bound of {} does not hold",
    LimitationCode.CRASHED: "FAILED, which is a bug: {}",
    LimitationCode.NOT_INSTALLED: "not computed: {}, as the extension {} is not installed",
}


@dataclass(frozen=True, slots=True)
class Limitation(Sentence):
    """A limitation of a result: its code, and the names and numbers in its text."""

    code: LimitationCode
    arguments: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the limitation as a text."""
        return _TEXTS[self.code].format(*self.arguments)


# A note of a result: a limitation that a decision may depend on, or a text for output only.
Note = str | Limitation


def code_of(note: Note) -> LimitationCode | None:
    """Return the code of a note; None for a text for output only."""
    return note.code if isinstance(note, Limitation) else None
