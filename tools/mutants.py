"""Mutants of a module: its small changes, each an edit of the text.

Comparisons and their boundaries, arithmetic, conditions and constants are changed; statements and entries of tables are
left out. Texts, annotations and declarations stay.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

# Operator -> its opposite, and the other side of its boundary.
COMPARISONS = {
    ast.Lt: ("<", (">=", "<=")),
    ast.LtE: ("<=", (">", "<")),
    ast.Gt: (">", ("<=", ">=")),
    ast.GtE: (">=", ("<", ">")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
    ast.Is: ("is", ("is not",)),
    ast.IsNot: ("is not", ("is",)),
    ast.In: ("in", ("not in",)),
    ast.NotIn: ("not in", ("in",)),
}
ARITHMETIC = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "+"),
    ast.Pow: ("**", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
}
CALLS = {"min": "max", "max": "min", "any": "all", "all": "any"}
# Arguments that declare something: they guard against a mistake of a programmer, and no input shows them.
DECLARATIONS = frozenset({"strict", "frozen", "eq", "slots", "kw_only"})
Edit = tuple[int, int, str]  # begin and end in the source [bytes], and the text in place of it
Row = tuple[str, str, str]  # module, its lines before a change and after it


@dataclass(frozen=True)
class Mutant:
    """One change of a module."""

    module: str
    line: int  # the first line that it changes
    before: str  # its lines
    after: str
    source: bytes  # the whole module with the change

    @property
    def row(self) -> Row:
        """Module and lines, as the table of survivors has them."""
        return self.module, self.before, self.after


def find_mutants(module: str, source: bytes) -> list[Mutant]:
    """List all changes of a module, in the order of its lines."""
    return [_make_mutant(module, source, *edit) for edit in sorted(set(Editor(source).find_edits()))]


def _make_mutant(module: str, source: bytes, begin: int, end: int, text: str) -> Mutant:
    first, last = source.rfind(b"\n", 0, begin) + 1, source.find(b"\n", end)
    head, tail = source[first:begin], source[end:last]
    before, after = (_join_lines(lines.decode()) for lines in (source[first:last], head + text.encode() + tail))
    changed = source[:begin] + text.encode() + source[end:]
    return Mutant(module, source.count(b"\n", 0, begin) + 1, before, after, changed)


def _join_lines(lines: str) -> str:
    """Return lines as one, without their comments."""
    return " ".join(re.sub(r"(  # .*)?\n", " ", lines + "\n").split()) or "left out"


class Editor:
    """Finds the edits of a source."""

    def __init__(self, source: bytes) -> None:
        self._source = source
        self._lines = [0, *(found.end() for found in re.finditer(b"\n", source))]

    def find_edits(self) -> Iterator[Edit]:
        """Return all edits."""
        for node, function in _walk(ast.parse(self._source), None):
            yield from self._edit_expression(node)
            yield from self._edit_statement(node, function)

    def _edit_expression(self, node: ast.AST) -> Iterator[Edit]:
        match node:
            case ast.Compare(left=first, ops=operators, comparators=others):
                for left, operator, right in zip([first, *others], operators, others, strict=False):
                    old, texts = COMPARISONS[type(operator)]
                    yield from (self._edit_between(left, right, old, new) for new in texts)
                    if isinstance(operator, ast.In | ast.NotIn) and isinstance(right, ast.Tuple):
                        yield from ((*self._span(one), "...") for one in right.elts)  # equal to nothing
            case ast.BinOp(left=left, op=kind, right=right) if type(kind) in ARITHMETIC:
                yield self._edit_between(left, right, *ARITHMETIC[type(kind)])
            case ast.BoolOp(op=kind, values=values):
                old, new = ("and", "or") if isinstance(kind, ast.And) else ("or", "and")
                yield from (self._edit_between(*pair, old, new) for pair in pairwise(values))
                yield from self._negate(values)
            case ast.UnaryOp(op=ast.Not() | ast.USub() as kind):
                begin, _ = self._span(node)
                yield begin, begin + len("not" if isinstance(kind, ast.Not) else "-"), ""
            case ast.IfExp(test=test) | ast.If(test=test) | ast.While(test=test):
                yield from self._negate([test])
            case ast.comprehension(ifs=tests):
                yield from self._negate(tests)
            case ast.Constant(value=bool(value)):
                yield *self._span(node), str(not value)
            case ast.Constant(value=int(value) | float(value)):
                larger = 2.0 * value if value and isinstance(value, float) else value + 1
                yield from ((*self._span(node), repr(other)) for other in {larger, 0 * value} - {value})
            case ast.Call(func=ast.Name(id=name)) if name in CALLS:
                yield *self._span(node.func), CALLS[name]
            case ast.Dict(keys=keys, values=values):
                yield from (self._leave_out(key, value) for key, value in zip(keys, values, strict=True) if key)
            case ast.Set(elts=elements):
                yield from (self._leave_out(one, one) for one in elements)

    def _edit_statement(self, node: ast.AST, function: ast.FunctionDef | None) -> Iterator[Edit]:
        match node:
            case ast.AugAssign(target=target, op=kind, value=value) if type(kind) in ARITHMETIC:
                old, new = ARITHMETIC[type(kind)]
                yield self._edit_between(target, value, f"{old}=", f"{new}=")
                yield *self._span(node), "pass"
            case ast.Assign(targets=targets) if function is not None and _are_bound_otherwise(targets, function):
                yield *self._span(node), "pass"
            case ast.Expr(value=value) if not _is_text(value):
                yield *self._span(node), "pass"
            case ast.Raise() | ast.Continue() | ast.Break() | ast.Delete():
                yield *self._span(node), "pass"
            case ast.Return(value=ast.expr()) if function is not None and function.returns is not None:
                if ast.unparse(function.returns).endswith("| None") and ast.unparse(node) != "return None":
                    yield *self._span(node), "return None"

    def _negate(self, conditions: Sequence[ast.expr]) -> Iterator[Edit]:
        """Negate the conditions that no other edit negates."""
        for one in conditions:
            if not isinstance(one, ast.Compare | ast.BoolOp | ast.UnaryOp | ast.Constant):
                begin, end = self._span(one)
                yield begin, end, f"(not {self._source[begin:end].decode()})"

    def _edit_between(self, left: ast.expr, right: ast.expr, old: str, new: str) -> Edit:
        """Replace the operator between two operands."""
        begin = self._source.index(old.encode(), self._span(left)[1], self._span(right)[0])
        return begin, begin + len(old), new

    def _leave_out(self, first: ast.expr, last: ast.expr) -> Edit:
        """Leave out an entry and the comma after it."""
        begin, end = self._span(first)[0], self._span(last)[1]
        comma = re.compile(rb"\s*,").match(self._source, end)
        return begin, comma.end() if comma else end, ""

    def _span(self, node: ast.AST) -> tuple[int, int]:
        assert isinstance(node, ast.expr | ast.stmt) and node.end_lineno is not None and node.end_col_offset is not None
        begin, end = self._lines[node.lineno - 1], self._lines[node.end_lineno - 1]
        return begin + node.col_offset, end + node.end_col_offset


def _walk(node: ast.AST, function: ast.FunctionDef | None) -> Iterator[tuple[ast.AST, ast.FunctionDef | None]]:
    """Return all nodes that behaviour depends on, each with its function."""
    parts: list[ast.AST | None] = []
    match node:
        case ast.expr() if _is_text(node):
            return
        case ast.If(test=ast.Name(id="TYPE_CHECKING")) | ast.Assign(targets=[ast.Name(id="__all__")]):
            return
        case ast.FunctionDef(args=arguments):
            function = node
            parts = [*arguments.defaults, *arguments.kw_defaults, *node.body]
        case ast.ClassDef():
            parts = [*node.body]
        case ast.AnnAssign():
            parts = [node.value]
        case ast.Assign(value=ast.Subscript(value=ast.Name(id="tuple" | "dict"))):
            return  # a name for a type
        case _:
            parts = [*ast.iter_child_nodes(node)]
    yield node, function
    for part in parts:
        if part is not None and not (isinstance(part, ast.keyword) and part.arg in DECLARATIONS):
            yield from _walk(part, function)


def _are_bound_otherwise(targets: Sequence[ast.expr], function: ast.FunctionDef) -> bool:
    """Whether names have a value without this assignment: else every run fails, which shows nothing."""
    nodes = list(ast.walk(function))
    bound = [one.id for one in nodes if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
    bound += [one.arg for one in nodes if isinstance(one, ast.arg)]
    names = (one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name))
    return all(bound.count(name) != 1 for name in names)


def _is_text(node: ast.AST) -> bool:
    """Whether a value is a text for people: also a choice between texts, and a table of them."""
    match node:
        case ast.IfExp(body=one, orelse=other):
            return _is_text(one) and _is_text(other)
        case ast.Dict(values=[_, *_] as values):
            return all(map(_is_text, values))
        case _:
            return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
