# SPDX-License-Identifier: Apache-2.0
"""The ``remaster`` command: runs a verb; errors become one line and an exit status."""

from __future__ import annotations

import argparse
import ctypes
import importlib
import keyword
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from shlex import quote

from remaster_ros.cli.options import Parser, integer
from remaster_ros.errors import InsufficientDataError, MistakeFoundError, RemasterError
from remaster_ros.version import __version__

# Each verb is the module of that name beside this one, imported only when it is used: SciPy and
# the rest take more than a second to load, and `remaster --help` needs none of it.
VERBS = {
    'demo': 'The whole pipeline on fake hardware: real nodes, real DDS, real sockets.',
    'init': 'Write a cell file for a robot (URDF or xacro), with what is proposed and why.',
    'import': "Make a session of anybody's table of joint angles and points, or of a ROS bag.",
    'plan': 'Plan the poses of a cell: counts, times, expected precision; nothing moves.',
    'simulate': 'Make a session from a known truth, which is written beside it.',
    'fit': 'Fit the zero-offsets of a session: fit.json, figures and report.html.',
    'discover': 'Find what the offsets leave, name the cause, extend the model, prove the gain.',
    'report': 'One page of fit and causes: what to do, what it brings, what remains.',
    'accuracy': 'Judge the zero-offsets of a fit on any session: the three metrics.',
    'compensate': 'Correct a table of joint targets by compensation.json, for a program.',
    'export': 'Write compensation.json in the form that a controller, a driver or tf takes.',
    'verify': 'Does a correction act, and not twice? What error remains? From ten new poses.',
    'check': 'Has an arm changed since its correction was measured? From eight poses, day by day.',
    'batch': 'Fit, discover and check many sessions: a row each, resumable, a page over all.',
    'recover': 'Finish the files of a session whose recorder was killed; print what was lost.',
    'watch': 'Show a collection under way on a local web page.',
    'replay': 'Make the rows of a session again from its bag, or publish the bag again (ROS).',
}
SHELLS = ('bash', 'zsh', 'fish')
TRACEBACK = 'REMASTER_TRACEBACK'
# M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of <malloc.h>; the largest that glibc takes of the latter.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3


def build_parser(chosen: str | None) -> argparse.ArgumentParser:
    """Return the parser with all verbs, and the options of the chosen one.

    ``chosen``: verb, whose module is imported; None, or an unknown word, for none.
    """
    parser = Parser(
        prog='remaster',
        description='Remaster a robot arm in place: joint zero-offsets with honest uncertainty.',
        epilog='Exit status: 0 done, 1 the data allow no answer, 2 wrong usage or bad input.',
    )
    parser.add_argument('--version', action='version', version=f'remaster {__version__}')
    parser.add_argument(
        '--completion',
        choices=SHELLS,
        help='print what completes this command in a shell: eval "$(remaster --completion bash)"',
    )
    verbs = parser.add_subparsers(dest='verb', metavar='VERB')
    for name, text in VERBS.items():
        verb = verbs.add_parser(name, help=text, description=text)
        if name != chosen:
            continue
        # A module cannot be named `import`.
        module_name = f'{name}_' if keyword.iskeyword(name) else name
        module = importlib.import_module(f'remaster_ros.cli.{module_name}')
        module.add_arguments(verb)
        verb.add_argument(
            '--seed', type=integer(0), default=0, help='seed of all randomness (default 0)'
        )
        verb.add_argument('--quiet', action='store_true', help='print nothing but errors')
        verb.add_argument('--no-figures', action='store_true', help='write no figures')
        verb.set_defaults(run=module.run)
    return parser


def _mending(args: argparse.Namespace, options: str) -> str:
    """Return the command line by which a person corrects the mistake in a session.

    It writes a copy of the session by ``remaster import`` with ``options``, which state the
    correction. For several sessions a sentence that tells to fit each by itself.
    """
    given = args.session if isinstance(args.session, list) else [args.session]
    if len(given) > 1:
        return 'fit each session by itself: the one with the mistake then names the command'
    session = str(given[0]).rstrip(os.sep)
    return f'remaster import {quote(session)} {options} --out {quote(f"{session}-mended")}'


def _keep_freed_memory() -> None:
    """Make the C library reuse freed memory instead of returning it to the kernel.

    Returning and allocating it again, with zeros in every page, would take a tenth of the time
    of a large session. Nothing if the C library has no mallopt.
    """
    c_library = ctypes.CDLL(None)
    # Of other systems' libraries none has it.
    if hasattr(c_library, 'mallopt'):
        c_library.mallopt(TRIM_THRESHOLD, 1 << 27)
        c_library.mallopt(MMAP_THRESHOLD, 1 << 25)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    ``argv``: without the program's name, None for that of the process. 0 done; 1 the data allow no
    answer; 2 wrong usage or bad input, or a fault; 130 after Ctrl-C, 141 if the reader of the
    output has gone. Errors are one line on stderr; wrong options raise SystemExit.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    # Products of small matrices in several threads take many times as long as in one: the threads
    # wait for each other at full speed. NumPy looks at this when it is first imported.
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    _keep_freed_memory()
    try:
        if '_ARGCOMPLETE' in os.environ:
            _complete()
        parser = build_parser(next(iter(argv), None))
        args = parser.parse_args(argv)
        if args.completion:
            import argcomplete

            print(argcomplete.shellcode(['remaster'], shell=args.completion))
            return 0
        if args.verb is None:
            parser.print_help()
            return 0
        logging.basicConfig(
            format='%(levelname)s: %(message)s',
            level=logging.ERROR if args.quiet else logging.WARNING,
        )
        if not os.environ.get(TRACEBACK):
            # NumPy warns of overflows; the error or verdict that follows has the reason.
            warnings.simplefilter('ignore', RuntimeWarning)
        status = args.run(args)
        # Here and not at exit, where it could not be caught: the reader may have gone.
        sys.stdout.flush()
        return status
    except MistakeFoundError as error:
        _complain(f'{error}; to mend it: {_mending(args, error.options)}')
        return 1
    except RemasterError as error:
        _complain(str(error))
        return 1 if isinstance(error, InsufficientDataError) else 2
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130
    except BrokenPipeError:
        # `remaster fit … | head` has seen enough. Nothing is left to flush into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        _complain(f'{error.filename}: {error.strerror}' if error.filename else str(error))
        return 2
    except Exception as error:
        if os.environ.get(TRACEBACK):
            traceback.print_exc()
        _complain(
            f'a fault of this program, please report it: {type(error).__name__}: {error} '
            f'(set {TRACEBACK}=1 to see where)'
        )
        return 2


def _complete() -> None:
    """Answer a shell that completes a command line (argcomplete), and exit."""
    # Imported here: it is only of use to a shell.
    import argcomplete

    words = os.environ.get('COMP_LINE', '').split()
    argcomplete.autocomplete(build_parser(next(iter(words[1:]), None)))


def _complain(message: str) -> None:
    """Print an error message as one line on stderr."""
    print(f'error: {" ".join(message.split())}', file=sys.stderr)


if __name__ == '__main__':
    sys.exit(main())
