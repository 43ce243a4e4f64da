# SPDX-License-Identifier: Apache-2.0
"""Expand one xacro file, in a process of its own, which `robot_description` starts and bounds.

xacro's places where a file does something are replaced: expressions, substitutions ``$(…)``, which
files are read, and XML that declares entities. With trust only the way to find packages is, as
outside of ROS there is no ament_index_python.
"""

from __future__ import annotations

import ast
import contextlib
import glob
import json
import math
import operator
import os
import re
import resource
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.dom import minidom

import xacro
import yaml
from xacro import substitution_args

from remaster_ros.errors import InputError
from remaster_ros.session.files import URDF_LIMIT, decode_text, read_limited
from remaster_ros.session.packages import Confinement, find_package

# What stands in ``${…}`` and ``$(eval …)`` of a xacro file, worked out without Python's `eval`.
#
# xacro runs these expressions as Python, so that a robot description is a program of its author.
# Here an expression is parsed and its syntax tree walked: numbers, strings, names, arithmetic,
# comparisons, lists and dictionaries, items of loaded YAML, and calls of the functions listed
# here. There is no other attribute, no lambda, no comprehension, no formatted string. No value
# grows beyond `LONGEST` characters or items, or `MOST_BITS` bits.


LONGEST = 100_000
"""Characters of an expression or of a text, items of a list: far above what descriptions have."""
MOST_BITS = 4096
"""Of a whole number; below what Python refuses to write out."""
_PLAIN = (bool, int, float, str, type(None))


class ExpressionError(Exception):
    """An expression that is none of a robot description; the text is why."""


class Function:
    """A function that an expression may call."""

    def __init__(self, call: Callable[..., Any]) -> None:
        self.call = call


class Namespace(dict[str, Any]):
    """Names behind a point, such as ``math.pi``."""


def evaluate(expression: str, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression; an `ExpressionError` says why it has none here.

    `names` are properties by their names, and what `global_names` returns.
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
    # A list that holds another one twice, and so on, is small in memory and endless when written.
    _count(value, LONGEST)
    return value


def global_names(**own: Any) -> dict[str, Any]:
    """Return the names that every expression has: xacro's, with `own` in its namespace ``xacro``.

    What takes the place of a function with side effects is for the caller to give.
    """
    xacro = Namespace({name: Function(call) for name, call in own.items()})
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
    """The walk through one syntax tree."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self._names = names

    def of(self, node: ast.expr) -> Any:
        visit = getattr(self, f'_of_{type(node).__name__}', None)
        if visit is None:
            raise ExpressionError(_REFUSED.get(type(node), f'{type(node).__name__} is not taken'))
        return visit(node)

    def _data(self, node: ast.expr) -> Any:
        """Return a value that is no function."""
        value = self.of(node)
        if isinstance(value, Function | Namespace):
            raise ExpressionError(f'{ast.unparse(node)} is a function and no value')
        return value

    def _of_Constant(self, node: ast.Constant) -> Any:
        if type(node.value) not in _PLAIN:
            raise ExpressionError(f'{ast.unparse(node)} is neither a number nor a text')
        return _bounded(node.value)

    def _of_Name(self, node: ast.Name) -> Any:
        if node.id.startswith('__'):
            raise ExpressionError(f'the name {node.id}')
        try:
            return self._names[node.id]
        except KeyError:
            raise ExpressionError(f"name '{node.id}' is not defined") from None

    def _of_Attribute(self, node: ast.Attribute) -> Any:
        holder = self.of(node.value)
        # Loaded YAML, and properties of an included file: items, never what the object has itself.
        if node.attr.startswith('_') or not isinstance(holder, Mapping):
            raise ExpressionError(f'the attribute .{node.attr} of {ast.unparse(node.value)}')
        try:
            return holder[node.attr]
        except (KeyError, AttributeError):
            raise ExpressionError(f'{ast.unparse(node.value)} has no {node.attr}') from None

    def _of_Subscript(self, node: ast.Subscript) -> Any:
        holder = self._data(node.value)
        if not isinstance(holder, str | list | tuple | dict):
            raise ExpressionError(f'{ast.unparse(node.value)} has no items')
        if isinstance(node.slice, ast.Slice):
            parts = (node.slice.lower, node.slice.upper, node.slice.step)
            return holder[slice(*(None if part is None else self._data(part) for part in parts))]
        return _item(holder, self._data(node.slice))

    def _of_UnaryOp(self, node: ast.UnaryOp) -> Any:
        value = self._data(node.operand)
        if isinstance(node.op, ast.Not):
            return not value
        if isinstance(node.op, ast.Invert) or not isinstance(value, int | float):
            raise ExpressionError(f'a sign before {ast.unparse(node.operand)}')
        return -value if isinstance(node.op, ast.USub) else +value

    def _of_BinOp(self, node: ast.BinOp) -> Any:
        operate = _ARITHMETIC.get(type(node.op))
        if operate is None:
            raise ExpressionError(f'the operator in {ast.unparse(node)}')
        return _bounded(operate(self._data(node.left), self._data(node.right)))

    def _of_BoolOp(self, node: ast.BoolOp) -> Any:
        ends = isinstance(node.op, ast.Or)
        value: Any = None
        for part in node.values:
            value = self._data(part)
            if bool(value) is ends:
                return value
        return value

    def _of_Compare(self, node: ast.Compare) -> Any:
        left = self._data(node.left)
        for op, part in zip(node.ops, node.comparators, strict=True):
            right = self._data(part)
            if not _COMPARISONS[type(op)](left, right):
                return False
            left = right
        return True

    def _of_IfExp(self, node: ast.IfExp) -> Any:
        return self._data(node.body if self._data(node.test) else node.orelse)

    def _of_List(self, node: ast.List) -> Any:
        return [self._data(part) for part in node.elts]

    def _of_Tuple(self, node: ast.Tuple) -> Any:
        return tuple(self._data(part) for part in node.elts)

    def _of_Dict(self, node: ast.Dict) -> Any:
        if None in node.keys:
            raise ExpressionError('** in a dictionary')
        return {
            self._data(key): self._data(value)
            for key, value in zip(node.keys, node.values, strict=True)
            if key is not None
        }

    def _of_Call(self, node: ast.Call) -> Any:
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
    if isinstance(holder, dict) and key not in holder:
        raise ExpressionError(f'there is no item {key!r}')
    return holder[key]


def _bounded(value: Any) -> Any:
    """Return a value that is not too large."""
    if isinstance(value, complex):
        raise ExpressionError('no real number')
    if isinstance(value, int) and value.bit_length() > MOST_BITS:
        raise ExpressionError('a number that is too large')
    if isinstance(value, str | list | tuple | dict) and len(value) > LONGEST:
        raise ExpressionError('a text or list that is too long')
    return value


def _count(value: Any, left: int) -> int:
    """Return how many more items than those of a value there may be."""
    if left < 0:
        raise ExpressionError('a text or list that is too long')
    if isinstance(value, dict):
        for item in dict.values(value):
            left = _count(item, left - 1)
    elif isinstance(value, list | tuple):
        for item in list.__iter__(value) if isinstance(value, list) else value:
            left = _count(item, left - 1)
    return left


def _length(value: Any) -> int:
    """Return how much of a number or text there is: bits, or characters and items."""
    if isinstance(value, int):
        return value.bit_length()
    return len(value) if isinstance(value, str | list | tuple) else 0


def _times(left: Any, right: Any) -> Any:
    for text, count in ((left, right), (right, left)):
        if isinstance(text, str | list | tuple) and isinstance(count, int):
            if len(text) * count > LONGEST:
                raise ExpressionError('a text or list that is too long')
            return text * count
    return _number(left) * _number(right)


def _power(left: Any, right: Any) -> Any:
    base, exponent = _number(left), _number(right)
    whole = isinstance(base, int) and isinstance(exponent, int)
    if whole and _length(base) * abs(exponent) > MOST_BITS:
        raise ExpressionError('a number that is too large')
    return base**exponent


def _plus(left: Any, right: Any) -> Any:
    if isinstance(left, str | list | tuple) and isinstance(right, str | list | tuple):
        return operator.add(left, right)
    return _number(left) + _number(right)


def _number(value: Any) -> Any:
    # Also of %, which formats a text.
    if not isinstance(value, int | float):
        raise ExpressionError(f'{value!r:.40} is no number')
    return value


def _of_numbers(operate: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda left, right: operate(_number(left), _number(right))


def _replace(text: str, old: str, new: str) -> str:
    if text.count(old) * len(new) > LONGEST:
        raise ExpressionError('a text that is too long')
    return text.replace(old, new)


def _round(value: Any, ndigits: int = 0) -> Any:
    # That of a whole number works out 10 to the power of the digits.
    return round(_number(value), max(-400, min(ndigits, 400))) if ndigits else round(value)


def _range(*given: Any) -> list[int]:
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


MEMORY = 1024**3
"""What an expansion may take, bytes: descriptions of makers take a tenth of it."""
_TRUST = 'add --trust if you trust this file and its packages like a program that you run'
_UNDEFINED = re.compile(r'Undefined substitution argument (\w+)')
# xacro's own tokens. Its lexer copies what is left of a text with each of them.
_TOKENS = re.compile(
    r'(?P<escaped>\$\$+[{(])|\$\{(?P<expression>[^}]*)\}|\$\((?P<substitution>[^)]*)\)'
    r'|(?P<text>[^$]+|\$[^{($]+|\$$)'
)


class Expansion:
    """The expansion of one file, which may do what a program may if it is trusted.

    ROS packages are looked for in the folders of `package_path`, and around the file. The files
    `named` by the user may be read as well.
    """

    def __init__(
        self, path: Path, package_path: list[Path], named: list[Path], *, trusted: bool
    ) -> None:
        self._path, self._package_path = path, package_path
        self._files = Confinement(path, package_path, named)
        if trusted:
            substitution_args._eval_find = self._find
            substitution_args._eval_dict['find'] = self._find
            return
        self._written = 0
        xacro._global_symbols = global_names(
            load_yaml=self._load_yaml,
            abs_filename=self._file,
            dotify=xacro.YamlDictWrapper,
            arg=self._argument,
            tokenize=_tokens,
            fatal=_fatal,
            **dict.fromkeys(('message', 'warning', 'error', 'print_location'), _show),
        )
        xacro.eval_text = self._text
        # Units in YAML (!degrees 90) are expressions, too.
        xacro.safe_eval = self._evaluated
        xacro.abs_filename_spec = self._file
        xacro.get_include_files = self._included
        xacro.parse = self._parsed

    def text(self, arguments: dict[str, str]) -> str:
        """Return the file as URDF text."""
        document = xacro.process_file(str(self._path), mappings=arguments)
        text: str = document.documentElement.toprettyxml(indent='  ')
        return text

    # What stands in texts and attributes

    def _text(self, text: str, symbols: Any) -> Any:
        """Return a text with its expressions and substitutions worked out, as xacro.eval_text."""
        parts, at = [], 0
        for token in _TOKENS.finditer(text):
            if token.start() != at:
                break
            at = token.end()
            kind = token.lastgroup
            if kind == 'expression':
                expression = str(self._text(token['expression'], symbols))
                parts.append(self._evaluated(expression, symbols))
            elif kind == 'substitution':
                parts.append(self._substituted(str(self._text(token['substitution'], symbols))))
            else:
                parts.append(token[0][1:] if kind == 'escaped' else token[0])
        if at < len(text):
            raise InputError(f'{_here()}: {text[at:][:80]!r} is no expression; correct the file')
        if len(parts) == 1:
            self._count(parts[0])
            return parts[0]
        joined = []
        for part in parts:
            joined.append(str(part))
            self._count(joined[-1])
        return ''.join(joined)

    def _count(self, part: Any) -> None:
        self._written += len(part) if isinstance(part, str) else 1
        if self._written > URDF_LIMIT:
            raise InputError(f'{_here()}: it expands to more than {URDF_LIMIT} characters')

    def _evaluated(self, expression: str, symbols: Any, _: Any = None) -> Any:
        try:
            return evaluate(expression, symbols)
        except ExpressionError as error:
            raise _refused(f'${{{expression}}}', str(error)) from None

    def _substituted(self, command: str) -> str:
        name, *given = command.split() or ['']
        if name == 'find' and len(given) == 1:
            return self._find(given[0])
        if name == 'arg' and len(given) == 1:
            return str(self._argument(given[0]))
        if name == 'eval' and given:
            return str(self._eval(command.strip().removeprefix('eval')))
        if name in ('env', 'optenv'):
            raise _refused(f'$({command})', 'the environment is not read')
        raise _refused(f'$({command})', 'no substitution of a robot description')

    def _eval(self, expression: str) -> Any:
        given = xacro.substitution_args_context['arg']
        values = {name: _converted(value) for name, value in given.items()}
        functions = {
            'arg': Function(lambda name: _converted(self._argument(name))),
            'find': Function(self._find),
        }
        try:
            return evaluate(expression, xacro._global_symbols | functions | values)
        except ExpressionError as error:
            raise _refused(f'$(eval{expression})', str(error)) from None

    def _argument(self, name: str) -> str:
        try:
            value: str = xacro.substitution_args_context['arg'][name]
        except KeyError:
            raise xacro.XacroException(f'Undefined substitution argument {name}') from None
        return value

    # Which files are read

    def _find(self, name: str) -> str:
        folder = find_package(name, self._path, self._package_path)
        if folder is None:
            raise InputError(
                f'{self._path}: it needs the ROS package {name}, which is not around it; give the '
                'folder that holds the package with --package-path, or source its workspace'
            )
        # A folder that has the name alone may be anybody's.
        if (folder / 'package.xml').is_file():
            self._files.add(folder)
        # xacro takes a relative one from the file that it stands in.
        return str(folder.absolute())

    def _file(self, name: str) -> str:
        """Return the file that is named in the one being read, if it may be read."""
        if not isinstance(name, str):
            raise _refused(str(name), 'no file name')
        path = Path(_here()).parent / name
        if not self._files.holds(path):
            raise InputError(
                f'{_here()}: it names {name}, which lies outside of the folder of the description '
                'and of the packages that it names; give the folder that it is in with '
                f'--package-path, or {_TRUST}'
            )
        return str(path)

    def _included(self, name: str, symbols: Any) -> Any:
        name = str(self._text(name, symbols))
        if not re.search(r'[*?[]', name):
            yield self._file(name)
            return
        # Nothing outside is listed either.
        fixed = re.split(r'[*?[]', name, maxsplit=1)[0]
        self._file(f'{os.path.dirname(fixed)}/.' if '/' in fixed else '.')
        for found in sorted(glob.glob(str(Path(_here()).parent / name))):
            yield self._file(found)

    def _parsed(self, given: Any, filename: str = '') -> Any:
        path = Path(filename)
        if not path.exists():
            # What xacro raises, which knows of files that may be missing.
            xacro.filestack.pop()
            raise xacro.XacroException(f'no such file: {path}', exc=FileNotFoundError())
        text = decode_text(read_limited(path, URDF_LIMIT, 'the description includes it'), path)
        # The keyword is case-sensitive in XML, so text without it cannot declare an entity.
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise InputError(f'{path}: it declares a DOCTYPE or entities; remove the declaration')
        return minidom.parseString(text)

    def _load_yaml(self, filename: str) -> Any:
        path = Path(self._file(filename))
        text = decode_text(read_limited(path, URDF_LIMIT, 'the description loads it'), path)
        for unit in xacro.ConstructUnits:
            yaml.SafeLoader.add_constructor(unit.value.tag, unit.constructor)
        xacro.filestack.append(str(path))
        try:
            return xacro.YamlListWrapper.wrap(yaml.safe_load(text))
        except yaml.YAMLError as error:
            raise InputError(f'{path}: no YAML ({error}); correct the file') from None
        finally:
            xacro.filestack.pop()


def _here() -> str:
    """Return the file that is being read."""
    return str(xacro.filestack[-1])


def _refused(what: str, why: str) -> InputError:
    return InputError(f'{_here()}: {what:.200}: {why}; correct it, or {_TRUST}')


def _converted(value: Any) -> Any:
    return substitution_args.convert_value(value, 'auto') if isinstance(value, str) else value


def _show(*given: Any, **_: Any) -> str:
    print(*given, file=sys.stderr)
    return ''


def _fatal(*given: Any) -> None:
    raise InputError(f'{_here()}: {" ".join(map(str, given))}')


def _tokens(text: str, sep: str = ',; ', skip_empty: bool = True) -> list[str]:
    items = re.split(f'[{re.escape(sep)}]', text)
    return [item for item in items if item or not skip_empty]


def _line(path: Path, error: BaseException) -> str:
    """Return what went wrong, with the file that it is in and the remedy."""
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, InputError):
            return str(inner)
        inner = getattr(inner, 'exc', None) or inner.__cause__ or inner.__context__
    file = (xacro.filestack or [path])[-1]
    if isinstance(error, RecursionError):
        return f'{file}: xacro: nested too deeply; does a macro call itself, or a file itself?'
    if isinstance(error, MemoryError):
        return f'{file}: xacro: it needs too much memory; correct the file'
    what = ' '.join(str(error).split()) or type(error).__name__
    missing = _UNDEFINED.search(what)
    remedy = f'; give it behind the file: {missing[1]}:=VALUE' if missing else '; correct the file'
    return f'{file}: xacro: {what[:300]}{remedy}'


def serve(request: dict[str, Any]) -> None:
    """Answer a request of `robot_description` on stdout: ``text``, or ``error`` with one line."""
    path, trusted = Path(request['file']), request['trusted']
    resource.setrlimit(resource.RLIMIT_CPU, (request['cpu_s'], request['cpu_s']))
    if not trusted:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        folders = [Path(folder) for folder in request['package_path']]
        # What xacro prints is for people.
        with contextlib.redirect_stdout(sys.stderr):
            named = [Path(file) for file in request['named']]
            expansion = Expansion(path, folders, named, trusted=trusted)
            text = expansion.text(request['arguments'])
        answer = {'text': text}
    # A xacro file is a program: it raises whatever it leads to.
    except Exception as error:
        answer = {'error': _line(path, error)}
    sys.stdout.write(json.dumps(answer))
