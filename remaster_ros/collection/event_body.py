"""What every state and event derives from."""

from __future__ import annotations

from typing import ClassVar

import msgspec


class Body(msgspec.Struct, frozen=True, tag_field='kind'):
    """What a record carries; ``kind`` names its type.

    Attributes
    ----------
    sender
        The name of the only node that may publish it; '' for any.
    """

    sender: ClassVar[str] = ''
