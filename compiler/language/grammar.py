"""The language's own grammar: the text of an expression or equation to a tree.

Takes: a text and where it stands. Gives: `parse_expression`, `parse_equation`.
Guarantees: length, depth, digits and exponents are bounded, so parsing always ends soon;
`parse_expression(format_expression(e)) == e` for every parsed `e`; nothing is ever run as Python.
Does not: know what a name means, or its unit.

The grammar, loosest first; `^` and `**` are the same:

    expression  = "if" expression "then" expression {"elseif" expression "then" expression} "else" expression
                | disjunction
    disjunction = conjunction {"or" conjunction}
    conjunction = negation {"and" negation}
    negation    = "not" negation | comparison
    comparison  = sum [("<" | "<=" | ">" | ">=" | "==" | "!=") sum]
    sum         = product {("+" | "-") product}
    product     = sign {("*" | "/") sign}
    sign        = ("-" | "+") sign | power
    power       = atom ["^" exponent]
    exponent    = ["-"] number | "(" ["-"] number ["/" number] ")"
    atom        = number | "pi" | name | function "(" expression {"," expression} ")" | "(" expression ")"
                | "{" expression {"," expression} "}"
    name        = segment {"." segment},   segment = letter {letter | digit | "_"} ["[" integer "]"]
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import NoReturn

from apc.compiler.errors import ApcError, Mistake, Place, nearest, place_in
from apc.compiler.language.expression import (
    COMPARISONS,
    FUNCTIONS,
    KEYWORDS,
    LEVELS,
    PI,
    Binary,
    Call,
    Compare,
    Conditional,
    Equation,
    Expr,
    Level,
    Logic,
    Name,
    Negate,
    Not,
    Number,
    Vector,
    format_expression,
    interval_of,
)
from apc.compiler.language.lexer import Token, tokens
from apc.compiler.words import cut

ALIKE = 0.8  # of the letters of a function's name, for another to be the one that was meant
MAX_LENGTH = 10_000  # characters of an expression
MAX_DEPTH = 100  # levels of the tree; Python's own stack allows about 300
MAX_DIGITS = 1000  # characters of a number: Python refuses an integer of 4300 digits
MAX_NUMBER_EXPONENT = 300  # of 1e300: still a float
MAX_POWER = 100  # of x^100


def parse_expression(text: str, place: Place) -> Expr:
    """Return the tree of an expression that is a number; a condition stands inside an `if` only.

    Parameters
    ----------
    text
        One expression.
    place
        Where the first character of `text` stands; mistakes are reported that much further right.

    Raises
    ------
    ApcError
        E321 a character, E322 a wrong or missing token, E323 a number, E324 a name, E325 a function,
        E326 an exponent, E327 a condition where a number is due or the reverse, E328 too long or too deep.
    """
    parser = _Parser(text, place)
    expr = parser.number(0)
    if parser.kind == "=":
        parser.fail("E322", "an expression", "one value", "an equation")
    parser.expect_end()
    return expr


def parse_equation(text: str, place: Place) -> Equation:
    """Return both sides of `left = right`: as `parse_expression`, and E329 unless there is just one `=`."""
    parser = _Parser(text, place)
    left = parser.expression(0)
    if parser.kind == "end":
        # The usual slip: `a == b` for `a = b`.
        if isinstance(left, Compare) and left.operator == "==":
            hint = f"{format_expression(left.left)} = {format_expression(left.right)}"
            parser.fail("E329", "an equation", "one =", "==, which compares", hint)
        parser.fail("E329", "an equation", "one =, as in a = b", "none")
    parser.want_number(left)
    if parser.kind == "=":
        parser.step()
    else:
        parser.expect_end()
    right = parser.number(0)
    if parser.kind == "=":
        parser.fail("E329", "an equation", "one =", "a second one")
    parser.expect_end()
    return Equation(left, right, text, place)


class _Parser:
    """Precedence climbing over the tokens (Pratt 1973); `self.token` is the next one not yet used."""

    def __init__(self, text: str, place: Place) -> None:
        self.text, self.place = text, place
        self.nesting = 0
        # The depth of every tree built so far that is not a leaf, by identity: a long chain is deep too.
        self.depths: dict[int, tuple[Expr, int]] = {}
        if len(text) > MAX_LENGTH:
            self.too_long()
        self.tokens = tokens(text, place)
        self.token = next(self.tokens)
        self.last_end = 0

    @property
    def kind(self) -> str:
        return self.token.kind

    def step(self) -> Token:
        """Use the next token."""
        used = self.token
        self.last_end = used.end
        if used.kind != "end":
            self.token = next(self.tokens)
        return used

    def fail(
        self,
        code: str,
        what: str,
        expected: str = "",
        got: str = "",
        hint: str = "",
        *,
        at: int | None = None,
    ) -> NoReturn:
        """Raise one mistake at an offset, by default at the next token."""
        offset = self.token.start if at is None else at
        place = place_in(self.place, self.text, offset)
        raise ApcError(Mistake(code, place, what, expected, got, hint))

    def too_long(self) -> NoReturn:
        got = f"{len(self.text)}"
        raise ApcError(Mistake("E328", self.place, "an expression", f"at most {MAX_LENGTH} characters", got))

    def got(self) -> str:
        """Name the next token for a message."""
        return cut(self.token.text) if self.token.text else "the end of the text"

    def expect(self, kind: str, inside: str) -> Token:
        """Use the next token, which has to be this one."""
        if self.kind != kind:
            self.fail("E322", inside, kind, self.got())
        return self.step()

    def expect_end(self) -> None:
        """Raise unless the text is used up; the usual reasons get their own sentence."""
        if self.kind == "end":
            return
        if self.kind == ")":
            self.fail("E322", "this ) closes nothing")
        if self.kind == "}":
            self.fail("E322", "this } closes nothing")
        if self.kind == ",":
            what = "commas stand between arguments, or entries of a vector, only"
            self.fail("E322", what)
        if self.kind in KEYWORDS:
            self.fail("E322", f"{self.token.text} belongs to an if … then … else, and none is open here")
        self.fail("E322", "an operator was expected", "", f"here, not {self.got()}")

    def built(self, expr: Expr, *parts: Expr) -> Expr:
        """Return a new node after checking how deep it is."""
        depth = 1 + max(self.depths[id(part)][1] if id(part) in self.depths else 0 for part in parts)
        if depth > MAX_DEPTH:
            self.fail_depth(expr.start)
        self.depths[id(expr)] = (expr, depth)  # keeping the node keeps its identity its own
        return expr

    def fail_depth(self, at: int) -> NoReturn:
        what = f"this is nested or chained more than {MAX_DEPTH} deep: give a part of it a name"
        self.fail("E328", what, at=at)

    def number(self, level: int) -> Expr:
        """Parse an operand that is a number."""
        expr = self.expression(level)
        self.want_number(expr)
        return expr

    def condition(self, level: int) -> Expr:
        """Parse an operand that is a condition."""
        expr = self.expression(level)
        self.want_condition(expr)
        return expr

    def want_number(self, expr: Expr) -> None:
        if isinstance(expr, Compare | Logic | Not):
            self.fail("E327", f"{self.said(expr)} is a condition, and a number is due here", at=expr.start)

    def want_condition(self, expr: Expr) -> None:
        # A name may stand for a condition; what it is, only its declaration can tell.
        if not isinstance(expr, Compare | Logic | Not | Name):
            self.fail("E327", f"{self.said(expr)} is a number, and a condition is due here", at=expr.start)

    def said(self, expr: Expr) -> str:
        return cut(self.text[expr.start : expr.end])

    def expression(self, level: int) -> Expr:
        """Parse an operand whose operators all bind at least as tightly as `level`."""
        self.nesting += 1
        if self.nesting > MAX_DEPTH:
            self.fail_depth(self.token.start)
        left = self.prefix(level)
        while (binds := LEVELS.get(self.kind, 0)) and binds >= level:
            left = self.binary(left, binds)
        self.nesting -= 1
        return left

    def binary(self, left: Expr, binds: int) -> Expr:
        """Parse one operator and its right operand."""
        operator = self.step().text
        right: Expr
        if binds == Level.POWER:
            self.want_number(left)
            right = self.exponent()
            if self.kind == "^":
                self.fail("E326", "a power of a power needs parentheses", hint="(x^2)^3")
            return self.built(Binary("^", left, right, start=left.start, end=self.last_end), left)
        if binds in (Level.OR, Level.AND):
            self.want_condition(left)
            right = self.condition(binds + 1)
            return self.built(Logic(operator, left, right, start=left.start, end=right.end), left, right)
        self.want_number(left)
        right = self.number(binds + 1)
        if binds == Level.COMPARE:
            if self.kind in COMPARISONS:
                self.fail("E322", "a comparison has two sides", hint="a < b and b < c")
            return self.built(
                Compare(operator, left, right, start=left.start, end=self.last_end), left, right
            )
        return self.built(Binary(operator, left, right, start=left.start, end=self.last_end), left, right)

    def prefix(self, level: int) -> Expr:
        """Parse what an operand starts with."""
        token = self.token
        operand: Expr
        match token.kind:
            case "number":
                return self.literal()
            case "name":
                return self.name_or_call()
            case "(":
                return self.parenthesis()
            case "{":
                self.step()
                entries = self.arguments("}", "an entry of a vector")
                end = self.expect("}", "an opened {").end
                if not entries:
                    self.fail("E322", "a vector has entries; one of zeros is {0, 0}", at=token.start)
                return self.built(Vector(entries, start=token.start, end=end), *entries)
            case "+":
                self.step()
                return self.number(Level.SIGN)
            case "-":
                self.step()
                operand = self.number(Level.SIGN)
                return self.built(Negate(operand, start=token.start, end=self.last_end), operand)
            case "not" if level <= Level.NOT:
                self.step()
                operand = self.condition(Level.NOT)
                return self.built(Not(operand, start=token.start, end=self.last_end), operand)
            case "if" if level == 0:
                return self.conditional()
            case "not" | "if":
                return self.fail("E322", f"{token.kind} … needs parentheses here")
            case _:
                return self.fail("E322", "a number, a name or ( was expected", "", f"here, not {self.got()}")

    def parenthesis(self) -> Expr:
        start = self.step().start
        inner = self.expression(0)
        end = self.expect(")", "an opened (").end
        # The parentheses belong to the node's text: what stands in them is pointed at with them.
        wider: Expr = replace(inner, start=start, end=end)
        if id(inner) in self.depths:
            self.depths[id(wider)] = (wider, self.depths[id(inner)][1])
        return wider

    def conditional(self) -> Expr:
        start = self.step().start
        condition = self.condition(0)
        self.expect("then", "an if")
        then = self.number(0)
        otherwise: Expr
        if self.kind == "elseif":
            self.nesting += 1
            if self.nesting > MAX_DEPTH:
                self.fail_depth(self.token.start)
            otherwise = self.conditional()
            self.nesting -= 1
        else:
            self.expect("else", "an if … then")
            otherwise = self.number(0)
        expr = Conditional(condition, then, otherwise, start=start, end=self.last_end)
        return self.built(expr, condition, then, otherwise)

    def literal(self) -> Expr:
        token = self.step()
        value = self.exact(token)
        if self.kind in ("name", "number") and self.text[token.end : self.token.start].strip(" ") == "":
            said = self.text[token.start : self.token.end]
            what = f"{cut(said)} is not a number, and units stand on parameters only"
            hint = ""
            if self.kind == "name" and value == 0:
                hint = token.text  # nothing is nothing in any unit
            elif self.kind == "name":
                hint = (
                    f"a parameter, with default: {token.text} {self.token.text}; of a name, {token.text}*name"
                )
            self.fail("E323", what, hint=hint, at=token.start)
        return Number(value, start=token.start, end=token.end)

    def exact(self, token: Token) -> Fraction:
        """Return a literal's exact value, inside bounds."""
        if len(token.text) > MAX_DIGITS:
            got = f"{len(token.text)}"
            self.fail("E323", "a number", f"at most {MAX_DIGITS} characters", got, at=token.start)
        mantissa, _, exponent = token.text.lower().partition("e")
        if exponent and abs(int(exponent)) > MAX_NUMBER_EXPONENT:
            limit = f"an exponent from -{MAX_NUMBER_EXPONENT} to {MAX_NUMBER_EXPONENT}"
            self.fail("E323", "a number", limit, cut(exponent), at=token.start)
        return Fraction(mantissa) * Fraction(10) ** int(exponent or 0)

    def exponent(self) -> Number:
        """Parse the right side of ^: a literal, so that its unit and its cost are known."""
        start = self.token.start
        inside = self.kind == "("
        if inside:
            self.step()
        sign = -1 if self.kind == "-" else 1
        if self.kind in ("-", "+"):
            self.step()
        value = sign * self.exponent_part(start)
        if inside:
            if self.kind == "/":
                self.step()
                divisor = self.exponent_part(start)
                if divisor == 0:
                    self.fail("E326", "this exponent divides by zero", at=start)
                value /= divisor
            if self.kind != ")":
                self.refuse_exponent(start)
            self.step()
        if abs(value) > MAX_POWER or value.denominator > MAX_POWER:
            limit = f"-{MAX_POWER} to {MAX_POWER}, or a fraction of such numbers"
            self.fail("E326", "an exponent", limit, cut(str(value)), at=start)
        return Number(value, start=start, end=self.last_end)

    def exponent_part(self, start: int) -> Fraction:
        if self.kind != "number":
            self.refuse_exponent(start)
        return self.exact(self.step())

    def refuse_exponent(self, start: int) -> NoReturn:
        expected = "a number written out, as in x^2 or x^(1/2)"
        self.fail("E326", "an exponent", expected, self.got(), at=start)

    def name_or_call(self) -> Expr:
        token = self.step()
        if self.kind != "(":
            if token.text == "pi":
                return Number(PI, start=token.start, end=token.end)
            return Name(tuple(token.text.split(".")), start=token.start, end=token.end)
        function = token.text
        if function not in FUNCTIONS:
            close = nearest(function, FUNCTIONS, alike=ALIKE)
            what = f"there is no function {cut(function)}"
            if not close:
                what += f"; there are: {', '.join(sorted(FUNCTIONS))}"
            self.fail("E325", what, hint=f"{close}(…)" if close else "", at=token.start)
        self.step()
        arguments = self.arguments(")", f"an argument of {function}")
        end = self.expect(")", f"{function}(").end
        self.check_count(function, len(arguments), token.start)
        if function == "interval":
            clock = arguments[0]
            if not (isinstance(clock, Name) and len(clock.parts) == 1):
                self.fail("E325", function, "the name of a clock", self.said(clock), at=clock.start)
            return Name((interval_of(clock.parts[0]),), start=token.start, end=end)
        return self.built(Call(function, arguments, start=token.start, end=end), *arguments)

    def arguments(self, close: str, each: str) -> tuple[Expr, ...]:
        """Parse expressions with commas between them, up to what closes them."""
        found: list[Expr] = []
        while self.kind != close:
            found.append(self.number(0))
            if self.kind != ",":
                break
            self.step()
            if self.kind == close:
                self.fail("E322", f"{each} is missing behind the comma")
        return tuple(found)

    def check_count(self, function: str, count: int, at: int) -> None:
        least, most = FUNCTIONS[function]
        if not least <= count <= most:
            wanted = f"{least}" if least == most else f"{least} to {most}"
            plural = "argument" if most == 1 else "arguments"
            self.fail("E325", function, f"{wanted} {plural}", str(count), at=at)
