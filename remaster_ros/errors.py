# SPDX-License-Identifier: Apache-2.0
"""The exceptions a caller may expect; each carries what is wrong and the remedy."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

_LONGEST = 1000
"""Characters of a message; what a stranger's file holds must not flood the terminal."""


class RemasterError(Exception):
    """Base of every error this package raises on purpose; ``str()`` is one line for a user.

    A line that quotes too much is shortened in its middle: the place stands at its beginning, the
    remedy at its end.
    """

    def __str__(self) -> str:
        """Return the line."""
        line = ' '.join(super().__str__().split())
        half = _LONGEST // 2
        return line if len(line) <= _LONGEST else f'{line[:half]} … {line[-half:]}'


class InputError(RemasterError):
    """Bad input or wrong usage: names the file, row, field or device, and the remedy."""


class DiskError(InputError):
    """A disk refuses to write or read, as for lack of room; it may go on once that is mended."""


class MovedError(DiskError):
    """A folder that is written to has been moved away; writing may go on once it is put back."""


class InsufficientDataError(RemasterError):
    """The data do not allow an answer; the message has the reason, and what to measure."""


class MisfitError(InsufficientDataError):
    """The data do not fit this robot, as the session describes it.

    Parameters
    ----------
    what
        What does not fit.
    remedy
        What to check, if no mistake is found that explains it.
    """

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(f'{what}; {remedy}')
        self.what, self.remedy = what, remedy

    def __reduce__(self) -> tuple[type[MisfitError], tuple[str, str]]:
        # A worker hands its errors on: made again from the line alone it would wait for ever.
        return type(self), (self.what, self.remedy)


class MistakeFoundError(InsufficientDataError):
    """The data do not fit this robot, and a mistake in the session's tables explains it.

    Parameters
    ----------
    sentence
        What does not fit, and what mends it.
    options
        Options of ``remaster import SESSION`` that mend it; '' if the data cannot tell which.
    """

    def __init__(self, sentence: str, options: str) -> None:
        super().__init__(sentence)
        self.options = options

    def __reduce__(self) -> tuple[type[MistakeFoundError], tuple[str, str]]:
        return type(self), (self.args[0], self.options)


class DeviceError(RemasterError):
    """A device does not answer, or answers wrongly; the message names it and the remedy."""


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return "; did you mean 'other'?" with the word of ``words`` that is most like ``word``.

    '' if none is like it (`difflib.get_close_matches` decides). Upper and lower case count as
    the same.
    """
    by_folded = {known.casefold(): known for known in words}
    close = get_close_matches(word.casefold(), by_folded, 1)
    return f'; did you mean {by_folded[close[0]]!r}?' if close else ''
