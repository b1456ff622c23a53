"""The changes of Python source that `mutation.py` makes, one at a time: operators, constants, statements, arguments."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator
from typing import Any

COMPARISONS: dict[type[ast.cmpop], dict[str, type[ast.cmpop]]] = {
    ast.Lt: {"boundary": ast.LtE, "comparison": ast.GtE},
    ast.LtE: {"boundary": ast.Lt, "comparison": ast.Gt},
    ast.Gt: {"boundary": ast.GtE, "comparison": ast.LtE},
    ast.GtE: {"boundary": ast.Gt, "comparison": ast.Lt},
    ast.Eq: {"comparison": ast.NotEq}, ast.NotEq: {"comparison": ast.Eq},
    ast.In: {"comparison": ast.NotIn}, ast.NotIn: {"comparison": ast.In},
    ast.Is: {"comparison": ast.IsNot}, ast.IsNot: {"comparison": ast.Is},
}  # fmt: skip
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.FloorDiv, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv, ast.Pow: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd, ast.MatMult: ast.Add,
}  # fmt: skip
FUNCTIONS = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}
Change = tuple[ast.AST, str, ast.AST, int, bool]
WORD = re.compile(r"[A-Za-z_][\w.-]+")


def changed(node: ast.AST, **fields: Any) -> ast.AST:
    new = copy.copy(node)
    for field, value in fields.items():
        setattr(new, field, value)
    return new


def options(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield the kinds of change of one node, each with the node that takes its place."""
    match node:
        case ast.Compare(ops=ops):
            for i, op in enumerate(ops):
                for kind, other in COMPARISONS[type(op)].items():
                    yield kind, changed(node, ops=[*ops[:i], other(), *ops[i + 1 :]])
        case ast.BinOp(op=op) | ast.AugAssign(op=op):
            yield "arithmetic", changed(node, op=ARITHMETIC[type(op)]())
        case ast.BoolOp(op=op):
            yield "boolean", changed(node, op=ast.And() if isinstance(op, ast.Or) else ast.Or())
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield "boolean" if isinstance(node.op, ast.Not) else "arithmetic", operand
        case ast.IfExp(test=test) | ast.If(test=test) | ast.While(test=test) if not isinstance(test, ast.Compare):
            yield "boolean", changed(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Constant(value=bool() as value):
            yield "constant", ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield "constant", ast.Constant(value + 1)
        case ast.Constant(value=str() as value) if WORD.fullmatch(value):
            yield "constant", ast.Constant(f"{value}_")
        case ast.Call(func=called, args=[first, second, *rest]) if ast.Starred not in (type(first), type(second)):
            if ast.dump(first) != ast.dump(second) and ast.unparse(called).split(".")[-1] not in FUNCTIONS:
                yield "swapped arguments", changed(node, args=[second, first, *rest])


def more_options(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield the changes of functions, and the removal of statements."""
    match node:
        case ast.Call(func=ast.Name(id=name)) if name in FUNCTIONS:
            yield "function", changed(node, func=ast.Name(FUNCTIONS[name], ast.Load()))
        case ast.Call(func=ast.Attribute(attr=name, value=value)) if name in FUNCTIONS:
            yield "function", changed(node, func=ast.Attribute(value, FUNCTIONS[name], ast.Load()))
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break():
            yield "removed statement", ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield "removed statement", ast.Pass()
        case ast.Return(value=ast.AST() as value) if ast.unparse(value) != "None":
            yield "removed statement", ast.Return(ast.Constant(None))


def changes(node: ast.AST, statement: int = 0, inside: bool = False) -> Iterator[Change]:
    """Yield all changes below a node: (node, kind, its replacement, line of its statement, whether in a function).

    Annotations, decorators, docstrings, the texts of errors and ``strict`` of zip, an assertion, stay as they are.
    """
    statement = node.lineno if isinstance(node, ast.stmt) else statement
    for kind, new in (*options(node), *more_options(node)):
        yield node, kind, new, statement, inside
    if isinstance(node, ast.Raise) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "format_spec"):
            continue
        within = inside or (isinstance(node, ast.FunctionDef | ast.Lambda) and field == "body")
        for child in value if isinstance(value, list) else [value]:
            text = isinstance(child, ast.Constant) and isinstance(child.value, str)
            if isinstance(child, ast.AST) and not (text and isinstance(node, ast.Expr | ast.JoinedStr)):
                yield from changes(child, statement, within)


class Swap(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> Any:
        return self.new if node is self.old else self.generic_visit(node)


def changed_tree(source: str, number: int) -> ast.Module:
    """Return the tree of the source with one of its `changes`, by its place among them."""
    tree = ast.parse(source)
    old, _, new, *_ = list(changes(tree))[number]
    Swap(old, ast.copy_location(new, old)).visit(tree)
    return ast.fix_missing_locations(tree)
