"""Typesetting of equations in docstrings: from plain text to LaTeX, which GitHub displays.

In plain text, spaces mean a product, `_` an index, `^` a power and bars an absolute value. A `/` with spaces divides
all factors before it by the next factor; a `/` without spaces divides only its neighbours. Words stay words.
"""

import itertools
import re
from typing import NamedTuple

TOKEN = re.compile(r"( *)([A-Za-z]+(?:'s\b)?|\d+(?:\.\d+)?|\.\.\.|<=|>=|\S)")
GREEK = ("alpha", "tau")
FUNCTIONS = ("cos", "exp", "log", "sin", "tanh")
SIGNS = {"<=": r"\le", ">=": r"\ge", "...": r"\dots", ",": r",\ ", ";": r";\ ", ":": r":\ "}
NO_TERM = {"", "+", "-", "=", "<", ">", ")", "|", *SIGNS}  # tokens that end a product


class Token(NamedTuple):
    """A name, number or sign, with the number of spaces before it."""

    spaces: int
    text: str


def to_fences(equations: str) -> str:
    """Return equations as Markdown, one block of LaTeX per line.

    Args:
        equations: Equations in plain text.

    Raises:
        ValueError: A parenthesis or bar has no partner, or a factor is missing.
    """
    return "\n\n".join(f"```math\n{_Line(line).read()}\n```" for line in equations.splitlines())


class _Line:
    """One line, parsed once from left to right."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.left = [Token(len(match[1]), match[2]) for match in TOKEN.finditer(text.strip())]

    def read(self) -> str:
        latex = self.terms()
        if self.left:
            raise ValueError(f"{self.left[0].text!r} closes nothing in {self.text!r}.")
        return latex

    def terms(self, end: str = "") -> str:
        """Read products and the signs between them, up to and including the sign that ends them."""
        parts: list[str] = []
        while (token := self.next()).text not in ("", end or ")", ")"):
            if token.spaces > 1:
                parts.append(r"\quad")
            parts.append(self.sign() if token.text in NO_TERM - {"|"} else self.product())
        if end:
            self.take(end)
        return " ".join(parts)

    def sign(self) -> str:
        text = self.take()
        return SIGNS.get(text, text)

    def product(self) -> str:
        factors = [self.factor()]
        while ((token := self.next()).text not in NO_TERM and token.spaces < 2) or self.opens_bar():
            if token.text == "/":
                self.take()
                tight = not token.spaces
                above = factors.pop() if tight else _multiply(factors)
                factors = [*(factors if tight else []), rf"\frac{{{_bare(above)}}}{{{_bare(self.factor())}}}"]
            else:
                factors.append(self.factor())
        return _multiply(factors)

    def opens_bar(self) -> bool:
        """Return whether an opening bar follows: it has a space before it and none after it."""
        if self.next().text != "|" or not self.next().spaces or len(self.left) < 2:
            return False
        return not self.left[1].spaces

    def factor(self) -> str:
        """Read a symbol, number, word, call, parenthesis or absolute value, with its index and power."""
        text = self.take()
        if text in ("(", "|"):
            latex = self.enclosed(text)
        elif text == "sqrt":
            self.take("(")
            latex = rf"\sqrt{{{self.terms(')')}}}"
        else:
            latex = _symbol(text, called=self.touches("(") or self.touches("'")) + self.raised("_")
            if self.touches("'"):
                latex += self.take()
            if text[0].isalpha() and self.touches("("):
                self.take()
                latex += self.enclosed("(")
        return latex + self.raised("_") + self.raised("^")

    def enclosed(self, opening: str) -> str:
        closing = {"(": ")", "|": "|"}[opening]
        return rf"\left{opening} {self.terms(closing)} \right{closing}"

    def raised(self, mark: str) -> str:
        """Read an optional index or power: an expression in parentheses, or one symbol, sign or call."""
        if not self.touches(mark):
            return ""
        self.take()
        if self.touches("("):
            self.take()
            return f"{mark}{{{self.terms(')')}}}"
        text = self.take()
        latex = _symbol(text, called=self.touches("(") and mark == "^")
        if mark == "^" and self.touches("("):
            self.take()
            latex += self.enclosed("(")
        return f"{mark}{{{latex}}}"

    def touches(self, text: str) -> bool:
        return self.next() == Token(0, text)

    def next(self) -> Token:
        return self.left[0] if self.left else Token(0, "")

    def take(self, expected: str = "") -> str:
        if not self.left or (expected and self.next().text != expected):
            raise ValueError(f"{expected or 'A factor'} is missing in {self.text!r}.")
        return self.left.pop(0).text


def _symbol(text: str, called: bool) -> str:
    if text in (*GREEK, *FUNCTIONS):
        return f"\\{text}"
    if len(text) == 2 and text[0] == "d" and text.isalpha():  # a differential
        return rf"\mathrm{{d}}{text[1]}"
    if len(text) == 1 or not text[0].isalpha():
        return text
    return rf"\operatorname{{{text}}}" if called else rf"\text{{{text}}}"


def _multiply(factors: list[str]) -> str:
    """Join factors, with word spaces around words."""
    latex = factors[0]
    for before, factor in itertools.pairwise(factors):
        latex += (r"\ " if before.startswith(r"\text") or factor.startswith(r"\text") else r"\,") + factor
    return latex


def _bare(latex: str) -> str:
    """Strip the parentheses that a numerator or denominator does not need."""
    inner = re.fullmatch(r"\\left\( (.*) \\right\)", latex)
    if inner is None:
        return latex
    marks = re.findall(r"\\(left|right)[()]", inner[1])
    depths = itertools.accumulate(1 if mark == "left" else -1 for mark in marks)
    return inner[1] if min(depths, default=0) >= 0 else latex
