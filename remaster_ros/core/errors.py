"""The exceptions a caller may expect; each carries what is wrong and the remedy."""


class RemasterError(Exception):
    """Base of every error this package raises on purpose; ``str()`` is one line for a user."""


class InputError(RemasterError):
    """Bad input or wrong usage: names the file, row, field or device, and the remedy."""


class InsufficientDataError(RemasterError):
    """The data do not allow an answer; says why, and what to measure."""


class DeviceError(RemasterError):
    """A device does not answer, or answers what it must not; names the device and the remedy."""
