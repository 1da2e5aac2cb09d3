"""Verdicts, proofs and limitations as data, each with its one text.

Takes: nothing.
Gives: `Term`, `Sentence`; `StabilityVerdict`, `BoxVerdict`; `ProofMethod`, `ProofOutcome`, `ProofScope`,
`StabilityProof`, `NO_PROOF`; `LimitationCode`, `Limitation`, `Note`, `code_of`.
Guarantees: a decision reads a member, a number or a code; the text is made here, and for output only.
Does not: decide (see `eigen.spectrum`), or know how wide a line is (see `output`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Term(StrEnum):
    """A member of a closed set, equal to its text in every output."""

    def __repr__(self) -> str:
        """Return the text as Python writes it."""
        return repr(self.value)


class Sentence:
    """Data whose document is a text: `str` of it."""

    __slots__ = ()


class StabilityVerdict(Term):
    """The verdict on a spectrum; the numbers of rigid modes are fields of the result that has it."""

    STABLE = "stable"
    STABLE_TRANSLATING = "stable up to a common translation"
    STABLE_TURNING = "stable up to a common rotation"
    STABLE_MOVING = "stable up to a common translation and rotation"
    DRIFTS = "drifts"
    UNSTABLE = "unstable"
    UNDECIDED = "undecided: |ρ−1| below the error bound"

    @property
    def stable(self) -> bool | None:
        """Whether it means stable; None if undecided."""
        if self is StabilityVerdict.UNDECIDED:
            return None
        return self not in (StabilityVerdict.DRIFTS, StabilityVerdict.UNSTABLE)

    @property
    def word(self) -> str:
        """The verdict in a word, rigid modes left out."""
        if self.stable is None:
            return "undecided"
        return str(StabilityVerdict.STABLE if self.stable else self)

    @property
    def up_to_rigid_modes(self) -> bool:
        """Whether it means stable in all but rigid modes."""
        return self.stable is True and self is not StabilityVerdict.STABLE


class BoxVerdict(Term):
    """The verdict over a box where neither that of stable nor of unstable points is proved."""

    UNDECIDED = "undecided"


class ProofMethod(Term):
    """How a verdict is known, or the value at which it changes."""

    NONE = ""
    BALLS = "ball arithmetic"
    ROUNDED = "by floats whose every rounding is bounded"
    BOUNDED = "bounded in floats"
    ESTIMATED = "estimated in floats"
    COINCIDENT_EVENTS = "events coincide there"
    OPEN_BETWEEN = "analysed on either side; the verdict between them is left open"
    ANALYSED_BESIDE = "analysed on either side"
    BOTH_COUNTS = "both judged"
    SOME_COUNTS = "some counts are left open"
    BOUNDED_MOMENTS = "second moments bounded on either side"
    BOUNDED_HANDS = "what hands can draw bounded on either side"
    ITERATED_MOMENTS = "second moments by iteration in floats, not proved"
    ESTIMATED_MOMENTS = "an estimate, not proved: of second moments that are themselves estimates"


class ProofOutcome(Term):
    """The outcome of a proof; `PARTLY` where it decides only the cases that floats left open."""

    STABLE = "proved stable"
    DRIFTS = "proved to drift"
    UNSTABLE = "proved unstable"
    UNDECIDED = "undecided"
    PARTLY = "decided"

    @property
    def proved(self) -> bool:
        """Whether the verdict is proved as a whole."""
        return self not in (ProofOutcome.UNDECIDED, ProofOutcome.PARTLY)


class ProofScope(Term):
    """The subject of a proof, where it is not the unchanged topology."""

    LINEARIZATION = "the linearization"
    NOMINAL_NETWORK = "the nominal network"
    MEAN_SQUARE = "mean square"
    CLAMPED_DEVICES = "clamped devices"


@dataclass(frozen=True, slots=True)
class StabilityProof(Sentence):
    """How a verdict, or a value at which it changes, is known; false where there is no proof to report.

    `bits` is the precision of ball arithmetic, 0 without it. `outcome` is None of a value at which the
    verdict changes. `undecided` is how many numbers of peers between the two are undecided.
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
            return f"{self.undecided} between are left open"
        text = str(self.method)
        if self.method is ProofMethod.BALLS:
            at = "at" if self.outcome is ProofOutcome.UNDECIDED else "with"
            text = f"{self.outcome or 'proved'} {at} {self.bits} bits"
            if self.outcome is ProofOutcome.PARTLY:
                text += " where floats left it open"
        elif self.method is ProofMethod.ROUNDED:
            criterion = " in mean square," if ProofScope.MEAN_SQUARE in self.scope else ""
            text = f"{self.outcome or 'proved'}{criterion} {self.method}"
        if ProofScope.CLAMPED_DEVICES in self.scope:
            text = f"with its devices clamped it is unstable: {text}"
        of = [
            scope for scope in (ProofScope.LINEARIZATION, ProofScope.NOMINAL_NETWORK) if scope in self.scope
        ]
        return f"{text}, of {' on '.join(of)}" if of else text


NO_PROOF = StabilityProof()


class LimitationCode(Term):
    """A limitation of a result, or a fault in it."""

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


_TEXTS = {
    LimitationCode.NOT_PROVED: "{}: not proved, as {}",
    LimitationCode.NO_BALLS: "not proved, as method {} has no matrix of balls",
    LimitationCode.ONE_DIRECTION: "along one direction; along others: {}",
    LimitationCode.UNSTABLE_MAP: "of the map: the topology is unstable",
    LimitationCode.SLOWER_MOTION: (
        "of slow motions nothing is told: something of the topology is slower still"
    ),
    LimitationCode.COUPLED_COPIES: (
        "largest gains leave out how far the copies of peers that differ move apart together"
    ),
    LimitationCode.CLOCK_PHASE: "what noise does is not told: the fastest clock has a phase",
    LimitationCode.WRONG_VERDICT: "WRONG: {} says {}, {} {}",
    LimitationCode.OPEN_VERDICT: "WRONG: analyze leaves the verdict open: {}",
    LimitationCode.WRONG_BOUND: "WRONG: the bound of {} does not hold",
    LimitationCode.CRASHED: "FAILED, which is a bug: {}",
}


@dataclass(frozen=True, slots=True)
class Limitation(Sentence):
    """A limitation of a result: its code, and the names and numbers that its text holds."""

    code: LimitationCode
    arguments: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the limitation as a text."""
        return _TEXTS[self.code].format(*self.arguments)


# A note of a result: a limitation that a decision may depend on, or a text for output only.
Note = str | Limitation


def code_of(note: Note) -> LimitationCode | None:
    """Return the code of a note, None of a text for output only."""
    return note.code if isinstance(note, Limitation) else None
