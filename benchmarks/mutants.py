"""Small changes of Python source, one at a time, that tests should notice.

The operators are those of mutmut and a few more (values that are returned, decorated functions,
class attributes), on the syntax tree: comparisons, logic, arithmetic, numbers, texts, arguments,
assigned and returned values, conditions, statements left out. Annotations and documentation are
left alone, and so are texts that only describe a parameter.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARED = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_COMPUTED = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
}
_NONE = ast.Constant(None)


@dataclass(frozen=True)
class Mutant:
    """A changed source.

    Attributes
    ----------
    name
        Where (function) and what: the text before and after; unique in its file.
    line, last_line
        Lines in the original.
    source
        The whole changed text.
    """

    name: str
    line: int
    last_line: int
    source: str


def mutants_of(text: str) -> Iterator[Mutant]:
    """Yield every mutant of a module."""
    tree = ast.parse(text)
    seen: dict[str, int] = {}
    for path, scope in list(_places(tree)):
        node = _at(tree, path)
        for changed in _variants(node):
            name = f'{scope}: {_short(node)} -> {_short(changed)}'
            seen[name] = seen.get(name, 0) + 1
            if seen[name] > 1:
                name += f' ({seen[name]})'
            first = getattr(node, 'lineno', 0)
            last = getattr(node, 'end_lineno', first)
            yield Mutant(name, first, last, _replaced(tree, path, changed))


Path = tuple[tuple[str, int | None], ...]


def _places(tree: ast.Module) -> Iterator[tuple[Path, str]]:
    """Yield the path to each node that may be changed, and the function that it is in."""

    def visit(node: ast.AST, path: Path, scope: str) -> Iterator[tuple[Path, str]]:
        if path:
            yield path, scope or 'module'
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            scope = f'{scope}.{node.name}' if scope else node.name
        for name, value in ast.iter_fields(node):
            if name in ('annotation', 'returns', 'decorator_list', 'type_params', 'bases', 'ctx'):
                continue
            if isinstance(value, list):
                for i, item in enumerate(value):
                    if isinstance(item, ast.AST) and not _left_alone(node, name, i, item):
                        yield from visit(item, (*path, (name, i)), scope)
            elif isinstance(value, ast.AST):
                yield from visit(value, (*path, (name, None)), scope)

    yield from visit(tree, (), '')


def _left_alone(parent: ast.AST, field: str, index: int, item: ast.AST) -> bool:
    if isinstance(item, ast.Import | ast.ImportFrom):
        return True
    if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant):
        return True
    if isinstance(item, ast.Assign) and ast.unparse(item.value).startswith('Callable['):
        # The name of a type.
        return True
    if isinstance(parent, ast.Call) and isinstance(parent.func, ast.Name):
        if parent.func.id == 'parameter' and (field, index) == ('args', 1):
            return True
        if parent.func.id == 'parameter' and getattr(item, 'arg', '') == 'unit':
            return True
    return False


def _at(tree: ast.AST, path: Path) -> ast.AST:
    for name, index in path:
        value = getattr(tree, name)
        tree = value if index is None else value[index]
    return tree


def _replaced(tree: ast.Module, path: Path, changed: ast.AST) -> str:
    new = copy.deepcopy(tree)
    parent = _at(new, path[:-1])
    name, index = path[-1]
    if index is None:
        setattr(parent, name, changed)
    else:
        getattr(parent, name)[index] = changed
    return ast.unparse(ast.fix_missing_locations(new))


def _short(node: ast.AST) -> str:
    text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None
    line = repr(text) if text is not None else ast.unparse(node).partition('\n')[0]
    return line if len(line) <= 110 else line[:80] + '…' + line[-29:]


def _with(node: ast.AST, **fields: object) -> ast.AST:
    new = copy.deepcopy(node)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def _variants(node: ast.AST) -> Iterator[ast.AST]:
    match node:
        case ast.Compare(ops=ops):
            for i, op in enumerate(ops):
                yield _with(node, ops=[*ops[:i], _COMPARED[type(op)](), *ops[i + 1 :]])
        case ast.BoolOp(op=op):
            yield _with(node, op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield copy.deepcopy(operand)
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in _COMPUTED:
            yield _with(node, op=_COMPUTED[type(op)]())
        case ast.Constant(value=value):
            yield from _other_constants(value)
        case ast.Call(args=args, keywords=keywords):
            for i, argument in enumerate(args):
                if not (isinstance(argument, ast.Constant) and argument.value is None):
                    yield _with(node, args=[*args[:i], _NONE, *args[i + 1 :]])
            for i in range(len(keywords)):
                yield _with(node, keywords=[*keywords[:i], *keywords[i + 1 :]])
        case ast.Assign(value=value) | ast.AnnAssign(value=value):
            if value is not None and not isinstance(value, ast.Constant):
                yield _with(node, value=_NONE)
        case ast.Return(value=value):
            if value is not None and not isinstance(value, ast.Constant):
                yield _with(node, value=_NONE)
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            yield _with(node, test=ast.UnaryOp(ast.Not(), copy.deepcopy(test)))
        case ast.Expr() | ast.Raise():
            yield ast.Pass()
        case ast.Lambda(body=body):
            if not (isinstance(body, ast.Constant) and body.value is None):
                yield _with(node, body=_NONE)
        case ast.Continue():
            yield ast.Break()
        case ast.Break():
            yield ast.Continue()
        case ast.comprehension(ifs=[_, *_]):
            yield _with(node, ifs=[])


def _other_constants(value: object) -> Iterator[ast.AST]:
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int | float):
        yield ast.Constant(value + 1)
    elif isinstance(value, str):
        yield ast.Constant(f'XX{value}XX')
    elif value is None:
        yield ast.Constant('')
