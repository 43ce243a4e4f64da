# SPDX-License-Identifier: Apache-2.0
"""Expressions ``${…}`` and ``$(eval …)`` of a xacro file, evaluated without Python's `eval`.

xacro runs these expressions as Python, so that a robot description is a program of its author.
Here an expression is parsed and its syntax tree is walked: numbers, strings, names, arithmetic,
comparisons, lists and dictionaries, items of loaded YAML, and calls of the functions listed here.
There is no other attribute, no lambda, no comprehension, no formatted string. No value grows
beyond `LONGEST` characters or items, or `MOST_BITS` bits.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

LONGEST = 100_000
"""Most characters of an expression or text, and items of a list: far above any description."""
MOST_BITS = 4096
"""Most bits of an integer, below Python's limit of conversion to text."""
_PLAIN = (bool, int, float, str, type(None))


class ExpressionError(Exception):
    """An expression that is not supported; the text says why."""


class Function:
    """A function that an expression may call."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call


class Namespace(dict[str, Any]):
    """Values by name, used with a dot, such as ``math.pi``."""


def evaluate(expression: str, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression; raise ExpressionError if it is not supported.

    ``names``: properties by name, and those of `global_names`.
    """
    if len(expression) > LONGEST:
        raise ExpressionError(f'an expression of {len(expression)} characters')
    try:
        tree = ast.parse(expression.strip(), mode='eval')
        value = _Evaluation(names).of(tree.body)
    except SyntaxError as error:
        raise ExpressionError(f'no expression ({error.msg})') from None
    except (RecursionError, MemoryError):
        raise ExpressionError('an expression too deep or too large') from None
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ExpressionError(f'{type(error).__name__}: {error}') from None
    if isinstance(value, Function | Namespace):
        raise ExpressionError('a function is no value; call it')
    # Lists that contain one another repeatedly are small in memory and huge as text.
    _count(value, LONGEST)
    return value


def global_names(**functions: Any) -> dict[str, Any]:
    """Return name -> value of what every expression may use: functions, modules and constants.

    These are the permitted functions of Python and of math, with and without the prefix
    ``python.`` or ``math.``, and ``functions`` with the prefix ``xacro.``; of the latter
    load_yaml, abs_filename and dotify also without it. ``functions``: replacements for xacro's
    own ones.
    """
    xacro = Namespace({name: Function(call) for name, call in functions.items()})
    return {
        **_PYTHON,
        **_MATH,
        'math': _MATH,
        'python': _PYTHON,
        'xacro': xacro,
        **{name: xacro[name] for name in ('load_yaml', 'abs_filename', 'dotify') if name in xacro},
        **_CONSTANTS,
    }


class _Evaluation:
    """Evaluation of one syntax tree; ExpressionError for anything unsupported or too large."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self._names = names

    def of(self, node: ast.expr) -> Any:
        """Value of an expression's node; ExpressionError if its kind is not supported."""
        visit = getattr(self, f'_of_{type(node).__name__}', None)
        if visit is None:
            raise ExpressionError(_REFUSED.get(type(node), f'{type(node).__name__} is not taken'))
        return visit(node)

    def _data(self, node: ast.expr) -> Any:
        """Return the value of a node; raise ExpressionError if it is a function or a namespace."""
        value = self.of(node)
        if isinstance(value, Function | Namespace):
            raise ExpressionError(f'{ast.unparse(node)} is a function and no value')
        return value

    def _of_Constant(self, node: ast.Constant) -> Any:
        """Number, text or other plain constant; ExpressionError for another one."""
        if type(node.value) not in _PLAIN:
            raise ExpressionError(f'{ast.unparse(node)} is neither a number nor a text')
        return _bounded(node.value)

    def _of_Name(self, node: ast.Name) -> Any:
        """Value of a name; ExpressionError if it is not defined or begins with two underscores."""
        if node.id.startswith('__'):
            raise ExpressionError(f'the name {node.id}')
        try:
            return self._names[node.id]
        except KeyError:
            raise ExpressionError(f"name '{node.id}' is not defined") from None

    def _of_Attribute(self, node: ast.Attribute) -> Any:
        """Item of a mapping, written as an attribute; ExpressionError for any other attribute."""
        holder = self.of(node.value)
        # Loaded YAML, and properties of an included file: items, never attributes of the object.
        if node.attr.startswith('_') or not isinstance(holder, Mapping):
            raise ExpressionError(f'the attribute .{node.attr} of {ast.unparse(node.value)}')
        try:
            return holder[node.attr]
        except (KeyError, AttributeError):
            raise ExpressionError(f'{ast.unparse(node.value)} has no {node.attr}') from None

    def _of_Subscript(self, node: ast.Subscript) -> Any:
        """Item or slice of a text, list, tuple or dictionary; ExpressionError for other values."""
        holder = self._data(node.value)
        if not isinstance(holder, str | list | tuple | dict):
            raise ExpressionError(f'{ast.unparse(node.value)} has no items')
        if isinstance(node.slice, ast.Slice):
            parts = (node.slice.lower, node.slice.upper, node.slice.step)
            return holder[slice(*(None if part is None else self._data(part) for part in parts))]
        return _item(holder, self._data(node.slice))

    def _of_UnaryOp(self, node: ast.UnaryOp) -> Any:
        """Value of `not` before any value, or of `+` or `-` before a number.

        Raises ExpressionError for `~`, or a sign before another value.
        """
        value = self._data(node.operand)
        if isinstance(node.op, ast.Not):
            return not value
        if isinstance(node.op, ast.Invert) or not isinstance(value, int | float):
            raise ExpressionError(f'a sign before {ast.unparse(node.operand)}')
        return -value if isinstance(node.op, ast.USub) else +value

    def _of_BinOp(self, node: ast.BinOp) -> Any:
        """Result of an arithmetic operator; ExpressionError for another or a huge result."""
        operate = _ARITHMETIC.get(type(node.op))
        if operate is None:
            raise ExpressionError(f'the operator in {ast.unparse(node)}')
        return _bounded(operate(self._data(node.left), self._data(node.right)))

    def _of_BoolOp(self, node: ast.BoolOp) -> Any:
        """Value of the part that decides an `and` or an `or`, as in Python.

        Later parts are not evaluated.
        """
        ends = isinstance(node.op, ast.Or)
        value: Any = None
        for part in node.values:
            value = self._data(part)
            if bool(value) is ends:
                return value
        return value

    def _of_Compare(self, node: ast.Compare) -> Any:
        """Whether a chain of comparisons is true; it is evaluated up to the first false one."""
        left = self._data(node.left)
        for op, part in zip(node.ops, node.comparators, strict=True):
            right = self._data(part)
            if not _COMPARISONS[type(op)](left, right):
                return False
            left = right
        return True

    def _of_IfExp(self, node: ast.IfExp) -> Any:
        """Value of ``a if test else b``; only the chosen part is evaluated."""
        return self._data(node.body if self._data(node.test) else node.orelse)

    def _of_List(self, node: ast.List) -> Any:
        """List of evaluated parts."""
        return [self._data(part) for part in node.elts]

    def _of_Tuple(self, node: ast.Tuple) -> Any:
        """Tuple of evaluated parts."""
        return tuple(self._data(part) for part in node.elts)

    def _of_Dict(self, node: ast.Dict) -> Any:
        """Dictionary of evaluated keys and values; ExpressionError for `**`."""
        if None in node.keys:
            raise ExpressionError('** in a dictionary')
        return {
            self._data(key): self._data(value)
            for key, value in zip(node.keys, node.values, strict=True)
            if key is not None
        }

    def _of_Call(self, node: ast.Call) -> Any:
        """Result of a call of a given function, or of a permitted method of a text.

        Raises ExpressionError for another callable, `*` or `**`, or a huge result.
        """
        if any(isinstance(part, ast.Starred) for part in node.args):
            raise ExpressionError('* in a call')
        named = {
            part.arg: self._data(part.value) for part in node.keywords if part.arg is not None
        }
        if len(named) < len(node.keywords):
            raise ExpressionError('** in a call')
        given = [self._data(part) for part in node.args]
        if isinstance(node.func, ast.Attribute):
            holder = self.of(node.func.value)
            if isinstance(holder, str):
                method = _OF_TEXTS.get(node.func.attr)
                if method is None:
                    raise ExpressionError(f'.{node.func.attr}() of a text')
                return _bounded(method(holder, *given, **named))
        called = self.of(node.func)
        if not isinstance(called, Function):
            raise ExpressionError(f'{ast.unparse(node.func)} is no function')
        return _bounded(called.call(*given, **named))


def _item(holder: Any, key: Any) -> Any:
    """Return an item of a list, tuple, dictionary or text.

    Raises ExpressionError if a dictionary lacks the key, IndexError for an index out of range,
    TypeError for a key of a wrong type or a holder that has no items.
    """
    if isinstance(holder, dict) and key not in holder:
        raise ExpressionError(f'there is no item {key!r}')
    return holder[key]


def _bounded(value: Any) -> Any:
    """Return a value unchanged; raise ExpressionError if it is too large or a complex number.

    Too large: an integer above 4096 bits (`MOST_BITS`), or over 100,000 characters or items.
    """
    if isinstance(value, complex):
        raise ExpressionError('no real number')
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        raise ExpressionError('a number that is too large')
    if isinstance(value, str | list | tuple | dict) and len(value) > LONGEST:
        raise ExpressionError('a text or list that is too long')
    return value


def _count(value: Any, budget: int) -> int:
    """Return ``budget`` less the number of items in a value, nested ones included.

    A number or text has none. Raises ExpressionError if the budget falls below 0.
    """
    if budget < 0:
        raise ExpressionError('a text or list that is too long')
    if isinstance(value, dict):
        for item in dict.values(value):
            budget = _count(item, budget - 1)
    elif isinstance(value, list | tuple):
        for item in list.__iter__(value) if isinstance(value, list) else value:
            budget = _count(item, budget - 1)
    return budget


def _length(value: Any) -> int:
    """Return the size of a value: bits of an integer, or length of a text, list or tuple.

    0 for other values, dictionaries among them.
    """
    if isinstance(value, int):
        return value.bit_length()
    return len(value) if isinstance(value, str | list | tuple) else 0


def _times(left: Any, right: Any) -> Any:
    """Product of two numbers, or a text, list or tuple repeated by a whole number, on either side.

    Raises ExpressionError if the repeated text or list would be longer than `LONGEST`, or if
    the values are neither.
    """
    for text, count in ((left, right), (right, left)):
        if isinstance(text, str | list | tuple) and isinstance(count, int):
            if len(text) * count > LONGEST:
                raise ExpressionError('a text or list that is too long')
            return text * count
    return _number(left) * _number(right)


def _power(left: Any, right: Any) -> Any:
    """Return left ** right; ExpressionError for no numbers, or over `MOST_BITS` bits."""
    base, exponent = _number(left), _number(right)
    are_integers = isinstance(base, int) and isinstance(exponent, int)
    if are_integers and _length(base) * abs(exponent) > MOST_BITS:
        raise ExpressionError('a number that is too large')
    return base**exponent


def _plus(left: Any, right: Any) -> Any:
    """Sum of two numbers, or two texts, two lists or two tuples joined.

    Raises TypeError for a text, list or tuple with another of these types, ExpressionError for
    any other values.
    """
    if isinstance(left, str | list | tuple) and isinstance(right, str | list | tuple):
        return operator.add(left, right)
    return _number(left) + _number(right)


def _number(value: Any) -> Any:
    """Return a number (int, float or bool); raise ExpressionError for another value."""
    # Also of %, which formats a text.
    if not isinstance(value, int | float):
        raise ExpressionError(f'{value!r:.40} is no number')
    return value


def _of_numbers(operate: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return an operator that raises ExpressionError unless both values are numbers."""
    return lambda left, right: operate(_number(left), _number(right))


def _replace(text: str, old: str, new: str) -> str:
    """Return text with every ``old`` replaced; raise ExpressionError if it would be too long.

    Too long: the replacements together over 100,000 characters (`LONGEST`).
    """
    if text.count(old) * len(new) > LONGEST:
        raise ExpressionError('a text that is too long')
    return text.replace(old, new)


def _round(value: Any, ndigits: int = 0) -> Any:
    # That of a whole number works out 10 to the power of the digits.
    """Return a number rounded to `ndigits` decimals, as Python's round; a whole number for 0.

    `ndigits` beyond ±400 counts as ±400. Raises ExpressionError or TypeError if `value` is no
    number.
    """
    return round(_number(value), max(-400, min(ndigits, 400))) if ndigits else round(value)


def _range(*given: Any) -> list[int]:
    """Return a range as a list; raise ExpressionError if it would be too long."""
    if len(values := range(*given)) > LONGEST:
        raise ExpressionError('a list that is too long')
    return list(values)


_ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: _plus,
    ast.Sub: _of_numbers(operator.sub),
    ast.Mult: _times,
    ast.Div: _of_numbers(operator.truediv),
    ast.FloorDiv: _of_numbers(operator.floordiv),
    ast.Mod: _of_numbers(operator.mod),
    ast.Pow: _power,
}
_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda left, right: left in right,
    ast.NotIn: lambda left, right: left not in right,
}
_REFUSED: dict[type[ast.expr], str] = {
    ast.Lambda: 'a lambda',
    ast.JoinedStr: 'a formatted string',
    ast.ListComp: 'a comprehension',
    ast.SetComp: 'a comprehension',
    ast.DictComp: 'a comprehension',
    ast.GeneratorExp: 'a comprehension',
    ast.NamedExpr: 'an assignment',
}
_OF_TEXTS: dict[str, Callable[..., Any]] = {
    'split': str.split,
    'startswith': str.startswith,
    'endswith': str.endswith,
    'strip': str.strip,
    'lower': str.lower,
    'upper': str.upper,
    'replace': _replace,
}
_CONSTANTS = {'True': True, 'False': False, 'true': True, 'false': False, 'None': None}
_MATH = Namespace(
    {name: getattr(math, name) for name in ('pi', 'e', 'tau', 'inf', 'nan')}
    | {
        name: Function(getattr(math, name))
        for name in (
            *('sin', 'cos', 'tan', 'asin', 'acos', 'atan', 'atan2', 'radians', 'degrees'),
            *('sinh', 'cosh', 'tanh', 'asinh', 'acosh', 'atanh', 'hypot', 'sqrt', 'pow', 'exp'),
            *('log', 'log10', 'log2', 'ceil', 'floor', 'trunc', 'fabs', 'fmod', 'copysign'),
            *('isclose', 'isfinite', 'isinf', 'isnan'),
        )
    }
)
_CALLS: dict[str, Callable[..., Any]] = {
    **{'list': list, 'tuple': tuple, 'dict': dict, 'len': len, 'str': str, 'float': float},
    **{'int': int, 'bool': bool, 'min': min, 'max': max, 'round': _round, 'abs': abs, 'sum': sum},
    **{'any': any, 'all': all, 'sorted': sorted, 'range': _range},
}
_PYTHON = Namespace({name: Function(call) for name, call in _CALLS.items()})
