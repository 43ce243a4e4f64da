"""Files of one maker's own form, read into named columns: one file a maker, one function each."""

from __future__ import annotations

from collections.abc import Callable

from remaster_ros.importing.makers import (
    fanuc,
    gsi,
    inform,
    kuka,
    listed,
    motive,
    rapid,
    ros_echo,
    staubli,
    ur_script,
)
from remaster_ros.importing.makers.named import Named

# Each returns None where a text is not of its kind.
READERS: tuple[Callable[[str], Named | None], ...] = (
    motive.read,
    fanuc.read,
    kuka.read,
    inform.read,
    ur_script.read,
    # Before RAPID, whose logs have two lists in brackets.
    listed.read,
    rapid.read,
    staubli.read,
    gsi.read,
    ros_echo.read,
)
