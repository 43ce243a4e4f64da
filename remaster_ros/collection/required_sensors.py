"""Which sensors the arm waits for, and which of them are not there."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from remaster_ros.errors import InputError


class RequiredSensors:
    """The sensors of a cell that the arm waits for.

    Parameters
    ----------
    names
        All sensors of the cell.
    require
        ``all``, ``any`` (one of them is enough), or the name of one.

    Raises
    ------
    InputError
        `require` is none of these.

    Attributes
    ----------
    names
        The sensors that the arm waits for, or for one of them.
    any_of_them
        Whether one of them is enough.
    """

    def __init__(self, names: Iterable[str], require: str) -> None:
        known = tuple(names)
        if require not in ('all', 'any', *known):
            raise InputError(
                f'parameter require is {require!r}; it must be all, any or one of '
                f'{", ".join(known)}'
            )
        self.names = [name for name in known if require in ('all', 'any', name)]
        self.any_of_them = require == 'any'

    def missing(self, absent: Mapping[str, str]) -> str:
        """Return which sensors have to come back before the arm goes on, and why; ''.

        Parameters
        ----------
        absent
            The sensors that are not there, and why.
        """
        gone = [name for name in self.names if name in absent]
        if not gone or (self.any_of_them and len(gone) < len(self.names)):
            return ''
        return '; '.join(f'{name}: {absent[name]}' for name in gone)

    def are_among(self, found: Collection[str]) -> bool:
        """Whether what the arm waits for is among these sensors."""
        known = [name in found for name in self.names]
        return any(known) if self.any_of_them else all(known)
