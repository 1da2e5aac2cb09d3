"""`expression`: the grammar, its bounds, its messages, the round trip and exact evaluation."""

import math
from collections.abc import Callable
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apc.compiler.errors import ApcError, Place
from apc.compiler.language.evaluation import evaluate
from apc.compiler.language.expression import (
    FUNCTIONS,
    Binary,
    Call,
    Compare,
    Conditional,
    Equation,
    Expr,
    Logic,
    Name,
    Negate,
    Not,
    Number,
    children,
    format_expression,
    names,
    rebuild,
    transform,
    walk,
)
from apc.compiler.language.grammar import parse_equation, parse_expression
from tests.topologies import ROOT

A, B, C, X = (Name((letter,)) for letter in "abcx")
TWO = Number(Fraction(2))

LISTED = ", ".join(sorted(FUNCTIONS))


def parse(text: str) -> Expr:
    return parse_expression(text, Place("a.yaml", 1, 1, text))


def refusal(text: str, parser: Callable[[str, Place], object] = parse_expression) -> str:
    """The only message, without its source line."""
    with pytest.raises(ApcError) as caught:
        parser(text, Place("a.yaml", 1, 1, text))
    (mistake,) = caught.value.mistakes
    return str(mistake).splitlines()[0].removeprefix("a.yaml:")


def value(text: str, **known: Fraction | float) -> Fraction | float | bool:
    return evaluate(parse(text), lambda parts: known[parts[0]], Place("a.yaml", 1, 1, text))


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("a + b*c", Binary("+", A, Binary("*", B, C))),
        ("a - b - c", Binary("-", Binary("-", A, B), C)),
        ("a/b*c", Binary("*", Binary("/", A, B), C)),
        ("-x^2", Negate(Binary("^", X, TWO))),
        ("-a*b", Binary("*", Negate(A), B)),
        ("a*-b", Binary("*", A, Negate(B))),
        ("+a", A),
        ("x**2", Binary("^", X, TWO)),
        ("x^-2", Binary("^", X, Number(Fraction(-2)))),
        ("x^(-1/2)", Binary("^", X, Number(Fraction(-1, 2)))),
        ("0.1", Number(Fraction(1, 10))),
        ("1e-3", Number(Fraction(1, 1000))),
        ("finger[2].x", Name(("finger[2]", "x"))),
        ("max(a, b)", Call("max", (A, B))),
        (
            "if a < b or not a == b and b > c then a else b",
            Conditional(
                Logic("or", Compare("<", A, B), Logic("and", Not(Compare("==", A, B)), Compare(">", B, C))),
                A,
                B,
            ),
        ),
        (
            "if a < b then a elseif b < c then b else c",
            Conditional(Compare("<", A, B), A, Conditional(Compare("<", B, C), B, C)),
        ),
    ],
)
def test_operators_bind_as_in_arithmetic(text: str, tree: Expr) -> None:
    assert parse(text) == tree


def test_every_node_knows_its_part_of_the_text() -> None:
    text = "a*(b + der(x)) - 2"
    assert [text[node.start : node.end] for node in walk(parse(text))] == [
        *("a*(b + der(x)) - 2", "a*(b + der(x))", "a", "(b + der(x))", "b", "der(x)", "x", "2"),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "1:1: E322 a number, a name or ( was expected here, not the end of the text."),
        ("a b", "1:3: E322 an operator was expected here, not b."),
        ("a)", "1:2: E322 this ) closes nothing."),
        ("(a", "1:3: E322 an opened ( wants ), got the end of the text."),
        (
            "a,b",
            "1:2: E322 commas stand between arguments, or entries of a vector, only.",
        ),
        ("a = b", "1:3: E322 an expression wants one value, got an equation."),
        ("a < b < c", "1:7: E322 a comparison has two sides. Write: a < b and b < c"),
        ("1 + if a < b then 1 else 2", "1:5: E322 if … needs parentheses here."),
        ("if a < b then 1", "1:16: E322 an if … then wants else, got the end of the text."),
        ("2 then", "1:3: E322 then belongs to an if … then … else, and none is open here."),
        ("max(a,)", "1:7: E322 an argument of max is missing behind the comma."),
        (
            "2 N",
            "1:1: E323 2 N is not a number, and units stand on parameters only."
            " Write: a parameter, with default: 2 N; of a name, 2*name",
        ),
        ("1e999", "1:1: E323 a number wants an exponent from -300 to 300, got 999."),
        ("1" * 1001, "1:1: E323 a number wants at most 1000 characters, got 1001."),
        ("__class__", "1:1: E324 a name wants a letter first, got __class__."),
        ("a.__dict__", "1:1: E324 a name wants a letter first, got a.__dict__."),
        ("a.if", "1:1: E324 if is a word of the language, not a name."),
        ("a[0]", "1:1: E324 an index wants a whole number counted from 1, got 0."),
        (
            "a[i]",
            "1:2: E321 [ cannot stand here: an index is a whole number right behind its name,"
            " as in finger[2].",
        ),
        ("a().b", f"1:1: E325 there is no function a; there are: {LISTED}."),
        ("ln(x)", f"1:1: E325 there is no function ln; there are: {LISTED}."),
        ("atan2(x)", "1:1: E325 atan2 wants 2 arguments, got 1."),
        ("arctan2(y, x)", "1:1: E325 there is no function arctan2. Write: atan2(…)"),
        ("arcsin(x)", "1:1: E325 there is no function arcsin. Write: asin(…)"),
        ("arctan(x)", "1:1: E325 there is no function arctan. Write: atan(…)"),
        ("sin(a).b", "1:7: E321 . cannot stand here: only a name can be followed by a dot and another name."),
        ("sine(x)", "1:1: E325 there is no function sine. Write: sin(…)"),
        ("max()", "1:1: E325 max wants 1 to 16 arguments, got 0."),
        ("der(x, a)", "1:1: E325 der wants 1 argument, got 2."),
        ("'x'", "1:1: E321 ' cannot stand here: an expression holds no quoted text."),
        ("lambda x", "1:8: E322 an operator was expected here, not x."),
        (
            "x − 1",
            "1:3: E321 an expression wants ASCII letters, digits and + - * / ^ ( ),"
            " got − (U+2212, MINUS SIGN). Write: -",
        ),
        (
            "а + 1",  # a Cyrillic а
            "1:1: E321 an expression wants ASCII letters, digits and + - * / ^ ( ),"
            " got а (U+0430, CYRILLIC SMALL LETTER A).",
        ),
        ("x^n", "1:3: E326 an exponent wants a number written out, as in x^2 or x^(1/2), got n."),
        ("x^2^3", "1:4: E326 a power of a power needs parentheses. Write: (x^2)^3"),
        ("x^101", "1:3: E326 an exponent wants -100 to 100, or a fraction of such numbers, got 101."),
        ("x^(1/0)", "1:3: E326 this exponent divides by zero."),
        ("1 + (a < b)", "1:5: E327 (a < b) is a condition, and a number is due here."),
        ("if 1 then 2 else 3", "1:4: E327 1 is a number, and a condition is due here."),
        ("not a", "1:1: E327 not a is a condition, and a number is due here."),
    ],
)
def test_a_refused_expression_is_answered_with_one_line(text: str, message: str) -> None:
    assert refusal(text) == message


def test_an_equation_has_two_sides_and_keeps_its_text() -> None:
    place = Place("a.yaml", 3, 5, "  - a*x = b")
    equation = parse_equation("a*x = b", place)
    assert equation == Equation(Binary("*", A, X), B, "a*x = b", place)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a", "1:2: E329 an equation wants one =, as in a = b, got none."),
        ("a == b*c", "1:9: E329 an equation wants one =, got ==, which compares. Write: a = b*c"),
        ("a = b = c", "1:7: E329 an equation wants one =, got a second one."),
        ("a = b < c", "1:5: E327 b < c is a condition, and a number is due here."),
        ("a < b = c", "1:1: E327 a < b is a condition, and a number is due here."),
        ("a b = c", "1:3: E322 an operator was expected here, not b."),
    ],
)
def test_an_equation_has_exactly_one_equals_sign(text: str, message: str) -> None:
    assert refusal(text, parse_equation) == message


def test_a_mistake_in_a_yaml_line_is_reported_at_its_own_column() -> None:
    with pytest.raises(ApcError) as caught:
        parse_equation("f = stifness(x)", Place("mass.yaml", 9, 5, "  - f = stifness(x)"))
    assert str(caught.value).splitlines()[0].startswith("mass.yaml:9:9: E325")


DEEP = "E328 this is nested or chained more than 100 deep: give a part of it a name."


@pytest.mark.parametrize(
    "text",
    [
        "(" * 3000 + "x" + ")" * 3000,
        "(" * 9000,
        "-" * 9000 + "x",
        "not " * 2000 + "a < b",
        "abs(" * 1900 + "x" + ")" * 1900,
        "+".join("x" * 200),
        "if a<b then 1 else " * 400 + "2",
        "if a<b then 1" + " elseif a<b then 1" * 400 + " else 2",
    ],
)
def test_what_nests_or_chains_too_deep_is_refused_without_recursion(text: str) -> None:
    assert refusal(text).endswith(DEEP)


def test_a_tree_just_within_the_depth_works_everywhere() -> None:
    for text in ("(" * 99 + "x" + ")" * 99, "+".join("x" * 100), "abs(" * 99 + "x" + ")" * 99):
        tree = parse(text)
        assert parse(format_expression(tree)) == tree
        assert hash(tree) == hash(parse(text))
        assert transform(tree, lambda node: None) is tree
        assert value(text, x=Fraction(0)) == 0


def test_a_text_too_long_is_refused_before_it_is_read() -> None:
    assert refusal("x" * 10_001) == "1:1: E328 an expression wants at most 10000 characters, got 10001."


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (Binary("*", Binary("+", A, B), C), "(a + b)*c"),
        (Binary("-", A, Binary("-", B, C)), "a - (b - c)"),
        (Binary("/", A, Binary("*", B, C)), "a/(b*c)"),
        (Binary("^", Negate(X), TWO), "(-x)^2"),
        (Negate(Binary("^", X, TWO)), "-x^2"),
        (Binary("^", Binary("^", X, TWO), TWO), "(x^2)^2"),
        (Binary("^", X, Number(Fraction(1, 3))), "x^(1/3)"),
        (Negate(Binary("+", A, B)), "-(a + b)"),
        (Not(Logic("and", Compare("<", A, B), Compare("<", B, C))), "not (a < b and b < c)"),
        (Binary("+", A, Conditional(Compare("<", A, B), A, B)), "a + (if a < b then a else b)"),
        (Number(Fraction(1, 10)), "0.1"),
        (Number(Fraction(1, 1000000)), "1e-6"),
        (Number(Fraction(10) ** 30), "1e30"),
        (Number(Fraction(1, 3)), "1/3"),
        (Binary("*", A, Number(Fraction(-1, 3))), "a*(-1/3)"),
    ],
)
def test_a_tree_prints_with_no_more_parentheses_than_it_needs(tree: Expr, text: str) -> None:
    assert format_expression(tree) == text


def _numbers() -> st.SearchStrategy[Expr]:
    """Trees a text can hold: literals are decimals without a sign."""
    decimals = st.builds(
        lambda digits, places: Fraction(digits, 10**places), st.integers(0, 10**9), st.integers(0, 12)
    )
    exponents = st.one_of(st.integers(-100, 100).map(Fraction), st.fractions(-9, 9, max_denominator=9))
    words = st.sampled_from(["a", "b", "x1", "object", "finger[2]"])
    leaves: st.SearchStrategy[Expr] = st.one_of(
        decimals.map(Number), st.lists(words, min_size=1, max_size=3).map(lambda parts: Name(tuple(parts)))
    )

    def grow(inner: st.SearchStrategy[Expr]) -> st.SearchStrategy[Expr]:
        compare = st.builds(Compare, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), inner, inner)
        condition: st.SearchStrategy[Expr] = st.one_of(
            compare,
            compare.map(Not),
            st.builds(Logic, st.sampled_from(["and", "or"]), compare, compare.map(Not)),
        )
        return st.one_of(
            inner.map(Negate),
            st.builds(Binary, st.sampled_from("+-*/"), inner, inner),
            st.builds(lambda base, exponent: Binary("^", base, Number(exponent)), inner, exponents),
            st.sampled_from(sorted(set(FUNCTIONS) - {"interval"})).flatmap(lambda name: _call(name, inner)),
            st.builds(Conditional, condition, inner, inner),
        )

    return st.recursive(leaves, grow, max_leaves=12)


def _call(name: str, argument: st.SearchStrategy[Expr]) -> st.SearchStrategy[Expr]:
    """Calls with as many arguments as the function takes, three at most."""
    fewest, most = FUNCTIONS[name]
    arguments = st.lists(argument, min_size=fewest, max_size=min(most, 3))
    return arguments.map(lambda found: Call(name, tuple(found)))


@settings(max_examples=200)
@given(_numbers())
def test_printing_and_parsing_give_the_same_tree(tree: Expr) -> None:
    assert parse(format_expression(tree)) == tree


@settings(max_examples=300)
@given(st.one_of(st.text(max_size=30), st.text("ab.1e()+-*/^<=, notif[]_", max_size=40)))
def test_any_text_is_parsed_or_refused_and_nothing_else(text: str) -> None:
    for parser in (parse_expression, parse_equation):
        try:
            parser(text, Place("a.yaml", 1, 1, text))
        except ApcError as error:
            assert len(error.mistakes) == 1


def test_names_come_left_to_right_with_repetitions() -> None:
    assert [name.parts for name in names(parse("a*x + max(b, a.x)"))] == [("a",), ("x",), ("b",), ("a", "x")]


def test_a_replacement_is_not_descended_into_and_the_rest_stays_the_same_object() -> None:
    tree = parse("der(x) + a")
    assert isinstance(tree, Binary)
    changed = transform(tree, lambda node: X if isinstance(node, Call) else None)
    assert changed == Binary("+", X, A)
    assert isinstance(changed, Binary)
    assert changed.right is tree.right


def test_a_node_rebuilt_from_its_children_is_itself() -> None:
    for node in walk(parse("if not a < -b and b > 2 then max(a, x^2) else c")):
        assert rebuild(node, children(node)) == node


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1/3 + 1/6", Fraction(1, 2)),
        ("0.1 + 0.2", Fraction(3, 10)),
        ("2^-3", Fraction(1, 8)),
        ("sqrt(4/9)", Fraction(2, 3)),
        ("(9/4)^(-3/2)", Fraction(8, 27)),
        ("floor(-7/2)", Fraction(-4)),
        ("max(1, 2, 1/2) + min(1, 2)", Fraction(3)),
        ("abs(-3)*sign(-2)", Fraction(-3)),
        ("if 1 < 2 and not 3 < 2 then 3 else 1/0", Fraction(3)),
        ("kt/(peers - 1)", Fraction(1000)),
    ],
)
def test_rational_operations_stay_exact(text: str, expected: Fraction) -> None:
    found = value(text, kt=Fraction(2000), peers=Fraction(3))
    assert found == expected
    assert isinstance(found, Fraction)


def test_other_functions_give_the_floats_of_the_math_module() -> None:
    assert value("exp(1) + sin(2)*log(3)") == math.exp(1) + math.sin(2) * math.log(3)
    assert value("2^(1/2)") == math.sqrt(2)


def test_a_condition_that_holds_is_one() -> None:
    assert evaluate(Compare("<=", TWO, TWO), lambda parts: 0) == 1
    assert evaluate(Compare("<", TWO, TWO), lambda parts: 0) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 + 1/0", "a.yaml:1:5: E331 1/0 divides by zero."),
        ("0^-1", "a.yaml:1:1: E331 0^(-1) divides by zero."),
        ("log(0)", "a.yaml:1:1: E331 log(0) has no real value."),
        ("sqrt(-2)", "a.yaml:1:1: E331 sqrt(-2) has no real value."),
        ("exp(1000)", "a.yaml:1:1: E331 exp(1000) is too large for a number."),
        ("1e300*1e300", "a.yaml:1:1: E331 1e300*1e300 is too large for a number."),
        ("2*kt", "a.yaml:1:3: E330 kt has no value here."),
        (
            "der(1)",
            "a.yaml:1:1: E332 der(…) changes with time or with the peers: a parameter cannot hold it.",
        ),
    ],
)
def test_what_has_no_value_is_refused_at_its_place(text: str, message: str) -> None:
    with pytest.raises(ApcError) as caught:
        value(text)
    assert str(caught.value).splitlines()[0] == message


@pytest.mark.parametrize("text", ["((9^99)^99)^99", "(((0.1^100)^100)^100)^100", "*".join(["9^100"] * 90)])
def test_a_tower_of_powers_ends(text: str) -> None:
    try:
        assert value(text) == 0  # what is too small for a float is zero
    except ApcError as error:
        assert "E331" in str(error)


def test_pi_is_a_number_of_the_language() -> None:
    assert float(value("2*pi*x", x=Fraction(1, 2))) == math.pi
    assert format_expression(parse("2*pi*x - pi/2")) == "2*pi*x - pi/2"
    assert parse("pi.x") == Name(("pi", "x"))
    assert parse("pie") == Name(("pie",))
    assert "E325 there is no function pi" in refusal("pi(x)")
    assert "E326" in refusal("x^pi")


def test_the_reference_shows_the_grammar() -> None:
    rules = (ROOT / "compiler" / "language" / "expression.lark").read_text(encoding="utf-8")
    shown = rules[rules.index("expression: ") : rules.index("NUMBER: /")].strip()
    assert shown in (ROOT / "models" / "README.md").read_text(encoding="utf-8")
