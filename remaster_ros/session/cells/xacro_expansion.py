# SPDX-License-Identifier: Apache-2.0
"""Expansion of one xacro file, in a separate process that `robot_description` starts and limits.

The functions of xacro with side effects are replaced: expressions, substitutions ``$(…)``, access
to files, and XML that declares entities. With trust only the search for packages is replaced,
since without ROS there is no ament_index_python.
"""

from __future__ import annotations

import contextlib
import glob
import json
import os
import re
import resource
import sys
from pathlib import Path
from typing import Any
from xml.dom import minidom

import xacro
import yaml
from xacro import substitution_args

from remaster_ros.errors import InputError
from remaster_ros.session.cells.packages import Confinement, find_package
from remaster_ros.session.cells.xacro_expressions import (
    ExpressionError,
    Function,
    evaluate,
    global_names,
)
from remaster_ros.session.files import URDF_LIMIT, decode_text, read_limited

MEMORY = 1024**3
"""Most memory of an expansion, bytes: descriptions of makers take a tenth of it."""
_TRUST = 'add --trust if you trust this file and its packages like a program that you run'
_UNDEFINED = re.compile(r'Undefined substitution argument (\w+)')
# Tokens of xacro, whose lexer copies the remaining text for each of them.
_TOKENS = re.compile(
    r'(?P<escaped>\$\$+[{(])|\$\{(?P<expression>[^}]*)\}|\$\((?P<substitution>[^)]*)\)'
    r'|(?P<text>[^$]+|\$[^{($]+|\$$)'
)


class Expansion:
    """Expansion of one file: by plain xacro if it is trusted, else confined and of limited length.

    ``package_path``: folders to search for ROS packages, besides those around the file; ``named``:
    files named by the user, which may be read as well.
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
        """Return the file as URDF text; ``arguments``: of xacro, by name.

        Raises InputError for what is not supported, and any error of xacro.
        """
        document = xacro.process_file(str(self._path), mappings=arguments)
        text: str = document.documentElement.toprettyxml(indent='  ')
        return text

    def _text(self, text: str, symbols: Any) -> Any:
        """Return a text with its expressions and substitutions evaluated, as xacro.eval_text.

        Raises InputError if the expansion becomes too long.
        """
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
        """Add the length of a part (characters of a text, else 1) to that of the expansion.

        Raises InputError if the length is then above `URDF_LIMIT`.
        """
        self._written += len(part) if isinstance(part, str) else 1
        if self._written > URDF_LIMIT:
            raise InputError(f'{_here()}: it expands to more than {URDF_LIMIT} characters')

    def _evaluated(self, expression: str, symbols: Any, _: Any = None) -> Any:
        """Return the value of ``${…}``; raise InputError if it is not supported."""
        try:
            return evaluate(expression, symbols)
        except ExpressionError as error:
            raise _refused(f'${{{expression}}}', str(error)) from None

    def _substituted(self, command: str) -> str:
        """Return the value of ``$(…)``: of find, arg or eval.

        ``command``: text between the brackets. Raises InputError for others, such as env, and
        for an unknown package; XacroException for an unknown argument.
        """
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
        """Return the value of ``$(eval …)``; raise InputError if it is not supported."""
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
        """Return an argument of the file; raise XacroException if it is not given."""
        try:
            value: str = xacro.substitution_args_context['arg'][name]
        except KeyError:
            raise xacro.XacroException(f'Undefined substitution argument {name}') from None
        return value

    def _find(self, name: str) -> str:
        """Return the folder of ``$(find NAME)``; raise InputError if there is no such package."""
        folder = find_package(name, self._path, self._package_path)
        if folder is None:
            raise InputError(
                f'{self._path}: it needs the ROS package {name}, which is not around it; give the '
                'folder that holds the package with --package-path, or source its workspace'
            )
        # A folder with only the name may be any folder.
        if (folder / 'package.xml').is_file():
            self._files.add(folder)
        # xacro resolves relative names from the file that has them.
        return str(folder.absolute())

    def _file(self, name: str) -> str:
        """Return the path of a file that the file being read names, relative to that file.

        Raises InputError if it lies outside the folders that may be read.
        """
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
        """Yield the files that an <xacro:include> names, which may have a wildcard, as xacro does.

        ``name``: text with expressions, which are evaluated with ``symbols``. Raises
        InputError if a file lies outside the folders that may be read.
        """
        name = str(self._text(name, symbols))
        if not re.search(r'[*?[]', name):
            yield self._file(name)
            return
        # Folders outside are not listed either.
        fixed = re.split(r'[*?[]', name, maxsplit=1)[0]
        self._file(f'{os.path.dirname(fixed)}/.' if '/' in fixed else '.')
        for found in sorted(glob.glob(str(Path(_here()).parent / name))):
            yield self._file(found)

    def _parsed(self, given: Any, filename: str = '') -> Any:
        """Return the parsed XML of the file ``filename``, in place of xacro.parse.

        ``given``: argument of xacro.parse that is not used. Raises InputError if the file has a
        DOCTYPE or declares entities, or is unreadable, too large or not UTF-8; ExpatError if it is
        malformed XML; XacroException if there is no such file.
        """
        path = Path(filename)
        if not path.exists():
            # xacro's error, since it handles optional files.
            xacro.filestack.pop()
            raise xacro.XacroException(f'no such file: {path}', exc=FileNotFoundError())
        text = decode_text(read_limited(path, URDF_LIMIT, 'the description includes it'), path)
        # The keyword is case-sensitive in XML, so text without it cannot declare an entity.
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise InputError(f'{path}: it declares a DOCTYPE or entities; remove the declaration')
        return minidom.parseString(text)

    def _load_yaml(self, filename: str) -> Any:
        """Return the content of a YAML file; raise InputError if it may not or cannot be read."""
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
    """Return the path of the file that xacro is reading."""
    return str(xacro.filestack[-1])


def _refused(what: str, why: str) -> InputError:
    """Return the InputError for an expression or substitution (``what``) that is not supported."""
    return InputError(f'{_here()}: {what:.200}: {why}; correct it, or {_TRUST}')


def _converted(value: Any) -> Any:
    """Return an argument as a bool, number or text, as xacro does."""
    return substitution_args.convert_value(value, 'auto') if isinstance(value, str) else value


def _show(*given: Any, **_: Any) -> str:
    """Print a message of xacro to stderr; return ''."""
    print(*given, file=sys.stderr)
    return ''


def _fatal(*given: Any) -> None:
    """Raise InputError: xacro calls this to end the program."""
    raise InputError(f'{_here()}: {" ".join(map(str, given))}')


def _tokens(text: str, sep: str = ',; ', skip_empty: bool = True) -> list[str]:
    """Split a text at each character of `sep`; empty parts are dropped if `skip_empty`."""
    items = re.split(f'[{re.escape(sep)}]', text)
    return [item for item in items if item or not skip_empty]


def _line(path: Path, error: BaseException) -> str:
    """Return an error of an expansion as one line of text, with the file and the remedy.

    If the error, or one of its causes, is an InputError, its text unchanged.
    """
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
    """Expand a xacro file; print JSON with ``text``, or with ``error``, one line, to stdout.

    ``request``: that of `robot_description`. Limits the processor time, and unless the file is
    trusted the memory, of this process.
    """
    path, trusted = Path(request['file']), request['trusted']
    resource.setrlimit(resource.RLIMIT_CPU, (request['cpu_s'], request['cpu_s']))
    if not trusted:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        folders = [Path(folder) for folder in request['package_path']]
        # xacro prints messages for users.
        with contextlib.redirect_stdout(sys.stderr):
            named = [Path(file) for file in request['named']]
            expansion = Expansion(path, folders, named, trusted=trusted)
            text = expansion.text(request['arguments'])
        answer = {'text': text}
    # A xacro file is a program, which can raise any error.
    except Exception as error:
        answer = {'error': _line(path, error)}
    sys.stdout.write(json.dumps(answer))
